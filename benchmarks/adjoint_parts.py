"""What the adjoint of the blend spends its time on: its kernel with parts left out, on one thread.

A variant's gradients are wrong; only its time counts. The processor overlaps what parts do, so shares need not add up.

    python benchmarks/adjoint_parts.py -m path/to/model -s path/to/scene [--out docs/benchmarks]
"""

import inspect
import statistics
import time
from unittest.mock import patch

import torch
import warp as wp
import work
from common import REPEATS, SCENE, TRAINED, load_model, parse, write_table

from warp_splat.config import RasterOptions
from warp_splat.kernels import falloff, step
from warp_splat.kernels.cpu import adjoint
from warp_splat.kernels.inline import defined
from warp_splat.kernels.simd import times, vec16
from warp_splat.raster.api import render
from warp_splat.raster.drivers import Driver
from warp_splat.runtime import launch
from warp_splat.scene import load_scene

falloff.EXP2[1] = (1.0, -0.5)
WHOLE, DIVISION = "nothing", "the division alpha / (1 - alpha)"
STEP = "    def step(k, splat, dx, dy, block, here, own, out, s, alphas):\n"
FINISH = "    def finish(k, splat, ahead, slots_out, s):\n"
CHANNELS = "in range(CHANNELS):\n            row"
WALK = (STEP, STEP + "        s[T + block] = dx + dy\n\n" + STEP.replace("step", "unused_step"))
NO_ROWS = (FINISH, FINISH + "        return False\n\n" + FINISH.replace("finish", "unused"))
#: What is left out, as changes of the kernel's text.
VARIANTS: dict[str, tuple] = {
    WHOLE: (),
    "the sum over 16 lanes, of each column of a row": (
        ("folded(s, SUMS + grad)", "s[SUMS + grad][0]"),
        ("eight[grad]", "s[SUMS + grad][0]"),
    ),
    "that, and rows of gradients": (NO_ROWS,),
    "sums in lanes, and their products": (
        ("range(CHANNEL):", "range(0):"),
        (CHANNELS, CHANNELS.replace("CHANNELS", "0")),
    ),
    "the exponential's polynomial, but one term": (("variant.falloff, vec16", "1, vec16"),),
    DIVISION: (),
    "all but the walk over blocks": (NO_ROWS, WALK),
}


@wp.func
def product(alpha: vec16):
    return times(alpha, alpha)


def make(changes: tuple):
    """What makes the kernel."""
    text = inspect.getsource(adjoint.make_reverse.__wrapped__)
    for before, after in changes:
        assert before in text, before
        text = text.replace(before, after)
    names = {**vars(adjoint), "make_reverse_step": step.make_reverse_step.__wrapped__}
    return defined("make_reverse", text, names)


def main() -> None:
    arguments = parse(__doc__, TRAINED, SCENE, REPEATS)
    launch.prepare("cpu", 1)
    model = load_model(arguments.models[0]).arranged()
    camera = load_scene(arguments.scene, eval=True).test[0].camera
    options, seconds, differentiate = RasterOptions(), {}, Driver.differentiate
    counts = work.count(model.activated(), camera, options)

    def timed(*given) -> None:
        start = time.process_time()
        differentiate(*given)
        seconds.setdefault(name, []).append(time.process_time() - start)

    kernels = {name: make(changes) for name, changes in VARIANTS.items()}
    with patch.object(Driver, "differentiate", timed):
        for _ in range(1 + arguments.repeats):  # the first one compiles
            for name, reverse in kernels.items():
                cheap = product if name == DIVISION else step.odds_of
                with patch.object(adjoint, "make_reverse", reverse), patch.object(step, "odds_of", cheap):
                    image = render(model.activated(), camera, torch.zeros(3), options).image
                    image.sum().backward()
    whole = statistics.median(seconds[WHOLE][1:])
    rows = []
    for name in VARIANTS:
        took = statistics.median(seconds[name][1:])
        rows.append((name, f"{1e3 * took:.1f}", "" if name == WHOLE else f"{100 * (1 - took / whole):.0f} %"))
    note = (
        f"Processor time, median of {arguments.repeats} rounds. {len(model)} Gaussians, {camera.width} x "
        f"{camera.height} px; {counts.pairs / 1e6:.1f}M pairs blended of {counts.by_adjoint / 1e6:.1f}M looked at."
    )
    write_table("adjoint_parts", arguments.out, ("left out", "ms", "saved"), rows, note)


if __name__ == "__main__":
    main()

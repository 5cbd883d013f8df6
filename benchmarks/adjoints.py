"""What does each way to differentiate the pixel loop cost? 100k Gaussians at 980 x 545, one and two threads.

Checks first that the modes agree, then times in one run, interleaved; prints and writes ratios to ``manual``.

    python benchmarks/adjoints.py [--out docs/benchmarks]
"""

import numpy as np
import torch
from blend import Lanes
from common import REPEATS, interleaved, parse, with_threads, write_table
from made_up import blend_scene

from warp_splat.compare.adjoints import peak_of
from warp_splat.config import ADJOINTS
from warp_splat.runtime import launch

MODES = (*ADJOINTS, "generated")


def main() -> None:
    arguments = parse(__doc__, REPEATS)
    launch.prepare("cpu", 0)
    scene = blend_scene()
    upstream = torch.from_numpy(np.random.default_rng(1).normal(size=(scene.height, scene.width, 3)).astype(np.float32))
    drivers = {mode: Lanes(scene, upstream, mode) for mode in MODES}
    memory, agreement = {}, {}
    for mode, driver in drivers.items():

        def both(driver=driver):
            driver.forward()
            driver.adjoint()

        both()
        memory[mode] = peak_of(both, torch.device("cpu"))
        first = drivers["manual"]
        differences = [(a - b).norm() / b.norm() for a, b in zip(driver.grads, first.grads, strict=True)]
        agreement[mode] = float(max(differences))
    if max(agreement.values()) > 1e-5:
        raise SystemExit(f"the modes disagree: {agreement}")

    runs = {
        (mode, kind, count): with_threads(count, getattr(driver, kind))
        for mode, driver in drivers.items()
        for count in (1, 2)
        for kind in ("forward", "adjoint")
    }
    medians = interleaved(runs, arguments.repeats)
    rows = [
        (
            mode,
            *(f"{1e3 * medians[mode, kind, count]:.1f}" for count in (1, 2) for kind in ("forward", "adjoint")),
            f"{medians[mode, 'adjoint', 1] / medians['manual', 'adjoint', 1]:.2f}",
            f"{medians[mode, 'adjoint', 2] / medians['manual', 'adjoint', 2]:.2f}",
            f"{memory[mode] / 2**20:.0f}",
            f"{agreement[mode]:.0e}",
        )
        for mode in MODES
    ]
    headers = (
        *("mode", "forward ms, 1 thread", "adjoint ms", "forward ms, 2 threads", "adjoint ms "),
        *("adjoint x manual, 1 thread", "2 threads", "peak MiB", "gradients differ by"),
    )
    note = f"{len(scene.splats)} Gaussians, {scene.width} x {scene.height} px, {len(scene.instances)} tile instances."
    data = {
        "seconds": {" ".join(map(str, key)): value for key, value in medians.items()},
        "peak_bytes": memory,
        "relative_difference": agreement,
    }
    write_table("adjoints", arguments.out, headers, rows, note, data)


if __name__ == "__main__":
    main()

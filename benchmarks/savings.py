"""What leaving out work saves in a training step: its time with the work and without, and what that changes.

On one workload in one run, on all cores: the photographs and model of `benchmarks/step.py` at full size, or 200,000
random Gaussians without -s. Each row compares the step as it is, or as an option makes it, with a step that does what
is left out then, in turns; times are medians. Rates are zero, so that every step does the same.

    python benchmarks/savings.py [-s path/to/fox --models output/fox] [--out docs/benchmarks]
"""

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import OpenImageIO as oiio
import torch
from common import interleaved, parse, using, write_table
from made_up import NEVER, steps_of
from step import GIVEN, synthetic, trained

from warp_splat.raster.api import render
from warp_splat.raster.data import Bins, Gaussians
from warp_splat.raster.drivers import CPU
from warp_splat.raster.project import project
from warp_splat.runtime import launch, pool
from warp_splat.scene.images import read_pixels
from warp_splat.training.trainer import Trainer

SYNTHETIC = (200_000, 980, 545)
ROUNDS, STEPS = 15, 2
GEOMETRY = ("means", "quats", "scales")
HEADERS = ("left out", "with it ms", "without ms", "saved", "what changes")


@dataclass
class Case:
    """Two ways to take a step: a context to do the work in, and one to leave it out in."""

    name: str
    work: Callable[[Trainer], AbstractContextManager]
    spared: Callable[[Trainer], AbstractContextManager] = lambda _: nullcontext()
    remark: str = ""  # in place of a comparison of images and gradients


def options(**changes) -> Callable[[Trainer], AbstractContextManager]:
    return lambda trainer: patch.object(trainer, "options", replace(trainer.options, **changes))


def config(**changes) -> Callable[[Trainer], AbstractContextManager]:
    @contextmanager
    def context(trainer: Trainer) -> Iterator[None]:
        changed = trainer.config.changed(**changes)
        with (
            patch.object(trainer, "config", changed),
            patch.object(trainer.optimizer, "options", changed.learn),
            patch.object(trainer.growth, "options", changed.plugins[changed.grow.growth]),
        ):
            yield

    return context


def white(trainer: Trainer) -> AbstractContextManager:
    return patch.object(trainer, "background", torch.ones(3))


def flat(interval: int) -> Callable[[Trainer], AbstractContextManager]:
    """No color that depends on the direction, at the degree that ``sh_interval`` leads to."""

    @contextmanager
    def context(trainer: Trainer) -> Iterator[None]:
        rest = trainer.model.parameters["sh_rest"]
        values = rest.detach().clone()
        rest.detach().zero_()
        trainer.degree = 0  # it never falls
        with config(sh_interval=interval)(trainer):
            yield
        rest.detach().copy_(values)

    return context


@contextmanager
def frozen(trainer: Trainer) -> Iterator[None]:
    leaves = [trainer.model.parameters[name] for name in GEOMETRY]
    for leaf in leaves:
        leaf.requires_grad_(False)
    yield
    for leaf in leaves:
        leaf.requires_grad_()


def every_block(_: Trainer) -> AbstractContextManager:
    """All blocks of a tile for each Gaussian that it lists."""

    def bin_wide(*arguments) -> Bins:
        bins = CPU.bin(*arguments)
        bins.splats.numpy()["extent"] = 1e9
        return bins

    return using(replace(CPU, bin=bin_wide))


def whole_lists(_: Trainer) -> AbstractContextManager:
    """The adjoint from the end of each tile's list, not from where its last pixel stopped."""

    def differentiate(mode, bins: Bins, chosen, saved, upstream, steps, slots, before) -> None:
        original(mode, bins, chosen, saved, upstream, bins.ranges[:, 1] - bins.ranges[:, 0], slots, before)

    original = CPU.differentiate
    return patch.object(CPU, "differentiate", differentiate)


CASES = (
    Case("SH degrees 1 to 3 while they are inactive, with their Adam", flat(1), flat(NEVER)),
    Case("a background that is black", white, remark="3 multiply-adds per pixel: no kernel of its own"),
    Case("depth, if not asked for", options(depth=True)),
    Case("frozen means, rotations, scales: Adam alone", lambda _: nullcontext(), frozen),
    Case("Adam for Gaussians not seen (sparse_adam)", lambda _: nullcontext(), config(optimizer_type="sparse_adam"),
         "another optimizer: no bias correction, no step by inertia"),
    Case("statistics, once nothing is densified any more", config(densify_until_iter=NEVER),
         config(densify_until_iter=0)),
    Case("tiles out of reach: the ellipse instead of the square", options(extent="square")),
    Case("blocks of 4 x 4 pixels out of reach", every_block),
    Case("what lies behind saturated pixels", options(t_min=0.0)),
    Case("the adjoint of instances that no pixel of the tile reached", whole_lists),
)  # fmt: skip


def time_in_turns(trainer: Trainer, case: Case) -> tuple[float, float]:
    """Seconds of a step with the work and without."""
    step = steps_of(trainer)
    found: tuple[list[float], list[float]] = ([], [])
    for number in range(-1, ROUNDS):
        for times, context in zip(found, (case.work, case.spared), strict=True):
            with context(trainer):
                step()  # the first after a change finds other things in the caches
                start = time.perf_counter()
                for _ in range(STEPS):
                    step()
                if number >= 0:
                    times.append((time.perf_counter() - start) / STEPS)
    return statistics.median(found[0]), statistics.median(found[1])


def outcome(trainer: Trainer, context: AbstractContextManager) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Image, and gradients by name."""
    with context:
        trainer.differentiate(10)
        grads = {name: leaf.grad for name, leaf in trainer.model.parameters.items() if leaf.grad is not None}
        trainer.optimizer.zero_grad()
        with torch.no_grad():
            chosen = replace(trainer.options, sh_degree=trainer.degree)
            camera = trainer.scene.train[0].camera
            image = render(trainer.model.activated(trainer.degree), camera, trainer.background, chosen).image
    return image, grads


def difference(trainer: Trainer, case: Case) -> str:
    """Between the images, and between the gradients that both ways give."""
    if case.remark:
        return case.remark
    image, grads = outcome(trainer, case.work(trainer))
    other, others = outcome(trainer, case.spared(trainer))
    shared = [(grads[name], others[name]) for name in grads.keys() & others.keys()]
    pixels = "same image" if torch.equal(image, other) else f"image {(image - other).abs().max():.0e} at most"
    if all(torch.equal(*pair) for pair in shared):
        return f"{pixels}, same gradients"
    worst = max(float((one - two).norm() / one.norm()) for one, two in shared)
    return f"{pixels}, gradients {worst:.0e} relative"


def measure_projection(trainer: Trainer) -> list[str]:
    """Projection and its adjoint, against as many Gaussians that are all seen: copies of those that are."""
    camera, chosen = trainer.scene.train[0].camera, trainer.options
    everything = Gaussians(*(tensor.detach() for tensor in trainer.model.activated()))
    seen = (project(everything, camera, chosen).radii > 0).nonzero()[:, 0]
    count = len(everything.means)
    copied = seen.repeat(-(-count // len(seen)))[:count].sort().values

    def run(rows: torch.Tensor) -> Callable[[], object]:
        gaussians = Gaussians(*(tensor[rows].requires_grad_() for tensor in everything))

        def once() -> None:
            out = project(gaussians, camera, chosen)[:5]  # what has gradients
            torch.autograd.grad(out, gaussians, [torch.ones_like(tensor) for tensor in out])

        return once

    found = interleaved({"work": run(copied), "spared": run(torch.arange(count))}, ROUNDS * STEPS)
    name = f"projection and adjoint of the {100 - 100 * len(seen) / count:.0f} % of Gaussians not seen (alone)"
    return row_of(name, **found, change="same image, same gradients")


def measure_decoding(trainer: Trainer) -> list[str]:
    """A photograph from a JPEG file in every step, against all of them once before the first."""
    step = steps_of(trainer)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "photograph.jpg"
        oiio.ImageBuf(np.ascontiguousarray(trainer.scene.train[0].image)).write(str(path))

        def decoding() -> None:
            np.rint(255.0 * read_pixels(path, 0.0).color).astype(np.uint8)
            step()

        found = interleaved({"work": decoding, "spared": step}, ROUNDS * STEPS)
    return row_of("decoding the photograph in the step", **found, change="same image, same gradients")


def row_of(name: str, work: float, spared: float, change: str) -> list[str]:
    return [name, f"{1e3 * work:.2f}", f"{1e3 * spared:.2f}", f"{100 * (1 - spared / work):.0f} %", change]


def main() -> None:
    arguments = parse(__doc__, *GIVEN)
    launch.prepare("cpu", 0)
    if arguments.scene:
        trainer = trained(arguments.scene, arguments.models, "full")
    else:
        trainer = synthetic(*SYNTHETIC)
    trainer.deck.views = trainer.scene.train[:1]
    rows = [row_of(case.name, *time_in_turns(trainer, case), difference(trainer, case)) for case in CASES]
    rows += [measure_projection(trainer), measure_decoding(trainer)]
    camera = trainer.scene.train[0].camera
    note = (
        f"{len(trainer.model)} Gaussians at {camera.width} x {camera.height} px, {pool.get_threads()} threads; "
        "times of a whole training step, if nothing else is said. The SH degree is an argument of the kernels: when it "
        "rises, nothing is compiled."
    )
    data = [dict(zip(HEADERS, row, strict=True)) for row in rows]
    write_table("savings", arguments.out, HEADERS, rows, note, {"rows": data})


if __name__ == "__main__":
    main()

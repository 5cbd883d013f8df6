"""Cameras that find their way back, and what their gradients cost.

A camera looks at random Gaussians in a cube of 1 m. It is then moved by 5 degrees, 10 cm and 5 % of its focal lengths,
and follows the gradients of its pose and of fx and fy until it sees the picture that the renderer drew first.

    python benchmarks/cameras.py [--out docs/benchmarks]
"""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from common import parse, write_table
from made_up import steps_of
from step import synthetic

from warp_splat import Camera, CameraParameters, Lens, rasterize
from warp_splat.evaluation.report import BLUE, ORANGE, new_panels, plain_axes, save_figure
from warp_splat.runtime import launch, timers
from warp_splat.training.trainer import Trainer

SEEDS, STEPS = 10, 400
SIZE = 96  # px
SHOWN = {
    "degrees": ("direction [degrees]", 0.05),
    "meters": ("place [m]", 1e-3),
    "share": ("focal length [share]", 1e-3),
}
COLUMNS = {
    "camera": "{name}",
    "step ms": lambda price: f"{1e3 * price['step']:.1f}",
    "what learning it adds ms": lambda price: f"{1e3 * price['added']:.2f}",
}
COUNT, ROUNDS = 194_000, 30  # of the steps whose price is measured
LEVELS = (1, 2, 4, 8, 16)  # px, boxes over which pictures are averaged before they are compared
RATE, LAST_RATE = 1e-2, 1e-4  # of Adam: radians, meters, share of the focal length
LENS = Lens("OPENCV", (0.12, -0.05, 0.004, -0.006))
PRICED = {"pinhole": (None, "affine"), "OPENCV": (LENS, "affine"), "OPENCV, unscented": (LENS, "unscented")}
LENS_UNITS = (0.1, 0.1, 0.01, 0.01)  # of its coefficients
LENS_STEPS, LENS_WANTED = 30, 0.05  # px
ANGLE, SHIFT, ZOOM = np.radians(5.0), 0.1, 1.05


def cube(seed: int, count: int = 400) -> list[torch.Tensor]:
    """Means, quaternions, scales, opacities and SH of degree 1 of random Gaussians in a cube of 1 m."""
    generator = torch.Generator().manual_seed(seed)
    normal, uniform = (
        lambda *shape, make=make: make(*shape, generator=generator) for make in (torch.randn, torch.rand)
    )
    scales = 0.02 + 0.06 * uniform(count, 3)
    return [uniform(count, 3) - 0.5, normal(count, 4), scales, 0.2 + 0.7 * uniform(count), normal(count, 4, 3) * 0.5]


def direction(generator: np.random.Generator, length: float) -> np.ndarray:
    vector = generator.normal(size=3)
    return length * vector / np.linalg.norm(vector)


def looking() -> Camera:
    """From 1.5 m at the middle of the cube."""
    return Camera(SIZE, SIZE, 1.2 * SIZE, 1.2 * SIZE, SIZE / 2, SIZE / 2, np.eye(3), np.array([0.0, 0.0, 1.5]))


def recover(seed: int, steps: int = STEPS) -> list[tuple[float, float, float]]:
    """Before every step and at last: :func:`distance` from where the picture was drawn."""
    generator, gaussians, right = np.random.default_rng(seed), cube(seed), looking()
    with torch.no_grad():
        target = rasterize(*gaussians, right).image
    wrong = np.concatenate([direction(generator, ANGLE), direction(generator, SHIFT)])
    numbers = torch.tensor([*wrong, np.log(ZOOM), np.log(ZOOM)], requires_grad=True)
    middle = torch.tensor([right.cx, right.cy])

    def learned() -> CameraParameters:
        focal = torch.tensor([right.fx, right.fy]) * numbers[6:].exp()
        return CameraParameters(right, numbers[:6], torch.cat([focal, middle]))

    def loss() -> torch.Tensor:
        return compared(rasterize(*gaussians, learned()).image, target)

    errors = descend(numbers, loss, lambda: distance(learned().camera, right), steps, RATE, LAST_RATE)
    return [*errors, distance(learned().camera, right)]


def descend(
    numbers: torch.Tensor, loss: Callable, watched: Callable, steps: int, rate: float, last: float, kept=1.0
) -> list:
    """What is ``watched`` before each of the steps of Adam, from one rate to another, with a share of the gradient."""
    adam, found = torch.optim.Adam([numbers], rate, betas=(0.9, 0.9)), []
    scheduler = torch.optim.lr_scheduler.ExponentialLR(adam, (last / rate) ** (1 / steps))
    for _ in range(steps):
        found.append(watched())
        adam.zero_grad()
        loss().backward()
        numbers.grad *= kept
        adam.step()
        scheduler.step()
    return found


def compared(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Mean squares of the differences, averaged over boxes of several sizes; summed."""
    difference = (image - target).permute(2, 0, 1)
    pooled = [torch.nn.functional.avg_pool2d(difference, level) for level in LEVELS]
    return torch.stack([picture.square().mean() for picture in pooled]).sum()


def recover_lens(seed: int, steps: int = LENS_STEPS) -> list[float]:
    """Before every step and at last: by how many pixels the coefficients are off, at most; first there are none."""
    gaussians, right = cube(seed), replace(looking(), lens=LENS)
    with torch.no_grad():
        target = rasterize(*gaussians, right).image
    numbers = torch.zeros(len(LENS_UNITS), dtype=torch.float64, requires_grad=True)
    newton = torch.optim.LBFGS([numbers], max_iter=1, line_search_fn="strong_wolfe")
    still = torch.zeros(6), torch.tensor([right.fx, right.fy, right.cx, right.cy])
    rays, errors = right.rays(np.stack(np.meshgrid(*2 * [np.linspace(0, SIZE, 9)]), -1).reshape(-1, 2)), []

    def learned() -> CameraParameters:
        return CameraParameters(right, *still, coefficients=numbers * torch.tensor(LENS_UNITS))

    def loss() -> torch.Tensor:
        newton.zero_grad()
        found = compared(rasterize(*gaussians, learned()).image, target)
        found.backward()
        return found

    for _ in range(steps):
        errors.append(float(np.abs(learned().camera.pixels(rays) - right.pixels(rays)).max()))
        newton.step(loss)
    return [*errors, float(np.abs(learned().camera.pixels(rays) - right.pixels(rays)).max())]


def distance(camera: Camera, right: Camera) -> tuple[float, float, float]:
    """In degrees, in meters, and the larger error of the two focal lengths as a share."""
    turn = camera.rotation @ right.rotation.T
    sine = np.linalg.norm([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    focal = max(abs(camera.fx / right.fx - 1), abs(camera.fy / right.fy - 1))
    return float(np.degrees(np.arcsin(sine))), float(np.linalg.norm(camera.center - right.center)), focal


def measure_price(trainer: Trainer, lens: Lens | None, projection: str) -> dict[str, float]:
    """Processor seconds of a training step, and what a camera that learns adds to its projection, both ways.

    In turns, the least of each: what is added is less than the noise of a whole step. Learned are pose and intrinsics,
    and the coefficients of ``lens``, if there is one.
    """
    trainer.options = replace(trainer.options, projection=projection)
    step, through = steps_of(trainer), Trainer._through

    def still(self, name, value, *rest):
        return replace(value, lens=lens) if name == "camera" else through(self, name, value, *rest)

    def learning(self, name, value, *rest):
        found = still(self, name, value, *rest)
        coefficients = torch.tensor(lens.coefficients, requires_grad=True) if lens else None
        return CameraParameters(found, coefficients=coefficients) if name == "camera" else found

    whole, projecting = [], {still: [], learning: []}
    for _ in range(ROUNDS):
        for change, seconds in projecting.items():
            clock = patch.object(timers, "_now", time.process_time)
            with patch.object(Trainer, "_through", change), clock, timers.profile() as stages:
                start = time.process_time()
                step()
                if change is still:
                    whole.append(time.process_time() - start)
                seconds.append(stages["project"] + stages["adjoint of project"])
    return {"step": min(whole), "added": min(projecting[learning]) - min(projecting[still])}


def plot(runs: list[list[tuple[float, float, float]]], path: Path) -> None:
    """Errors over steps, a panel for each, and what was asked for."""
    figure, panels = new_panels(2.8, columns=len(SHOWN))
    for column, (axes, (title, wanted)) in enumerate(zip(panels[0], SHOWN.values(), strict=True)):
        for run in runs:
            axes.semilogy([errors[column] for errors in run], color=BLUE, linewidth=0.8)
        axes.axhline(wanted, color=ORANGE)
        plain_axes(axes, title, "steps")
    save_figure(figure, path)


def main() -> None:
    arguments = parse(__doc__)
    launch.prepare("cpu", 1)
    runs = [recover(seed) for seed in range(SEEDS)]
    wanted = [wanted for _, wanted in SHOWN.values()]
    reached = [1 + max(n for n, found in enumerate(run) if not np.all(np.less(found, wanted))) for run in runs]
    lost = [seed for seed, steps in enumerate(reached) if steps > STEPS]
    if lost:
        raise SystemExit(f"Of seeds 0 to {SEEDS - 1}, these did not come back within {STEPS} steps: {lost}.")
    lenses = [recover_lens(seed)[-1] for seed in range(SEEDS)]
    if max(lenses) > LENS_WANTED:
        raise SystemExit(f"A lens came back but for {max(lenses):.2g} px, expected at most {LENS_WANTED}: {lenses}.")
    trainer = synthetic(COUNT, 980, 545)
    prices = {name: measure_price(trainer, *changed) for name, changed in PRICED.items()}
    last = {name: [run[-1][column] for run in runs] for column, name in enumerate(SHOWN)}
    data = {"last": last, "reached": reached, "lenses": lenses, "prices": prices}
    note = f"Processor time on one thread; {COUNT} Gaussians, 980 x 545 px. Learned: pose, intrinsics, coefficients."
    if arguments.out:
        plot(runs, arguments.out / "cameras.png")
    write_table(
        "cameras", arguments.out, COLUMNS, [{"name": name} | price for name, price in prices.items()], note, data
    )


if __name__ == "__main__":
    main()

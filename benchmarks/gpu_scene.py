"""A scene without files, of any number of Gaussians, trainers on it or another, and a clock for either device."""

import math
import statistics
import time
from collections.abc import Callable, Sequence

import numpy as np
import torch

from warp_splat.camera import Camera
from warp_splat.gaussians import GaussianModel
from warp_splat.rendering.camera_paths import ORBIT_RADIUS, ORBIT_SIZE, origin_orbit
from warp_splat.scene.types import Scene, View
from warp_splat.training.options import TrainConfig
from warp_splat.training.trainer import Trainer

RADIUS = 4.0  # world units, of the ball that the Gaussians fill; the orbit lies outside
VIEWS = 8
NEVER = 10**9


def make_gaussians(count: int, device: str) -> GaussianModel:
    """Random Gaussians of SH degree 3 in a ball, the smaller the more there are, and arranged, as in training.

    At 100,000 their standard deviation is 2 px seen from the orbit; the scale falls with the cube root of the count.
    """
    generator = torch.Generator(device).manual_seed(0)
    normal = lambda *shape: torch.randn(*shape, generator=generator, device=device)  # noqa: E731
    uniform = torch.rand(count, 1, generator=generator, device=device)
    pixel = ORBIT_RADIUS / cameras(ORBIT_SIZE[0], ORBIT_SIZE[1], 1)[0].fx * (100_000 / count) ** (1 / 3)
    return GaussianModel(
        {
            "means": RADIUS * uniform ** (1 / 3) * torch.nn.functional.normalize(normal(count, 3), dim=1),
            "sh_dc": normal(count, 1, 3),
            "sh_rest": 0.1 * normal(count, 15, 3),
            "opacities": 2.0 * normal(count),
            "scales": 0.3 + 0.8 * normal(count, 3) + math.log(pixel),
            "quats": normal(count, 4),
        }
    ).arranged()


def cameras(width: int, height: int, count: int) -> list[Camera]:
    """On the orbit of ``warp-splat render``, for images of another size."""
    return [camera.resized(width, height) for camera in origin_orbit(count)]


def make_scene(width: int, height: int, kinds: Sequence[str] = ()) -> Scene:
    """VIEWS photographs of noise, from the orbit; see :func:`make_trainer`."""
    rng = np.random.default_rng(0)
    views = []
    for index, camera in enumerate(cameras(width, height, VIEWS)):
        image = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
        if "linear" in kinds:
            image = np.divide(image, 255, dtype=np.float32)
        alpha, mask = (np.ones((height, width), np.uint8) if k in kinds else None for k in ("composited", "masked"))
        views.append(View(f"{index}", camera, image, camera, alpha, mask))
    return Scene(views, [], np.eye(4, 3, dtype=np.float32), np.zeros((4, 3), np.uint8))


def make_trainer(count: int, width: int, height: int, device: str, kinds: Sequence[str] = ()) -> Trainer:
    """:func:`trainer_on` the scene and ``count`` random Gaussians.

    Its photographs may be "masked", in "linear" light, and "composited" on random backgrounds.
    """
    options = {"random_background": True} if "composited" in kinds else {}
    return trainer_on(make_scene(width, height, kinds), make_gaussians(count, device), device, **options)


def trainer_on(scene: Scene, gaussians: GaussianModel, device: str, **options) -> Trainer:
    """A trainer of ``gaussians`` at the highest degree, which watches their gradients but does not densify."""
    never = {"densify_from_iter": NEVER, "densify_until_iter": NEVER, "opacity_reset_interval": NEVER}
    trainer = Trainer(scene, TrainConfig(device=device, data_device=device, **{"sh_interval": 1, **never, **options}))
    nobody = torch.empty(0, dtype=torch.int64, device=trainer.device)
    added = {name: tensor.detach() for name, tensor in gaussians.parameters.items()}
    trainer.optimizer.replace(nobody, added)
    trainer.growth.clear()
    return trainer


def steps_of(trainer: Trainer) -> Callable[[], None]:
    """What takes one step after another."""
    iterations = iter(range(10, NEVER))

    def step() -> None:
        iteration = next(iterations)
        trainer.differentiate(iteration)
        trainer.update(iteration)

    return step


def milliseconds(run: Callable[[], object], device: str, repeats: int) -> float:
    """Median after a warm-up, by CUDA events (by the clock on a CPU)."""
    times = []
    for repeat in range(-2, repeats):
        if device == "cuda":
            start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            start.record()
            run()
            end.record()
            torch.cuda.synchronize()
            elapsed = start.elapsed_time(end)
        else:
            begun = time.perf_counter()
            run()
            elapsed = 1e3 * (time.perf_counter() - begun)
        if repeat >= 0:
            times.append(elapsed)
    return statistics.median(times)


def synchronize(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()

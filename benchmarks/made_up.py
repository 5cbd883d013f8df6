"""Scenes made up: Gaussians in a ball, photographs of noise, trainers on these or others; splats for blends alone."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch

from warp_splat.camera import Camera
from warp_splat.config import ALPHA_MIN, TILE
from warp_splat.gaussians import GaussianModel
from warp_splat.kernels.splat import Splat2D
from warp_splat.presets import EMBEDDED_DEFAULTS, PRESETS
from warp_splat.rendering.camera_paths import ORBIT_RADIUS, ORBIT_SIZE, origin_orbit
from warp_splat.scene.types import Decoded, Scene, View
from warp_splat.training.options import TrainConfig
from warp_splat.training.trainer import Trainer

RADIUS = 4.0  # world units, of the ball that the Gaussians fill; the orbit lies outside
VIEWS = 8
GROWN = 1.08  # logarithm
NEVER = 10**9
LN_2 = np.log(2.0)


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


def make_crowd(count: int, device: str) -> GaussianModel:
    """Those, larger and more opaque, so that pixels stop early; a hundred of them fill the screen.

    At a million and 1920 x 1080 px there are 8 million tile instances.
    """
    model = make_gaussians(count, device)
    with torch.no_grad():
        model.parameters["scales"] += GROWN
        model.parameters["opacities"] += 2.0
        model.parameters["scales"][:: -(-count // 100)] = math.log(RADIUS)
        model.parameters["opacities"][:: -(-count // 100)] = -3.0  # faint: what is behind is drawn, too
    return model


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
        views.append(View(f"{index}", camera, Decoded(image, alpha, mask), camera))
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


def short_trainer(scene: Scene, steps: int, options: dict) -> Trainer:
    """By ``--preset fast`` of the embedded scene, its schedule shrunk to so many steps."""
    values = {**EMBEDDED_DEFAULTS[""], **PRESETS["fast"], **EMBEDDED_DEFAULTS["fast"]}
    whole = values["iterations"]
    for name, value in values.items():
        if type(value) is int and name.endswith(("iterations", "_steps", "_iter", "sh_interval")):
            values[name] = value * steps // whole
    return Trainer(scene, TrainConfig(**values | {"device": "cpu"} | options))


def take_steps(trainer: Trainer, steps: int) -> None:
    """All but the last update: a set that was changed a moment ago is unsettled."""
    for iteration in range(1, steps + 1):
        trainer.advance(iteration)


class BlendScene(NamedTuple):
    """Random screen-space Gaussians, binned by their 3-sigma square, front to back: V of them, M instances, T tiles."""

    width: int
    height: int
    tiles_x: int
    splats: np.ndarray  # [V] Splat2D
    ranges: np.ndarray  # [T, 2] int32, first and last instance
    instances: np.ndarray  # [M] int32, splats
    places: np.ndarray  # [M] int32, where in ``instances``, splat by splat
    place_begins: np.ndarray  # [V] int32


def blend_scene(count: int = 100_000, width: int = 980, height: int = 545, seed: int = 0) -> BlendScene:
    """Log-normal sizes around 2 px, any orientation, logistic-normal opacities: 1.14M instances at the default size."""
    rng = np.random.default_rng(seed)
    mean = np.stack([rng.uniform(0, width, count), rng.uniform(0, height, count)], 1)
    sigma = [np.exp(rng.normal(0.7, 1.0, count)).clip(0.55, 60) for _ in range(2)]
    angle = rng.uniform(0, np.pi, count)
    c, s = np.cos(angle), np.sin(angle)
    xx, yy = ((a * sigma[0]) ** 2 + (b * sigma[1]) ** 2 for a, b in ((c, s), (s, c)))
    xy = c * s * (sigma[0] ** 2 - sigma[1] ** 2)
    det = xx * yy - xy * xy
    opacity = 1 / (1 + np.exp(-rng.normal(0, 2, count)))
    color = rng.uniform(0, 1, (count, 3))
    order = np.argsort(rng.uniform(1, 10, count))  # by depth
    reach = 2 * np.log(np.maximum(opacity / ALPHA_MIN, 1.0001))
    splats = np.zeros(count, dtype=Splat2D.numpy_dtype())
    splats["mean"], splats["opacity"], splats["color"], splats["depth"] = mean, opacity, color, 1.0
    splats["extent"] = np.sqrt(reach[:, None] * np.stack([xx, yy], 1))
    splats["root"] = np.stack([yy, -xy, np.sqrt(det)], 1) / np.sqrt(2 * LN_2 * det * yy)[:, None]
    return _bin(splats[order], np.ceil(3 * np.maximum(*sigma))[order], width, height)


def _bin(splats: np.ndarray, radius: np.ndarray, width: int, height: int) -> BlendScene:
    tiles = np.array([-(-width // TILE), -(-height // TILE)])
    low = np.clip((splats["mean"] - radius[:, None]) // TILE, 0, tiles).astype(np.int64)
    high = np.clip((splats["mean"] + radius[:, None] + TILE - 1) // TILE, 0, tiles).astype(np.int64)
    counts = np.prod(high - low, axis=1)
    splat = np.repeat(np.arange(len(splats)), counts)
    local = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    across = np.repeat(high[:, 0] - low[:, 0], counts)
    tile = (low[splat, 1] + local // across) * tiles[0] + low[splat, 0] + local % across
    order = np.argsort(tile, kind="stable")  # splats are in depth order already
    ends = np.searchsorted(tile[order], np.arange(tiles.prod()), "right")
    ranges = np.stack([np.concatenate([[0], ends[:-1]]), ends], 1)
    places = np.argsort(order)
    lists = (table.astype(np.int32) for table in (ranges, splat[order], places, np.cumsum(counts) - counts))
    return BlendScene(width, height, int(tiles[0]), splats, *lists)

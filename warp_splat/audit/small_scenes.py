"""Small scenes with answers that are known, and those of the catalog of stiff cases that anyone could draw."""

import re
from collections.abc import Callable
from functools import cache, partial

import numpy as np
import torch

from warp_splat.camera import Camera
from warp_splat.compare.scenes import at_pixels, cloud, look, make_camera, tensors
from warp_splat.compare.stability import pixel_loop, shapes
from warp_splat.compare.stability.verdict import Problem, activated
from warp_splat.compare.workloads import Workload, in_training
from warp_splat.config import RasterOptions
from warp_splat.formats.stored import SH_C0
from warp_splat.raster.data import Gaussians
from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene

SIZE = (64, 48)  # px
NEAR, FAR, RED, BLUE = (28, 22), (36, 26), (0.9, 0.2, 0.1), (0.1, 0.3, 0.9)  # places [px] and colors of two
REPEATED = ("cloud", "layers_4000")  # drawn ten times by slow ones, too: an order of threads shows here
#: Parts of names in the catalog: what only this package promises (a count, a decision of float32, an outline, a ratio),
#: or pictures of 20,000 px.
OURS = re.compile("log_scales|scales_1e38|not_finite|near_plane|quats_1e-42|size_|ellipsoid|antialiased")

Drawn = tuple[dict[str, torch.Tensor], Camera]


def balls(camera: Camera, pixels, depth, sigma, opacity, color) -> dict[str, np.ndarray]:
    """Round Gaussians of one color from all sides, at ``pixels`` [N, 2]; the others are numbers or one for each."""
    pixels = np.asarray(pixels, np.float64)
    spread = lambda value, *shape: np.broadcast_to(np.asarray(value, np.float64), (len(pixels), *shape))  # noqa: E731
    depth = spread(depth)
    return {
        "means": at_pixels(pixels, depth, camera),
        "quats": spread([1.0, 0, 0, 0], 4),
        "scales": spread((spread(sigma) * np.abs(depth) / camera.fx)[:, None], 3),
        "opacities": spread(opacity),
        "sh_dc": ((spread(color, 3) - 0.5) / SH_C0)[:, None],
        "sh_rest": np.zeros((len(pixels), 0, 3)),
    }


def _balls(*given) -> Drawn:
    camera = make_camera(*SIZE)
    return tensors(balls(camera, *given)), camera


def _many(camera: Camera, seed: int, count: int = 60, **ranges) -> Drawn:
    return tensors(cloud(seed, count, camera, **ranges)), camera


def _band(degree: int) -> Drawn:
    """Colors of one band of harmonics alone."""
    drawn, camera = _many(make_camera(*SIZE), 50 + degree, 40)
    count, coefficients = len(drawn["means"]), (degree + 1) ** 2
    rest = torch.zeros(count, 15, 3)
    if degree:
        drawn["sh_dc"].zero_()
        generator = torch.Generator().manual_seed(degree)
        rest[:, degree**2 - 1 : coefficients - 1] = torch.randn(count, 2 * degree + 1, 3, generator=generator) * 0.3
    return drawn | {"sh_rest": rest}, camera


def _hair() -> Drawn:
    """Centers outside the picture by a hair, and by a few pixels, on all sides."""
    off = np.repeat([0.01, 1.0, 6.0, 20.0], 6)
    along, side = np.linspace(0.1, 0.9, 24), np.arange(24) % 4
    x = np.choose(side, [-off, SIZE[0] + off, SIZE[0] * along, SIZE[0] * along])
    y = np.choose(side, [SIZE[1] * along, SIZE[1] * along, -off, SIZE[1] + off])
    colors = np.random.default_rng(3).uniform(0.2, 1, (24, 3))
    return _balls(np.stack([x, y], 1), np.linspace(2, 5, 24), 7.0, 0.6, colors)


@cache
def _trained() -> Drawn:
    """After 300 steps with pictures of 64 px, seen in a view that was held out, at half their size."""
    scene = load_scene(embedded_scene(), resolution=SIZE[0], eval=True, report=lambda *_: None)
    last = in_training("trained", scene, torch.device("cpu"), lambda *_: None)[-1]
    return last.gaussians._asdict(), last.camera.resized(32, 30)


def _of(problem: Callable[[], Problem]) -> Drawn:
    found = problem()
    return activated(found, found.gaussians)._asdict(), found.camera


#: What each scene shows, and how it is made.
SCENES: dict[str, tuple[str, Callable[[], Drawn]]] = {
    "one": ("one round Gaussian", lambda: _balls([[30.2, 25.6]], 3, 5, 0.8, [0.9, 0.5, 0.2])),
    "two": ("two Gaussians, the nearer first in the file", lambda: _balls([NEAR, FAR], [3, 4], 6, 0.7, [RED, BLUE])),
    "two_exchanged": ("the same, the nearer last", lambda: _balls([FAR, NEAR], [4, 3], 6, 0.7, [BLUE, RED])),
    "cloud": ("60 ordinary Gaussians", lambda: _many(make_camera(*SIZE), 1)),
    "opaque": ("nearly opaque Gaussians", lambda: _many(make_camera(*SIZE), 2, opacity=(0.97, 0.999))),
    "faint": ("faint Gaussians, around 1/255", lambda: _many(make_camera(*SIZE), 3, 200, opacity=(0.002, 0.02))),
    "small": ("Gaussians smaller than a pixel", lambda: _many(make_camera(*SIZE), 4, 200, sigma=(0.05, 0.6))),
    "hair": ("centers outside the picture by a hair", _hair),
    "layers_4000": ("4,000 layers in one tile", lambda: _many(look(16, 12), 5, 4000, opacity=(0.005, 0.02))),
    "far_1e4": ("means and camera 1e4 from the origin", lambda: _many(make_camera(*SIZE, center=(1e4, -1e4, 1e4)), 6)),
    "principal": ("a principal point a third beside the middle", lambda: _many(make_camera(*SIZE, cx=11, cy=38), 7)),
    "anisotropic": ("focal lengths of 50 and 90 px", lambda: _many(make_camera(*SIZE, 50, 90), 8)),
    **{f"band_{degree}": (f"harmonics of degree {degree} alone", partial(_band, degree)) for degree in range(4)},
    "near": (
        "depths of 0.19 and 0.21, around a near plane of 0.2",
        lambda: _of(lambda: shapes.at_depths(np.tile([0.19, 0.21], 15), opacity=(0.01, 0.1))),
    ),
    "trained": ("the embedded scene after 300 steps of training", _trained),
    "opacity_1": ("opacities of 1", lambda: _of(pixel_loop.opacity_one)),
    "logits_100": ("opacities of 0 and 1 among others", lambda: _of(pixel_loop.logits)),
    "tile_100000": ("100,000 small Gaussians in one tile", lambda: _of(pixel_loop.tile)),
}
for cases in shapes.TABLE.values():
    SCENES |= {name: (claim, partial(_of, build)) for name, (claim, build) in cases.items() if not OURS.search(name)}


def on_all_pixels(name: str, drawn: Drawn, background=(0.0, 0.0, 0.0), degree: int = 3, **rules) -> Workload:
    """All pixels of what a builder made, its harmonics cut at ``degree``; ``rules`` are options of the renderer."""
    arrays, camera = drawn
    arrays = arrays | {"sh_rest": arrays["sh_rest"][:, : (degree + 1) ** 2 - 1]}
    gaussians = Gaussians(**{field: arrays[field] for field in Gaussians._fields})
    pixels = torch.cartesian_prod(torch.arange(camera.height), torch.arange(camera.width))
    return Workload(name, gaussians, camera, torch.tensor(background), RasterOptions(**rules), pixels)

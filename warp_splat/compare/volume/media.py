"""Media, scenes and integrators that the comparison with physics measures."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from warp_splat.camera import Camera
from warp_splat.compare.scenes import make_camera
from warp_splat.compare.volume import light as physics
from warp_splat.compare.volume.light import Volume
from warp_splat.evaluation.report import BLUE, GREEN, ORANGE

#: name: (integrator, evaluations of the medium per step, largest stable tau ds in theory, color, marker)
METHODS = {
    "exponential": (physics.integrate_exponential, 1, np.inf, BLUE, "o"),
    "Euler": (physics.integrate_euler, 1, 2.0, ORANGE, "s"),
    "RK4": (physics.integrate_rk4, 2, 2.785293563405282, GREEN, "^"),
}
RAYS = 64
FAR = 20.0  # world units; the media of the integrators lie between 0 and here
OPTICAL_DEPTHS = (1e-2, 1.0, 1e2, 1e4, 1e6)
SAMPLES = [2**k for k in range(3, 13)]
REPEATS = 5
UNSTABLE = 1.0  # an error as large as the whole range of color, or one that is no number
LIMIT_DEPTHS = (1e2, 1e3, 1e4)  # media in which the largest stable step is sought

#: Rung of the ladder: the image that it changes in one thing, so that the difference is that thing's own cost.
PARENT = {
    "no overlap": "truth",
    "linear depth": "no overlap",
    "linear peak": "no overlap",
    "affine": "no overlap",
    "ellipsoid": "no overlap",
    "affine + blur": "affine",
    "3DGS": "truth",
}
PICTURED = ("overlapping", "needle at the edge", "cluster")
LEAST_ERROR = 1e-4  # black in the error maps, a fortieth of a step of 8-bit color


def stiff_medium(optical_depth: float, rays: int = RAYS) -> tuple[physics.Profile, Volume]:
    """A fan of rays through two overlapping Gaussians of different color, ``optical_depth`` along the first ray."""
    volume = Volume(
        means=[[0, 0, 10], [0.4, 0.1, 10.5]],
        quats=[[1, 0, 0, 0], [0.9, 0.2, 0.3, 0.1]],
        scales=[[1, 1, 1], [1.2, 0.6, 1.1]],
        densities=[1, 1],
        colors=[[0.9, 0.3, 0.1], [0.1, 0.4, 0.9]],
        background=[0.2, 0.8, 0.4],
    )
    directions = np.stack([np.linspace(0, 0.1, rays), np.zeros(rays), np.ones(rays)], 1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    profile = physics.ray_profile(volume, np.zeros(3), directions)
    return replace(profile, peak=profile.peak * optical_depth / profile.depths()[0].sum()), volume


def _scene(camera: Camera, means, scales, optical_depths, colors, quats=None) -> tuple[Volume, Camera]:
    """Gaussians with an optical depth through the center as the camera sees it; unrotated unless ``quats``."""
    count = len(means)
    quats = np.tile([1.0, 0, 0, 0], (count, 1)) if quats is None else quats
    volume = Volume(means, quats, scales, np.ones(count), colors, [0.05, 0.05, 0.08])
    return replace(volume, densities=optical_depths / physics.peak_depths(volume, camera)), camera


def _camera(focal: float = 48.0) -> Camera:
    return make_camera(48, 48, focal, seed=None)


def _cluster() -> tuple[Volume, Camera]:
    rng, count = np.random.default_rng(7), 32
    means = rng.normal(size=(count, 3)) * [0.55, 0.55, 0.4] + [0, 0, 4]
    scales = np.exp(rng.uniform(np.log(0.08), np.log(0.45), (count, 3)))
    optical_depths = np.exp(rng.uniform(np.log(0.3), np.log(6), count))
    return _scene(_camera(), means, scales, optical_depths, rng.uniform(0, 1, (count, 3)), rng.normal(size=(count, 4)))


ORANGE_BLUE = np.array([[0.95, 0.55, 0.1], [0.1, 0.4, 0.9]])
SCENES: dict[str, Callable[[], tuple[Volume, Camera]]] = {
    "one": lambda: _scene(_camera(), [[0, 0, 4]], [[0.5, 0.35, 0.4]], np.array([2.0]), ORANGE_BLUE[:1]),
    "separated": lambda: _scene(
        _camera(), [[-0.2, 0, 3], [0.4, 0, 9]], [[0.3] * 3, [1.0] * 3], np.array([1.5, 3.0]), ORANGE_BLUE
    ),
    "overlapping": lambda: _scene(
        _camera(), [[-0.25, 0, 4], [0.25, 0, 4.2]], [[0.5, 0.5, 0.6]] * 2, np.array([3.0, 3.0]), ORANGE_BLUE
    ),
    "needle along its axis": lambda: _scene(
        _camera(), [[0, 0, 5]], [[0.08, 0.08, 0.8]], np.array([4.0]), ORANGE_BLUE[:1]
    ),
    "needle at the edge": lambda: _scene(
        _camera(focal=17.0), [[2.6, 0.6, 3.0]], [[0.35, 0.35, 0.8]], np.array([3.0]), ORANGE_BLUE[:1]
    ),
    "cluster": _cluster,
}


def plain(number: float) -> str:
    """0.01 and 1,000,000, not 1e+06."""
    return f"{number:,.0f}" if number >= 1 else f"{number:g}"

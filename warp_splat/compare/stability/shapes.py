"""Extremes of geometry: needles, pancakes, scales and quaternions at the ends of float32, odd depths and cameras."""

import itertools
from collections.abc import Callable
from functools import partial

import numpy as np

from warp_splat.camera import Camera
from warp_splat.compare.scenes import cloud, facing, look, tensors, to_world
from warp_splat.compare.stability.verdict import Problem, rendered
from warp_splat.config import NEAR, RasterOptions

RATIOS = (2, 4, 6, 8)  # powers of ten
COUNT = 48
QUAT_NORMS = (1e-42, 1e-30, 1e-20, 1e18)


def stretched(power: int, flat: bool, longest: float = 60.0, options: RasterOptions | None = None) -> Problem:
    """Needles (or, if ``flat``, pancakes) at every angle in the image and to it.

    Args:
        power: of ten, the ratio of the long scale to the short one.
        flat: two long axes instead of one.
        longest: standard deviation along the long axis [px].
        options: of the renderer.
    """
    camera = look()
    arrays = cloud(20 + power, COUNT, camera, opacity=(0.2, 0.7))
    depth = (arrays["means"] - camera.center) @ camera.forward
    long = longest * depth / camera.fx
    short = long * 10.0**-power
    arrays["scales"] = np.stack([short, long, long] if flat else [long, short, short], 1)
    tilts = np.where(np.arange(COUNT) % 2, np.linspace(0, 0.5 * np.pi, COUNT), 0.0)
    arrays["quats"] = facing(camera, np.linspace(0, np.pi, COUNT, endpoint=False), tilts)
    return Problem(tensors(arrays), camera, options or RasterOptions())


def extreme_logs() -> Problem:
    """Logarithms of scales of +100 (exp overflows) and -100 (a point) among ordinary ones."""
    arrays = cloud(30, 40)
    logs = np.log(arrays["scales"])
    logs[:4] = 100.0
    logs[4, 1] = 100.0
    logs[5:10] = -100.0
    logs[10, 0] = -100.0
    values = arrays | {"scales": logs, "opacities": np.log(arrays["opacities"] / (1 - arrays["opacities"]))}
    return Problem(tensors(values), raw=True, left_out=(0, 1, 2, 3, 4), invalid=5)


def too_large() -> Problem:
    """Scales that float32 holds but whose square it does not."""
    arrays = cloud(31, 40)
    arrays["scales"][:3] = np.array([1e12, 1e20, 1e38])[:, None]
    return Problem(tensors(arrays), left_out=(0, 1, 2), invalid=3)


def zero_quats() -> Problem:
    """Quaternions without a direction."""
    arrays = cloud(32, 40)
    arrays["quats"][[3, 17]] = 0.0
    return Problem(tensors(arrays), left_out=(3, 17), invalid=2)


def quat_norms(norm: float) -> Problem:
    """Every quaternion of that norm, down to denormal ones."""
    arrays = cloud(33, 40)
    arrays["quats"] *= norm / np.linalg.norm(arrays["quats"], axis=1, keepdims=True)
    return Problem(tensors(arrays))


def at_depths(depth: np.ndarray, opacity: tuple[float, float] = (0.05, 0.5)) -> Problem:
    """Gaussians at these depths, along the world's axes so that depths are exact; those up to ``NEAR`` are left out."""
    camera = look(seed=None)
    gaussians = tensors(cloud(35, len(depth), camera, depth=depth, opacity=opacity))
    near = gaussians["means"][:, 2].numpy() <= np.float32(NEAR)
    return Problem(gaussians, camera, left_out=tuple(np.flatnonzero(near).tolist()))


def near_plane() -> Problem:
    """On the near plane, and float32's next numbers on either side of it."""
    plane = np.float32(NEAR)
    sides = [np.nextafter(plane, np.float32(side)) for side in (0, 1)]
    return at_depths(np.tile([plane, *sides], 10).astype(np.float64), opacity=(0.01, 0.1))


def not_finite() -> Problem:
    """NaN and infinity in every parameter."""
    arrays = cloud(41, 40)
    for row, (name, value) in enumerate(itertools.product(arrays, (np.nan, np.inf))):
        arrays[name][row] = value
    return Problem(tensors(arrays), left_out=tuple(range(12)), invalid=12)


def enclosed(options: RasterOptions) -> Problem:
    """The camera within Gaussians of 0.3 to 5 units whose centers are nearer, farther and behind."""
    camera = look(seed=None)
    rng = np.random.default_rng(36)
    arrays = cloud(36, 24, camera, opacity=(0.1, 0.5))
    depth = np.concatenate([np.linspace(-2, 0.19, 8), np.linspace(0.25, 3, 16)])
    arrays["means"] = np.concatenate([rng.uniform(-0.1, 0.1, (24, 2)), depth[:, None]], 1)
    arrays["scales"] = np.exp(rng.uniform(np.log(0.3), np.log(5), (24, 3)))
    return Problem(tensors(arrays), camera, options, left_out=tuple(range(8)))


def seen_through(camera: Camera, seed: int, options: RasterOptions | None = None, **ranges) -> Problem:
    """Ordinary Gaussians that an odd camera sees."""
    return Problem(tensors(cloud(seed, 60, camera, **ranges)), camera, options or RasterOptions())


def size(width: int, height: int) -> Problem:
    """An image of this size, seen at 50 degrees along its longer side."""
    longest = max(width, height)
    camera = look(width, height, 2 * np.degrees(np.arctan(width / longest * np.tan(np.radians(25)))))
    arrays = cloud(39, 20, camera, sigma=(1, 1 + longest / 20), opacity=(0.05, 0.5))
    return Problem(tensors(arrays), camera, conditioned=True)


def beside() -> Problem:
    """Means far beside the image, where the Jacobian's slope is clamped, large enough to reach in."""
    camera = look(fov=90)
    arrays = cloud(40, 40, camera)
    rng = np.random.default_rng(40)
    z = rng.uniform(1, 4, 40)
    slopes = rng.uniform(1.5, 6, (40, 2)) * rng.choice([-1, 1], (40, 2))
    arrays["means"] = to_world(np.concatenate([slopes * z[:, None], z[:, None]], 1), camera)
    arrays["scales"] = rng.uniform(1, 6, (40, 3)) * z[:, None]
    return Problem(tensors(arrays), camera)


AFFINE, ELLIPSOID = RasterOptions(), RasterOptions(projection="ellipsoid")
RATIO = "scale ratio at every angle: as in float64"
NORM = "normalized; gradients beyond 3.4e38 dropped and counted"
SIZE = "as in float64, within the problem's condition"
FAR, OFF = {"center": (1e6, -1e6, 1e6)}, {"cx": -70.0, "cy": 65.0}  # from the origin; three widths beside the image
FIELDS = {"": (AFFINE, (1, 90, 150, 170)), "_ellipsoid": (ELLIPSOID, (1, 90, 150))}  # of view, degrees
#: By group: what is stated of each problem.
TABLE: dict[str, dict[str, tuple[str, Callable[[], Problem]]]] = {
    "shape": {
        **{f"needle_1e{power}": (RATIO, partial(stretched, power, False)) for power in RATIOS},
        **{f"pancake_1e{power}": (RATIO, partial(stretched, power, True)) for power in RATIOS},
        "needle_10000px": ("ratio 1e8, 10,000 px long", partial(stretched, 8, False, 1e4)),
        "needle_antialiased": (
            "ratio 1e4, 300 px long, antialiased: the ratio of determinants has no cancellation",
            partial(stretched, 4, False, 300.0, RasterOptions(antialiasing=True)),
        ),
        "log_scales_100": ("+100: left out and counted; -100: a point, as in float64", extreme_logs),
        "scales_1e38": ("too large to square: left out and counted", too_large),
        "quats_0": ("no direction: left out and counted", zero_quats),
        **{f"quats_{norm:g}": (NORM, partial(quat_norms, norm)) for norm in QUAT_NORMS},
        "not_finite": ("NaN and infinity in any parameter: left out and counted", not_finite),
    },
    "camera": {
        "far_1e6": (
            "means and camera 1e6 from the origin: as in float64",
            lambda: seen_through(look(**FAR), 34, depth=(50.0, 400.0)),
        ),
        "depth_1e-6_1e6": (
            "up to 0.2 left out, the rest as in float64",
            lambda: at_depths(np.random.default_rng(0).permutation(np.logspace(-6, 6, 60))),
        ),
        "near_plane": ("at 0.2 and before left out, after drawn", near_plane),
        "behind": ("left out", lambda: at_depths(np.random.default_rng(1).permutation(np.linspace(-30, 30, 60)))),
        "equal_depths": ("ordered by index", lambda: at_depths(np.full(60, 4.0))),
        "inside": ("drawn or left out by the center's depth alone", partial(enclosed, AFFINE)),
        "inside_ellipsoid": (
            "left out too where the ellipsoid of three sigma reaches the camera's plane: no outline",
            partial(enclosed, ELLIPSOID),
        ),
        **{
            f"fov_{degrees}{kind}": ("as in float64", partial(seen_through, look(fov=degrees), 37, options))
            for kind, (options, angles) in FIELDS.items()
            for degrees in angles
        },
        "principal_outside": ("as in float64", lambda: seen_through(look(**OFF), 38)),
        "beside": ("the Jacobian's slope is clamped: as in float64", beside),
        **{f"size_{w}x{h}": (SIZE, partial(size, w, h)) for w, h in ((1, 1), (1, 20_000), (20_000, 1))},
    },
}
CASES = tuple(rendered(name, group, *case) for group, cases in TABLE.items() for name, case in cases.items())

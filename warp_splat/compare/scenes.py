"""Cameras and Gaussians made up: ordinary ones, of which a case, a workload or a test changes what it is about."""

import numpy as np
import torch

from warp_splat.camera import Camera
from warp_splat.formats.stored import SH_C0


def make_camera(
    width: int, height: int, fx=None, fy=None, cx=None, cy=None, seed: int | None = 0, center=(0.3, -0.2, 0.5)
) -> Camera:
    """A camera at ``center``, turned at random by ``seed``; without a seed, at the origin along the world's axes.

    Unless given, ``fx`` is 1.1 times the width, ``fy`` is ``fx``, and the principal point the image's middle [px].
    """
    rotation, origin = np.eye(3), np.zeros(3)
    if seed is not None:  # the Q of a random matrix, its determinant made +1
        origin = np.asarray(center, dtype=np.float64)
        rotation, upper = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
        rotation *= np.sign(np.diag(upper))
        rotation *= np.linalg.det(rotation)
    fx = fx or 1.1 * width
    cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
    return Camera(width, height, fx, fy or fx, cx, cy, rotation, -rotation @ origin)


def look(width: int = 24, height: int = 20, fov: float = 50.0, **pose) -> Camera:
    """:func:`make_camera` by the horizontal field of view [degrees]."""
    return make_camera(width, height, 0.5 * width / np.tan(np.radians(0.5 * fov)), **pose)


def distinct_depths(rng: np.random.Generator, count: int, low: float, high: float) -> np.ndarray:
    """``count`` numbers in random order, no two closer than half an even spacing: depths that cannot swap."""
    return low + (high - low) / max(count, 1) * (rng.permutation(count) + rng.uniform(0.25, 0.75, count))


def to_world(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Camera points [N, 3] in the world."""
    return points @ camera.rotation + camera.center


def at_pixels(pixels: np.ndarray, depth: np.ndarray, camera: Camera) -> np.ndarray:
    """World points [N, 3] that show at ``pixels`` [N, 2] at ``depth`` [N]."""
    slopes = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return to_world(np.concatenate([slopes * depth[:, None], depth[:, None]], 1), camera)


def cloud(
    seed: int,
    count: int,
    camera: Camera | None = None,
    depth: np.ndarray | tuple[float, float] = (2.0, 8.0),
    sigma: tuple[float, float] = (1.0, 5.0),
    opacity: tuple[float, float] = (0.05, 0.9),
    aspect: float = 0.2,
) -> dict[str, np.ndarray]:
    """Random Gaussians over the image, of SH degree 1.

    Args:
        seed: of everything.
        count: N.
        camera: whose image they cover; :func:`look`'s unless given.
        depth: of each [N], or their range, world units.
        sigma: range of the largest standard deviation on the image [px].
        opacity: range.
        aspect: least ratio of the other standard deviations to the largest.
    """
    rng, camera = np.random.default_rng(seed), camera or look()
    z = distinct_depths(rng, count, *depth) if isinstance(depth, tuple) else depth
    pixels = rng.uniform(-0.1, 1.1, (count, 2)) * [camera.width, camera.height]
    size = np.exp(rng.uniform(*np.log(sigma), count)) * np.abs(z) / camera.fx
    ratios = np.exp(rng.uniform(np.log(aspect), 0, (count, 3)))
    ratios[:, 0] = 1
    return {
        "means": at_pixels(pixels, z, camera),
        "quats": rng.normal(size=(count, 4)),
        "scales": size[:, None] * ratios,
        "opacities": rng.uniform(*opacity, count),
        "sh_dc": (rng.uniform(0, 1, (count, 1, 3)) - 0.5) / SH_C0,
        "sh_rest": 0.15 * rng.normal(size=(count, 3, 3)),
    }


def facing(camera: Camera, angles: np.ndarray, tilts: np.ndarray) -> np.ndarray:
    """Quaternions [N, 4] that turn the x axis to ``angles`` in the image plane and ``tilts`` out of it [radians]."""
    x = np.stack([np.cos(tilts) * np.cos(angles), np.cos(tilts) * np.sin(angles), np.sin(tilts)], 1) @ camera.rotation
    half = np.concatenate([1 + x[:, :1], np.zeros((len(x), 1)), -x[:, 2:], x[:, 1:2]], 1)  # from (1, 0, 0) to x
    return half / np.linalg.norm(half, axis=1, keepdims=True)


def tensors(arrays: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    """The arrays in float32, on which float64 and float32 agree exactly."""
    return {name: torch.tensor(np.ascontiguousarray(array), dtype=torch.float32) for name, array in arrays.items()}

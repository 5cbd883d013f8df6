"""What training starts from where a scene has no points: random ones, or Gaussians."""

import math

import numpy as np

from warp_splat.camera import Camera
from warp_splat.errors import InputError
from warp_splat.formats.coordinates import read_coordinates
from warp_splat.formats.model_folder import folder_of, open_model
from warp_splat.formats.ply import GRAY
from warp_splat.formats.splats import SplatFile
from warp_splat.formats.stored import SH_C0
from warp_splat.scene.types import spread_of, visible
from warp_splat.text import Report

COUNT = 50_000
DEPTHS = 0.2, 8.0  # of the cameras' extent: from near the middle of an orbit to far behind what a walk shows
ROUNDS = 20  # of drawing, and one more for what no two see; a pair of cameras with one place to look at needs a few


def random_points(cameras: list[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Points in what at least two cameras see, more of them near by; the same for the same cameras.

    Each is drawn along a random ray of a random camera. Its depth is log-uniform between DEPTHS times the largest
    distance of a camera from the cameras' mean (times 1 if all stand at one place). Where no two cameras see the same,
    one is enough.

    Returns:
        Points [P, 3] float32, P = 50,000; gray colors [P, 3] uint8.
    """
    random = np.random.default_rng(0)
    extent = spread_of(np.stack([camera.center for camera in cameras])) or 1.0
    kept: list[np.ndarray] = []
    for left in range(ROUNDS, -1, -1):
        drawn = _along_rays(cameras, extent, random)
        if len(cameras) > 1 and left:
            drawn = drawn[sum(visible(camera, drawn).astype(int) for camera in cameras) >= 2]
        kept.append(drawn)
        if sum(map(len, kept)) >= COUNT:
            break
    return np.concatenate(kept)[:COUNT].astype(np.float32), np.full((COUNT, 3), GRAY, np.uint8)


def _along_rays(cameras: list[Camera], extent: float, random: np.random.Generator) -> np.ndarray:
    """COUNT points [COUNT, 3], as many in front of each camera up to one."""
    depths = extent * DEPTHS[0] * _power(DEPTHS[1] / DEPTHS[0], random.uniform(size=COUNT))
    pixels, points = random.uniform(size=(COUNT, 2)), np.empty((COUNT, 3))
    for index, camera in enumerate(cameras):
        mine = slice(index, None, len(cameras))
        # at the camera, where it sees nothing
        ahead = np.nan_to_num(camera.directions(pixels[mine] * [camera.width, camera.height]))
        seen = ahead * depths[mine, None] - camera.translation
        points[mine] = (seen[:, :, None] * camera.rotation).sum(1)
    return points


def _power(base: float, shares: np.ndarray) -> np.ndarray:
    """``base`` to powers of 0 to 1, multiples of 2^-16, by square roots: NumPy's exponential differs by processor."""
    values, bits = np.ones(len(shares)), (shares * 2**16).astype(np.int64)
    for place in reversed(range(16)):
        base = math.sqrt(base)
        values = np.where(bits >> place & 1, values * base, values)
    return values


def load_start(path: str, report: Report) -> tuple[SplatFile, np.ndarray, np.ndarray]:
    """Gaussians of a file or model folder, their centers [N, 3] float32 and colors [N, 3] uint8, seen from nowhere.

    Raises:
        InputError: if it is missing or not a file of Gaussians, or if there are none in it.
    """
    _, file, _ = open_model(path, report=report)
    file = file._replace(coordinates=read_coordinates(folder_of(path)) or file.coordinates)
    if not len(file.splats.means):
        raise InputError(f"{path}: expected at least one Gaussian to start from, found none; name another file.")
    colors = (255 * (SH_C0 * file.splats.sh[:, 0].astype(np.float64) + 0.5)).clip(0, 255).round().astype(np.uint8)
    return file, file.splats.means, colors

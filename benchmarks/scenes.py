"""A scene for the blends alone: random screen-space Gaussians, binned by their 3-sigma square, front to back."""

from typing import NamedTuple

import numpy as np

from warp_splat.config import ALPHA_MIN, TILE
from warp_splat.kernels.splat import Splat2D

LN_2 = np.log(2.0)


class BlendScene(NamedTuple):
    """V Gaussians, M tile instances, T tiles."""

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

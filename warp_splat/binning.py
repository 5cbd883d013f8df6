"""From 2D Gaussians to lists: which Gaussians touch which tile of the image, in depth order. No gradient."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.config import TILE, RasterOptions
from warp_splat.errors import InputError
from warp_splat.kernels import tiles
from warp_splat.kernels.blend import Splat2D
from warp_splat.launch import available_memory, empty, even_slices, get_threads, launch, view

MAX_INSTANCES = 2**31 - 1  # kernels index instances with 32 bits
MANY = 10**7  # instances from which on their memory is asked for
BYTES = 60  # of an instance: its place, what sorting it takes, and its row of gradients
MAX_TILE = 2**24  # instances of one tile: the blends count them in float32
SLICES_PER_THREAD = 8  # of the blends: tiles differ in cost by more than their number of instances says


@dataclass
class Bins:
    """Tile lists: V Gaussians drawn (on a GPU: all, those not drawn behind), M tile instances, T tiles."""

    order: wp.array  # [V] Gaussian, nearest first
    splats: wp.array  # [V] Splat2D
    slot_ends: wp.array  # [V] int64, inclusive scan of a Gaussian's instances
    instances: torch.Tensor  # [M, 2] int32 (rank, slot), by tile, nearest first
    ranges: torch.Tensor  # [T, 2] int32, first and last instance
    slices: list[int]  # bounds of slices of tiles with about equal work, for the threads of the CPU
    tiles_x: int
    invalid: int | torch.Tensor


def bin_tiles(
    means2d, conics, opacities, colors, depths, extents, radii, camera: Camera, options: RasterOptions
) -> Bins:
    """Sort the drawn Gaussians by depth (ties by index) and list those of each tile.

    Raises:
        InputError: if the tile instances are more than the kernels can number.
    """
    bin_on = bin_by_sorting if means2d.is_cuda else bin_by_counting
    return bin_on(means2d, conics, opacities, colors, depths, extents, radii, camera, options)


def bin_by_counting(
    means2d, conics, opacities, colors, depths, extents, radii, camera: Camera, options: RasterOptions
) -> Bins:
    """:func:`bin_tiles` for the CPU: a counting sort by tile, a band of Gaussians per thread."""
    tiles_x, tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
    invalid = int(np.count_nonzero(radii.numpy() < 0))
    order = sort_by_depth(depths, radii)
    drawn = len(order)
    splats = wp.empty(drawn, dtype=Splat2D, device="cpu")
    row_ends = wp.empty(drawn, dtype=wp.int64, device="cpu")
    slot_ends = wp.empty(drawn, dtype=wp.int64, device="cpu")
    tensors = views2d((means2d, conics, opacities, colors, depths, extents))
    square = int(options.extent == "square")
    launch(tiles.pack, drawn, [order, *tensors, camera.height, options.alpha_min, square], [splats, row_ends])
    rows = _scan(row_ends)
    _check_count(rows, camera, drawn, radii.device)
    spans = wp.empty(rows, dtype=wp.vec2i, device="cpu")
    size = [camera.width, camera.height, tiles_x]
    launch(tiles.find_spans, drawn, [splats, row_ends, *size, square], [spans, slot_ends])
    count = _scan(slot_ends)
    _check_count(count, camera, drawn, radii.device)
    instances, ends = _sort_by_tile(spans, row_ends, slot_ends, count, tiles_x * tiles_y)
    ranges = torch.from_numpy(np.stack([np.concatenate([[0], ends[:-1]]), ends], 1).astype(np.int32))
    return Bins(order, splats, slot_ends, instances, ranges, balanced_slices(ends), tiles_x, invalid)


def bin_by_sorting(
    means2d, conics, opacities, colors, depths, extents, radii, camera: Camera, options: RasterOptions
) -> Bins:
    """:func:`bin_tiles` for a GPU: the host waits for the number of tile instances.

    Where these are so many that one tile might hold too many, it waits for the longest list as well.
    """
    tiles_x, tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
    device, total = radii.device, len(radii)
    keys = torch.where(radii > 0, depths.detach(), torch.inf)
    order = wp.from_torch(torch.sort(keys, stable=True).indices.int())
    splats, counts = empty(total, Splat2D, device), torch.empty(total, dtype=torch.int64, device=device)
    tensors = views2d((means2d, conics, opacities, colors, depths, extents))
    square = int(options.extent == "square")
    launch(
        tiles.pack,
        total,
        [order, *tensors, camera.height, options.alpha_min, square],
        [splats, view(counts, wp.int64)],
        device=device,
    )
    inputs = [order, view(radii, wp.int32), splats, camera.width, camera.height, tiles_x, square]

    def list_tiles(slot_ends: torch.Tensor, *lists: torch.Tensor) -> None:
        outputs = [view(counts, wp.int64), *(view(numbers, wp.int32) for numbers in lists)]
        launch(tiles.list_tiles, total, [*inputs, view(slot_ends, wp.int64)], outputs, device=device)

    list_tiles(counts[:0], *torch.empty(2, 0, dtype=torch.int32, device=device))
    slot_ends = torch.cumsum(counts, 0)
    count = int(slot_ends[-1]) if total else 0
    _check_count(count, camera, total, device)
    listed, ranks = torch.empty(2, count, dtype=torch.int32, device=device)
    list_tiles(slot_ends, listed, ranks)
    # the fewer bits, the fewer passes of the sort
    narrow = torch.int16 if tiles_x * tiles_y < 2**15 else torch.int32
    listed, slots = torch.sort(listed.to(narrow), stable=True)
    instances = torch.stack([ranks[slots], slots.int()], 1)
    bounds = torch.searchsorted(listed, torch.arange(tiles_x * tiles_y + 1, dtype=narrow, device=device)).int()
    ranges = torch.stack([bounds[:-1], bounds[1:]], 1)
    if count > MAX_TILE:  # only then can one tile hold as many, and only then is it worth waiting for
        _check_longest(int(bounds.diff().max()))
    invalid = torch.count_nonzero(radii < 0)
    return Bins(order, splats, wp.from_torch(slot_ends), instances, ranges, [], tiles_x, invalid)


def _sort_by_tile(
    spans: wp.array, row_ends: wp.array, slot_ends: wp.array, count: int, tile_count: int
) -> tuple[torch.Tensor, np.ndarray]:
    """Instances [M, 2] (rank, slot) by tile, nearest first, and where each tile's end [T].

    A counting sort in bands of Gaussians, one per thread: each band counts its instances of every tile, then writes
    them after those of the bands before it. The result is the same for any number of bands.
    """
    ranks = np.array(even_slices(len(row_ends)), dtype=np.int32)
    bands = len(ranks) - 1
    one_each = list(range(bands + 1))
    rows = np.concatenate([[0], row_ends.numpy()])[ranks].astype(np.int32)
    counts = np.zeros((bands, tile_count), dtype=np.int32)
    to = lambda array: wp.array(array, dtype=int, copy=False, device="cpu")  # noqa: E731
    launch(tiles.count_tiles, bands, [to(rows), spans], [to(counts)], bounds=one_each)
    places = np.cumsum(counts.T.ravel(), dtype=np.int64).reshape(tile_count, bands)
    _check_longest(int(counts.sum(0).max(initial=0)))
    cursor = np.ascontiguousarray((places - counts.T).T, dtype=np.int32)
    instances = torch.empty((count, 2), dtype=torch.int32)
    launch(
        tiles.scatter,
        bands,
        [to(ranks), spans, row_ends, slot_ends],
        [to(cursor), view(instances, wp.vec2i)],
        bounds=one_each,
    )
    return instances, places[:, -1]


def sort_by_depth(depths: torch.Tensor, radii: torch.Tensor) -> wp.array:
    """Indices of the drawn Gaussians, nearest first, ties by index, [V] int32."""
    drawn = np.flatnonzero(radii.numpy() > 0).astype(np.int32)
    count = len(drawn)
    if count == 0:
        return wp.empty(0, dtype=int, device="cpu")
    keys = np.empty(2 * count, dtype=np.float32)  # the sort works in twice the space
    values = np.empty(2 * count, dtype=np.int32)
    keys[:count] = depths.detach().numpy()[drawn]
    values[:count] = drawn
    pairs = (wp.array(array, dtype=dtype, copy=False, device="cpu") for array, dtype in ((keys, float), (values, int)))
    wp.utils.radix_sort_pairs(*pairs, count)
    return wp.array(values[:count], dtype=int, copy=False, device="cpu")


def _scan(counts: wp.array) -> int:
    """Inclusive scan in place, in 64 bits (a 32-bit one wraps without a word); returns the total."""
    if not len(counts):
        return 0
    wp.utils.array_scan(counts, counts, inclusive=True)
    return int(counts.numpy()[-1])


def _check_count(count: int, camera: Camera, drawn: int, device: torch.device) -> None:
    touch = f"rasterize: {drawn} Gaussians on {camera.width} x {camera.height} pixels touch tiles {count} times"
    if count > MAX_INSTANCES:
        raise InputError(
            f"{touch}, more than the {MAX_INSTANCES} that fit; render a smaller image or fewer, smaller Gaussians."
        )
    if count > MANY and BYTES * count > (available := available_memory(device)):
        raise InputError(
            f"{touch}, which takes {BYTES * count / 2**30:.1f} GiB, but only {available / 2**30:.1f} GiB are free; "
            "render a smaller image or fewer, smaller Gaussians."
        )


def _check_longest(count: int) -> None:
    if count > MAX_TILE:
        raise InputError(
            f"rasterize: one tile of {TILE} x {TILE} pixels lists {count} Gaussians, more than the {MAX_TILE} that "
            "fit; render fewer Gaussians."
        )


def balanced_slices(ends: np.ndarray) -> list[int]:
    """Bounds of slices of tiles with about the same number of instances; an empty tile counts a little, too."""
    work = ends + 32 * np.arange(1, len(ends) + 1)
    parts = SLICES_PER_THREAD * get_threads() if get_threads() > 1 else 1
    inner = np.searchsorted(work, work[-1] * np.arange(1, parts) / parts)
    return [0, *inner.tolist(), len(ends)]


def views2d(tensors) -> list:
    """Kernel arguments for as many of (means2d, conics, opacities, colors, depths, extents) as are given."""
    types = (wp.vec2, wp.vec3, wp.float32, wp.vec3, wp.float32, wp.vec2)
    return [view(tensor, dtype) for tensor, dtype in zip(tensors, types, strict=False)]

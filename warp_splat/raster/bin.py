"""From 2D Gaussians to lists: which Gaussians touch which tile of the image, in depth order. No gradient."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.config import TILE, RasterOptions
from warp_splat.errors import InputError
from warp_splat.kernels import tiles
from warp_splat.kernels.splat import Splat2D
from warp_splat.runtime.launch import (
    available_memory,
    empty,
    even_slices,
    get_threads,
    in_slices,
    launch,
    torch_slices,
    view,
)

MAX_INSTANCES = 2**31 - 1  # kernels index instances with 32 bits
MANY = 10**7  # instances from which on their memory is asked for
BYTES = 60  # of an instance: its place, what sorting it takes, and its row of gradients
MAX_TILE = 2**24  # instances of one tile: the blends count them in float32
SLICES_PER_THREAD = 8  # of the blends: tiles differ in cost by more than their number of instances says


@dataclass
class Bins:
    """Tile lists: V splats (Gaussians drawn; on a GPU all, those not drawn behind), M tile instances, T tiles."""

    gaussians: wp.array  # [V] Gaussian of each splat: ascending; on a GPU, nearest first
    splats: wp.array  # [V] Splat2D
    instances: torch.Tensor  # [M] int32, splats, by tile, nearest first
    places: torch.Tensor  # [M] int32, where in ``instances`` a splat stands, splat by splat
    place_begins: torch.Tensor  # [V] int32, where in ``places`` those of each splat begin
    ranges: torch.Tensor  # [T, 2] int32, first and last instance
    slices: list[int]  # bounds of slices of tiles with about equal work, for the threads of the CPU; on a GPU empty
    tiles_x: int
    invalid: int | torch.Tensor


def bin_tiles(
    means2d, conics, opacities, colors, depths, extents, radii, camera: Camera, options: RasterOptions
) -> Bins:
    """List the Gaussians of each tile by depth (ties by index).

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
    drawn = np.flatnonzero(radii.numpy() > 0).astype(np.int32)
    count = len(drawn)
    order, nearness = np.empty(count, dtype=np.int32), _taken(depths.detach().numpy(), drawn)
    splats, rows = wp.empty(count, dtype=Splat2D, device="cpu"), np.empty(count, dtype=np.int32)
    tensors = views2d((means2d, conics, opacities, colors, depths, extents))
    gaussians, square = _array(drawn), int(options.extent == "square")
    inputs = [gaussians, *tensors, camera.height, options.alpha_min, square]
    # one thread sorts while others pack
    launch(tiles.pack, count, inputs, [splats, _array(rows)], beside=partial(order_by_depth, nearness, order))
    by_depth = _taken(rows, order)
    row_ends = np.cumsum(by_depth, dtype=np.int64)  # a 32-bit scan wraps without a word
    _check_count(_last(row_ends), camera, count, radii.device)
    begins = _put(row_ends - by_depth, order)
    spans, counts = wp.empty(_last(row_ends), dtype=wp.vec2i, device="cpu"), np.empty(count, dtype=np.int64)
    inputs = [splats, _array(rows), _array(begins), camera.width, camera.height, tiles_x, square]
    launch(tiles.find_spans, count, inputs, [spans, _array(counts)])
    place_ends = np.cumsum(counts)
    _check_count(_last(place_ends), camera, count, radii.device)
    begins = (place_ends - counts).astype(np.int32)
    instances, places, ends = _sort_by_tile(
        order, _taken(begins, order), row_ends, spans, _last(place_ends), tiles_x * tiles_y
    )
    ranges = torch.from_numpy(np.stack([np.concatenate([[0], ends[:-1]]), ends], 1).astype(np.int32))
    lists = (instances, places, torch.from_numpy(begins), ranges)
    return Bins(gaussians, splats, *lists, balanced_slices(ends), tiles_x, invalid)


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
    rows = torch.empty(total, dtype=torch.int32, device=device)  # of tiles, which only a CPU needs
    tensors = views2d((means2d, conics, opacities, colors, depths, extents))
    square = int(options.extent == "square")
    inputs = [order, *tensors, camera.height, options.alpha_min, square]
    launch(tiles.pack, total, inputs, [splats, view(rows, wp.int32)], device=device)
    inputs = [order, view(radii, wp.int32), splats, camera.width, camera.height, tiles_x, square]

    def list_tiles(place_ends: torch.Tensor, *lists: torch.Tensor) -> None:
        outputs = [view(counts, wp.int64), *(view(numbers, wp.int32) for numbers in lists)]
        launch(tiles.list_tiles, total, [*inputs, view(place_ends, wp.int64)], outputs, device=device)

    list_tiles(counts[:0], *torch.empty(2, 0, dtype=torch.int32, device=device))
    place_ends = torch.cumsum(counts, 0)
    count = int(place_ends[-1]) if total else 0
    _check_count(count, camera, total, device)
    listed, ranks = torch.empty(2, count, dtype=torch.int32, device=device)
    list_tiles(place_ends, listed, ranks)
    # the fewer bits, the fewer passes of the sort
    narrow = torch.int16 if tiles_x * tiles_y < 2**15 else torch.int32
    listed, numbers = torch.sort(listed.to(narrow), stable=True)
    instances, places = ranks[numbers], torch.empty_like(ranks)
    places[numbers] = torch.arange(count, dtype=torch.int32, device=device)
    bounds = torch.searchsorted(listed, torch.arange(tiles_x * tiles_y + 1, dtype=narrow, device=device)).int()
    ranges = torch.stack([bounds[:-1], bounds[1:]], 1)
    if count > MAX_TILE:  # only then can one tile hold as many, and only then is it worth waiting for
        _check_longest(int(bounds.diff().max()))
    invalid = torch.count_nonzero(radii < 0)
    return Bins(order, splats, instances, places, (place_ends - counts).int(), ranges, [], tiles_x, invalid)


def _sort_by_tile(
    order: np.ndarray, begins: np.ndarray, row_ends: np.ndarray, spans: wp.array, count: int, tile_count: int
) -> tuple[torch.Tensor, torch.Tensor, np.ndarray]:
    """Instances [M] by tile, nearest first, their places [M], and where each tile's end [T].

    A counting sort in bands of splats, one per thread: each band counts its instances of every tile, then writes
    them after those of the bands before it. The result is the same for any number of bands.
    """
    bounds = np.array(even_slices(len(order)), dtype=np.int32)
    bands = len(bounds) - 1
    one_each = list(range(bands + 1))
    rows = np.concatenate([[0], row_ends])[bounds].astype(np.int32)
    counts = np.zeros((bands, tile_count), dtype=np.int32)
    launch(tiles.count_tiles, bands, [_array(rows), spans], [_array(counts)], bounds=one_each)
    ends = np.cumsum(counts.T.ravel(), dtype=np.int64).reshape(tile_count, bands)
    _check_longest(int(counts.sum(0).max(initial=0)))
    cursor = np.ascontiguousarray((ends - counts.T).T, dtype=np.int32)
    instances, places = (torch.empty(count, dtype=torch.int32, device="cpu") for _ in range(2))
    inputs = [_array(bounds), _array(order), _array(begins), _array(row_ends), spans]
    outputs = [_array(cursor), view(instances, wp.int32), view(places, wp.int32)]
    launch(tiles.scatter, bands, inputs, outputs, bounds=one_each)
    return instances, places, ends[:, -1]


def order_by_depth(depths: np.ndarray, order: np.ndarray) -> None:
    """Write the indices of ``depths`` [V] from the least to the largest, ties by index, into ``order`` [V] int32.

    Tried: only the bits in which the depths differ, 25 of 32, or digits of 9 or 11 bits: no faster.
    """
    count = len(depths)
    keys = np.empty(2 * count, dtype=np.float32)  # the sort works in twice the space
    values = np.empty(2 * count, dtype=np.int32)
    keys[:count] = depths
    values[:count] = np.arange(count)
    if count:
        wp.utils.radix_sort_pairs(wp.array(keys, dtype=float, copy=False, device="cpu"), _array(values), count)
    order[:] = values[:count]


def _taken(values: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """``values[indices]`` by torch, which takes half of numpy's time, on the threads of the CPU."""
    found = np.empty(len(indices), dtype=values.dtype)

    def run(low: int, high: int) -> None:
        table, part = torch.from_numpy(values), torch.from_numpy(found[low:high])
        torch.index_select(table, 0, torch.from_numpy(indices[low:high]), out=part)

    in_slices(run, torch_slices(len(indices)))
    return found


def _put(values: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """An array of int32 that holds ``values`` at ``indices``, which are a permutation."""
    found = np.empty(len(indices), dtype=np.int32)

    def run(low: int, high: int) -> None:
        table, part = torch.from_numpy(found), torch.from_numpy(values[low:high]).int()
        table.scatter_(0, torch.from_numpy(indices[low:high]).long(), part)

    in_slices(run, torch_slices(len(indices)))
    return found


def _array(values: np.ndarray) -> wp.array:
    """The same memory for a kernel."""
    dtype = {np.dtype(np.int32): int, np.dtype(np.int64): wp.int64}[values.dtype]
    return wp.array(values, dtype=dtype, copy=False, device="cpu")


def _last(ends: np.ndarray) -> int:
    """The total of an inclusive scan."""
    return int(ends[-1]) if len(ends) else 0


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

"""From 2D Gaussians to lists: which Gaussians touch which tile of the image, in depth order. No gradient."""

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.config import TILE, RasterOptions
from warp_splat.errors import InputError
from warp_splat.kernels.cpu import lists
from warp_splat.kernels.cuda.lists import make_count_tiles, make_gather_tiles, make_list_tiles
from warp_splat.kernels.simd import LANES
from warp_splat.kernels.splat import Splat2D
from warp_splat.raster.data import LESS, MAX_INSTANCES, Bins, Room, Splats2D, falloff_of
from warp_splat.runtime.launch import bind, check_memory, empty, launch, read_later, send
from warp_splat.runtime.pool import even_slices, falling_slices, in_slices, slice_count, torch_slices, with_slices

MANY = 10**7  # instances from which on their memory is asked for
BYTES = 64  # of an instance: its place and blocks, what sorting it takes, and its row of gradients
MAX_TILE = 2**24  # instances of one tile: the blends count them in float32
IN_PIECES = 2**14  # splats for each of two threads that share a piece when depths are sorted, or more
SAMPLE = 2**10  # depths that tell which range of them is whose


def bin_by_counting(
    splats2d: Splats2D, camera: Camera, options: RasterOptions, room: Room | None = None, worlds: Sequence[int] = ()
) -> Bins:
    """The Gaussians of each tile by depth (ties by index) on the CPU: a counting sort by tile, a band per thread.

    The number of bands does not show in the result. A CPU knows the number of instances in time, and needs no ``room``.
    With ``worlds``, how many of the Gaussians belong to each of several pictures, one after the other, lists are those
    of the tiles of the first picture, then of the next.

    Raises:
        InputError: if the tile instances are more than the kernels can number, or than fit.
    """
    tiles_x, tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
    radii = splats2d.radii.numpy()
    drawn, invalid = np.flatnonzero(radii > 0).astype(np.int32), int(np.count_nonzero(radii < 0))
    count = len(drawn)
    splats, rows = empty(count, Splat2D, "cpu"), np.empty(count, dtype=np.int32)
    gaussians, square = wp.array(drawn, copy=False, device="cpu"), int(options.extent == "square")
    inputs, groups = [gaussians, splats2d.view(), camera.height, options.alpha_min, square], -(-count // LANES)
    pack = bind(lists.make_pack(falloff_of(options).reach_of), inputs, [splats, rows], "cpu")
    depths = splats2d.depths.detach().numpy()
    order = with_slices(lambda: order_by_depth(_taken(depths, drawn)), pack, falling_slices(groups, LANES))
    edges, begins, row_count = _sums(_taken(rows, order))
    check_count(row_count, camera, count, splats2d.radii.device)
    spans, counts = empty(row_count, wp.vec2i, "cpu"), np.empty(count, dtype=np.int64)
    inputs = [splats, rows, _put(begins, order), camera.width, camera.height, tiles_x, square]
    launch(lists.find_spans, groups, inputs, [spans, counts], bounds=falling_slices(groups, LANES))
    pictures = max(len(worlds), 1)
    if worlds:
        first = _first_tiles(worlds, tiles_x * tiles_y, splats2d.radii.device)[drawn[order]]
        wp.to_torch(spans)[:, 0] += torch.repeat_interleave(first, torch.from_numpy(_taken(rows, order)))
    # of as many rows each
    bands = np.array([0, *np.searchsorted(edges[1:], even_slices(row_count)[1:-1]), count], dtype=np.int32)
    cursor, ends, (_, begins, total) = _count_bands(edges[bands], spans, tiles_x * tiles_y * pictures, counts)
    check_count(total, camera, count, splats2d.radii.device)
    _check_longest(int(np.diff(ends, prepend=0).max(initial=0)))
    instances, places = (torch.empty(total, dtype=torch.int32, device="cpu") for _ in range(2))
    inputs, outputs = [bands, order, begins, edges[1:], spans], [cursor, instances, places]
    launch(lists.scatter, len(bands) - 1, inputs, outputs, bounds=list(range(len(bands))))
    ranges = torch.from_numpy(np.stack([np.concatenate([[0], ends[:-1]]), ends], 1).astype(np.int32))
    found = (instances, places, torch.from_numpy(begins), ranges, balanced_slices(ends))
    return Bins(len(radii), gaussians, splats, *found, tiles_x, camera.height, invalid, pictures)


def bin_by_sorting(
    splats2d: Splats2D, camera: Camera, options: RasterOptions, room: Room | None = None, worlds: Sequence[int] = ()
) -> Bins:
    """:func:`bin_by_counting` for a GPU: the host waits for the number of tile instances, unless there is ``room``.

    Lists and gradients are the same whatever the room. Where instances are so many that one tile might hold too many,
    the host waits, and for the longest list as well.
    """
    device, total = splats2d.radii.device, len(splats2d.radii)
    gaussians, splats, counts = _count_tiles(splats2d, camera, options)
    ends = torch.cumsum(counts, 0)
    if room and total and 0 < room.instances <= MAX_TILE:
        count, room.counted = room.instances, read_later(ends[-1:])
    else:
        count = int(ends[-1]) if total else 0
        check_count(count, camera, total, device)
        if room:
            room.learn(count)
    tiles_x, tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
    pictures = max(len(worlds), 1)
    narrow = tiles_x * tiles_y * pictures < 2**15  # the fewer bits, the fewer passes of the sort
    listed = torch.empty(count, dtype=torch.int16 if narrow else torch.int32, device=device)
    begins, ranks = _list_tiles(splats, ends, listed, torch.empty(0, dtype=torch.int32, device=device), camera, options)
    if worlds:
        listed += _first_tiles(worlds, tiles_x * tiles_y, device).to(listed.dtype)[wp.to_torch(gaussians)[ranks]]
    listed, numbers = torch.sort(listed, stable=True)
    new = partial(torch.empty, dtype=torch.int32, device=device)
    instances, places, ranges = new(count), new(count), new(tiles_x * tiles_y * pictures, 2)
    inputs, outputs = [listed, numbers, ranks], [instances, places, ranges]
    launch(make_gather_tiles(narrow), count + 1, inputs, outputs, device=device)
    if count > MAX_TILE:  # only then can one tile hold as many, and only then is it worth waiting for
        _check_longest(int((ranges[:, 1] - ranges[:, 0]).max()))
    invalid = torch.count_nonzero(splats2d.radii < 0)
    return Bins(
        total, gaussians, splats, instances, places, begins, ranges, [], tiles_x, camera.height, invalid, pictures
    )


def _count_tiles(splats2d: Splats2D, camera: Camera, options: RasterOptions) -> tuple[wp.array, wp.array, torch.Tensor]:
    """Gaussians nearest first, their splats, and the number of their tiles, [N] each."""
    device, total = splats2d.radii.device, len(splats2d.radii)
    order = torch.sort(splats2d.depths.detach(), stable=True).indices
    gaussians, splats = empty(total, int, device), empty(total, Splat2D, device)
    counts = torch.empty(total, dtype=torch.int64, device=device)
    square, kernel = int(options.extent == "square"), make_count_tiles(falloff_of(options).reach_of)
    inputs = [order, splats2d.view(), camera.width, camera.height, options.alpha_min, square]
    launch(kernel, total, inputs, [gaussians, splats, counts], device=device)
    return gaussians, splats, counts


def _list_tiles(
    splats: wp.array, ends: torch.Tensor, listed: torch.Tensor, counts: torch.Tensor, camera, options
) -> tuple[torch.Tensor, torch.Tensor]:
    """Where the instances of each splat begin [N + 1], and their ranks [M]; their tiles are written into ``listed``.

    ``counts`` [N], or [0], are counted anew.
    """
    begins, ranks = (torch.empty(size, dtype=torch.int32, device=ends.device) for size in (len(ends) + 1, len(listed)))
    kernel, outputs = make_list_tiles(listed.dtype == torch.int16), [begins, listed, ranks, counts]
    inputs = [splats, camera.width, camera.height, int(options.extent == "square"), ends]
    launch(kernel, len(begins), inputs, outputs, device=ends.device)
    return begins, ranks


def _first_tiles(worlds: Sequence[int], tiles: int, device: torch.device) -> torch.Tensor:
    """The first tile of the picture that each Gaussian belongs to, [N] int32."""
    firsts, counts = torch.arange(0, tiles * len(worlds), tiles), torch.tensor(worlds)
    return torch.repeat_interleave(*(send(t, device) for t in (firsts.int(), counts)), output_size=sum(worlds))


def count_twice(splats2d: Splats2D, camera: Camera, options: RasterOptions) -> tuple[torch.Tensor, torch.Tensor]:
    """The number of tiles of each splat [N], as :func:`bin_by_sorting` finds it to count, and to write."""
    _, splats, counts = _count_tiles(splats2d, camera, options)
    again, ends = counts.int(), torch.cumsum(counts, 0)
    _list_tiles(splats, ends, torch.empty(int(ends[-1]), dtype=torch.int32, device=ends.device), again, camera, options)
    return counts, again


def _count_bands(bounds: np.ndarray, spans: wp.array, tiles: int, counts: np.ndarray) -> tuple:
    """Where each band's instances of each tile go [B, T], after those of the bands before it; each tile's end [T].

    Bands lie between ``bounds`` in ``spans``. And the sums of ``counts``, which are found meanwhile.
    """
    changes = np.zeros((len(bounds) - 1, tiles + 1), dtype=np.int32)
    count = bind(lists.count_tiles, [bounds.astype(np.int32), spans], [changes], "cpu")
    sums = with_slices(lambda: _sums(counts), count, list(range(len(bounds))))
    found = np.cumsum(changes[:, :-1], axis=1, dtype=np.int32)
    totals = found.sum(0, dtype=np.int64)
    begins, ends = np.empty_like(found), np.cumsum(totals)
    begins[0] = ends - totals
    for band in range(1, len(found)):
        np.add(begins[band - 1], found[band - 1], out=begins[band])
    return begins, ends, sums


def _sums(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Where the counted begin, and the last end [V + 1], in 64 bits: 32 wrap silently; begins in 32 [V]; their sum."""
    edges = np.zeros(len(counts) + 1, dtype=np.int64)
    torch.cumsum(torch.from_numpy(counts), 0, out=torch.from_numpy(edges[1:]))  # in a quarter of numpy's time
    return edges, edges[:-1].astype(np.int32), int(edges[-1])


def _taken(values: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """``values[indices]`` by torch, which takes half of numpy's time, on the threads of the CPU."""
    found = np.empty(len(indices), dtype=values.dtype)
    data, rows, out = (torch.from_numpy(array) for array in (values, indices, found))
    in_slices(lambda low, high: torch.index_select(data, 0, rows[low:high], out=out[low:high]), torch_slices(len(rows)))
    return found


def _put(values: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """An array of int32 that holds ``values`` at ``indices``, which are a permutation."""
    found = np.empty(len(indices), dtype=np.int32)
    data, rows, out = (torch.from_numpy(array) for array in (values, indices, found))
    in_slices(lambda low, high: out.scatter_(0, rows[low:high].long(), data[low:high].int()), torch_slices(len(rows)))
    return found


def check_count(count: int, camera: Camera, drawn: int, device: torch.device) -> None:
    """Raise InputError if so many tile instances are more than kernels can number, or than fit."""
    touch = f"rasterize: {drawn} Gaussians on {camera.width} x {camera.height} pixels touch tiles {count} times"
    if count > MAX_INSTANCES:
        raise InputError(f"{touch}, more than the {MAX_INSTANCES} that fit; {LESS}.")
    if count > MANY:
        check_memory(f"{touch}, which takes", BYTES * count, device, LESS)


def _check_longest(count: int) -> None:
    if count > MAX_TILE:
        raise InputError(
            f"rasterize: one tile of {TILE} x {TILE} pixels lists {count} Gaussians, more than the {MAX_TILE} that "
            "fit; render fewer Gaussians."
        )


def balanced_slices(ends: np.ndarray) -> list[int]:
    """Bounds of slices of tiles by the number of their instances; an empty tile counts a little, too."""
    work = ends + 32 * np.arange(1, len(ends) + 1)
    return [0, *np.searchsorted(work, falling_slices(int(work[-1]))[1:-1]).tolist(), len(ends)]


def order_by_depth(depths: np.ndarray) -> np.ndarray:
    """The indices [V] int32 of ``depths`` [V] float32 from the least to the largest, ties by index.

    A depth and its index are one whole number of 64 bits, which NumPy sorts by vectors. Many threads sort a piece each,
    and then what all pieces have of a range of depths. The result is the same for any number of pieces. Tried:

    - 1.9 instead of 1.2 ms for 125,000 on AVX-512, as long on AVX2: Warp's radix sort, also in ranges of depths
    - 9.7 instead of 8.0 ms for 700,000: two pieces on two threads
    """
    bits, pairs = depths.view(np.int32), np.empty((len(depths), 2), dtype=np.int32)
    pairs[:, 0], pairs[:, 1] = np.arange(len(depths)), bits ^ (bits >> 31 & 0x7FFFFFFF)  # as floats are ordered
    keys, pieces = pairs.view(np.int64)[:, 0], slice_count(len(depths), 1, IN_PIECES) // 2 or 1
    cuts = [len(keys) * piece // pieces for piece in range(pieces + 1)]
    in_slices(lambda low, high: keys[low:high].sort(), cuts)
    if pieces > 1:
        sample = np.sort(keys[:: -(-len(keys) // SAMPLE)])
        edges = sample[len(sample) * np.arange(1, pieces) // pieces]
        parts = [np.split(piece, np.searchsorted(piece, edges)) for piece in np.split(keys, cuts[1:-1])]
        ranges = [np.concatenate(part) for part in zip(*parts, strict=True)]
        in_slices(lambda number, _: ranges[number].sort(), list(range(pieces + 1)))
        keys = np.concatenate(ranges)
    return keys.astype(np.int32)

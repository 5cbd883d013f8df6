"""Which Gaussians touch which tile, in depth order. Forward only.

Splats are the Gaussians that are drawn. On the CPU they keep the order in which they are stored: most is then read and
written from one end to the other, and what lies near each other in space does so in the caches.

A splat's tiles are found once, in floating point, as one span per row of tiles. All that follows is integer work, so no
two kernels can round differently. Spans are written by depth. So a counting sort by tile, which keeps their order,
gives exact lists without a sort of tile instances. Random reads are left to numpy, whose short loops have many of them
under way at a time. Tried:

- 11 ms for 1.14M instances: a radix sort of the tile numbers
- up to 10 ms instead of 2 to 5 for 125,000: random reads in these kernels
- no faster: a shorter way for splats in a single column of tiles

The adjoint writes a row of gradients for each instance, in the order of the lists. Places tell each splat where its
rows are. Tried:

- 20 ms longer at full size on one thread: rows in the order of the splats; writing here and there waits for memory
- no faster: a row to a line of the cache

A GPU stores splats by depth and sorts the instances. There one kernel runs twice, first to count a splat's tiles and
then to write them: it is the same machine code, and rounds alike.
"""

import functools

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.compiler import FORWARD_ONLY
from warp_splat.kernels.falloff import LOG2_E, reach_of
from warp_splat.kernels.splat import Splat2D
from warp_splat.kernels.structs import Splats2DView

wp.set_module_options(FORWARD_ONLY)

MARGIN = wp.constant(1.0e-3)  # px, far more than the rounding of a span's ends; a spare instance costs time only


@wp.func
def pixels(low: float, high: float, size: int):
    """First and last pixel of a row of ``size`` whose center lies in [low, high]; empty if first > last."""
    # clamped as floats: a huge extent has no int
    first = wp.clamp(wp.ceil(low - 0.5 - MARGIN), 0.0, float(size))
    last = wp.clamp(wp.floor(high - 0.5 + MARGIN), -1.0, float(size - 1))
    return wp.vec2i(int(first), int(last))


@wp.func
def square_of(extent: wp.vec2, conic: wp.vec3, reach: float):
    """Half sides of the reference's square, 3 standard deviations of the long axis, rounded up."""
    xx = extent[0] * extent[0] / reach
    yy = extent[1] * extent[1] / reach
    xy = -conic[1] * yy / conic[0]
    side = wp.ceil(3.0 * wp.sqrt(0.5 * (xx + yy + wp.length(wp.vec2(xx - yy, 2.0 * xy)))))
    return wp.vec2(side, side)


@functools.cache
def make_pack(reach_of: wp.Function = reach_of) -> wp.Kernel:
    """Splats, as the blends read them; ``reach_of`` says where their falloff ends."""

    @wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
    def pack(
        first: int,  # splat of this slice
        gaussians: wp.array[int],  # [V] Gaussian of each splat
        splats2d: Splats2DView,
        height: int,
        alpha_min: float,
        square: int,  # 1: look at the square of the reference instead of the ellipse
        # out
        splats_out: wp.array[Splat2D],  # [V]
        rows_out: wp.array[int],  # [V] rows of tiles that the box touches
    ):
        v = first + wp.tid()
        i = gaussians[v]
        splat = Splat2D()
        splat.mean = splats2d.means2d[i]
        splat.extent = splats2d.extents[i]
        conic = splats2d.conics[i]
        # root' root = conic log2(e) / 2; its last entry, the root of yy - xy^2 / xx, by the box's height: no difference
        root = wp.sqrt(0.5 * LOG2_E * conic[0])
        splat.opacity = splats2d.opacities[i]
        reach = reach_of(splat.opacity, alpha_min)
        splat.root = wp.vec3(root, 0.5 * LOG2_E * conic[1] / root, wp.sqrt(0.5 * LOG2_E * reach) / splat.extent[1])
        if square != 0:
            splat.extent = square_of(splat.extent, conic, reach)
        splat.color = splats2d.colors[i]
        splat.depth = splats2d.depths[i]
        splats_out[v] = splat
        span = pixels(splat.mean[1] - splat.extent[1], splat.mean[1] + splat.extent[1], height)
        rows_out[v] = wp.max(span[1] // TILE - span[0] // TILE + 1, 0)

    return pack


@wp.struct
class Outline:
    """The ellipse q <= reach / 2, or the square around it, cut by rows of tiles.

    At height dy it spans dx = slope dy +- half sqrt(1 - (dy / extent y)^2).
    """

    slope: float
    half: float
    turn: float  # dy at its right end
    top: int  # first row of tiles
    bottom: int  # last


@wp.func
def outline_of(splat: Splat2D, height: int):
    outline = Outline()
    rows = pixels(splat.mean[1] - splat.extent[1], splat.mean[1] + splat.extent[1], height)
    outline.top = rows[0] // TILE
    outline.bottom = rows[1] // TILE
    outline.slope = -splat.root[1] / splat.root[0]
    outline.half = splat.root[2] * splat.extent[1] / splat.root[0]  # sqrt(reach log2(e) / 2) / root; square: unused
    outline.turn = outline.slope * splat.extent[1] * splat.extent[1] / splat.extent[0]
    return outline


@wp.func
def cut(splat: Splat2D, outline: Outline, row: int, width: int, square: int):
    """First tile of a row of tiles that the outline touches, and how many."""
    low = float(row * TILE) + 0.5 - splat.mean[1] - MARGIN
    high = low + float(TILE - 1) + 2.0 * MARGIN
    low = wp.max(low, -splat.extent[1])
    high = wp.min(high, splat.extent[1])
    dy_right = wp.clamp(outline.turn, low, high)
    dy_left = wp.clamp(-outline.turn, low, high)
    f_right = dy_right / splat.extent[1]
    f_left = dy_left / splat.extent[1]
    right = outline.slope * dy_right + outline.half * wp.sqrt(wp.max(1.0 - f_right * f_right, 0.0))
    left = outline.slope * dy_left - outline.half * wp.sqrt(wp.max(1.0 - f_left * f_left, 0.0))
    if square != 0:
        right = splat.extent[0]
        left = -splat.extent[0]
    span = pixels(splat.mean[0] + left, splat.mean[0] + right, width)
    return wp.vec2i(span[0] // TILE, wp.max(span[1] // TILE - span[0] // TILE + 1, 0))


@wp.func
def begin_of(ends: wp.array[wp.int64], i: int):
    """Where what belongs to ``i`` begins, from the inclusive scan of the counts."""
    begin = int(0)
    if i > 0:
        begin = int(ends[i - 1])
    return begin


@wp.kernel
def find_spans(
    first: int,
    splats: wp.array[Splat2D],  # [V]
    rows: wp.array[int],  # [V]
    begins: wp.array[int],  # [V] where its rows go
    width: int,
    height: int,
    tiles_x: int,
    square: int,
    # out
    spans_out: wp.array[wp.vec2i],  # [R] per row of tiles, nearest splat first: first tile, number of tiles
    instances_out: wp.array[wp.int64],  # [V] tiles in all
):
    v = first + wp.tid()
    splat = splats[v]
    outline = outline_of(splat, height)
    found = int(0)
    for row in range(rows[v]):
        span = cut(splat, outline, outline.top + row, width, square)
        spans_out[begins[v] + row] = wp.vec2i((outline.top + row) * tiles_x + span[0], span[1])
        found += span[1]
    instances_out[v] = wp.int64(found)


@wp.kernel
def list_tiles(
    first: int,
    order: wp.array[int],  # [N] Gaussian, nearest first, those that are not drawn last
    radii: wp.array[int],  # [N]
    splats: wp.array[Splat2D],  # [N] by rank; undefined where not drawn
    width: int,
    height: int,
    tiles_x: int,
    square: int,
    place_ends: wp.array[wp.int64],  # [N] inclusive scan of what the first run counted; [0] in that run
    # out
    instances_out: wp.array[wp.int64],  # [N] tiles in all, in the first run
    tiles_out: wp.array[int],  # [M] by rank, in the second run
    ranks_out: wp.array[int],  # [M]
):
    rank = first + wp.tid()
    writes = place_ends.shape[0] > 0
    begin = int(0)
    if writes:
        begin = begin_of(place_ends, rank)
    found = int(0)
    if radii[order[rank]] > 0:
        splat = splats[rank]
        outline = outline_of(splat, height)
        for row in range(outline.top, outline.bottom + 1):
            span = cut(splat, outline, row, width, square)
            if writes:
                for column in range(span[1]):
                    tiles_out[begin + found + column] = row * tiles_x + span[0] + column
                    ranks_out[begin + found + column] = rank
            found += span[1]
    if not writes:
        instances_out[rank] = wp.int64(found)


@wp.kernel
def count_tiles(
    first: int,  # always 0: one launch index per band
    bands: wp.array[int],  # [B + 1] bounds of the bands in `spans`
    spans: wp.array[wp.vec2i],  # [R]
    # out
    counts_out: wp.array2d[int],  # [B, T] instances of a tile that come from a band
):
    band = first + wp.tid()
    for row in range(bands[band], bands[band + 1]):
        span = spans[row]
        for tile in range(span[0], span[0] + span[1]):
            counts_out[band, tile] = counts_out[band, tile] + 1


@wp.kernel
def scatter(
    first: int,
    bounds: wp.array[int],  # [B + 1] of the bands in `order`
    order: wp.array[int],  # [V] splat, nearest first
    begins: wp.array[int],  # [V] where the places of each begin, in that order
    row_ends: wp.array[wp.int64],  # [V] likewise
    spans: wp.array[wp.vec2i],  # [R]
    # out
    cursor_out: wp.array2d[int],  # [B, T] where a band's next instance of a tile goes
    instances_out: wp.array[int],  # [M] splats, by tile, nearest first
    places_out: wp.array[int],  # [M] where in those lists, splat by splat
):
    band = first + wp.tid()
    row = begin_of(row_ends, bounds[band])
    for rank in range(bounds[band], bounds[band + 1]):
        number = begins[rank]
        end = int(row_ends[rank])
        while row < end:
            span = spans[row]
            for tile in range(span[0], span[0] + span[1]):
                place = cursor_out[band, tile]
                instances_out[place] = order[rank]
                places_out[number] = place
                cursor_out[band, tile] = place + 1
                number += 1
            row += 1

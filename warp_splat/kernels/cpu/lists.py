"""How the CPU lists the splats of each tile: by spans and a counting sort in bands.

Splats keep the order in which they are stored: most is then read and written from one end to the other, and what lies
near each other in space does so in the caches. Spans are written by depth. So a counting sort by tile, which keeps
their order, gives exact lists without a sort of tile instances. Where something is written here and there, the lines of
memory are asked for some rounds before. Tried:

- 11 ms for 1.14M instances: a radix sort of the tile numbers
- 47 instead of 22 ms for 700,000 splats: spans written without asking before; 32, one splat after another
- 39 instead of 9 ms: spans in the order of the splats, read by depth
- no faster: a shorter way for splats in a single column of tiles
- as long: kernels for what NumPy and torch do between these: the Gaussians that are drawn, sums, what lies where
- 4.5 instead of 1.1 ms for 70,000 splats: the box and root of one after the other

The adjoint writes a row of gradients for each instance, in the order of the lists. Places tell each splat where its
rows are. Tried:

- 20 ms longer at full size on one thread: rows in the order of the splats; writing here and there waits for memory
- no faster: a row to a line of the cache
"""

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.compiler import FORWARD_ONLY, once
from warp_splat.kernels.cpu.ahead import ask
from warp_splat.kernels.simd import LANES, vec16, vec16i
from warp_splat.kernels.splat import Splat2D
from warp_splat.kernels.structs import Splats2DView
from warp_splat.kernels.tiles import MARGIN, cut, make_shaped, outline, packed, pixels

wp.set_module_options(FORWARD_ONLY)

AHEAD = wp.constant(32)  # rounds for which memory is asked before


@once
def make_pack(reach_of: wp.Function) -> wp.Kernel:
    """Splats as the blends read them, and how many rows of tiles each has; ``reach_of``: where their falloff ends."""
    shaped = make_shaped(reach_of, LANES)

    @wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
    def pack(
        first: int,  # group of splats of this slice
        gaussians: wp.array[int],  # [V] Gaussian of each splat
        splats2d: Splats2DView,
        height: int,
        alpha_min: float,
        square: int,  # 1: look at the square of the reference instead of the ellipse
        # out
        splats_out: wp.array[Splat2D],  # [V]
        rows_out: wp.array[int],  # [V] rows of tiles that the box touches
    ):
        group = (first + wp.tid()) * LANES
        last = gaussians.shape[0] - 1
        y = vec16()
        x_extent = vec16()
        y_extent = vec16()
        conic0 = vec16()
        conic1 = vec16()
        opacity = vec16()
        for lane in range(LANES):
            i = gaussians[wp.min(group + lane, last)]
            y[lane] = splats2d.means2d[i][1]
            x_extent[lane] = splats2d.extents[i][0]
            y_extent[lane] = splats2d.extents[i][1]
            conic0[lane] = splats2d.conics[i][0]
            conic1[lane] = splats2d.conics[i][1]
            opacity[lane] = splats2d.opacities[i]
        x_extent, y_extent, root0, root1, root2 = shaped(x_extent, y_extent, conic0, conic1, opacity, alpha_min, square)
        tops, bottoms = pixels(y - y_extent, y + y_extent, height, MARGIN)
        for lane in range(LANES):
            v = group + lane
            if v <= last:
                extent = wp.vec2(x_extent[lane], y_extent[lane])
                root = wp.vec3(root0[lane], root1[lane], root2[lane])
                splats_out[v] = packed(splats2d, gaussians[v], extent, root)
                rows_out[v] = wp.max(bottoms[lane] // TILE - tops[lane] // TILE + 1, 0)

    return pack


@wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
def find_spans(
    first: int,  # group of splats of this slice
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
    group = (first + wp.tid()) * LANES
    last = splats.shape[0] - 1
    x = vec16()
    y = vec16()
    x_extent = vec16()
    y_extent = vec16()
    root0 = vec16()
    root1 = vec16()
    root2 = vec16()
    most = int(0)
    for lane in range(LANES):
        ask(spans_out, begins[wp.min(group + lane + AHEAD, last)])
        v = wp.min(group + lane, last)
        splat = splats[v]
        x[lane] = splat.mean[0]
        y[lane] = splat.mean[1]
        x_extent[lane] = splat.extent[0]
        y_extent[lane] = splat.extent[1]
        root0[lane] = splat.root[0]
        root1[lane] = splat.root[1]
        root2[lane] = splat.root[2]
        most = wp.max(most, rows[v])
    slope, half, turn = outline(x_extent, y_extent, root0, root1, root2)
    tops, _bottoms = pixels(y - y_extent, y + y_extent, height, MARGIN)
    top = vec16()
    found = vec16i()
    for lane in range(LANES):
        top[lane] = float(tops[lane] // TILE)
    for row in range(most):
        here = top + vec16(float(row))
        firsts, lasts = cut(x, y, x_extent, y_extent, slope, half, turn, here, width, square, MARGIN)
        lane = int(0)
        while lane < LANES:
            v = group + lane
            if v <= last:
                if row < rows[v]:
                    tile = firsts[lane] // TILE
                    count = wp.max(lasts[lane] // TILE - tile + 1, 0)
                    spans_out[begins[v] + row] = wp.vec2i((tops[lane] // TILE + row) * tiles_x + tile, count)
                    found[lane] = found[lane] + count
            lane += 1
    for lane in range(LANES):
        if group + lane <= last:
            instances_out[group + lane] = wp.int64(found[lane])


@wp.kernel
def count_tiles(
    first: int,  # band of this slice
    bands: wp.array[int],  # [B + 1] bounds of the bands in `spans`
    spans: wp.array[wp.vec2i],  # [R]
    # out
    changes_out: wp.array2d[int],  # [B, T + 1] instances of a tile that come from a band, less those of the one before
):
    band = first + wp.tid()
    for row in range(bands[band], bands[band + 1]):
        span = spans[row]
        end = span[0] + span[1]
        changes_out[band, span[0]] = changes_out[band, span[0]] + 1
        changes_out[band, end] = changes_out[band, end] - 1


@wp.kernel
def scatter(
    first: int,
    bounds: wp.array[int],  # [B + 1] of the bands in `order`
    order: wp.array[int],  # [V] splat, nearest first
    begins: wp.array[int],  # [V] where the places of each splat begin
    row_ends: wp.array[wp.int64],  # [V] where the rows of tiles end, in the order
    spans: wp.array[wp.vec2i],  # [R]
    # out
    cursor_out: wp.array2d[int],  # [B, T] where a band's next instance of a tile goes
    instances_out: wp.array[int],  # [M] splats, by tile, nearest first
    places_out: wp.array[int],  # [M] where in those lists, splat by splat
):
    band = first + wp.tid()
    row = int(0)
    if bounds[band] > 0:
        row = int(row_ends[bounds[band] - 1])
    for rank in range(bounds[band], bounds[band + 1]):
        ask(places_out, begins[order[wp.min(rank + AHEAD, order.shape[0] - 1)]])
        number = begins[order[rank]]
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

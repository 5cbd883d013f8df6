"""Tile lists on CUDA: instances of splats nearest first, which a stable sort then brings together tile by tile.

A splat's tiles are found twice, by the same functions: first to count them, then to write them. No compiler may fuse a
multiplication with an addition in one place and not in the other (``SPELLED_OUT``). Were they to differ nevertheless,
nothing is written beyond the places that were counted; the self-test compares both runs.

There may be room for more instances than there are. What is left over belongs to no tile, and comes last. There may be
room for fewer: then nothing is written beyond it.
"""

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.compiler import once
from warp_splat.kernels.splat import Splat2D
from warp_splat.kernels.structs import Splats2DView
from warp_splat.kernels.tiles import MARGIN, SPELLED_OUT, cut, make_shaped, outline, packed, pixels


@wp.func
def tile_rows_of(splat: Splat2D, height: int):
    """The first row of tiles that a splat touches, and the one after the last."""
    top, bottom = pixels(splat.mean[1] - splat.extent[1], splat.mean[1] + splat.extent[1], height, MARGIN)
    return top // TILE, bottom // TILE + 1


@wp.func
def tiles_of_row(splat: Splat2D, row: int, width: int, square: int):
    """The first tile of a row that it touches, and how many."""
    x_extent, y_extent = splat.extent[0], splat.extent[1]
    slope, half, turn = outline(x_extent, y_extent, splat.root[0], splat.root[1], splat.root[2])
    left, right = cut(
        splat.mean[0], splat.mean[1], x_extent, y_extent, slope, half, turn, float(row), width, square, MARGIN
    )  # fmt: skip
    return left // TILE, wp.max(right // TILE - left // TILE + 1, 0)


@once
def make_count_tiles(reach_of: wp.Function) -> wp.Kernel:
    """Splats by rank, and the tiles of each; ``reach_of`` says where their falloff ends."""
    shaped = make_shaped(reach_of, 1)

    @wp.kernel(module="unique", module_options=dict(SPELLED_OUT))
    def count_tiles(
        first: int,
        order: wp.array[wp.int64],  # [N] Gaussian, nearest first; those that are not drawn stand somewhere
        splats2d: Splats2DView,
        width: int,
        height: int,
        alpha_min: float,
        square: int,  # 1: look at the square of the reference instead of the ellipse
        # out
        gaussians_out: wp.array[int],  # [N] that order
        splats_out: wp.array[Splat2D],  # [N]; undefined where not drawn
        counts_out: wp.array[wp.int64],  # [N] tiles; 0 where not drawn
    ):
        rank = first + wp.tid()
        i = int(order[rank])
        extent = splats2d.extents[i]
        conic = splats2d.conics[i]
        x_extent, y_extent, root0, root1, root2 = shaped(
            extent[0], extent[1], conic[0], conic[1], splats2d.opacities[i], alpha_min, square
        )
        splat = packed(splats2d, i, wp.vec2(x_extent, y_extent), wp.vec3(root0, root1, root2))
        found = int(0)
        if splats2d.radii[i] > 0:
            top, below = tile_rows_of(splat, height)
            for row in range(top, below):
                _left, count = tiles_of_row(splat, row, width, square)
                found += count
        gaussians_out[rank] = i
        splats_out[rank] = splat
        counts_out[rank] = wp.int64(found)

    return count_tiles


@wp.func
def begin_of(ends: wp.array[wp.int64], i: int, room: int):
    """Where what belongs to ``i`` begins, from the inclusive scan of the counts, within ``room``."""
    begin = wp.int64(0)
    if i > 0:
        begin = ends[i - 1]
    return int(wp.min(begin, wp.int64(room)))


@once
def make_list_tiles(narrow: bool) -> wp.Kernel:
    """Instances by rank; ``narrow``: tiles in 16 bits."""
    number = wp.int16 if narrow else int

    @wp.kernel(module="unique", module_options=dict(SPELLED_OUT))
    def list_tiles(
        first: int,
        splats: wp.array[Splat2D],  # [N]
        width: int,
        height: int,
        square: int,
        ends: wp.array[wp.int64],  # [N] inclusive scan of the counts
        # out
        begins_out: wp.array[int],  # [N + 1] where those of each begin; last, where all end
        tiles_out: wp.array[number],  # [M]; T where there is none
        ranks_out: wp.array[int],  # [M]
        counts_out: wp.array[int],  # [N] tiles in this run; or [0]
    ):
        rank = first + wp.tid()  # N + 1 of them
        count = ends.shape[0]
        room = tiles_out.shape[0]
        tiles_x = (width + TILE - 1) // TILE
        begin = begin_of(ends, rank, room)
        begins_out[rank] = begin
        total = begin_of(ends, count, room)
        for left_over in range(rank, room - total, count + 1):
            tiles_out[total + left_over] = number(tiles_x * ((height + TILE - 1) // TILE))
            ranks_out[total + left_over] = 0
        if rank < count:
            end = begin_of(ends, rank + 1, room)
            found = int(0)
            if begin < end:
                splat = splats[rank]
                top, below = tile_rows_of(splat, height)
                for row in range(top, below):
                    left, columns = tiles_of_row(splat, row, width, square)
                    for column in range(wp.min(columns, end - begin - found)):
                        tiles_out[begin + found + column] = number(row * tiles_x + left + column)
                        ranks_out[begin + found + column] = rank
                    found += columns
            for place in range(begin + found, end):  # none, if both runs round alike; else it hardly shows there
                tiles_out[place] = number(0)
                ranks_out[place] = rank
            if counts_out.shape[0] > 0:
                counts_out[rank] = found

    return list_tiles


@once
def make_gather_tiles(narrow: bool) -> wp.Kernel:
    """Instances by tile, after the sort; ``narrow``: tiles in 16 bits."""
    number = wp.int16 if narrow else int

    @wp.kernel(module="unique", module_options=dict(SPELLED_OUT))
    def gather_tiles(
        first: int,
        tiles: wp.array[number],  # [M] sorted
        places: wp.array[wp.int64],  # [M] where each stood before
        ranks: wp.array[int],  # [M] there
        # out
        instances_out: wp.array[int],  # [M]
        places_out: wp.array[int],  # [M] where each is now
        ranges_out: wp.array2d[int],  # [T, 2]
    ):
        k = first + wp.tid()  # M + 1 of them: the last ends all tiles
        tile_count = ranges_out.shape[0]
        before = int(-1)
        here = tile_count
        if k > 0:
            before = int(tiles[k - 1])
        if k < tiles.shape[0]:
            here = int(tiles[k])
            place = int(places[k])
            instances_out[k] = ranks[place]
            places_out[place] = k
        for tile in range(before, here):  # between two instances, as many tiles end as begin
            if tile >= 0:
                ranges_out[tile, 1] = k
            if tile + 1 < tile_count:
                ranges_out[tile + 1, 0] = k

    return gather_tiles

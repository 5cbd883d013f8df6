"""Which tiles a splat touches. Forward only.

Splats are the Gaussians that are drawn. A splat's tiles are found once, in floating point, as one span per row of
tiles. All that follows is integer work, so no two kernels can round differently. What the CPU makes of them is in
``kernels/cpu/lists.py``, a GPU in ``kernels/cuda/lists.py``.
"""

from typing import Any

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.compiler import FORWARD_ONLY, once
from warp_splat.kernels.falloff import LOG2_E, in_each_lane
from warp_splat.kernels.simd import TYPES, fill, over, root, rounded_down, rounded_up, times, whole
from warp_splat.kernels.splat import Splat2D
from warp_splat.kernels.structs import BinsView, Splats2DView

#: Every operation is rounded by itself, on a GPU, too.
SPELLED_OUT = {**FORWARD_ONLY, "fuse_fp": False}

wp.set_module_options(SPELLED_OUT)

MARGIN = wp.constant(1.0e-3)  # px, far more than the rounding of a span's ends; a spare instance costs time only


@wp.func
def pixels(low: Any, high: Any, size: int, margin: float):
    """First and last pixel of a row of ``size`` whose center is within ``margin`` of [low, high]; or first > last."""
    last = float(size)
    # clamped as floats: a huge extent has no int
    first = wp.min(wp.max(rounded_up(low - fill(0.5, low) - fill(margin, low)), fill(0.0, low)), fill(last, low))
    up_to = wp.max(rounded_down(high - fill(0.5, low) + fill(margin, low)), fill(-1.0, low))
    return whole(first), whole(wp.min(up_to, fill(last - 1.0, low)))


@wp.func
def square_of(x_extent: Any, y_extent: Any, xx: Any, xy: Any, reach: Any):
    """Half side of the reference's square, 3 standard deviations of the long axis, rounded up; of a conic."""
    var_x = over(times(x_extent, x_extent), reach)
    var_y = over(times(y_extent, y_extent), reach)
    cov = over(times(-xy, var_y), xx)
    across = root(times(var_x - var_y, var_x - var_y) + times(times(cov, 2.0), times(cov, 2.0)))
    return rounded_up(times(root(times(var_x + var_y + across, 0.5)), 3.0))


@once
def make_shaped(reach_of: wp.Function, lanes: int) -> wp.Function:
    """Half sides of the box, and the root, of a splat; ``reach_of`` says where its falloff ends."""
    number = TYPES[lanes].number
    reaches = in_each_lane(reach_of) if lanes > 1 else reach_of

    @wp.func
    def shaped(
        x_extent: number, y_extent: number, xx: number, xy: number, opacity: number, alpha_min: float, square: int
    ):
        # root' root = conic log2(e) / 2; its last entry, the root of yy - xy^2 / xx, by the box's height: no difference
        scale = root(times(xx, 0.5 * LOG2_E))
        reach = reaches(opacity, alpha_min)
        turned = over(times(xy, 0.5 * LOG2_E), scale)
        last = over(root(times(reach, 0.5 * LOG2_E)), y_extent)
        if square != 0:
            side = square_of(x_extent, y_extent, xx, xy, reach)
            return side, side, scale, turned, last
        return x_extent, y_extent, scale, turned, last

    return shaped


@wp.func
def packed(splats2d: Splats2DView, i: int, extent: wp.vec2, root: wp.vec3):
    """A splat, as the blends read it."""
    splat = Splat2D()
    splat.mean = splats2d.means2d[i]
    splat.extent = extent
    splat.root = root
    splat.opacity = splats2d.opacities[i]
    splat.color = splats2d.colors[i]
    splat.depth = splats2d.depths[i]
    return splat


@wp.func
def first_pixel_of(bins: BinsView, tile: int):
    """Column and line of a tile's first pixel in its picture [px], and the line at which that begins."""
    own = tile % bins.tiles
    return (own % bins.tiles_x) * TILE, (own // bins.tiles_x) * TILE, (tile // bins.tiles) * bins.height


@wp.func
def outline(x_extent: Any, y_extent: Any, root0: Any, root1: Any, root2: Any):
    """The ellipse q <= reach / 2, at height dy: dx = slope dy +- half sqrt(1 - (dy / extent y)^2).

    Returns (slope, half, dy at its right end).
    """
    slope = over(-root1, root0)
    half = over(times(root2, y_extent), root0)  # sqrt(reach log2(e) / 2) / root; of a square: unused
    return slope, half, over(times(times(slope, y_extent), y_extent), x_extent)


@wp.func
def cut(
    x: Any, y: Any, x_extent: Any, y_extent: Any, slope: Any, half: Any, turn: Any, row: Any,
    width: int, square: int, margin: float,
):  # fmt: skip
    """First and last pixel between which the outline, or the square around it, touches a row of tiles."""
    one = fill(1.0, x)
    low = times(row, float(TILE)) + fill(0.5, x) - y - fill(margin, x)
    high = low + fill(float(TILE - 1), x) + fill(2.0 * margin, x)
    low = wp.max(low, -y_extent)
    high = wp.min(high, y_extent)
    dy_right = wp.min(wp.max(turn, low), high)
    dy_left = wp.min(wp.max(-turn, low), high)
    f_right = over(dy_right, y_extent)
    f_left = over(dy_left, y_extent)
    right = times(slope, dy_right) + times(half, root(wp.max(one - times(f_right, f_right), fill(0.0, x))))
    left = times(slope, dy_left) - times(half, root(wp.max(one - times(f_left, f_left), fill(0.0, x))))
    if square != 0:
        right = x_extent
        left = -x_extent
    return pixels(x + left, x + right, width, margin)


@wp.kernel
def count_in_front(
    first: int,
    bins: BinsView,
    surface: wp.array2d[float],  # [H, W] its depth; where it is not positive, there is none
    lanes: int,  # that hold the pixels of a block of 4 x 4, or one pixel after the other
    # out
    limits_out: wp.array2d[float],  # [T, TILE TILE] instances in front of it
):
    tile = first + wp.tid()
    start = bins.ranges[tile][0]
    column, line, begin = first_pixel_of(bins, tile)
    for place in range(TILE * TILE):
        x = place % TILE
        y = place // TILE
        if lanes > 1:
            x = 4 * (place // lanes % 4) + place % 4
            y = 4 * (place // lanes // 4) + place % lanes // 4
        x = wp.min(column + x, surface.shape[1] - 1)
        y = begin + wp.min(line + y, bins.height - 1)
        high = int(bins.ranges[tile][1])
        low = wp.where(surface[y, x] > 0.0, start, high)
        while low < high:
            middle = (low + high) // 2
            if bins.splats[bins.instances[middle]].depth < surface[y, x]:
                low = middle + 1
            else:
                high = middle
        limits_out[tile, place] = float(low - start)


@wp.kernel
def merge_lists(
    first: int,
    back: BinsView,  # of T tiles
    front: BinsView,  # of as many tiles of each of several pictures; splats that are numbered after those
    ranges: wp.array[wp.vec2i],  # [V T] of the merged lists; empty where nothing of `front` is
    # out
    instances_out: wp.array[int],  # [M] nearest first, of equal ones those of `back`
):
    tile = first + wp.tid()
    i = back.ranges[tile % back.ranges.shape[0]][0]
    end = back.ranges[tile % back.ranges.shape[0]][1]
    k = front.ranges[tile][0]
    for place in range(ranges[tile][0], ranges[tile][1]):
        behind = k == front.ranges[tile][1]
        if i < end and not behind:
            behind = not front.splats[front.instances[k]].depth < back.splats[back.instances[i]].depth
        if behind:
            instances_out[place] = back.instances[i]
            i += 1
        else:
            instances_out[place] = back.splats.shape[0] + front.instances[k]
            k += 1

"""The bound beside CUDA's blend, as ``kernels/cpu/settle.py`` keeps it: a row for each sum, a column for each pixel."""

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.bound import (
    BoundView,
    Since,
    all_cuts,
    all_rounding,
    light_behind,
    make_skipped,
    next_map,
    outside_of,
    own_light,
    rounding_of,
    watch,
)
from warp_splat.kernels.cuda.warps import across_of, down_of
from warp_splat.kernels.simd import where_less
from warp_splat.kernels.structs import BinsView

EACH = 4  # pixels of a lane
skipped = make_skipped(floor=True)
SKIPPED, TOTAL, TAKEN, ADDED, ROUNDING, BEFORE, LIGHT = (wp.constant(row) for row in range(7))
mat_settled = wp.types.matrix(shape=(9, EACH), dtype=float)
vec_each = wp.types.vector(length=EACH, dtype=float)


@wp.func
def settle(
    m: mat_settled,
    p: int,
    pixel: wp.vec4,
    bound: BoundView,
    since: Since,
    end: int,
    tile: int,
    tiles_x: int,
    block: int,
):
    """The sums of a pixel up to here, where the map ``end`` follows those that begin."""
    t = wp.abs(pixel[3])
    now = wp.vec3(pixel[0], pixel[1], pixel[2])
    gained = wp.max(wp.max(now - wp.vec3(m[LIGHT, p], m[LIGHT + 1, p], m[LIGHT + 2, p])), 0.0)
    q = m[SKIPPED, p]
    total = m[TOTAL, p] + q
    before = wp.max(m[BEFORE, p], t)
    m[TAKEN, p] = light_behind(total, gained, m[TAKEN, p])
    m[ROUNDING, p] = m[ROUNDING, p] + rounding_of(before, t, wp.max(now), since, bound.brightest)
    outside = outside_of(bound, since.map, end, tile, tiles_x, block)
    added = own_light(before, q, bound.usual + since.shade, m[ADDED, p])
    m[ADDED, p] = own_light(t, outside, bound.usual, added)
    m[TOTAL, p] = total + outside
    m[BEFORE, p] = t
    m[SKIPPED, p] = 0.0
    for channel in range(3):
        m[LIGHT + channel, p] = now[channel]
    return m


@wp.func
def block_at(lane: int, pixel: int):
    """The block of 4 x 4 pixels of the tile in which one of a lane's pixels lies."""
    return (down_of(lane, pixel) // 4) * 4 + across_of(lane, pixel) // 4


@wp.func
def expect(
    m: mat_settled, ts: vec_each, reds: vec_each, greens: vec_each, blues: vec_each, bound: BoundView, since: Since,
    bins: BinsView, tile: int, lane: int, half: int, k: int, count: int,
):  # fmt: skip
    """Before ``count`` entries from ``k`` on: the sums, and what there is since they were settled."""
    end = next_map(bound, since.map, bins.splats[bins.instances[k + count - 1]].depth)
    if end > since.map:
        for p in range(EACH):
            pixel = wp.vec4(reds[p], greens[p], blues[p], ts[p])
            m = settle(m, p, pixel, bound, since, end, tile, bins.tiles_x, block_at(lane, half + p))
        since = Since()
        since.map = end
    return m, watch(bound, since, bins, k, count)


@wp.func
def skip(m: mat_settled, p: int, raw: float, alpha_min: float, color: wp.vec3, bound: BoundView):
    """With what a pixel leaves out."""
    m[SKIPPED, p] = skipped(raw, alpha_min, color, bound, m[SKIPPED, p])
    return m


@wp.func
def conclude(
    m: mat_settled, p: int, sums: wp.vec4, final: float, bound: BoundView, since: Since, bins: BinsView, tile: int,
    lane: int, half: int, length: int,
):  # fmt: skip
    """Write the bound of a pixel, which saw ``length`` entries of the list."""
    pixel = wp.vec4(sums[0], sums[1], sums[2], final)
    block = block_at(lane, half + p)
    m = settle(m, p, pixel, bound, since, bound.begins.shape[0], tile, bins.tiles_x, block)
    t = wp.abs(final)
    stopped = where_less(final, 0.0, 1.0, wp.where(bins.ranges[tile][1] - bins.ranges[tile][0] > length, 1.0, 0.0))
    hidden = stopped * wp.max(bound.brightest - bound.darkest, bound.behind)
    taken = light_behind(m[TOTAL, p], t * wp.max(stopped * bound.brightest, bound.behind), m[TAKEN, p])
    rounding = all_rounding(m[ROUNDING, p], bound)
    y = (tile // bins.tiles_x) * TILE + down_of(lane, half + p)
    x = (tile % bins.tiles_x) * TILE + across_of(lane, half + p)
    if y < bound.bound_out.shape[0] and x < bound.bound_out.shape[1]:
        bound.bound_out[y, x] = all_cuts(taken, m[ADDED, p], t * hidden, bound) + rounding
        bound.rounding_out[y, x] = rounding

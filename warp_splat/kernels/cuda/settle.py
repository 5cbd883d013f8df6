"""The bound beside CUDA's blend, as ``kernels/cpu/settle.py`` keeps it: a row for each sum, a column for each pixel."""

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels import bound as bounds
from warp_splat.kernels.bound import BoundView, Since
from warp_splat.kernels.compiler import once
from warp_splat.kernels.cuda.warps import across_of, down_of, vec12
from warp_splat.kernels.simd import where_less
from warp_splat.kernels.slots import CHANNEL, OPACITY
from warp_splat.kernels.splat import BlendVariant
from warp_splat.kernels.structs import BinsView

EACH = 4  # pixels of a lane of the blend, each in a block of 8 x 4
T, BEFORE, TOTAL, TAKEN, ADDED, ROUNDING, LIGHT = (wp.constant(row) for row in range(7))
SEEN = wp.constant(9)
vec_each = wp.types.vector(length=EACH, dtype=float)
mat_settled = wp.types.matrix(shape=(12, EACH), dtype=float)


@wp.func
def settle(m: mat_settled, p: int, bound: BoundView, since: Since, end: int, tile: int, tiles_x: int, block: int):
    """The sums of a pixel up to here, where the map ``end`` follows those that begin."""
    t = m[T, p]
    gained = float(0.0)
    light = float(0.0)
    for channel in range(3):
        now = m[LIGHT + channel, p]
        gained = wp.max(gained, now - m[SEEN + channel, p])
        light = wp.max(light, now)
        m[SEEN + channel, p] = now
    m[TAKEN, p] = bounds.light_behind(m[TOTAL, p], gained, m[TAKEN, p])
    m[ROUNDING, p] = m[ROUNDING, p] + bounds.rounding_of(m[BEFORE, p], t, light, since, bound.brightest)
    outside = bounds.outside_of(bound, since.map, end, tile, tiles_x, block)
    m[ADDED, p] = bounds.own_light(t, outside, bound.usual, m[ADDED, p])
    m[TOTAL, p] = m[TOTAL, p] + outside
    m[BEFORE, p] = t
    return m


@wp.func
def block_at(lane: int, pixel: int):
    """The block of 4 x 4 pixels of the tile in which one of a lane's pixels lies."""
    return (down_of(lane, pixel) // 4) * 4 + across_of(lane, pixel) // 4


@wp.func
def at_start():
    """The sums before the first entry."""
    m = mat_settled()
    for p in range(EACH):
        m[T, p] = 1.0
        m[BEFORE, p] = 1.0
    return m


@wp.func
def expect(
    m: mat_settled, bound: BoundView, since: Since, bins: BinsView, tile: int, lane: int, half: int, k: int, count: int
):  # fmt: skip
    """Before ``count`` entries from ``k`` on: the sums, and what there is since they were settled."""
    end = bounds.next_map(bound, since.map, bins.splats[bins.instances[k + count - 1]].depth)
    if end > since.map:
        for p in range(EACH):
            m = settle(m, p, bound, since, end, tile, bins.tiles_x, block_at(lane, half + p))
        since = Since()
        since.map = end
    return m, bounds.watch(bound, since, bins, k, count)


@once
def make_ideal(variant: BlendVariant) -> tuple[wp.Function, wp.Function]:
    """What keeps the ideal: from the picture's sums, if those are its own, and with one more Gaussian."""

    @wp.func
    def of_picture(m: mat_settled, ts: vec_each, reds: vec_each, greens: vec_each, blues: vec_each):
        if wp.static(not variant.ideal):
            for p in range(EACH):
                m[T, p] = wp.abs(ts[p])
                m[LIGHT, p] = reds[p]
                m[LIGHT + 1, p] = greens[p]
                m[LIGHT + 2, p] = blues[p]
        return m

    @wp.func
    def blend_ideal(m: mat_settled, p: int, shown: float, fall: float, g: vec12, alphas: wp.vec2, bound: BoundView):
        t, raw = wp.abs(shown), fall * g[OPACITY]
        color = wp.vec3(g[CHANNEL], g[CHANNEL + 1], g[CHANNEL + 2])
        if wp.static(variant.ideal):
            t = m[T, p]
            weight = bounds.sure(raw, alphas, bound) * t
            for channel in range(3):
                m[LIGHT + channel, p] += weight * color[channel]
            m[T, p] -= weight
        if wp.static(variant.floor):
            may = bounds.unsure(raw, bound)
            m[TOTAL, p] += may
            may *= bounds.brightness(color, bound.shade, bound.usual)
            m[ADDED, p] = bounds.own_light(t, may, bound.usual, m[ADDED, p])
        return m

    return of_picture, blend_ideal


@wp.func
def conclude(
    m: mat_settled, p: int, sums: wp.vec4, final: float, background: wp.array[float], bound: BoundView, since: Since,
    bins: BinsView, tile: int, lane: int, half: int, length: int,
):  # fmt: skip
    """Write the bound of a pixel, which saw ``length`` entries of the list."""
    m = settle(m, p, bound, since, bound.begins.shape[0], tile, bins.tiles_x, block_at(lane, half + p))
    t = m[T, p]
    stopped = where_less(final, 0.0, t, wp.where(bins.ranges[tile][1] - bins.ranges[tile][0] > length, t, 0.0))
    taken = bounds.light_behind(m[TOTAL, p], wp.max(stopped * bound.brightest, t * bound.behind), m[TAKEN, p])
    cuts = float(0.0)
    for channel in range(3):
        change = (t - wp.abs(final)) * background[channel] + m[LIGHT + channel, p] - sums[channel]
        cuts = bounds.all_cuts(change, taken, m[ADDED, p], cuts)
    rounding = bounds.all_rounding(m[ROUNDING, p], bound)
    y = (tile // bins.tiles_x) * TILE + down_of(lane, half + p)
    x = (tile % bins.tiles_x) * TILE + across_of(lane, half + p)
    if y < bound.bound_out.shape[0] and x < bound.bound_out.shape[1]:
        bound.bound_out[y, x] = bounds.with_rest(cuts, stopped, bound) + rounding
        bound.rounding_out[y, x] = rounding

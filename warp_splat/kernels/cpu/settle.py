"""The bound beside the CPU's blend, which keeps the ideal beside the picture, if it differs: transmittance and color.

What the blend does not see is settled where a map of depth begins, and at the end. Sixteen rows each, one for every
block of pixels.
"""

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels import bound as bounds
from warp_splat.kernels.bound import BoundView, Since
from warp_splat.kernels.compiler import once
from warp_splat.kernels.simd import LANES, fma, times, vec16, where_less
from warp_splat.kernels.splat import Splat2D
from warp_splat.kernels.structs import BinsView

BLOCKS = TILE * TILE // LANES
SETTLED = 12 * BLOCKS + 1  # rows


def rows_from(first: int, rgb: int | None = None) -> tuple[int, ...]:
    """The first of each: T, that at the last settlement, colors, those, sums of what is not seen, and of the bound.

    With ``rgb``, the first of the picture's colors, those and its T, which come first of all, are the ideal's, too.
    """
    rows = tuple(first + row * BLOCKS for row in (0, 1, 2, 5, 8, 9, 10, 11))
    return rows if rgb is None else (0, rows[1], rgb, *rows[3:])


@once
def make_settle(rgb: int, rows: tuple[int, ...], ahead: int) -> tuple[wp.Function, ...]:
    """What starts, settles before entries, and concludes.

    ``rgb``: the first row of the colors; ``rows``: those that :func:`rows_from` names. Transmittances are the first of
    all. ``ahead``: entries of the list that are read together.
    """
    T, BEFORE, LIGHT, SEEN, TOTAL, ADDED, TAKEN, ROUNDING = rows

    @wp.func
    def at_start(s: wp.array[vec16]):
        """The rows, which are zeros, before the first entry."""
        for block in range(BLOCKS):
            s[T + block] = vec16(1.0)
            s[BEFORE + block] = vec16(1.0)

    @wp.func
    def settle(s: wp.array[vec16], bound: BoundView, since: Since, tile: int, tiles_x: int, end: int):
        """The sums up to here, where the map ``end`` follows those that begin."""
        begin = since.map
        block = int(0)
        while block < BLOCKS:  # Warp would unroll a range
            t = wp.abs(s[T + block])  # negative where the picture stopped
            gained = vec16(0.0)
            light = vec16(0.0)
            for channel in range(3):
                now = s[LIGHT + channel * BLOCKS + block]
                gained = wp.max(gained, now - s[SEEN + channel * BLOCKS + block])
                light = wp.max(light, now)
                s[SEEN + channel * BLOCKS + block] = now
            s[TAKEN + block] = bounds.light_behind(s[TOTAL + block], gained, s[TAKEN + block])
            s[ROUNDING + block] = s[ROUNDING + block] + bounds.rounding_of(
                s[BEFORE + block], t, light, since, bound.brightest
            )
            outside = vec16(bounds.outside_of(bound, begin, end, tile, tiles_x, block))
            s[ADDED + block] = bounds.own_light(t, outside, bound.usual, s[ADDED + block])
            s[TOTAL + block] = s[TOTAL + block] + outside
            s[BEFORE + block] = t
            block += 1
        started = Since()
        started.map = end
        return started

    @wp.func
    def memory(s: wp.array[vec16]):
        """What is known since the sums were settled last, in the last row."""
        return wp.array(ptr=s.ptr + wp.uint64(64 * (s.shape[0] - 1)), shape=(1,), dtype=Since)

    @wp.func
    def expect(
        s: wp.array[vec16], bound: BoundView, tile: int, bins: BinsView, near: wp.array[Splat2D], k: int, length: int
    ):
        """Before ``ahead`` entries from ``k`` on, which are ``near``."""
        start = bins.ranges[tile][0]
        if (k - start) & (ahead - 1) != 0:
            return
        count = wp.min(ahead, start + length - k)
        since = memory(s)
        end = bounds.next_map(bound, since[0].map, near[count - 1].depth)
        if end > since[0].map:
            since[0] = settle(s, bound, since[0], tile, bins.tiles_x, end)
        since[0] = bounds.watch(bound, since[0], bins, k, count)

    @wp.func
    def conclude(
        s: wp.array[vec16], bound: BoundView, tile: int, bins: BinsView, length: int, background: wp.array[float]
    ):
        """The bound of every pixel, which saw ``length`` entries of the list."""
        since = memory(s)
        settle(s, bound, since[0], tile, bins.tiles_x, bound.begins.shape[0])
        tiles_x = bins.tiles_x
        cut = bins.ranges[tile][1] - bins.ranges[tile][0] > length
        left = (tile % tiles_x) * TILE
        top = (tile // tiles_x) * TILE
        block = int(0)
        while block < BLOCKS:
            t = wp.abs(s[T + block])
            through = t - wp.abs(s[block])
            stopped = where_less(s[block], vec16(0.0), t, times(t, wp.where(cut, 1.0, 0.0)))
            last = wp.max(times(stopped, bound.brightest), times(t, bound.behind))
            taken = bounds.light_behind(s[TOTAL + block], last, s[TAKEN + block])
            cuts = vec16(0.0)
            for channel in range(3):
                row = channel * BLOCKS + block
                change = fma(through, background[channel], s[LIGHT + row] - s[rgb + row])
                cuts = bounds.all_cuts(change, taken, s[ADDED + block], cuts)
            rounding = bounds.all_rounding(s[ROUNDING + block], bound)
            found = bounds.with_rest(cuts, stopped, bound) + rounding
            for lane in range(LANES):
                y = top + 4 * (block >> 2) + lane // 4
                x = left + 4 * (block & 3) + lane % 4
                if y < bound.bound_out.shape[0] and x < bound.bound_out.shape[1]:
                    bound.bound_out[y, x] = found[lane]
                    bound.rounding_out[y, x] = rounding[lane]
            block += 1

    return at_start, expect, conclude

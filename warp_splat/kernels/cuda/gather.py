"""Sums of each splat's rows of gradients on CUDA, as :mod:`warp_splat.kernels.cpu.gather`; a lane per splat.

A warp sums the rows of a splat with many together, lane by lane and then over the lanes. Which splats these are, and
the order of every sum, depends on the lists alone: two runs give the same bits.
"""

import warp as wp

from warp_splat.kernels.compiler import once
from warp_splat.kernels.cuda.warps import AT_ONCE, WARP, WARP_OPTIONS, column_of, lane_sum, vec_channels

MANY = wp.constant(64)  # rows of a splat from which on its warp sums them together


@wp.struct
class GradientsView:
    """What rows sum up to: their columns, one table after another."""

    first: wp.array2d[float]  # [N, widths[0]], and so on
    second: wp.array2d[float]  # [N, ...]
    third: wp.array2d[float]  # [N, ...]
    fourth: wp.array2d[float]  # [N, ...], or nothing, as the last
    fifth: wp.array2d[float]  # [N, ...]


@once
def make_gather(widths: tuple[int, ...]) -> wp.Kernel:
    """For rows whose numbers belong to tables of these ``widths``, one after another; sixteen numbers at a time."""
    width = sum(widths)
    ends = [sum(widths[: place + 1]) for place in range(5)]
    PARTS = (width + int(AT_ONCE) - 1) // int(AT_ONCE)

    @wp.func
    def add(sums: vec_channels, rows: wp.array2d[float], row: int, first: int):
        total = sums
        for i in range(AT_ONCE):
            if first + i < wp.static(width):
                total[i] = total[i] + rows[row, first + i]
        return total

    @wp.func
    def store(tables: GradientsView, gaussian: int, column: int, value: float):
        if column < wp.static(ends[0]):
            tables.first[gaussian, column] = value
        elif column < wp.static(ends[1]):
            tables.second[gaussian, column - wp.static(ends[0])] = value
        elif column < wp.static(ends[2]):
            tables.third[gaussian, column - wp.static(ends[1])] = value
        elif column < wp.static(ends[3]):
            tables.fourth[gaussian, column - wp.static(ends[2])] = value
        elif column < wp.static(ends[4]):
            tables.fifth[gaussian, column - wp.static(ends[3])] = value

    @wp.kernel(module="unique", module_options=dict(WARP_OPTIONS))
    def gather(
        gaussians: wp.array[int],  # [V] of each splat
        begins: wp.array[int],  # [V + 1] where in `places` those of each splat begin; last, where all end
        places: wp.array[int],  # [M]
        rows: wp.array2d[float],  # [M, width]
        # out
        tables_out: GradientsView,
    ):
        group, lane = wp.tid()
        v = group * WARP + lane
        begin = int(0)
        end = int(0)
        if v < gaussians.shape[0]:
            begin = begins[v]
            end = begins[v + 1]
        many = end - begin >= MANY
        most = wp.tile_max(wp.tile(end - begin))[0]
        column = column_of(lane, AT_ONCE)
        begins_here = wp.tile(begin)
        ends_here = wp.tile(end)
        for part in range(wp.static(PARTS)):
            first = part * AT_ONCE
            sums = vec_channels(0.0)
            if not many:
                for number in range(begin, end):
                    sums = add(sums, rows, places[number], first)
                if v < gaussians.shape[0]:
                    for i in range(AT_ONCE):
                        store(tables_out, gaussians[v], first + i, sums[i])
            if most >= MANY:
                for other in range(WARP):
                    low = begins_here[other]
                    high = ends_here[other]
                    if high - low >= MANY:  # the same for all lanes
                        mine = vec_channels(0.0)
                        for number in range(low + lane, high, WARP):
                            mine = add(mine, rows, places[number], first)
                        total = lane_sum(mine, lane)
                        if column >= 0:
                            store(tables_out, gaussians[group * WARP + other], first + column, total)

    return gather

"""A step of Adam (Kingma and Ba 2015) for several tables at once: N rows each, of any width. Forward only.

Memory limits it: for a number that is learned, four are read and three written. Tried:

- 3 x the time: a loop over the numbers of a row, which LLVM does not vectorize
"""

import functools
from typing import Any

import warp as wp

from warp_splat.kernels.compiler import LANES_IN_ORDER
from warp_splat.kernels.simd import TYPES, fill, over, pick, root, times

wp.set_module_options(LANES_IN_ORDER)  # regrouped, v would overflow for gradients above 1e19

#: Columns of the numbers of a table: rate over bias, eps, root of 1 / bias of v, and each beta with 1 - beta.
RATE, EPS, PER_ROOT, BETA1, REST1, BETA2, REST2 = (wp.constant(column) for column in range(7))


def rows_of(lanes: int) -> int:
    """The rows of a launch index."""
    return 64 if lanes > 1 else 1


@functools.cache
def make_adam(lanes: int, sparse: bool) -> wp.Kernel:
    """In vectors of ``lanes``, what is left over one by one; ``sparse``: only the rows of Gaussians that are drawn."""

    @wp.func
    def drawn(radii: wp.array[int], place: int, width: int, like: float):
        """Mask: the number at ``place`` is of a Gaussian that is drawn."""
        return wp.where(radii[place // width] > 0, 1.0, 0.0)

    if lanes > 1:

        @wp.func
        def drawn(radii: wp.array[int], place: int, width: int, like: Any):
            row = place // width
            left = (row + 1) * width - place  # numbers of this row
            mask = fill(0.0, like)
            for lane in range(lanes):
                if left == 0:
                    row += 1
                    left = width
                left -= 1
                mask[lane] = wp.where(radii[row] > 0, 1.0, 0.0)
            return mask

    def make_part(number):
        size = wp.types.type_size_in_bytes(number) // 4

        @wp.func
        def move(
            tables: wp.array2d[wp.uint64],
            numbers: wp.array2d[float],
            radii: wp.array[int],
            table: int,
            width: int,
            begin: int,
            end: int,
        ):
            """The numbers from ``begin`` to before ``end``, both multiples of the lanes."""
            offset = wp.uint64(4) * wp.uint64(begin)
            count = (end - begin) // size
            values = wp.array(ptr=tables[table, 0] + offset, shape=(count,), dtype=number)
            grads = wp.array(ptr=tables[table, 1] + offset, shape=(count,), dtype=number)
            firsts = wp.array(ptr=tables[table, 2] + offset, shape=(count,), dtype=number)
            seconds = wp.array(ptr=tables[table, 3] + offset, shape=(count,), dtype=number)
            for i in range(count):
                grad = grads[i]
                m = firsts[i] * numbers[table, BETA1] + grad * numbers[table, REST1]
                v = seconds[i] * numbers[table, BETA2] + times(grad * numbers[table, REST2], grad)
                size_of_step = root(v) * numbers[table, PER_ROOT] + fill(numbers[table, EPS], v)
                value = values[i] - over(m * numbers[table, RATE], size_of_step)
                if wp.static(sparse):
                    mask = drawn(radii, begin + size * i, width, v)
                    value = pick(mask, value, values[i])
                    m = pick(mask, m, firsts[i])
                    v = pick(mask, v, seconds[i])
                values[i] = value
                firsts[i] = m
                seconds[i] = v

        return move

    at_once = rows_of(lanes)
    move_lanes, move_rest = make_part(TYPES[lanes].number), make_part(wp.float32)

    @wp.kernel(module="unique", module_options=dict(LANES_IN_ORDER))
    def adam(
        first: int,  # group of rows of this slice
        rows: int,
        widths: wp.array[int],  # [T] numbers in a row
        numbers: wp.array2d[float],  # [T, 7] see RATE
        radii: wp.array[int],  # [N] px, or nothing
        # out
        tables_out: wp.array2d[wp.uint64],  # [T, 4] addresses of values, gradients, and moments; the gradients stay
    ):
        begin = (first + wp.tid()) * at_once
        end = wp.min(begin + at_once, rows)
        for table in range(tables_out.shape[0]):
            width = widths[table]
            whole = end * width - (end * width) % lanes
            if end < rows:
                whole = end * width
            move_lanes(tables_out, numbers, radii, table, width, begin * width, whole)
            move_rest(tables_out, numbers, radii, table, width, whole, end * width)

    return adam

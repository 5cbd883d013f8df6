"""A step of Adam (Kingma and Ba 2015) for several tables at once: N rows each, of any width. Forward only.

Memory limits it: for a number that is learned, four are read and three written. Moments may be kept in 16 bits
(``halves.py``); a step of the second moment is a thousandth of it, which rounding to the nearest would lose. Tried:

- 3 x the time: a loop over the numbers of a row, which LLVM does not vectorize
- 2 x the time: a group of rows of all tables, then the next; a core follows few streams of memory at a time
"""

from typing import Any

import warp as wp

from warp_splat.kernels.compiler import FORWARD_ONLY, once
from warp_splat.kernels.halves import HALF, noise, rounded, widened
from warp_splat.kernels.simd import TYPES, fill, over, pick, root, times

#: Columns of the numbers of a table: rate over bias, eps, root of 1 / bias of v, and each beta with 1 - beta.
RATE, EPS, PER_ROOT, BETA1, REST1, BETA2, REST2 = (wp.constant(column) for column in range(7))


@wp.func
def adam_step_of(value: Any, grad: Any, before: Any, before2: Any, numbers: Any, table: int):
    """A number, its mean gradient and the mean of its square, after the step; ``numbers``: its table's, see RATE."""
    m = before * numbers[table, BETA1] + grad * numbers[table, REST1]
    v = before2 * numbers[table, BETA2] + times(grad * numbers[table, REST2], grad)
    spread = root(v) * numbers[table, PER_ROOT] + fill(numbers[table, EPS], v)
    return value - over(m * numbers[table, RATE], spread), m, v


@once
def make_adam(lanes: int, sparse: bool, halves: bool = False) -> wp.Kernel:
    """For ``lanes`` rows at once; ``sparse``: only of Gaussians that are drawn; ``halves``: moments in 16 bits."""
    number = TYPES[lanes].number
    moment = HALF[lanes] if halves else number

    @wp.func
    def drawn(radii: wp.array[int], row: int, place: int, width: int):
        """Mask: the numbers from ``place`` on, counted from ``row``, are of Gaussians that are drawn."""
        shown = row + place // width
        left = width - place % width  # numbers of this row
        mask = number()
        for lane in range(lanes):
            if left == 0:
                shown += 1
                left = width
            left -= 1
            mask[lane] = wp.where(radii[shown] > 0, 1.0, 0.0)
        return mask

    @wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
    def adam(
        first: int,  # group of rows of this slice, counted through all tables, one after the other
        groups: int,  # of a table
        start: int,  # row of the first group
        widths: wp.array[int],  # [T] numbers in a row
        keys: wp.array[int],  # [T] for rounding at random
        numbers: wp.array2d[float],  # [T, 7] see RATE
        radii: wp.array[int],  # [N] px, or nothing
        # out
        tables_out: wp.array2d[wp.uint64],  # [T, 4] addresses of values, gradients, and moments; the gradients stay
    ):
        table = (first + wp.tid()) // groups
        group = (first + wp.tid()) % groups
        width = widths[table]
        begin = wp.uint64(4 * lanes) * wp.uint64(group) * wp.uint64(width)
        begin_moments = wp.uint64(wp.static(2 if halves else 4) * lanes) * wp.uint64(group) * wp.uint64(width)
        values = wp.array(ptr=tables_out[table, 0] + begin, shape=(width,), dtype=number)
        grads = wp.array(ptr=tables_out[table, 1] + begin, shape=(width,), dtype=number)
        firsts = wp.array(ptr=tables_out[table, 2] + begin_moments, shape=(width,), dtype=moment)
        seconds = wp.array(ptr=tables_out[table, 3] + begin_moments, shape=(width,), dtype=moment)
        shown = int(0)
        if wp.static(sparse):
            for lane in range(lanes):
                shown += wp.where(radii[lanes * group + lane] > 0, 1, 0)
            if shown == 0:
                return
        for i in range(width):
            grad = grads[i]
            before = widened(firsts[i])
            before2 = widened(seconds[i])
            value, m, v = adam_step_of(values[i], grad, before, before2, numbers, table)
            if wp.static(sparse and lanes > 1):
                if shown < lanes:
                    mask = drawn(radii, lanes * group, lanes * i, width)
                    m = pick(mask, m, before)
                    v = pick(mask, v, before2)
                    value = pick(mask, value, values[i])
            values[i] = value
            if wp.static(halves):
                bits = noise((start + lanes * group) * width + lanes * i, keys[table], grad)
                firsts[i] = rounded(m, bits, 0)
                seconds[i] = rounded(v, bits, 16)
            else:
                firsts[i] = m
                seconds[i] = v

    return adam

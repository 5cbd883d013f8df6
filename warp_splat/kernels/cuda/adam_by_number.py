"""Adam on CUDA: one launch for all tables. A thread takes a number of each, so threads read what lies side by side.

What it computes is :mod:`warp_splat.kernels.adam`'s. What changes with every step comes as numbers of the launch.
"""

import warp as wp

from warp_splat.kernels.adam import adam_step_of
from warp_splat.kernels.compiler import FORWARD_ONLY, once
from warp_splat.kernels.halves import HALF, noise, rounded, widened

AT_ONCE = 6  # tables of a launch
TABLES = wp.constant(AT_ONCE)
VALUES, GRADIENTS, FIRSTS, SECONDS = (wp.constant(column) for column in range(4))

vec_tables = wp.types.vector(length=AT_ONCE, dtype=int)
mat_numbers = wp.types.matrix(shape=(AT_ONCE, 7), dtype=float)
mat_addresses = wp.types.matrix(shape=(AT_ONCE, 4), dtype=wp.uint64)


@once
def make_adam_by_number(sparse: bool, halves: bool = False) -> wp.Kernel:
    """``sparse``: only of Gaussians that are drawn; ``halves``: moments in 16 bits."""
    moment = HALF[1] if halves else float

    @wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
    def adam(
        first: int,
        start: int,  # row at the addresses
        rows: int,  # from there on
        widths: vec_tables,  # numbers in a row; 0: no table
        keys: vec_tables,  # for rounding at random
        numbers: mat_numbers,  # see RATE
        radii: wp.array[int],  # [N] px, or nothing
        # out
        tables_out: mat_addresses,  # of values, gradients, and moments; the gradients stay
    ):
        i = first + wp.tid()
        column = i // rows
        for table in range(TABLES):
            width = widths[table]
            here = column < width
            if wp.static(sparse):
                if here:
                    here = radii[start + i // width] > 0
            if here:
                values = wp.array(ptr=tables_out[table, VALUES], shape=(i + 1,), dtype=float)
                grads = wp.array(ptr=tables_out[table, GRADIENTS], shape=(i + 1,), dtype=float)
                firsts = wp.array(ptr=tables_out[table, FIRSTS], shape=(i + 1,), dtype=moment)
                seconds = wp.array(ptr=tables_out[table, SECONDS], shape=(i + 1,), dtype=moment)
                value, m, v = adam_step_of(values[i], grads[i], widened(firsts[i]), widened(seconds[i]), numbers, table)
                values[i] = value
                if wp.static(halves):
                    bits = noise(start * width + i, keys[table], value)
                    firsts[i] = rounded(m, bits, 0)
                    seconds[i] = rounded(v, bits, 16)
                else:
                    firsts[i] = m
                    seconds[i] = v

    return adam

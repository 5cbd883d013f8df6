"""Sums of each Gaussian's rows of gradients, which lie where its instances stand in the tiles' lists."""

import warp as wp

from warp_splat.kernels.compiler import FORWARD_ONLY, once

AHEAD = wp.constant(24)  # rows for which memory is asked before they are read


@once
def make_gather(widths: tuple[int, ...]) -> wp.Kernel:
    """For rows whose numbers belong to tables of these ``widths``, one after another."""
    width = sum(widths)
    vec = wp.types.vector(length=width, dtype=float)
    STEPS = wp.constant(wp.types.vector(length=width, dtype=int)(*[step for step in widths for _ in range(step)]))

    @wp.func_native("__builtin_prefetch(rows.data + i); __builtin_prefetch(rows.data[i].c + last);")
    def ask(rows: wp.array[vec], i: int, last: int):
        """Bring both ends of a row into the cache."""

    @wp.func
    def store(columns: wp.array[wp.uint64], i: int, sums: vec):
        for column in range(width):
            wp.array(ptr=columns[column], shape=(STEPS[column] * i + 1,), dtype=float)[STEPS[column] * i] = sums[column]

    @wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
    def gather(
        first: int,  # splat of this slice; one more than there are takes the Gaussians behind the last
        gaussian_count: int,
        gaussians: wp.array[int],  # [V] of each splat, ascending
        begins: wp.array[int],  # [V] where in `places` those of each splat begin
        places: wp.array[int],  # [M]
        rows: wp.array[vec],  # [M]
        zero: float,  # which the compiler does not know: added to it, -0 becomes 0
        # out
        columns_out: wp.array[wp.uint64],  # [width] addresses of the columns of the tables, [N] numbers each
    ):
        v = first + wp.tid()
        count = gaussians.shape[0]
        before = int(0)  # those between the last splat and this one are not drawn
        if v > 0:
            before = gaussians[v - 1] + 1
        here = gaussian_count
        if v < count:
            here = gaussians[v]
        for i in range(before, here):
            store(columns_out, i, vec(0.0))
        if v < count:
            end = places.shape[0]
            if v + 1 < count:
                end = begins[v + 1]
            sums = vec(zero)
            for number in range(begins[v], end):
                ask(rows, places[wp.min(number + AHEAD, places.shape[0] - 1)], width - 1)
                sums += rows[places[number]]
            store(columns_out, here, sums)

    return gather

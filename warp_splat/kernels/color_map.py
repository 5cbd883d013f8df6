"""An affine map of an image's colors, and its adjoint: 12 numbers, columns of a matrix and then what is added."""

import warp as wp

from warp_splat.kernels.columns import columns, rows
from warp_splat.kernels.compiler import FORWARD_ONLY, once
from warp_splat.kernels.simd import TYPES, fill, fma, inner, times

vec12 = wp.types.vector(length=12, dtype=float)


@once
def make_map_colors(lanes: int) -> wp.Kernel:
    """Of ``lanes`` pixels at once."""
    number, _integer, _row2, row3, _row4 = TYPES[lanes]

    @wp.func
    def weighted(n: vec12, k: int, r: number, g: number, b: number):
        return fma(r, fill(n[k], r), fma(g, fill(n[k + 3], r), fma(b, fill(n[k + 6], r), fill(n[k + 9], r))))

    @wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
    def map_colors(
        first: int,  # group of pixels of this slice
        numbers: wp.array[vec12],  # [1]
        colors: wp.array[row3],  # [M / lanes]
        # out
        colors_out: wp.array[row3],  # [M / lanes]
    ):
        i = first + wp.tid()
        n = numbers[0]
        r, g, b = columns(colors[i])
        colors_out[i] = rows(weighted(n, 0, r, g, b), weighted(n, 1, r, g, b), weighted(n, 2, r, g, b))

    return map_colors


@once
def make_adj_map_colors(lanes: int) -> wp.Kernel:
    """Of ``lanes`` pixels at once."""
    number, _integer, _row2, row3, _row4 = TYPES[lanes]

    @wp.func
    def weighted(n: vec12, k: int, r: number, g: number, b: number):
        return fma(r, fill(n[k], r), fma(g, fill(n[k + 1], r), times(b, fill(n[k + 2], r))))

    @wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
    def adj_map_colors(
        first: int,  # group of pixels of this slice
        numbers: wp.array[vec12],  # [1]
        colors: wp.array[row3],  # [M / lanes]
        adj: wp.array[row3],  # [M / lanes] of the mapped colors
        # out
        adj_colors_out: wp.array[row3],  # [M / lanes]
        adj_numbers_out: wp.array[vec12],  # [M / lanes] sums over the group
    ):
        i = first + wp.tid()
        r, g, b = columns(colors[i])
        x, y, z = columns(adj[i])
        n = numbers[0]
        adj_colors_out[i] = rows(weighted(n, 0, x, y, z), weighted(n, 3, x, y, z), weighted(n, 6, x, y, z))
        one = fill(1.0, r)
        adj_numbers_out[i] = vec12(
            inner(r, x), inner(r, y), inner(r, z), inner(g, x), inner(g, y), inner(g, z),
            inner(b, x), inner(b, y), inner(b, z), inner(one, x), inner(one, y), inner(one, z),
        )  # fmt: skip

    return adj_map_colors

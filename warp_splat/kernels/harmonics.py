"""Real spherical harmonics up to degree 3, with the signs of the reference implementation."""

from typing import NamedTuple

import warp as wp

from warp_splat.kernels import simd
from warp_splat.kernels.compiler import once
from warp_splat.kernels.inline import without_gradient
from warp_splat.kernels.simd import TYPES, fill, fma, inner, inverse, root

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2A, C2B, C2C = 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
C3A, C3B, C3C = 0.5900435899266435, 2.890611442640554, 0.4570457994644658
C3D, C3E = 0.3731763325901154, 1.445305721320277


class Harmonics(NamedTuple):
    """The functions of degree 1 to 3 for a number of lanes."""

    table: type  # 15 rows of lanes, one for each function
    evaluate: wp.Function  # their values in the direction of an offset
    value_of: wp.Function  # row k of a table, as lanes
    weigh: wp.Function  # the functions, weighted, summed over all lanes: what one differentiates


@once
def make_harmonics(lanes: int) -> Harmonics:
    """The functions in ``lanes`` directions at once."""
    number = TYPES[lanes].number
    times = simd.times if lanes == 1 else wp.cw_mul  # the overload for lanes: an adjoint that takes 11 % longer
    table = wp.types.matrix(shape=(15, lanes), dtype=float)
    table_of = table if lanes == 1 else wp.matrix_from_rows

    @wp.func
    def basis(x: number, y: number, z: number):
        per_norm = inverse(root(fma(x, x, fma(y, y, times(z, z)))))
        x = times(x, per_norm)
        y = times(y, per_norm)
        z = times(z, per_norm)
        xx = times(x, x)
        yy = times(y, y)
        zz = times(z, z)
        two = fill(2.0, x)
        three = fill(3.0, x)
        shared = times(fill(-C3C, x), times(fill(4.0, x), zz) - xx - yy)
        return (
            times(fill(-C1, x), y),
            times(fill(C1, x), z),
            times(fill(-C1, x), x),
            times(fill(C2A, x), times(x, y)),
            times(fill(-C2A, x), times(y, z)),
            times(fill(C2B, x), times(two, zz) - xx - yy),
            times(fill(-C2A, x), times(x, z)),
            times(fill(C2C, x), xx - yy),
            times(times(fill(-C3A, x), y), times(three, xx) - yy),
            times(times(fill(C3B, x), x), times(y, z)),
            times(shared, y),
            times(times(fill(C3D, x), z), times(two, zz) - times(three, xx + yy)),
            times(shared, x),
            times(times(fill(C3E, x), z), xx - yy),
            times(times(fill(-C3A, x), x), xx - times(three, yy)),
        )

    @wp.func
    def evaluate(x: number, y: number, z: number):
        b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10, b11, b12, b13, b14 = basis(x, y, z)
        return table_of(b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10, b11, b12, b13, b14)

    @without_gradient(number)  # nobody asks, and it would take a fifth of the adjoint
    def value_of(rows: table, k: int):
        if wp.static(lanes == 1):
            return rows[k, 0]
        else:
            return rows[k]

    @wp.func
    def weigh(x: number, y: number, z: number, weights: table):
        b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10, b11, b12, b13, b14 = basis(x, y, z)
        s = fma(b0, value_of(weights, 0), fma(b1, value_of(weights, 1), times(b2, value_of(weights, 2))))
        s = fma(b3, value_of(weights, 3), fma(b4, value_of(weights, 4), fma(b5, value_of(weights, 5), s)))
        s = fma(b6, value_of(weights, 6), fma(b7, value_of(weights, 7), fma(b8, value_of(weights, 8), s)))
        s = fma(b9, value_of(weights, 9), fma(b10, value_of(weights, 10), fma(b11, value_of(weights, 11), s)))
        s = fma(b12, value_of(weights, 12), fma(b13, value_of(weights, 13), fma(b14, value_of(weights, 14), s)))
        return inner(s, fill(1.0, s))

    return Harmonics(table, evaluate, value_of, weigh)

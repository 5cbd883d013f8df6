"""Real spherical harmonics up to degree 3, with the signs of the reference implementation."""

import functools
from typing import NamedTuple

import warp as wp

from warp_splat.kernels.numbers import make_numbers

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2A, C2B, C2C = 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
C3A, C3B, C3C, C3D, C3E = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)


class Harmonics(NamedTuple):
    """The functions of degree 1 to 3 for a number of lanes."""

    table: type  # 15 rows of lanes, one for each function
    evaluate: wp.Function  # their values in the direction of an offset
    weigh: wp.Function  # these, weighted, summed over all lanes: what one differentiates


@functools.cache
def make_harmonics(lanes: int) -> Harmonics:
    """The functions in ``lanes`` directions at once."""
    numbers = make_numbers(lanes)
    number, fill, root, inverse = numbers.number, numbers.fill, numbers.root, numbers.inverse
    table = wp.types.matrix(shape=(15, lanes), dtype=float)
    mul = wp.cw_mul

    @wp.func
    def basis(x: number, y: number, z: number):
        per_norm = inverse(root(mul(x, x) + mul(y, y) + mul(z, z)))
        x = mul(x, per_norm)
        y = mul(y, per_norm)
        z = mul(z, per_norm)
        xx = mul(x, x)
        yy = mul(y, y)
        zz = mul(z, z)
        two = fill(2.0)
        three = fill(3.0)
        shared = mul(fill(-C3C), mul(fill(4.0), zz) - xx - yy)
        return (
            mul(fill(-C1), y),
            mul(fill(C1), z),
            mul(fill(-C1), x),
            mul(fill(C2A), mul(x, y)),
            mul(fill(-C2A), mul(y, z)),
            mul(fill(C2B), mul(two, zz) - xx - yy),
            mul(fill(-C2A), mul(x, z)),
            mul(fill(C2C), xx - yy),
            mul(mul(fill(-C3A), y), mul(three, xx) - yy),
            mul(mul(fill(C3B), x), mul(y, z)),
            mul(shared, y),
            mul(mul(fill(C3D), z), mul(two, zz) - mul(three, xx + yy)),
            mul(shared, x),
            mul(mul(fill(C3E), z), xx - yy),
            mul(mul(fill(-C3A), x), xx - mul(three, yy)),
        )

    @wp.func
    def evaluate(x: number, y: number, z: number):
        b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10, b11, b12, b13, b14 = basis(x, y, z)
        return wp.matrix_from_rows(b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10, b11, b12, b13, b14)

    @wp.func
    def weight_of(weights: table, k: int):
        return weights[k]

    @wp.func_grad(weight_of)
    def adj_weight_of(weights: table, k: int, adj_ret: number):  # nobody asks, and it would take a fifth of the adjoint
        pass

    @wp.func
    def weigh(x: number, y: number, z: number, weights: table):
        b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10, b11, b12, b13, b14 = basis(x, y, z)
        s = mul(b0, weight_of(weights, 0)) + mul(b1, weight_of(weights, 1)) + mul(b2, weight_of(weights, 2))
        s = s + mul(b3, weight_of(weights, 3)) + mul(b4, weight_of(weights, 4)) + mul(b5, weight_of(weights, 5))
        s = s + mul(b6, weight_of(weights, 6)) + mul(b7, weight_of(weights, 7)) + mul(b8, weight_of(weights, 8))
        s = s + mul(b9, weight_of(weights, 9)) + mul(b10, weight_of(weights, 10)) + mul(b11, weight_of(weights, 11))
        s = s + mul(b12, weight_of(weights, 12)) + mul(b13, weight_of(weights, 13)) + mul(b14, weight_of(weights, 14))
        return wp.dot(s, fill(1.0))

    return Harmonics(table, evaluate, weigh)

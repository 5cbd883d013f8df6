"""The angle of a point in the plane, by a polynomial: alike on all processors, with no call of the C library."""

import math
from typing import Any

import warp as wp

from warp_splat.kernels.simd import fill, fma, less, over, pick, times, vec16

PI, EIGHTH, LEAST = wp.constant(math.pi), wp.constant(math.tan(math.pi / 8)), wp.constant(1.0e-37)
#: Of arctan(t) / t - 1 by t^2, up to an eighth of a half turn: the least largest error, 2e-8.
ARCTAN = wp.constant(wp.types.vector(length=4, dtype=float)(-0.33332955, 0.19977925, -0.13879842, 0.08060285))


@wp.func
def arctangent(y: Any, x: Any):
    zero = fill(0.0, x)
    one = fill(1.0, x)
    long = wp.max(wp.max(x, -x), wp.max(y, -y))
    short = wp.min(wp.max(x, -x), wp.max(y, -y))
    # of t = short / long: from 1 as well as from 0, whichever is nearer
    steep = less(times(fill(EIGHTH, x), long), short)
    t = over(pick(steep, short - long, short), wp.max(pick(steep, short + long, long), fill(LEAST, x)))
    q = times(t, t)
    series = fma(fill(ARCTAN[3], x), q, fill(ARCTAN[2], x))
    series = fma(fma(series, q, fill(ARCTAN[1], x)), q, fill(ARCTAN[0], x))
    found = fma(times(series, q), t, t) + pick(steep, fill(0.25 * PI, x), zero)
    found = pick(less(wp.max(x, -x), wp.max(y, -y)), fill(0.5 * PI, x) - found, found)
    found = pick(less(x, zero), fill(PI, x) - found, found)
    return times(found, pick(less(y, zero), -one, one))


for number in (float, vec16):

    @wp.func
    def angle(y: number, x: number):
        """Of the point (x, y) from the x axis, -pi to pi, 0 for the origin: a polynomial, alike on all processors."""
        return arctangent(y, x)

    @wp.func_grad(angle)
    def adj_angle(y: number, x: number, adj_ret: number):
        per_square = over(adj_ret, wp.max(fma(x, x, times(y, y)), fill(LEAST, x)))
        wp.adjoint[y] += times(x, per_square)
        wp.adjoint[x] -= times(y, per_square)

"""Sixteen pixels at once: the few operations from which the same mathematics is written for one pixel and for lanes.

Warp's CPU backend is scalar C++; LLVM turns a ``vec16`` into one AVX-512 register (two of AVX2, four of NEON) if
the code has no branch per lane and no libm call. Each operation here has a scalar and a lane overload, so that the
pieces of :mod:`warp_splat.kernels.blend`, generic in their argument types, compile to either.
"""

import warp as wp

from warp_splat.kernels.build import FORWARD_ONLY

wp.set_module_options(FORWARD_ONLY)

LANES = 16
vec16 = wp.types.vector(length=LANES, dtype=float)

#: Pixel offsets of the lanes in their 4 x 4 block, row by row.
LANE_X = wp.constant(vec16(*[float(lane % 4) for lane in range(LANES)]))
LANE_Y = wp.constant(vec16(*[float(lane // 4) for lane in range(LANES)]))


@wp.func
def times(a: float, b: float):
    return a * b


@wp.func
def times(a: vec16, b: vec16):
    return wp.cw_mul(a, b)


@wp.func
def over(a: float, b: float):
    return a / b


@wp.func
def over(a: vec16, b: vec16):
    return wp.cw_div(a, b)


@wp.func
def fill(value: float, like: float):
    """``value`` in every lane of a variable shaped as ``like``."""
    return value


@wp.func
def fill(value: float, like: vec16):
    return vec16(value)


@wp.func
def where_less(a: float, b: float, x: float, y: float):
    """``x`` where ``a < b``, else ``y``, lane by lane."""
    if a < b:  # not wp.where, which cannot be called from Python
        return x
    return y


@wp.func
def where_less(a: vec16, b: vec16, x: vec16, y: vec16):
    r = vec16()
    for lane in range(LANES):
        r[lane] = wp.where(a[lane] < b[lane], x[lane], y[lane])
    return r


@wp.func
def total(x: vec16):
    """Sum of the lanes, in a fixed order."""
    s = float(0.0)
    for lane in range(LANES):
        s += x[lane]
    return s

"""Sixteen pixels at once: the few operations from which the same mathematics is written for one pixel and for lanes.

Warp's CPU backend is scalar C++; LLVM turns a ``vec16`` into one AVX-512 register (two of AVX2, four of NEON) if
the code has no branch per lane and no libm call. Each operation here has a scalar and a lane overload, so that the
pieces of :mod:`warp_splat.kernels.splat`, generic in their argument types, compile to either.
"""

import warp as wp

from warp_splat.kernels.compiler import FORWARD_ONLY

wp.set_module_options(FORWARD_ONLY)

LANES = 16
vec16 = wp.types.vector(length=LANES, dtype=float)
vec16i = wp.types.vector(length=LANES, dtype=int)

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
def times(a: vec16, b: float):
    return a * b


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
def whole(x: float):
    """Whole part of ``x`` >= 0, as an integer."""
    return int(x)


@wp.func
def whole(x: vec16):
    r = vec16i()
    for lane in range(LANES):
        r[lane] = int(x[lane])
    return r


@wp.func
def fraction(x: float, n: int):
    """``x`` without its whole part ``n``."""
    return x - float(n)


@wp.func
def fraction(x: vec16, n: vec16i):
    r = vec16()
    for lane in range(LANES):
        r[lane] = x[lane] - float(n[lane])
    return r


@wp.func
def halved(x: float, n: int):
    """``x`` times 2^-n by the exponent's bits; neither x nor the result may be denormal."""
    return wp.cast(wp.cast(x, int) - (n << 23), float)


@wp.func
def halved(x: vec16, n: vec16i):
    r = vec16()
    for lane in range(LANES):
        r[lane] = wp.cast(wp.cast(x[lane], int) - (n[lane] << 23), float)
    return r


@wp.func_grad(halved)
def adj_halved(x: vec16, n: vec16i, adj_ret: vec16):  # bits have no derivative that Warp could find
    wp.adjoint[x] += times(adj_ret, halved(vec16(1.0), n))


@wp.func
def exp2_exact(x: float):
    """2^x by the C library: a call per lane."""
    return wp.exp(x * 0.6931471805599453)


@wp.func
def exp2_exact(x: vec16):
    r = vec16()
    for lane in range(LANES):
        r[lane] = wp.exp(x[lane] * 0.6931471805599453)
    return r


@wp.func
def inner(a: float, b: float):
    """Sum over the lanes of the product."""
    return a * b


@wp.func
def inner(a: vec16, b: vec16):
    return wp.dot(a, b)


@wp.func
def total(x: vec16):
    """Sum of the lanes, in a fixed order."""
    s = float(0.0)
    for lane in range(LANES):
        s += x[lane]
    return s

"""Numbers side by side: the one vocabulary in which kernels for one number and for sixteen are written.

Every operation has an overload for ``float`` and one for ``vec16``, under one name. A CPU runs ``vec16``, whose
operations are those of the compiler's vectors: one AVX-512 register, two of AVX2, four of NEON. A GPU's thread runs
``float``. ``+``, ``-``, ``wp.min`` and ``wp.max`` are Warp's and take either. There LLVM has to find the vectors among
scalars, which it does if the code has no branch per lane and no libm call.

Kernels that Warp differentiates need operations that know their derivative. The generated one is slow in lanes:

- of a choice: a branch per lane;
- of a constant: a sum over the lanes, one after the other (an adjoint twice as slow);
- of a division: two more divisions.

(Where ``wp.grad`` differentiates a function, what is called two levels below it needs a derivative by hand, too: Warp
1.19 silently leaves out the generated one.)

Masks are 1 or 0. Masks, constants, whole and rounded numbers have no derivative.
"""

import math
import re
from typing import NamedTuple

import warp as wp

from warp_splat.kernels.compiler import FORWARD_ONLY, PORTABLE

wp.set_module_options(FORWARD_ONLY)

LANES = 16
vec16 = wp.types.vector(length=LANES, dtype=float)
vec16i = wp.types.vector(length=LANES, dtype=int)
#: Rows of 2, 3 and 4 numbers of sixteen Gaussians, as they lie in memory.
vec32 = wp.types.vector(length=2 * LANES, dtype=float)
vec48 = wp.types.vector(length=3 * LANES, dtype=float)
vec64 = wp.types.vector(length=4 * LANES, dtype=float)


PI, EIGHTH, LEAST = wp.constant(math.pi), wp.constant(math.tan(math.pi / 8)), wp.constant(1.0e-37)
#: Of arctan(t) / t - 1 by t^2, up to an eighth of a half turn: the least largest error, 2e-8.
ARCTAN = wp.constant(wp.types.vector(length=4, dtype=float)(-0.33332955, 0.19977925, -0.13879842, 0.08060285))


class Types(NamedTuple):
    """The types of a kernel for a number of lanes."""

    number: type
    integer: type
    row2: type  # two numbers of each lane, as they lie in memory: see `columns`
    row3: type
    row4: type


TYPES = {1: Types(wp.float32, wp.int32, wp.vec2, wp.vec3, wp.vec4), LANES: Types(vec16, vec16i, vec32, vec48, vec64)}

#: Pixel offsets of the lanes in their 4 x 4 block, row by row.
LANE_X = wp.constant(vec16(*[float(lane % 4) for lane in range(LANES)]))
LANE_Y = wp.constant(vec16(*[float(lane // 4) for lane in range(LANES)]))


def _fused(number: str, builtin: str) -> str:
    """In C++: the function ``fused`` of three numbers, a b + c."""
    result = "a * b + c" if PORTABLE else f"{builtin}(a, b, c)"
    return f"auto fused = []({number} a, {number} b, {number} c) {{ return {result}; }}; "


_VECTORS = "".join(
    f"typedef {scalar} {name} __attribute__((vector_size({4 * LANES}), aligned(4), may_alias)); "
    for name, scalar in (("V", "float"), ("I", "int"))
) + _fused("V", "__builtin_elementwise_fma")


def _vectors(result: str, adjoint: str = ";", kind: str = "float") -> tuple[str, str]:
    """A function in C++, which sees its arguments as vectors of sixteen, and what its adjoint does.

    LLVM then need not find the vectors among scalars; it splits them where registers are shorter. Arguments named a, b,
    c, x, y and mask are of type V, n is of type I.
    """
    forward, reverse = (
        re.sub(r"\b(adj_)?(a|b|c|x|y|n|mask|ret)\b", lambda m: f"({'I' if m[0] == 'n' else 'V'}&){m[0]}", code)
        for code in (result, adjoint)
    )
    if kind == "bool":
        return f"{_VECTORS} return {forward};", _VECTORS + reverse
    name = {"float": "V", "int": "I"}[kind]
    return f"{_VECTORS} wp::vec_t<{LANES}, {kind}> r; ({name}&)r = {forward}; return r;", _VECTORS + reverse


@wp.func
def fill(value: float, like: float):
    """``value`` in every lane of a variable shaped as ``like``; a constant, without a gradient."""
    return value


@wp.func_grad(fill)
def adj_fill(value: float, like: float, adj_ret: float):
    pass


@wp.func_native(*_vectors("V{} + value"))
def fill(value: float, like: vec16) -> vec16: ...


@wp.func
def times(a: float, b: float):
    return a * b


@wp.func_native(*_vectors("a * b", "adj_a = fused(b, adj_ret, adj_a); adj_b = fused(a, adj_ret, adj_b);"))
def times(a: vec16, b: vec16) -> vec16: ...


@wp.func
def times(a: vec16, b: float):
    return a * b


@wp.func_native(
    _fused("float", "fmaf") + "return fused(a, b, c);",
    _fused("float", "fmaf") + "adj_a = fused(b, adj_ret, adj_a); adj_b = fused(a, adj_ret, adj_b); adj_c += adj_ret;",
)
def fma(a: float, b: float, c: float) -> float:
    """The product of ``a`` and ``b`` plus ``c``, rounded once."""
    return a * b + c  # what Python sees


@wp.func_native(
    *_vectors("fused(a, b, c)", "adj_a = fused(b, adj_ret, adj_a); adj_b = fused(a, adj_ret, adj_b); adj_c += adj_ret;")
)
def fma(a: vec16, b: vec16, c: vec16) -> vec16: ...


@wp.func
def fma(a: vec16, b: float, c: vec16):
    return fma(a, vec16(b), c)  # not fill: it is no constant


@wp.func
def over(a: float, b: float):
    return a / b


@wp.func_native(*_vectors("a / b", "V q = adj_ret / b; adj_a += q; adj_b = fused(-(a / b), q, adj_b);"))
def over(a: vec16, b: vec16) -> vec16: ...


@wp.func
def inverse(x: float):
    """1 / x."""
    return 1.0 / x


@wp.func_grad(inverse)
def adj_inverse(x: float, adj_ret: float):
    r = inverse(x)
    wp.adjoint[x] -= adj_ret * r * r


@wp.func_native(*_vectors("1.0f / x", "V r = 1.0f / x; adj_x -= adj_ret * r * r;"))
def inverse(x: vec16) -> vec16: ...


@wp.func
def root(x: float):
    """Square root."""
    return wp.sqrt(x)


@wp.func_grad(root)
def adj_root(x: float, adj_ret: float):
    wp.adjoint[x] += adj_ret / (root(x) * 2.0)


@wp.func_native(
    *_vectors("__builtin_elementwise_sqrt(x)", "adj_x += adj_ret / (__builtin_elementwise_sqrt(x) * 2.0f);")
)
def root(x: vec16) -> vec16: ...


@wp.func
def less(a: float, b: float):
    """Mask: a < b."""
    return wp.where(a < b, 1.0, 0.0)


@wp.func_native(*_vectors("a < b ? V{} + 1.0f : V{}"))
def less(a: vec16, b: vec16) -> vec16: ...


@wp.func
def equal(a: float, b: float):
    """Mask: a == b."""
    return wp.where(a == b, 1.0, 0.0)


@wp.func_native(*_vectors("a == b ? V{} + 1.0f : V{}"))
def equal(a: vec16, b: vec16) -> vec16: ...


@wp.func
def some(mask: float):
    """Whether a mask is set in any lane."""
    return mask > 0.0


@wp.func_native(*_vectors("__builtin_reduce_or((I)(mask > 0.0f)) != 0", kind="bool"))
def some(mask: vec16) -> bool: ...


@wp.func
def pick(mask: float, a: float, b: float):
    """``a`` where a mask is set, else ``b``."""
    return wp.where(mask > 0.0, a, b)


@wp.func_native(
    *_vectors("mask > 0.0f ? a : b", "adj_a += mask > 0.0f ? adj_ret : V{}; adj_b += mask > 0.0f ? V{} : adj_ret;")
)
def pick(mask: vec16, a: vec16, b: vec16) -> vec16: ...


@wp.func
def where_less(a: float, b: float, x: float, y: float):
    """``x`` where ``a < b``, else ``y``: compared and picked at once, for kernels that keep no mask."""
    if a < b:  # not wp.where, which cannot be called from Python
        return x
    return y


@wp.func_native(*_vectors("a < b ? x : y", "adj_x += a < b ? adj_ret : V{}; adj_y += a < b ? V{} : adj_ret;"))
def where_less(a: vec16, b: vec16, x: vec16, y: vec16) -> vec16: ...


@wp.func
def whole(x: float):
    """To an integer, towards 0."""
    return int(x)


@wp.func_native(*_vectors("__builtin_convertvector(x, I)", kind="int"))
def whole(x: vec16) -> vec16i: ...


@wp.func
def real(n: int):
    """From an integer."""
    return float(n)


@wp.func_native(*_vectors("__builtin_convertvector(n, V)"))
def real(n: vec16i) -> vec16: ...


@wp.func
def rounded_up(x: float):
    return wp.ceil(x)


@wp.func_native(*_vectors("__builtin_elementwise_ceil(x)"))
def rounded_up(x: vec16) -> vec16: ...


@wp.func
def rounded_down(x: float):
    return wp.floor(x)


@wp.func_native(*_vectors("__builtin_elementwise_floor(x)"))
def rounded_down(x: vec16) -> vec16: ...


@wp.func
def fraction(x: float, n: int):
    """``x`` without its whole part ``n``."""
    return x - float(n)


@wp.func_native(*_vectors("x - __builtin_convertvector(n, V)", "adj_x += adj_ret;"))
def fraction(x: vec16, n: vec16i) -> vec16: ...


@wp.func
def halved(x: float, n: int):
    """``x`` times 2^-n by the exponent's bits; neither x nor the result may be denormal."""
    return wp.cast(wp.cast(x, int) - (n << 23), float)


@wp.func_grad(halved)
def adj_halved(x: float, n: int, adj_ret: float):
    wp.adjoint[x] += adj_ret * halved(1.0, n)


@wp.func_native(*_vectors("(V)((I)x - (n << 23))", "adj_x += adj_ret * (V)((127 - n) << 23);"))
def halved(x: vec16, n: vec16i) -> vec16: ...


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


def _make_arctangent(number: type) -> wp.Function:
    @wp.func
    def arctangent(y: number, x: number):
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

    return arctangent


arctangent, arctangents = _make_arctangent(float), _make_arctangent(vec16)


@wp.func
def angle(y: float, x: float):
    """Of the point (x, y) from the x axis, -pi to pi, 0 for the origin: a polynomial, alike on all processors."""
    return arctangent(y, x)


@wp.func
def angle(y: vec16, x: vec16):
    return arctangents(y, x)


@wp.func_grad(angle)
def adj_angle(y: float, x: float, adj_ret: float):
    per_square = adj_ret / wp.max(x * x + y * y, LEAST)
    wp.adjoint[y] += x * per_square
    wp.adjoint[x] -= y * per_square


@wp.func_grad(angle)
def adj_angle(y: vec16, x: vec16, adj_ret: vec16):
    per_square = over(adj_ret, wp.max(fma(x, x, times(y, y)), fill(LEAST, x)))
    wp.adjoint[y] += times(x, per_square)
    wp.adjoint[x] -= times(y, per_square)


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


@wp.func
def columns(row: wp.vec2):
    """The numbers of a row one by one: rows of sixteen Gaussians become columns of sixteen lanes.

    Tried: one function for any width, a column at a time: projection and adjoint take half as long again.
    """
    return row[0], row[1]


@wp.func
def columns(row: vec32):
    x = vec16()
    y = vec16()
    for lane in range(LANES):
        x[lane] = row[2 * lane]
        y[lane] = row[2 * lane + 1]
    return x, y


@wp.func
def columns(row: wp.vec3):
    return row[0], row[1], row[2]


@wp.func
def columns(row: vec48):
    x = vec16()
    y = vec16()
    z = vec16()
    for lane in range(LANES):
        x[lane] = row[3 * lane]
        y[lane] = row[3 * lane + 1]
        z[lane] = row[3 * lane + 2]
    return x, y, z


@wp.func
def columns(row: wp.vec4):
    return row[0], row[1], row[2], row[3]


@wp.func
def columns(row: vec64):
    w = vec16()
    x = vec16()
    y = vec16()
    z = vec16()
    for lane in range(LANES):
        w[lane] = row[4 * lane]
        x[lane] = row[4 * lane + 1]
        y[lane] = row[4 * lane + 2]
        z[lane] = row[4 * lane + 3]
    return w, x, y, z


@wp.func
def rows(x: float, y: float):
    """Columns back to a row."""
    return wp.vec2(x, y)


@wp.func
def rows(x: vec16, y: vec16):
    row = vec32()
    for lane in range(LANES):
        row[2 * lane] = x[lane]
        row[2 * lane + 1] = y[lane]
    return row


@wp.func
def rows(x: float, y: float, z: float):
    return wp.vec3(x, y, z)


@wp.func
def rows(x: vec16, y: vec16, z: vec16):
    row = vec48()
    for lane in range(LANES):
        row[3 * lane] = x[lane]
        row[3 * lane + 1] = y[lane]
        row[3 * lane + 2] = z[lane]
    return row


@wp.func
def rows(w: vec16, x: vec16, y: vec16, z: vec16):
    row = vec64()
    for lane in range(LANES):
        row[4 * lane] = w[lane]
        row[4 * lane + 1] = x[lane]
        row[4 * lane + 2] = y[lane]
        row[4 * lane + 3] = z[lane]
    return row


@wp.func_grad(columns)
def adj_columns(row: vec48, adj_x: vec16, adj_y: vec16, adj_z: vec16):
    wp.adjoint[row] += rows(adj_x, adj_y, adj_z)


@wp.func_grad(columns)
def adj_columns(row: vec64, adj_w: vec16, adj_x: vec16, adj_y: vec16, adj_z: vec16):
    wp.adjoint[row] += rows(adj_w, adj_x, adj_y, adj_z)


@wp.func_grad(rows)
def adj_rows(x: vec16, y: vec16, adj_ret: vec32):
    adj_x, adj_y = columns(adj_ret)
    wp.adjoint[x] += adj_x
    wp.adjoint[y] += adj_y


@wp.func_grad(rows)
def adj_rows(x: vec16, y: vec16, z: vec16, adj_ret: vec48):
    adj_x, adj_y, adj_z = columns(adj_ret)
    wp.adjoint[x] += adj_x
    wp.adjoint[y] += adj_y
    wp.adjoint[z] += adj_z

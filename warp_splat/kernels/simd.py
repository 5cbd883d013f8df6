"""Numbers side by side: the one vocabulary in which kernels for one number and for sixteen are written.

Every operation has an overload for ``float`` and one for ``vec16``, under one name. A CPU runs ``vec16``, whose
operations are those of the compiler's vectors: one AVX-512 register, two of AVX2, four of NEON. A GPU's thread runs
``float``. ``+``, ``-``, ``wp.min`` and ``wp.max`` are Warp's and take either. There LLVM has to find the vectors among
scalars, which it does if the code has no branch per lane and no libm call.

Kernels that Warp differentiates need operations that know their derivative. The generated one is slow in lanes: of a
choice it is a branch per lane; of a constant a sum over the lanes, one after the other (an adjoint twice as slow); of a
division two more divisions. (Where ``wp.grad`` differentiates a function, what is called two levels below it needs a
derivative by hand, too: Warp 1.19 silently leaves out the generated one.)

Masks are 1 or 0. Masks, constants, whole and rounded numbers have no derivative.
"""

import inspect
import re
from collections.abc import Callable
from typing import NamedTuple

import warp as wp

from warp_splat.kernels.compiler import PORTABLE
from warp_splat.kernels.inline import defined

LANES = 16
vec16 = wp.types.vector(length=LANES, dtype=float)
vec16i = wp.types.vector(length=LANES, dtype=int)
#: Rows of 2, 3 and 4 numbers of sixteen Gaussians, as they lie in memory.
vec32 = wp.types.vector(length=2 * LANES, dtype=float)
vec48 = wp.types.vector(length=3 * LANES, dtype=float)
vec64 = wp.types.vector(length=4 * LANES, dtype=float)


class Types(NamedTuple):
    """The types of a kernel for a number of lanes."""

    number: type
    integer: type
    row2: type  # two numbers of each lane, as they lie in memory: see `columns`
    row3: type
    row4: type


TYPES = {1: Types(wp.float32, wp.int32, wp.vec2, wp.vec3, wp.vec4), LANES: Types(vec16, vec16i, vec32, vec48, vec64)}


def func_of(number: type, **others: type) -> Callable[[Callable], wp.Function]:
    """A decorator: wp.func of a function whose parameters are all of ``number``, but for ``others``."""

    def decorate(function: Callable) -> wp.Function:
        function.__annotations__ = {name: others.get(name, number) for name in inspect.signature(function).parameters}
        return wp.func(function)

    return decorate


def _fused(number: str, builtin: str) -> str:
    """In C++: the function ``fused`` of three numbers, a b + c."""
    result = "a * b + c" if PORTABLE else f"{builtin}(a, b, c)"
    return f"auto fused = []({number} a, {number} b, {number} c) {{ return {result}; }}; "


#: C++: the compiler's vectors of sixteen, V of floats and I of integers.
VECTORS = "".join(
    f"typedef {scalar} {name} __attribute__((vector_size({4 * LANES}), aligned(4), may_alias)); "
    for name, scalar in (("V", "float"), ("I", "int"))
) + _fused("V", "__builtin_elementwise_fma")


def by_width(wide: str, narrow: str) -> str:
    """In C++: ``wide`` where a register holds sixteen numbers, else ``narrow``."""
    return f"\n#if defined(__AVX512F__)\n{wide}\n#else\n{narrow}\n#endif\n"


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
        return f"{VECTORS} return {forward};", VECTORS + reverse
    name = {"float": "V", "int": "I"}[kind]
    return f"{VECTORS} wp::vec_t<{LANES}, {kind}> r; ({name}&)r = {forward}; return r;", VECTORS + reverse


def in_lanes(result: str, adjoint: str = ";", kind: str = "float") -> Callable[[Callable], wp.Function]:
    """A decorator: wp.func of a function of single numbers, with an overload for lanes of all but a ``value``.

    Args:
        result: that of the overload, in C++: see :func:`_vectors`.
        adjoint: what its adjoint does.
        kind: of the numbers that come out: float, int, or a bool for all lanes.
    """
    lanes = {"float": "vec16", "int": "vec16i", "bool": "bool"}

    def decorate(function: Callable) -> wp.Function:
        name, types = function.__name__, {each: number.__name__ for each, number in function.__annotations__.items()}
        given = [f"{each}: {types[each] if each == 'value' else lanes[types[each]]}" for each in types]
        source = f"@wp.func_native(*code)\ndef {name}({', '.join(given)}) -> {lanes[kind]}: ..."
        return defined(name, source, {**globals(), "code": _vectors(result, adjoint, kind), name: wp.func(function)})

    return decorate


@in_lanes("V{} + value")
def fill(value: float, like: float):
    """``value`` in every lane of a variable shaped as ``like``; a constant, without a gradient."""
    return value


@wp.func_grad(fill)
def adj_fill(value: float, like: float, adj_ret: float):
    pass


@in_lanes(
    "V{} + value",
    "V sums = adj_ret * 0.0f == V{} ? adj_ret : V{}; "
    f"for (int half = {LANES // 2}; half; half /= 2) "
    "for (int lane = 0; lane < half; lane++) sums[lane] += sums[lane + half]; "
    "adj_value += sums[0];",
)
def everywhere(value: float, like: float):
    """``value`` in every lane, which gets the sum of the lanes' gradients that are finite, in pairs."""
    return value


@wp.func_grad(everywhere)
def adj_everywhere(value: float, like: float, adj_ret: float):
    wp.adjoint[value] += wp.where(adj_ret * 0.0 == 0.0, adj_ret, 0.0)


@in_lanes("a * b", "adj_a = fused(b, adj_ret, adj_a); adj_b = fused(a, adj_ret, adj_b);")
def times(a: float, b: float):
    return a * b


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


@in_lanes("-x", "adj_x -= adj_ret;")
def negative(x: float):
    """-x, which the code for a GPU has as a part of what reads it; Warp's is 0 - x."""
    return x * -1.0


@in_lanes("a / b", "V q = adj_ret / b; adj_a += q; adj_b = fused(-(a / b), q, adj_b);")
def over(a: float, b: float):
    return a / b


@in_lanes("1.0f / x", "V r = 1.0f / x; adj_x -= adj_ret * r * r;")
def inverse(x: float):
    """1 / x."""
    return 1.0 / x


@wp.func_grad(inverse)
def adj_inverse(x: float, adj_ret: float):
    r = inverse(x)
    wp.adjoint[x] -= adj_ret * r * r


@in_lanes("__builtin_elementwise_sqrt(x)", "adj_x += adj_ret / (__builtin_elementwise_sqrt(x) * 2.0f);")
def root(x: float):
    """Square root."""
    return wp.sqrt(x)


@wp.func_grad(root)
def adj_root(x: float, adj_ret: float):
    wp.adjoint[x] += adj_ret / (root(x) * 2.0)


@in_lanes("a < b ? V{} + 1.0f : V{}")
def less(a: float, b: float):
    """Mask: a < b."""
    return wp.where(a < b, 1.0, 0.0)


@in_lanes("a == b ? V{} + 1.0f : V{}")
def equal(a: float, b: float):
    """Mask: a == b."""
    return wp.where(a == b, 1.0, 0.0)


@in_lanes("__builtin_reduce_or((I)(mask > 0.0f)) != 0", kind="bool")
def some(mask: float):
    """Whether a mask is set in any lane."""
    return mask > 0.0


@in_lanes("mask > 0.0f ? a : b", "adj_a += mask > 0.0f ? adj_ret : V{}; adj_b += mask > 0.0f ? V{} : adj_ret;")
def pick(mask: float, a: float, b: float):
    """``a`` where a mask is set, else ``b``."""
    return wp.where(mask > 0.0, a, b)


@in_lanes("a < b ? x : y", "adj_x += a < b ? adj_ret : V{}; adj_y += a < b ? V{} : adj_ret;")
def where_less(a: float, b: float, x: float, y: float):
    """``x`` where ``a < b``, else ``y``: compared and picked at once, for kernels that keep no mask."""
    if a < b:  # not wp.where, which cannot be called from Python
        return x
    return y


@in_lanes("a < b ? a : b", "adj_a += a < b ? adj_ret : V{}; adj_b += a < b ? V{} : adj_ret;")
def smaller(a: float, b: float):
    """``b`` where ``a`` is NaN."""
    return wp.min(a, b)


@in_lanes("__builtin_convertvector(x, I)", kind="int")
def whole(x: float):
    """To an integer, towards 0."""
    return int(x)


@in_lanes("__builtin_convertvector(n, V)")
def real(n: int):
    """From an integer."""
    return float(n)


@in_lanes("__builtin_elementwise_ceil(x)")
def rounded_up(x: float):
    return wp.ceil(x)


@in_lanes("__builtin_elementwise_floor(x)")
def rounded_down(x: float):
    return wp.floor(x)


@in_lanes("x - __builtin_convertvector(n, V)", "adj_x += adj_ret;")
def fraction(x: float, n: int):
    """``x`` without its whole part ``n``."""
    return x - float(n)


@in_lanes("(V)((I)x - (n << 23))", "adj_x += adj_ret * (V)((127 - n) << 23);")
def halved(x: float, n: int):
    """``x`` times 2^-n by the exponent's bits; neither x nor the result may be denormal."""
    return wp.cast(wp.cast(x, int) - (n << 23), float)


@wp.func_grad(halved)
def adj_halved(x: float, n: int, adj_ret: float):
    wp.adjoint[x] += adj_ret * halved(1.0, n)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __clz(__brev(bits));  // never negative, as the compiler knows
#else
    return __builtin_ctz(bits);
#endif
""")
def lowest(bits: int) -> int:
    """The place of the lowest bit that is set, of one at least."""
    ...


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

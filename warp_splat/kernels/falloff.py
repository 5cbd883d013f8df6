"""How the opacity of a splat falls off around its mean: as a Gaussian, or as a function of the user's own.

At the offset d [px] the splat's opacity is opacity times fall(q), with q = d' conic d / 2. The Gaussian is

    fall(q) = exp(-q) = 2^-z,   z = q log2(e)

Kernels compute z, of which 2^-z needs no constant. Its derivative is a multiple of its value, which the loops know
already. LLVM inlines a function of that size only where a kernel calls it once, and a call costs more than a step of
the blend. Warp differentiates a user's falloff. Tried:

- 2.9 x the time of ``stepwise``: three calls
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import warp as wp

from warp_splat.errors import InputError
from warp_splat.kernels.compiler import FORWARD_ONLY, once
from warp_splat.kernels.inline import without_gradient
from warp_splat.kernels.simd import LANES, fill, fma, fraction, halved, times, vec16, whole

#: Coefficients of 2^-f on [0, 1), by degree: the least largest relative error, 7e-5, 3e-6, 5e-8 and below rounding.
EXP2 = {
    3: (0.9999251962, -0.6910207272, 0.2300703675, -0.0390122607),
    4: (0.9999974370, -0.6930300000, 0.2393390089, -0.0530700758, 0.0067649423),
    5: (0.9999999404, -0.6931415796, 0.2401674092, -0.0552690737, 0.0091788266, -0.0009355642),
    6: (1.0, -0.6931471825, 0.2402262986, -0.0554987676, 0.0095929541, -0.0012853512, 0.0001120476),
}
#: The highest degree that is no better than a GPU's instruction, of which one counts, not eleven: its error is that of
#: exp2f, 2 units in the last place (CUDA C++ Programming Guide), 2.4e-7.
EX2_DEGREE = 5
LOG2_E = wp.constant(1.4426950408889634)
LN_2 = wp.constant(0.6931471805599453)


@dataclass(frozen=True)
class Falloff:
    """A falloff of the user's own, for :class:`warp_splat.RasterOptions`. docs/extending.md has an example.

    Args:
        fall: a ``wp.func`` of q, q >= 0, whose argument is annotated ``Any``: it is called with a number and with a
            vector of sixteen. 1 at q = 0, and never rising. Warp derives its gradient.
        reach: a ``wp.func`` of a float x >= 1: the q at which ``fall`` has come down to 1 / x. Extents and tile lists
            end there. At ``alpha_min`` 0, x is as large as 1e37.

    Raises:
        InputError: if one of the two is no such function.
    """

    fall: wp.Function
    reach: wp.Function

    def __post_init__(self):
        for name, kind, types in (("fall", "Any", (float, vec16)), ("reach", "float", (float,))):
            function = getattr(self, name)
            if not isinstance(function, wp.Function) or not all(function.get_overload([t], {}) for t in types):
                raise InputError(f"Falloff.{name}: expected a wp.func of one {kind}, got {function!r:.80}.")


class FalloffFunctions(NamedTuple):
    """What kernels call."""

    value: wp.Function  # of z; float or vec16
    known: wp.Function  # of z and of the value there: the value, and its gradient with respect to z
    reach_of: wp.Function  # of opacity and alpha_min: 2 q at which alpha has fallen to alpha_min


@once
def make_falloff(falloff: Falloff | int | None) -> FalloffFunctions:
    """Of the Gaussian by a polynomial's degree or by the C library (None), or of a user's falloff."""
    if not isinstance(falloff, Falloff):
        return FalloffFunctions(make_exp(falloff), exp2_known, reach_of)
    fall, reach = falloff.fall, falloff.reach
    for kind in (float, vec16):  # else Warp 1.19 leaves what it calls without adjoints, as ``value`` comes first
        fall.get_overload([kind], {}).adj.force_adjoint_codegen = True

    @wp.func
    def value(z: Any):
        return fall(z * LN_2)

    @wp.func
    def known(z: Any, before: Any):
        return fall(z * LN_2)

    @wp.func
    def reach_of_fall(opacity: float, alpha_min: float):
        return wp.max(2.0 * reach(opacity / wp.max(alpha_min, 1.0e-37)), 1.0e-6)

    return FalloffFunctions(value, known, reach_of_fall)


@once
def make_fall_value(falloff: Falloff | int | None, number: type) -> wp.Function:
    """The falloff without its gradient, which what knows the value supplies."""
    fall_at = make_falloff(falloff).value

    @without_gradient(number)
    def fall_value(z: number):
        return fall_at(z)

    return fall_value


@once
def make_evaluate(falloff: Falloff) -> wp.Kernel:
    """What a user's falloff is at some places, to see whether it is one."""
    fall, reach = falloff.fall, falloff.reach

    @wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
    def evaluate(
        first: int,  # place of this slice
        q: wp.array[float],  # [M]
        x: wp.array[float],  # [M]
        # out
        falls_out: wp.array[float],  # [M] at q
        reaches_out: wp.array[float],  # [M] of x
    ):
        i = first + wp.tid()
        falls_out[i] = fall(q[i])
        reaches_out[i] = reach(x[i])

    return evaluate


@once
def make_exp(degree: int | None) -> wp.Function:
    """2^-z for z >= 0 by a polynomial of ``degree`` (3 to 6), or by the C library (None).

    wp.exp is a scalar libm call, which defeats the vectorizer. 2^-z = 2^-n 2^-f with n whole; 2^-125 is the least.
    On a GPU its own instruction stands for degrees up to 5.
    """
    if degree is None:

        @wp.func
        def exp2_minus(z: Any):
            return exp2_exact(-z)

        return exp2_minus
    coefficients = wp.types.vector(length=degree + 1, dtype=float)(*EXP2[degree])

    @wp.func
    def exp2_minus(z: Any):
        bounded = wp.min(z, fill(125.0, z))
        n = whole(bounded)
        f = fraction(bounded, n)
        p = fill(coefficients[degree], z)
        for power in range(degree):
            p = fma(f, p, fill(coefficients[degree - 1 - power], z))
        if wp.static(degree <= EX2_DEGREE):
            return by_instruction(z, halved(p, n))
        return halved(p, n)

    return exp2_minus


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float found;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(found) : "f"(-z));
    return found;
#else
    return known;
#endif
""")
def by_instruction(z: float, known: float) -> float:
    """2^-z by a GPU's instruction; elsewhere ``known``, which a GPU then need not compute. Below 2^-126 it is 0."""
    ...


@wp.func
def by_instruction(z: vec16, known: vec16):
    return known


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


for number in (float, vec16):

    @wp.func
    def exp2_known(z: number, value: number):
        """2^-z, computed before."""
        return value

    @wp.func_grad(exp2_known)
    def adj_exp2_known(z: number, value: number, adj_ret: number):
        wp.adjoint[z] += times(value, adj_ret) * -LN_2


@wp.func
def log_of(x: float):
    """Logarithm of ``x`` to 3e-7 of itself, -88 to 89; wp.log is a call, which no loop over lanes gets rid of.

    x = m 2^n with m from 0.7 to 1.4, and log m = 2 artanh s with s = (m - 1) / (m + 1): an odd polynomial of s.
    """
    bits = wp.cast(wp.max(x, 0.0), int)
    n = (bits - 0x3F3504F3) >> 23  # of the root of 1/2
    m = wp.cast(bits - (n << 23), float)
    s = (m - 1.0) / (m + 1.0)
    t = s * s
    return float(n) * LN_2 + s * (2.0 + t * (0.66666776 + t * (0.39977541 + t * 0.29871734)))


@wp.func
def reach_of(opacity: float, alpha_min: float):
    """2 q at which alpha has fallen to ``alpha_min``; above 0, so that what is divided by an extent stays finite.

    Without a cut, 1e-37 takes its place: about where float32 ends.
    """
    return wp.max(2.0 * log_of(opacity / wp.max(alpha_min, 1.0e-37)), 1.0e-6)


def in_each_lane(reach_of: wp.Function) -> wp.Function:
    """``reach_of`` in every lane."""

    @wp.func
    def reaches(opacity: vec16, alpha_min: float):
        r = vec16()
        for lane in range(LANES):
            r[lane] = reach_of(opacity[lane], alpha_min)
        return r

    return reaches

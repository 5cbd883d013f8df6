"""The mathematics of one Gaussian over one pixel, and its adjoint. Written once, for scalars and for lanes.

A pixel blends Gaussians k = 0..n-1 front to back (Kerbl et al. 2023, eq. 2 and 3):

    q_k     = d' conic_k d / 2,  d = mean_k - pixel center
    raw_k   = opacity_k exp(-q_k) = opacity_k 2^-|root_k d|^2,  root_k upper triangular
    alpha_k = 0 if raw_k < alpha_min, else min(raw_k, ALPHA_MAX)
    w_k     = alpha_k T_k,  T_{k+1} = T_k - w_k = T_k (1 - alpha_k)
    image   = sum_k w_k color_k + T_n background

A Gaussian that would take T below t_min is not blended, nor any behind it. The adjoint walks back to front and
recovers T_k = T_{k+1} / (1 - alpha_k) instead of storing it. With u = dL/dimage and
behind_k = sum_{j > k} w_j (color_j . u) + T_n dL/dT_n:

    dL/dcolor_k = w_k u
    dL/dalpha_k = T_k (color_k . u) - behind_k / (1 - alpha_k)

The square root of the conic keeps needles right. The terms of d' conic d are as large as (d / short axis)^2, and cancel
along the long axis. Those of root d are only as large as d / short axis.

The gradient is zero where alpha is cut to 0 or clamped to ALPHA_MAX (the reference passes it through the clamp).
"""

import functools
from typing import Any

import warp as wp

from warp_splat.config import ALPHA_MAX
from warp_splat.kernels.compiler import FORWARD_ONLY
from warp_splat.kernels.simd import exp2_exact, fill, fraction, halved, over, times, where_less, whole

wp.set_module_options(FORWARD_ONLY)


@wp.struct
class Splat2D:
    """A projected Gaussian as the blends read it: 12 floats, one or two cache lines."""

    mean: wp.vec2  # px
    extent: wp.vec2  # px, half sides of the box that is looked at
    root: wp.vec3  # 1/px, (xx, xy, yy) of the upper triangular root with root' root = conic log2(e) / 2
    opacity: float
    color: wp.vec3
    depth: float


#: Coefficients of 2^-f on [0, 1), by degree: the least largest relative error, 7e-5, 3e-6, 5e-8 and below rounding.
EXP2 = {
    3: (0.9999251962, -0.6910207272, 0.2300703675, -0.0390122607),
    4: (0.9999974370, -0.6930300000, 0.2393390089, -0.0530700758, 0.0067649423),
    5: (0.9999999404, -0.6931415796, 0.2401674092, -0.0552690737, 0.0091788266, -0.0009355642),
    6: (1.0, -0.6931471825, 0.2402262986, -0.0554987676, 0.0095929541, -0.0012853512, 0.0001120476),
}
LOG2_E = wp.constant(1.4426950408889634)
LN_2 = wp.constant(0.6931471805599453)


@functools.cache
def make_exp(degree: int | None) -> wp.Function:
    """2^-z for z >= 0 by a polynomial of ``degree`` (3 to 6), or by the C library (None).

    wp.exp is a scalar libm call, which defeats the vectorizer. 2^-z = 2^-n 2^-f with n whole; 2^-125 is the least.
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
            p = fill(coefficients[degree - 1 - power], z) + times(f, p)
        return halved(p, n)

    return exp2_minus


@wp.func
def exponent(dx: Any, dy: Any, xx: Any, xy: Any, yy: Any):
    """The exponent z at offset (dx, dy) [px] from pixel center to mean, from the entries of the root."""
    u = times(dx, xx) + times(dy, xy)
    v = times(dy, yy)
    return times(u, u) + times(v, v)


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


@wp.func
def alpha_of(raw: Any, alpha_min: float):
    """Opacity of the Gaussian at the pixel, cut and clamped; 0 where ``raw`` is negative."""
    return where_less(raw, fill(alpha_min, raw), fill(0.0, raw), wp.min(raw, fill(ALPHA_MAX, raw)))


@wp.func
def adj_alpha_of(raw: Any, alpha_min: float, adj_ret: Any):
    zero = fill(0.0, raw)
    return where_less(raw, fill(alpha_min, raw), zero, where_less(raw, fill(ALPHA_MAX, raw), adj_ret, zero))


@wp.func
def advance(t: Any, alpha: Any, t_min: float):
    """Transmittance behind the Gaussian; ``t`` is that in front.

    A pixel stops at the Gaussian that would take T below ``t_min``: it keeps its T with the sign flipped, from then on.
    """
    after = t - times(alpha, t)
    return where_less(after, fill(t_min, t), wp.min(t, -t), after)


@wp.func
def weight(t: Any, alpha: Any, behind: Any):
    """Share of the Gaussian in the pixel, from T in front and :func:`advance`'s answer: one decision, one rounding."""
    return where_less(behind, fill(0.0, t), fill(0.0, t), times(alpha, t))


@wp.func
def adj_alpha_blend(t: Any, odds: Any, behind: Any, here: Any):
    """dL/dalpha_k from T_k, alpha_k / (1 - alpha_k), behind_k and color_k . u (module docstring)."""
    return times(t, here) - (behind + times(behind, odds))


@wp.func
def odds_of(alpha: Any):
    """w_k / T_{k+1}: the transmittance in front of a Gaussian is that behind it times 1 + odds.

    For faint Gaussians 1 / (1 - alpha) would round to one side: over 100,000 layers an error of 3e-3 instead of 5e-6.
    """
    return over(alpha, fill(1.0, alpha) - alpha)

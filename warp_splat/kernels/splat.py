"""The mathematics of one Gaussian over one pixel, and its adjoint. Written once, for scalars and for lanes.

A pixel blends Gaussians k = 0..n-1 front to back (Kerbl et al. 2023, eq. 2 and 3):

    q_k     = d' conic_k d / 2,  d = mean_k - pixel center
    raw_k   = opacity_k exp(-q_k) = opacity_k 2^-|root_k d|^2,  root_k upper triangular (:mod:`.falloff`)
    alpha_k = 0 if raw_k < alpha_min, else min(raw_k, alpha_max)
    w_k     = alpha_k T_k,  T_{k+1} = T_k - w_k = T_k (1 - alpha_k)
    image   = sum_k w_k color_k + T_n background

A Gaussian that would take T below t_min is not blended, nor any behind it. The adjoint walks back to front and
recovers T_k = T_{k+1} / (1 - alpha_k) instead of storing it. With u = dL/dimage and
behind_k = sum_{j > k} w_j (color_j . u) + T_n dL/dT_n:

    dL/dcolor_k = w_k u
    dL/dalpha_k = T_k (color_k . u) - behind_k / (1 - alpha_k)

The square root of the conic keeps needles right. The terms of d' conic d are as large as (d / short axis)^2, and cancel
along the long axis. Those of root d are only as large as d / short axis.

The gradient is zero where alpha is cut to 0 or clamped to alpha_max (the reference passes it through the clamp).
"""

from typing import Any, NamedTuple

import warp as wp

from warp_splat.kernels.falloff import Falloff
from warp_splat.kernels.simd import fill, fma, negative, over, smaller, times, vec16, where_less
from warp_splat.kernels.slots import CHANNEL


class BlendVariant(NamedTuple):
    """What a kernel of the blend is compiled for."""

    channels: int = 3  # that are blended: the color's, and depth
    falloff: Falloff | int | None = 5  # the user's, or the degree of the Gaussian's polynomial (see make_falloff)
    keep: bool = False  # every transmittance is stored
    bound: bool = False  # how wrong a pixel can be is found
    ideal: bool = False  # and the ideal differs from the picture before a pixel stops
    floor: bool = False  # and the ideal has nothing below an alpha
    hides: bool = False  # each pixel stops where it is told to

    @property
    def columns(self) -> int:
        """Of a slot."""
        return CHANNEL + self.channels


@wp.struct
class Splat2D:
    """A projected Gaussian as the blends read it: 12 floats, one or two cache lines."""

    mean: wp.vec2  # px
    extent: wp.vec2  # px, half sides of the box that is looked at
    root: wp.vec3  # 1/px, (xx, xy, yy) of the upper triangular root with root' root = conic log2(e) / 2
    opacity: float
    color: wp.vec3
    depth: float


@wp.func
def exponent(dx: Any, dy: Any, xx: Any, xy: Any, yy: Any):
    """The exponent z at offset (dx, dy) [px] from pixel center to mean, from the entries of the root."""
    u = fma(dx, xx, times(dy, xy))
    v = times(dy, yy)
    return fma(u, u, times(v, v))


@wp.func
def alpha_of(raw: Any, alphas: wp.vec2):
    """Opacity of the Gaussian at the pixel, cut and clamped by ``alphas``; 0 where ``raw`` is negative."""
    return where_less(raw, fill(alphas[0], raw), fill(0.0, raw), smaller(raw, fill(alphas[1], raw)))


@wp.func
def adj_alpha_of(raw: Any, alphas: wp.vec2, adj_ret: Any):
    zero = fill(0.0, raw)
    return where_less(raw, fill(alphas[0], raw), zero, where_less(raw, fill(alphas[1], raw), adj_ret, zero))


@wp.func
def advance(t: Any, alpha: Any, t_min: float):
    """Transmittance behind the Gaussian; ``t`` is that in front.

    A pixel stops at the Gaussian that would take T below ``t_min``: it keeps its T with the sign flipped, from then on.
    """
    after = fma(negative(alpha), t, t)
    return where_less(after, fill(t_min, t), wp.min(t, negative(t)), after)


@wp.func
def weight(t: Any, alpha: Any, behind: Any):
    """Share of the Gaussian in the pixel, from T in front and :func:`advance`'s answer: one decision, one rounding."""
    return where_less(behind, fill(0.0, t), fill(0.0, t), times(alpha, t))


@wp.func
def adj_alpha_blend(t: Any, odds: Any, behind: Any, here: Any):
    """dL/dalpha_k from T_k, alpha_k / (1 - alpha_k), behind_k and color_k . u (module docstring)."""
    return fma(t, here, negative(fma(behind, odds, behind)))


@wp.func_native("""
#if defined(__CUDA_ARCH__)  // a reciprocal and a step of Newton's: a division has twice the instructions, and a branch
    const float left = 1.0f - alpha;
    float inverse;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(inverse) : "f"(left));
    const float odds = alpha * inverse;
    return fmaf(fmaf(-left, odds, alpha), inverse, odds);
#else
    return alpha / (1.0f - alpha);
#endif
""")
def odds_of(alpha: float) -> float:
    """w_k / T_{k+1}: the transmittance in front of a Gaussian is that behind it times 1 + odds.

    For faint Gaussians 1 / (1 - alpha) would round to one side: over 100,000 layers an error of 3e-3 instead of 5e-6.
    """
    return alpha / (1.0 - alpha)  # what Python sees


@wp.func
def odds_of(alpha: vec16):
    return over(alpha, fill(1.0, alpha) - alpha)

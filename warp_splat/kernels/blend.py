"""The mathematics of one Gaussian over one pixel, and its adjoint. Written once, for scalars and for lanes.

A pixel blends Gaussians k = 0..n-1 front to back (Kerbl et al. 2023, eq. 2 and 3):

    q_k     = d' conic_k d / 2 = |root_k d|^2,  d = mean_k - pixel centre,  root_k upper triangular
    raw_k   = opacity_k exp(-q_k)
    alpha_k = 0 if raw_k < ALPHA_MIN, else min(raw_k, ALPHA_MAX)
    w_k     = alpha_k T_k,  T_{k+1} = T_k - w_k = T_k (1 - alpha_k)
    image   = sum_k w_k color_k + T_n background

A Gaussian that would take T below T_MIN is not blended, nor any behind it. The adjoint walks back to front and
recovers T_k = T_{k+1} / (1 - alpha_k) instead of storing it. With u = dL/dimage and
behind_k = sum_{j > k} w_j (color_j . u) + T_n dL/dT_n:

    dL/dcolor_k = w_k u
    dL/dalpha_k = T_k (color_k . u) - behind_k / (1 - alpha_k)

The square root of the conic keeps needles right: the terms of d' conic d are as large as (d / short axis)^2 and cancel
along the long axis, those of root d only as large as d / short axis.

The gradient is zero where alpha is cut to 0 or clamped to ALPHA_MAX (the reference passes it through the clamp).
"""

from typing import Any

import warp as wp

from warp_splat.config import ALPHA_MAX, ALPHA_MIN, T_MIN
from warp_splat.kernels.build import FORWARD_ONLY
from warp_splat.kernels.lanes import fill, over, times, where_less

wp.set_module_options(FORWARD_ONLY)


@wp.struct
class Splat2D:
    """A projected Gaussian as the blends read it: 12 floats, one or two cache lines."""

    mean: wp.vec2  # px
    extent: wp.vec2  # px, half sides of the box where alpha >= ALPHA_MIN
    root: wp.vec3  # 1/px, (xx, xy, yy) of the upper triangular root with root' root = conic / 2
    opacity: float
    color: wp.vec3
    depth: float


@wp.func
def exp_minus(q: Any):
    """exp(-q) for q in [0, 6], relative error 1.7e-6; above 6 as at 6 (there alpha < ALPHA_MIN for any opacity).

    (p(-q / 8))^8 with a fitted polynomial of degree 6: wp.exp is a scalar libm call, which defeats the vectoriser,
    and a Taylor polynomial of this degree is 200 times worse at the cut.
    """
    y = wp.min(q, fill(6.0, q)) * -0.125
    p = fill(0.00789773333, q) + y * 0.000949784813
    p = fill(0.041443443, q) + times(y, p)
    p = fill(0.166606608, q) + times(y, p)
    p = fill(0.499992159, q) + times(y, p)
    p = fill(0.999999608, q) + times(y, p)
    p = fill(0.999999997, q) + times(y, p)
    p = times(p, p)
    p = times(p, p)
    return times(p, p)


@wp.func
def falloff(dx: Any, dy: Any, root: wp.vec3):
    """exp(-q) at offset (dx, dy) [px] from pixel centre to mean."""
    u = dx * root[0] + dy * root[1]
    v = dy * root[2]
    return exp_minus(times(u, u) + times(v, v))


@wp.func
def reach_of(opacity: float):
    """2 q at which alpha has fallen to ALPHA_MIN; above 0, so that what is divided by an extent stays finite."""
    return wp.max(2.0 * wp.log(opacity / ALPHA_MIN), 1.0e-6)


@wp.func
def alpha_of(raw: Any):
    """Opacity of the Gaussian at the pixel, cut and clamped."""
    return where_less(raw, fill(ALPHA_MIN, raw), fill(0.0, raw), wp.min(raw, fill(ALPHA_MAX, raw)))


@wp.func
def adj_alpha_of(raw: Any, adj_ret: Any):
    zero = fill(0.0, raw)
    return where_less(raw, fill(ALPHA_MIN, raw), zero, where_less(raw, fill(ALPHA_MAX, raw), adj_ret, zero))


@wp.func
def weight(t: Any, alpha: Any):
    """Share of the Gaussian in the pixel; 0 from the Gaussian on that would take T below T_MIN.

    ``t`` is the transmittance in front, negative once the pixel has stopped.
    """
    w = times(alpha, t)
    return where_less(t - w, fill(T_MIN, t), fill(0.0, t), w)


@wp.func
def advance(t: Any, alpha: Any):
    """Transmittance behind the Gaussian. A pixel that stops keeps its T with the sign flipped, from then on."""
    after = t - times(alpha, t)
    return where_less(after, fill(T_MIN, t), wp.min(t, -t), after)


@wp.func
def adj_alpha_blend(t: Any, inverse: Any, behind: Any, here: Any):
    """dL/dalpha_k from T_k, 1 / (1 - alpha_k), behind_k and color_k . u (module docstring)."""
    return times(t, here) - times(behind, inverse)


@wp.func
def recover(alpha: Any):
    """1 / (1 - alpha): what turns the transmittance behind a Gaussian into that in front of it."""
    one = fill(1.0, alpha)
    return over(one, one - alpha)

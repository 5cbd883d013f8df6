"""The adjoint of one step of the blend, for one pixel or for lanes: by hand, or differentiated by Warp.

The reverse loops by hand, of either driver, of the color and of channels beside it, call :func:`make_reverse_step`'s.
What they share with the loops that Warp differentiates whole is here, too. ``number`` is float or vec16. The step is
sliced so that the Gaussian is computed at one place of a kernel (:mod:`warp_splat.kernels.falloff`).
"""

from typing import Any, NamedTuple

import warp as wp

from warp_splat.kernels.compiler import once
from warp_splat.kernels.falloff import LN_2, LOG2_E, Falloff, make_falloff
from warp_splat.kernels.simd import LANES, fill, fma, func_of, inner, times, vec16, where_less
from warp_splat.kernels.slots import CHANNEL, MEAN_X, MEAN_Y, OPACITY, XX, XY, YY
from warp_splat.kernels.splat import adj_alpha_blend, adj_alpha_of, alpha_of, exponent, odds_of

for number in (float, vec16):

    @wp.func
    def opaque(raw: number, alphas: wp.vec2, here: number, walked: number):
        """Opacity, 0 for pixels that had stopped."""
        return alpha_of(where_less(here, walked, raw, fill(-1.0, raw)), alphas)

    @wp.func_grad(opaque)
    def adj_opaque(raw: number, alphas: wp.vec2, here: number, walked: number, adj_ret: number):
        wp.adjoint[raw] += adj_alpha_of(where_less(here, walked, raw, fill(-1.0, raw)), alphas, adj_ret)


@wp.func
def conic_from_root(adj_root: wp.vec3, root: wp.vec3):
    """dL/dconic from dL/droot, where root' root = conic log2(e) / 2."""
    yy = adj_root[2] / root[2]
    xy = (adj_root[1] - root[1] * yy) / root[0]
    xx = (adj_root[0] - root[1] * xy) / root[0]
    return wp.vec3(0.25 * LOG2_E * xx, 0.5 * LOG2_E * xy, 0.25 * LOG2_E * yy)


@wp.func
def geometry_from_root(sums: Any, root: wp.vec3, opacity: float):
    """dL/d(mean, conic) from sums over pixels of the gradients of mean and root."""
    return wp.vec2(sums[MEAN_X], sums[MEAN_Y]), conic_from_root(wp.vec3(sums[XX], sums[XY], sums[YY]), root)


@wp.func
def geometry_from_magnitudes(sums: Any, root: wp.vec3, opacity: float):
    """Sums over pixels of |dL/dmean|, from their shares by dL/dq; nothing of the conic."""
    return 2.0 * LN_2 * opacity * wp.vec2(sums[MEAN_X], sums[MEAN_Y]), wp.vec3(0.0)


@wp.func
def geometry_from_moments(sums: Any, root: wp.vec3, opacity: float):
    """dL/d(mean, conic) from sums over pixels of d and d d', weighted by dL/dopacity."""
    adj_u = -2.0 * LN_2 * opacity * (root[0] * sums[MEAN_X] + root[1] * sums[MEAN_Y])
    adj_v = -2.0 * LN_2 * opacity * root[2] * sums[MEAN_Y]
    return (
        wp.vec2(root[0] * adj_u, root[1] * adj_u + root[2] * adj_v),
        wp.vec3(-0.5 * opacity * sums[XX], -opacity * sums[XY], -0.5 * opacity * sums[YY]),
    )


class ReverseStep(NamedTuple):
    """One Gaussian and one pixel, or sixteen, in a reverse loop.

    pixel(dx, dy, fall, root, opacity, t, adj_t, alphas, here, walked, lit):
        fall: the falloff there. t: transmittance behind. adj_t: dL/dT behind, by hand times T. lit: what the
        pixel's gradient says of the channels, color . u.
        -> T in front, that in front, the weight, and what to sum over pixels, in the columns before the channels'.
    geometry(sums, root, opacity):
        What these sums say of mean and conic.
    """

    pixel: wp.Function
    geometry: wp.Function


@once
def make_reverse_step(mode: str, falloff: Falloff | int | None, number: type) -> ReverseStep:
    """By hand (top of :mod:`warp_splat.kernels.splat`), or, ``stepwise``, by Warp.

    By ``absolute``, sums are of magnitudes of what each pixel says of the mean, and no others (Ye et al. 2024).
    """
    vec_sums = wp.types.vector(length=CHANNEL, dtype=float)
    if number is vec16:
        vec_sums = wp.types.matrix(shape=(CHANNEL, LANES), dtype=float)
    sums_of = wp.matrix_from_rows if number is vec16 else vec_sums
    step = make_step(falloff, number)

    @func_of(number, root=wp.vec3, opacity=float, alphas=wp.vec2)
    def by_hand(dx, dy, fall, root, opacity, t, adj_t, alphas, here, walked, lit):
        raw = where_less(here, walked, fall * opacity, fill(-1.0, dx))
        odds = odds_of(alpha_of(raw, alphas))
        w = times(t, odds)
        front = fma(t, odds, t)
        adj_raw = adj_alpha_of(raw, alphas, adj_alpha_blend(front, odds, adj_t, lit))
        adj_opacity = times(adj_raw, fall)  # times opacity: -dL/dq
        sums = vec_sums()
        if wp.static(mode == "absolute"):
            adj_u = times(fma(dx, root[0], times(dy, root[1])), adj_opacity)
            adj_v = times(times(dy, root[2]), adj_opacity)
            adj_x = times(adj_u, root[0])
            adj_y = fma(adj_u, root[1], times(adj_v, root[2]))
            sums[MEAN_X] = wp.max(adj_x, -adj_x)
            sums[MEAN_Y] = wp.max(adj_y, -adj_y)
        else:
            x = times(adj_opacity, dx)
            y = times(adj_opacity, dy)
            sums[MEAN_X] = x
            sums[MEAN_Y] = y
            sums[XX] = times(x, dx)
            sums[XY] = times(x, dy)
            sums[YY] = times(y, dy)
            sums[OPACITY] = adj_opacity
        return front, fma(w, lit, adj_t), w, sums

    @func_of(number, root=wp.vec3, opacity=float, alphas=wp.vec2)
    def stepwise(dx, dy, fall, root, opacity, t, adj_t, alphas, here, walked, lit):
        odds = odds_of(opaque(fall * opacity, alphas, here, walked))
        front = fma(t, odds, t)
        x, y, xx, xy, yy, adj_opacity, w, _fall, adj_front, _behind, _alphas, _here, _walked = wp.grad(step)(
            dx, dy, fill(root[0], dx), fill(root[1], dx), fill(root[2], dx), fill(opacity, dx), lit,
            fall, front, adj_t, alphas, here, walked,
        )  # fmt: skip
        return front, adj_front, w, sums_of(x, y, xx, xy, yy, adj_opacity)

    return {
        "manual": ReverseStep(by_hand, geometry_from_moments),
        "absolute": ReverseStep(by_hand, geometry_from_magnitudes),
        "stepwise": ReverseStep(stepwise, geometry_from_root),
    }[mode]


@once
def make_step(falloff: Falloff | int | None, number: type) -> wp.Function:
    """A step whose adjoint is wp.grad(step), as in the rasterizer written in Slang (Bangaru et al. 2023).

    A kernel may call a function that calls wp.grad, but no deeper: Warp 1.19 emits the functions in the wrong order.
    """
    fall_known = make_falloff(falloff).known

    @func_of(number, alphas=wp.vec2)
    def step(dx, dy, xx, xy, yy, opacity, lit, fall, t, adj_behind, alphas, here, walked):
        """What the step adds to the loss, from T in front; that behind is seen as a quantity of weight dL/dT."""
        alpha = opaque(times(fall_known(exponent(dx, dy, xx, xy, yy), fall), opacity), alphas, here, walked)
        w = times(alpha, t)
        return inner(w, lit) + inner(adj_behind, t - w)

    return step

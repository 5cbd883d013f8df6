"""The adjoint of one step of the blend, for one pixel or for lanes: by hand, or differentiated by Warp.

Both drivers' reverse loops call one of the two; what they share with the loops that Warp differentiates whole is here,
too. ``number`` is float or vec16. The step is sliced so that the Gaussian is computed at one place of a kernel
(:mod:`warp_splat.kernels.falloff`).
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_splat.kernels.compiler import FORWARD_ONLY
from warp_splat.kernels.falloff import LN_2, LOG2_E, make_falloff
from warp_splat.kernels.simd import fill, fma, inner, times, vec16, where_less
from warp_splat.kernels.splat import BlendVariant, adj_alpha_blend, adj_alpha_of, alpha_of, exponent, odds_of

wp.set_module_options(FORWARD_ONLY)


@wp.func
def opaque(raw: float, alphas: wp.vec2, here: float, walked: float):
    """Opacity, 0 for pixels that had stopped."""
    return alpha_of(where_less(here, walked, raw, -1.0), alphas)


@wp.func
def opaque(raw: vec16, alphas: wp.vec2, here: vec16, walked: vec16):
    return alpha_of(where_less(here, walked, raw, vec16(-1.0)), alphas)


@wp.func_grad(opaque)
def adj_opaque(raw: float, alphas: wp.vec2, here: float, walked: float, adj_ret: float):
    wp.adjoint[raw] += adj_alpha_of(where_less(here, walked, raw, -1.0), alphas, adj_ret)


@wp.func_grad(opaque)
def adj_opaque(raw: vec16, alphas: wp.vec2, here: vec16, walked: vec16, adj_ret: vec16):
    wp.adjoint[raw] += adj_alpha_of(where_less(here, walked, raw, vec16(-1.0)), alphas, adj_ret)


@wp.func
def conic_from_root(adj_root: wp.vec3, root: wp.vec3):
    """dL/dconic from dL/droot, where root' root = conic log2(e) / 2."""
    yy = adj_root[2] / root[2]
    xy = (adj_root[1] - root[1] * yy) / root[0]
    xx = (adj_root[0] - root[1] * xy) / root[0]
    return wp.vec3(0.25 * LOG2_E * xx, 0.5 * LOG2_E * xy, 0.25 * LOG2_E * yy)


@wp.func
def geometry_from_moments(s: wp.vec2, xx: float, xy: float, yy: float, root: wp.vec3, opacity: float):
    """dL/d(mean, conic) from sums over pixels of d and d d', weighted by dL/dopacity."""
    adj_u = -2.0 * LN_2 * opacity * (root[0] * s[0] + root[1] * s[1])
    adj_v = -2.0 * LN_2 * opacity * root[2] * s[1]
    return (
        wp.vec2(root[0] * adj_u, root[1] * adj_u + root[2] * adj_v),
        wp.vec3(-0.5 * opacity * xx, -opacity * xy, -0.5 * opacity * yy),
    )


@functools.cache
def make_manual(falloff: int | None, number: type) -> wp.Function:
    """The adjoint of a step by hand (top of :mod:`warp_splat.kernels.splat`), of the Gaussian."""
    fall_at = make_falloff(falloff).value

    @wp.func
    def adj_step(
        z: number,
        opacity: float,
        t: number,  # behind
        behind: number,  # T dL/dT, behind
        alphas: wp.vec2,
        here: number,
        walked: number,
        lit: number,  # color . u
    ):
        """T in front, T dL/dT in front, the weight, and dL/dopacity of every pixel (times opacity: -dL/dq)."""
        fall = fall_at(z)
        raw = where_less(here, walked, fall * opacity, fill(-1.0, z))
        odds = odds_of(alpha_of(raw, alphas))
        w = times(t, odds)
        front = fma(t, odds, t)
        adj_raw = adj_alpha_of(raw, alphas, adj_alpha_blend(front, odds, behind, lit))
        return front, fma(w, lit, behind), w, times(adj_raw, fall)

    return adj_step


class Stepwise(NamedTuple):
    """A step for wp.grad, the struct that it is differentiated by, and what recovers the state in front of it."""

    Parcel: type
    undo: wp.Function
    step: wp.Function


@functools.cache
def make_stepwise(variant: BlendVariant, number: type) -> Stepwise:
    """A step whose adjoint is wp.grad(step), as in the rasterizer written in Slang (Bangaru et al. 2023).

    A kernel may call a function that calls wp.grad, but no deeper: Warp 1.19 emits the functions in the wrong order.
    """
    (fall_at, fall_known, _), CHANNELS = make_falloff(variant.falloff), variant.channels

    @wp.struct
    class Parcel:
        """A Gaussian as the pixels see it: what its step depends on and is differentiated by."""

        dx: number
        dy: number
        xx: number  # of the root
        xy: number
        yy: number
        opacity: number
        red: number
        green: number
        blue: number
        depth: number

    @wp.func
    def undo(parcel: Parcel, t: number, alphas: wp.vec2, here: number, walked: number):
        """The falloff and the transmittance in front, from that behind."""
        fall = fall_at(exponent(parcel.dx, parcel.dy, parcel.xx, parcel.xy, parcel.yy))
        odds = odds_of(opaque(times(fall, parcel.opacity), alphas, here, walked))
        return fall, fma(t, odds, t)

    @wp.func
    def step(
        parcel: Parcel,
        fall: number,
        t: number,  # in front
        adj_behind: number,  # dL/dT behind
        alphas: wp.vec2,
        here: number,
        walked: number,
        red: number,  # upstream gradients
        green: number,
        blue: number,
        far: number,
    ):
        """What the step adds to the loss, T behind it seen as a quantity of weight dL/dT."""
        z = exponent(parcel.dx, parcel.dy, parcel.xx, parcel.xy, parcel.yy)
        alpha = opaque(times(fall_known(z, fall), parcel.opacity), alphas, here, walked)
        w = times(alpha, t)
        lit = fma(parcel.red, red, fma(parcel.green, green, times(parcel.blue, blue)))
        if wp.static(CHANNELS > 3):
            lit = fma(parcel.depth, far, lit)
        return inner(w, lit) + inner(adj_behind, t - w)

    return Stepwise(Parcel, undo, step)

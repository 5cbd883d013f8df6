"""One Gaussian and one block of pixels in the adjoint of channels: by hand, or the step that Warp differentiates."""

import functools

import warp as wp

from warp_splat.kernels.cpu.adjoint import vec5
from warp_splat.kernels.falloff import LN_2
from warp_splat.kernels.simd import LANES, fma, times, vec16
from warp_splat.kernels.slots import CHANNEL, MEAN_X, MEAN_Y, OPACITY, XX, XY, YY
from warp_splat.kernels.splat import BlendVariant, Splat2D, exponent
from warp_splat.kernels.step import conic_from_root, geometry_from_moments, make_manual, make_stepwise

mat_geometry = wp.types.matrix(shape=(CHANNEL, LANES), dtype=float)


@functools.cache
def make_reverse_step(mode: str, variant: BlendVariant) -> tuple[wp.Function, wp.Function]:
    """What the reverse loop does with a Gaussian and a block: by hand, or the step that Warp differentiates.

    ``lit`` is what the pixels gain by the Gaussian's channels.
    """
    adj_step = make_manual(variant.falloff, vec16)
    Parcel, undo, step = make_stepwise(variant, vec16)

    @wp.func
    def manual(
        splat: Splat2D, dx: vec16, dy: vec16, t: vec16, adj_t: vec16, alphas: wp.vec2, here: vec16, walked: vec16,
        lit: vec16,
    ):  # fmt: skip
        """T in front, T dL/dT in front, the weight, and what to sum for the geometry."""
        z = exponent(dx, dy, splat.root[0], splat.root[1], splat.root[2])
        front, adj_front, w, adj_opacity = adj_step(z, splat.opacity, t, adj_t, alphas, here, walked, lit)
        part = mat_geometry()
        adj_x = times(adj_opacity, dx)
        adj_y = times(adj_opacity, dy)
        part[MEAN_X] = adj_x
        part[MEAN_Y] = adj_y
        part[XX] = times(adj_x, dx)
        part[XY] = times(adj_x, dy)
        part[YY] = times(adj_y, dy)
        part[OPACITY] = adj_opacity
        return front, adj_front, w, part

    @wp.func
    def stepwise(
        splat: Splat2D, dx: vec16, dy: vec16, t: vec16, adj_t: vec16, alphas: wp.vec2, here: vec16, walked: vec16,
        lit: vec16,
    ):  # fmt: skip
        """T in front, dL/dT in front, the weight, and what to sum for the geometry."""
        parcel = Parcel()
        parcel.dx = dx
        parcel.dy = dy
        parcel.xx = vec16(splat.root[0])
        parcel.xy = vec16(splat.root[1])
        parcel.yy = vec16(splat.root[2])
        parcel.opacity = vec16(splat.opacity)
        parcel.red = lit
        zero = vec16(0.0)
        fall, front = undo(parcel, t, alphas, here, walked)
        adj, _fall, adj_front, _behind, _min, _here, _walked, _red, _green, _blue, _far = wp.grad(step)(
            parcel, fall, front, adj_t, alphas, here, walked, vec16(1.0), zero, zero, zero
        )
        part = mat_geometry()
        part[MEAN_X] = adj.dx
        part[MEAN_Y] = adj.dy
        part[XX] = adj.xx
        part[XY] = adj.xy
        part[YY] = adj.yy
        part[OPACITY] = adj.opacity
        return front, adj_front, adj.red, part

    @wp.func
    def absolute(
        splat: Splat2D, dx: vec16, dy: vec16, t: vec16, adj_t: vec16, alphas: wp.vec2, here: vec16, walked: vec16,
        lit: vec16,
    ):  # fmt: skip
        """As ``manual``; what is summed are the magnitudes of what each pixel says of the mean."""
        z = exponent(dx, dy, splat.root[0], splat.root[1], splat.root[2])
        front, adj_front, w, adj_opacity = adj_step(z, splat.opacity, t, adj_t, alphas, here, walked, lit)
        adj_u = times(fma(dx, splat.root[0], times(dy, splat.root[1])), adj_opacity)
        adj_v = times(times(dy, splat.root[2]), adj_opacity)
        adj_x = times(adj_u, splat.root[0])
        adj_y = fma(adj_u, splat.root[1], times(adj_v, splat.root[2]))
        part = mat_geometry()
        part[MEAN_X] = wp.max(adj_x, -adj_x)
        part[MEAN_Y] = wp.max(adj_y, -adj_y)
        return front, adj_front, w, part

    @wp.func
    def from_magnitudes(sums: vec5, splat: Splat2D):
        return 2.0 * LN_2 * splat.opacity * wp.vec2(sums[MEAN_X], sums[MEAN_Y]), wp.vec3(0.0)

    @wp.func
    def from_moments(sums: vec5, splat: Splat2D):
        s = wp.vec2(sums[MEAN_X], sums[MEAN_Y])
        return geometry_from_moments(s, sums[XX], sums[XY], sums[YY], splat.root, splat.opacity)

    @wp.func
    def from_root(sums: vec5, splat: Splat2D):
        adj_root = wp.vec3(sums[XX], sums[XY], sums[YY])
        return wp.vec2(sums[MEAN_X], sums[MEAN_Y]), conic_from_root(adj_root, splat.root)

    bodies = {"manual": (manual, from_moments), "stepwise": (stepwise, from_root)}
    return {**bodies, "absolute": (absolute, from_magnitudes)}[mode]

"""The adjoint of the blend, its reverse loop by hand: ``manual`` and ``stepwise`` differ in the body of the loop.

``manual`` is derived on paper (top of :mod:`warp_splat.kernels.blend`). ``stepwise`` lets Warp differentiate the step
of one Gaussian over one block of pixels, as the rasterizer written in Slang does (Bangaru et al. 2023). Both recover T
by division, both sum over the pixels of a tile in lanes and write one row per tile instance.

The exponential is called at one place of a kernel: LLVM inlines a function of this size only then, and a call costs
more than the step (Tried: three calls, 2.9 times slower). Hence ``exp2_known``, whose gradient uses a value that is
there already.
"""

import functools

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.blend import (
    LN_2,
    LOG2_E,
    Splat2D,
    adj_alpha_blend,
    adj_alpha_of,
    alpha_of,
    exponent,
    make_exp,
    odds_of,
)
from warp_splat.kernels.blend_lanes import BLOCKS, offset_x, offset_y, reach
from warp_splat.kernels.build import FORWARD_ONLY
from warp_splat.kernels.lanes import times, total, vec16, where_less


@wp.func
def conic_from_root(adj_root: wp.vec3, root: wp.vec3):
    """dL/dconic from dL/droot, where root' root = conic log2(e) / 2."""
    yy = adj_root[2] / root[2]
    xy = (adj_root[1] - root[1] * yy) / root[0]
    xx = (adj_root[0] - root[1] * xy) / root[0]
    return wp.vec3(0.25 * LOG2_E * xx, 0.5 * LOG2_E * xy, 0.25 * LOG2_E * yy)


@functools.cache
def make_manual(depth: bool, exp_degree: int | None) -> tuple[wp.Function, wp.Function]:
    """The body of the reverse loop by hand, and how its sums become a row."""
    CHANNELS = 4 if depth else 3
    exp2_minus = make_exp(exp_degree)

    @wp.func
    def adj_step(
        m: wp.array[vec16],  # sums over pixels of d, d d', 1 (weighted by dL/dopacity), and of the channels' gradients
        t: wp.array[vec16],  # transmittance, behind on entry, in front on exit
        behind: wp.array[vec16],  # T dL/dT, likewise
        block: int,
        splat: Splat2D,
        dx: vec16,
        dy: vec16,
        alpha_min: float,
        here: vec16,
        walked: vec16,
        up: wp.array[vec16],
    ):
        fall = exp2_minus(exponent(dx, dy, splat.root[0], splat.root[1], splat.root[2]))
        raw = where_less(here, walked, fall * splat.opacity, vec16(-1.0))
        alpha = alpha_of(raw, alpha_min)
        odds = odds_of(alpha)
        w = times(t[block], odds)
        front = t[block] + w
        lit = vec16(0.0)
        for channel in range(3):
            u = up[block * CHANNELS + channel]
            lit = lit + u * splat.color[channel]
            m[6 + channel] = m[6 + channel] + times(w, u)
        if wp.static(depth):
            u = up[block * CHANNELS + 3]
            lit = lit + u * splat.depth
            m[9] = m[9] + times(w, u)
        adj_raw = adj_alpha_of(raw, alpha_min, adj_alpha_blend(front, odds, behind[block], lit))
        behind[block] = behind[block] + times(w, lit)
        t[block] = front
        adj_fall = times(adj_raw, fall)  # dL/dopacity; times opacity: -dL/dq
        adj_x = times(adj_fall, dx)
        adj_y = times(adj_fall, dy)
        m[0] = m[0] + adj_x
        m[1] = m[1] + adj_y
        m[2] = m[2] + times(adj_x, dx)
        m[3] = m[3] + times(adj_x, dy)
        m[4] = m[4] + times(adj_y, dy)
        m[5] = m[5] + adj_fall

    @wp.func
    def adj_geometry(m: wp.array[vec16], splat: Splat2D):
        """dL/d(mean, conic)."""
        sx = total(m[0])
        sy = total(m[1])
        adj_u = -2.0 * LN_2 * splat.opacity * (splat.root[0] * sx + splat.root[1] * sy)
        adj_v = -2.0 * LN_2 * splat.opacity * splat.root[2] * sy
        half = -0.5 * splat.opacity
        return (
            wp.vec2(splat.root[0] * adj_u, splat.root[1] * adj_u + splat.root[2] * adj_v),
            wp.vec3(half * total(m[2]), 2.0 * half * total(m[3]), half * total(m[4])),
        )

    return adj_step, adj_geometry


@wp.struct
class Parcel:
    """A Gaussian as sixteen pixels see it: what its step depends on and is differentiated by."""

    dx: vec16
    dy: vec16
    xx: vec16  # of the root
    xy: vec16
    yy: vec16
    opacity: vec16
    red: vec16
    green: vec16
    blue: vec16
    depth: vec16


@wp.func
def exp2_known(z: vec16, value: vec16):
    """2^-z, computed before."""
    return value


@wp.func_grad(exp2_known)
def adj_exp2_known(z: vec16, value: vec16, adj_ret: vec16):
    wp.adjoint[z] += times(value, adj_ret) * -LN_2


@wp.func
def opaque(raw: vec16, alpha_min: float, here: vec16, walked: vec16):
    """Opacity, 0 for pixels that had stopped."""
    return alpha_of(where_less(here, walked, raw, vec16(-1.0)), alpha_min)


@wp.func_grad(opaque)
def adj_opaque(raw: vec16, alpha_min: float, here: vec16, walked: vec16, adj_ret: vec16):
    wp.adjoint[raw] += adj_alpha_of(where_less(here, walked, raw, vec16(-1.0)), alpha_min, adj_ret)


@functools.cache
def make_stepwise(depth: bool, exp_degree: int | None) -> tuple[wp.Function, wp.Function]:
    """The body of the reverse loop by Warp, and how its sums become a row."""
    CHANNELS = 4 if depth else 3
    exp2_minus = make_exp(exp_degree)

    @wp.func
    def step(
        parcel: Parcel,
        fall: vec16,
        t: vec16,  # in front
        adj_behind: vec16,  # dL/dT behind
        alpha_min: float,
        here: vec16,
        walked: vec16,
        red: vec16,
        green: vec16,
        blue: vec16,
        depth_up: vec16,
    ):
        """What the step adds to the loss, T behind it seen as a quantity of weight dL/dT."""
        z = exponent(parcel.dx, parcel.dy, parcel.xx, parcel.xy, parcel.yy)
        alpha = opaque(times(exp2_known(z, fall), parcel.opacity), alpha_min, here, walked)
        w = times(alpha, t)
        lit = times(parcel.red, red) + times(parcel.green, green) + times(parcel.blue, blue)
        if wp.static(depth):
            lit = lit + times(parcel.depth, depth_up)
        return wp.dot(w, lit) + wp.dot(adj_behind, t - w)

    @wp.func
    def adj_step(
        m: wp.array[vec16],  # sums over pixels of the gradients of a Parcel's members
        t: wp.array[vec16],
        adj_t: wp.array[vec16],  # dL/dT, behind on entry, in front on exit
        block: int,
        splat: Splat2D,
        dx: vec16,
        dy: vec16,
        alpha_min: float,
        here: vec16,
        walked: vec16,
        up: wp.array[vec16],
    ):
        parcel = Parcel()
        parcel.dx = dx
        parcel.dy = dy
        parcel.xx = vec16(splat.root[0])
        parcel.xy = vec16(splat.root[1])
        parcel.yy = vec16(splat.root[2])
        parcel.opacity = vec16(splat.opacity)
        parcel.red = vec16(splat.color[0])
        parcel.green = vec16(splat.color[1])
        parcel.blue = vec16(splat.color[2])
        parcel.depth = vec16(splat.depth)
        fall = exp2_minus(exponent(dx, dy, parcel.xx, parcel.xy, parcel.yy))
        odds = odds_of(opaque(times(fall, parcel.opacity), alpha_min, here, walked))
        front = t[block] + times(t[block], odds)
        first = block * CHANNELS
        depth_up = vec16(0.0)
        if wp.static(depth):
            depth_up = up[first + 3]
        adj, _fall, adj_front, _behind, _min, _here, _walked, _red, _green, _blue, _depth = wp.grad(step)(
            parcel,
            fall,
            front,
            adj_t[block],
            alpha_min,
            here,
            walked,
            up[first],
            up[first + 1],
            up[first + 2],
            depth_up,
        )
        adj_t[block] = adj_front
        t[block] = front
        m[0] = m[0] + adj.dx
        m[1] = m[1] + adj.dy
        m[2] = m[2] + adj.xx
        m[3] = m[3] + adj.xy
        m[4] = m[4] + adj.yy
        m[5] = m[5] + adj.opacity
        m[6] = m[6] + adj.red
        m[7] = m[7] + adj.green
        m[8] = m[8] + adj.blue
        if wp.static(depth):
            m[9] = m[9] + adj.depth

    @wp.func
    def adj_geometry(m: wp.array[vec16], splat: Splat2D):
        """dL/d(mean, conic)."""
        adj_root = wp.vec3(total(m[2]), total(m[3]), total(m[4]))
        return wp.vec2(total(m[0]), total(m[1])), conic_from_root(adj_root, splat.root)

    return adj_step, adj_geometry


@functools.cache
def make_reverse(mode: str, depth: bool, exp_degree: int | None) -> wp.Kernel:
    """The reverse loop with the body of ``mode``."""
    CHANNELS = 4 if depth else 3
    GRADS = 6 + CHANNELS  # mean, conic, opacity, channels
    adj_step, adj_geometry = {"manual": make_manual, "stepwise": make_stepwise}[mode](depth, exp_degree)

    @wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
    def adj_blend(
        first: int,
        tiles_x: int,
        ranges: wp.array[wp.vec2i],
        instances: wp.array[wp.vec2i],
        splats: wp.array[Splat2D],
        alpha_min: float,
        final: wp.array2d[vec16],
        count: wp.array2d[vec16],
        steps: wp.array[int],
        up: wp.array2d[vec16],
        adj_final: wp.array2d[vec16],
        # out
        slots_out: wp.array2d[float],  # [M, GRADS] mean 2, conic 3, opacity 1, channels: one row per tile instance
    ):
        tile = first + wp.tid()
        start = ranges[tile][0]
        x0 = float((tile % tiles_x) * TILE) + 0.5
        y0 = float((tile // tiles_x) * TILE) + 0.5
        t = wp.zeros(shape=(BLOCKS,), dtype=vec16)
        adj_t = wp.zeros(shape=(BLOCKS,), dtype=vec16)
        m = wp.zeros(shape=(GRADS,), dtype=vec16)
        for block in range(BLOCKS):
            t[block] = final[tile, block]
            adj_t[block] = adj_final[tile, block]
            if wp.static(mode == "manual"):
                adj_t[block] = times(t[block], adj_t[block])
        for back in range(steps[tile]):
            k = start + steps[tile] - 1 - back
            splat = splats[instances[k][0]]
            box = reach(splat.mean, splat.extent, x0, y0)
            here = vec16(float(k - start))
            for grad in range(GRADS):
                m[grad] = vec16(0.0)
            for by in range(box[2], box[3] + 1):
                dy = offset_y(splat.mean, y0, by)
                for bx in range(box[0], box[1] + 1):
                    block = 4 * by + bx
                    dx = offset_x(splat.mean, x0, bx)
                    adj_step(m, t, adj_t, block, splat, dx, dy, alpha_min, here, count[tile, block], up[tile])
            slot = instances[k][1]
            adj_mean, adj_conic = adj_geometry(m, splat)
            slots_out[slot, 0] = adj_mean[0]
            slots_out[slot, 1] = adj_mean[1]
            slots_out[slot, 2] = adj_conic[0]
            slots_out[slot, 3] = adj_conic[1]
            slots_out[slot, 4] = adj_conic[2]
            for grad in range(5, GRADS):
                slots_out[slot, grad] = total(m[grad])

    return adj_blend

"""The adjoint of the blend on the CPU, its reverse loop by hand: ``manual`` and ``stepwise`` differ in the step.

Both recover T by division, both sum over the pixels of a tile in lanes and write one row per tile instance.
"""

import functools

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.blend import Splat2D, exponent
from warp_splat.kernels.blend_lanes import BLOCKS, offset_x, offset_y, reach
from warp_splat.kernels.build import FORWARD_ONLY
from warp_splat.kernels.lanes import times, total, vec16
from warp_splat.kernels.step import conic_from_root, geometry_from_moments, make_manual, make_stepwise


@functools.cache
def _make_manual_body(depth: bool, exp_degree: int | None) -> tuple[wp.Function, wp.Function]:
    """What the loop does with a Gaussian and a block, and how its sums become a row."""
    CHANNELS = 4 if depth else 3
    adj_step = make_manual(exp_degree, vec16)

    @wp.func
    def body(
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
        lit = vec16(0.0)
        for channel in range(3):
            lit = lit + up[block * CHANNELS + channel] * splat.color[channel]
        if wp.static(depth):
            lit = lit + up[block * CHANNELS + 3] * splat.depth
        z = exponent(dx, dy, splat.root[0], splat.root[1], splat.root[2])
        front, beyond, w, adj_opacity = adj_step(
            z, splat.opacity, t[block], behind[block], alpha_min, here, walked, lit
        )
        t[block] = front
        behind[block] = beyond
        for channel in range(CHANNELS):
            m[6 + channel] = m[6 + channel] + times(w, up[block * CHANNELS + channel])
        adj_x = times(adj_opacity, dx)
        adj_y = times(adj_opacity, dy)
        m[0] = m[0] + adj_x
        m[1] = m[1] + adj_y
        m[2] = m[2] + times(adj_x, dx)
        m[3] = m[3] + times(adj_x, dy)
        m[4] = m[4] + times(adj_y, dy)
        m[5] = m[5] + adj_opacity

    @wp.func
    def adj_geometry(m: wp.array[vec16], splat: Splat2D):
        """dL/d(mean, conic)."""
        s = wp.vec2(total(m[0]), total(m[1]))
        return geometry_from_moments(s, total(m[2]), total(m[3]), total(m[4]), splat.root, splat.opacity)

    return body, adj_geometry


@functools.cache
def _make_stepwise_body(depth: bool, exp_degree: int | None) -> tuple[wp.Function, wp.Function]:
    """What the loop does with a Gaussian and a block, and how its sums become a row."""
    CHANNELS = 4 if depth else 3
    Parcel, undo, step = make_stepwise(depth, exp_degree, vec16)

    @wp.func
    def body(
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
        first = block * CHANNELS
        far = vec16(0.0)
        if wp.static(depth):
            far = up[first + 3]
        fall, front = undo(parcel, t[block], alpha_min, here, walked)
        adj, _fall, adj_front, _behind, _min, _here, _walked, _red, _green, _blue, _far = wp.grad(step)(
            parcel, fall, front, adj_t[block], alpha_min, here, walked, up[first], up[first + 1], up[first + 2], far
        )
        t[block] = front
        adj_t[block] = adj_front
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

    return body, adj_geometry


@functools.cache
def make_reverse(mode: str, depth: bool, exp_degree: int | None) -> wp.Kernel:
    """The reverse loop with the body of ``mode``."""
    CHANNELS = 4 if depth else 3
    GRADS = 6 + CHANNELS  # mean, conic, opacity, channels
    make_body = {"manual": _make_manual_body, "stepwise": _make_stepwise_body}[mode]
    body, adj_geometry = make_body(depth, exp_degree)

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
                    body(m, t, adj_t, block, splat, dx, dy, alpha_min, here, count[tile, block], up[tile])
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

"""The adjoint of the blend by differentiating its whole loop with Warp: ``reversible`` and ``stored``.

In the reverse pass Warp replays the body of a dynamic loop, last iteration first. It starts from what the variables of
the loop hold at that moment. Recorded plainly (``plain``) that is silently wrong: stores are not replayed, so T is 0 in
every step, and so is every gradient. Two cures:

    reversible  the replay of ``front_of`` undoes the step, T = T / (1 - alpha): no memory
    stored      it reads the T that the forward pass wrote

A replay cannot follow a break. So the loop runs over the instances that some pixel of the tile blended, and ``opaque``
skips those that a pixel did not. What a loop carries has to be an element of a kernel-local array, changed by += and
-=. Their adjoint is right; that of a[i] = a[i] + x is not.

Pieces with a gradient by hand: the clamp (``opaque``), the falloff (``fall_known``), and the reading of a Gaussian
(``spread`` into lanes, ``collect`` into its row). ``generated`` does without them. It reads a copy of the Gaussian per
tile instance: Warp adds the adjoint of a read to the Gaussian's own, which would be a race between threads.

Tried: no faster, ``stored`` 6 to 17 % slower: an ``if`` around the blocks in which the blend saw nothing.
"""

import warp as wp

from warp_splat.kernels.compiler import DIFFERENTIABLE, once
from warp_splat.kernels.cpu.blend import BLOCKS, LANE_X, LANE_Y, corner, reach
from warp_splat.kernels.falloff import make_fall_value, make_falloff
from warp_splat.kernels.inline import without_gradient
from warp_splat.kernels.simd import fma, times, total, vec16, where_less
from warp_splat.kernels.slots import CHANNEL, MEAN_X, MEAN_Y, OPACITY, XX, XY, YY, write_geometry
from warp_splat.kernels.splat import BlendVariant, Splat2D, alpha_of, exponent, odds_of
from warp_splat.kernels.step import conic_from_root, opaque
from warp_splat.kernels.structs import BinsView


@without_gradient()
def begin(t: wp.array[vec16], final: wp.array2d[vec16], tile: int):
    for block in range(BLOCKS):
        t[block] = vec16(1.0)


@wp.func_replay(begin)
def replay_begin(t: wp.array[vec16], final: wp.array2d[vec16], tile: int):
    for block in range(BLOCKS):
        t[block] = final[tile, block]


@wp.func
def spread(m: wp.array[vec16], field: int, value: float):
    """``value`` in all lanes; its gradient stays in lanes, in the adjoint of ``m``, until it is collected."""
    return vec16(value)


@wp.func_grad(spread)
def adj_spread(m: wp.array[vec16], field: int, value: float, adj_ret: vec16):
    wp.adjoint[m][field] += adj_ret


@wp.func
def collect(m: wp.array[vec16], root: wp.vec3, slots: wp.array2d[float], slot: int):
    """Nothing; in reverse, where all blocks have come before, the sums become the row of the instance."""
    pass


@wp.func_grad(collect)
def adj_collect(m: wp.array[vec16], root: wp.vec3, slots: wp.array2d[float], slot: int):
    adj_root = wp.vec3(total(wp.adjoint[m][XX]), total(wp.adjoint[m][XY]), total(wp.adjoint[m][YY]))
    adj_conic = conic_from_root(adj_root, root)
    adj_mean = wp.vec2(total(wp.adjoint[m][MEAN_X]), total(wp.adjoint[m][MEAN_Y]))
    write_geometry(slots, slot, adj_mean, adj_conic)
    for grad in range(OPACITY, slots.shape[1]):
        slots[slot, grad] = total(wp.adjoint[m][grad])
    for grad in range(slots.shape[1]):
        wp.adjoint[m][grad] = vec16(0.0)


@wp.kernel(enable_backward=False)
def rows_of_copies(
    first: int,
    copies: wp.array[Splat2D],  # [M] a Gaussian per tile instance
    adj_copies: wp.array[Splat2D],  # [M]
    # out
    slots_out: wp.array2d[float],  # [M, GRADS]
):
    """The rows of ``generated``, from the gradients of its copies."""
    k = first + wp.tid()
    adj = adj_copies[k]
    write_geometry(slots_out, k, adj.mean, conic_from_root(adj.root, copies[k].root))
    for i in range(3):
        slots_out[k, CHANNEL + i] = adj.color[i]
    slots_out[k, OPACITY] = adj.opacity
    if slots_out.shape[1] > CHANNEL + 3:
        slots_out[k, CHANNEL + 3] = adj.depth


@once
def make_walk(mode: str, variant: BlendVariant) -> wp.Kernel:
    """The blend over the instances that were blended, for its generated adjoint in ``mode``."""
    CHANNELS, GRADS = variant.channels, variant.columns
    STATE = BLOCKS * CHANNELS
    (fall_at, fall_known, _), fall_value = make_falloff(variant.falloff), make_fall_value(variant.falloff, vec16)

    @wp.func
    def front_of(t: wp.array[vec16], block: int, alpha: vec16, kept: wp.array2d[vec16], k: int):
        """Transmittance in front of the Gaussian."""
        return t[block]

    @wp.func_replay(front_of)
    def replay_front_of(t: wp.array[vec16], block: int, alpha: vec16, kept: wp.array2d[vec16], k: int):
        if wp.static(mode == "stored"):
            return kept[k, block]
        else:
            t[block] = fma(t[block], odds_of(alpha), t[block])
            return t[block]

    @wp.func_grad(front_of)
    def adj_front_of(t: wp.array[vec16], block: int, alpha: vec16, kept: wp.array2d[vec16], k: int, adj_ret: vec16):
        wp.adjoint[t][block] += adj_ret

    @wp.kernel(module="unique", module_options=dict(DIFFERENTIABLE))
    def walk(
        first: int,
        bins: BinsView,  # splats: a copy per instance for ``generated``, [M]
        alphas: wp.vec2,
        final: wp.array2d[vec16],  # [T, BLOCKS]
        count: wp.array2d[vec16],  # [T, BLOCKS]
        kept: wp.array2d[vec16],  # [M, BLOCKS], or nothing
        steps: wp.array[int],  # [T]
        slots: wp.array2d[float],  # [M, GRADS], written by the adjoint
        # out
        color_out: wp.array2d[vec16],  # [T, STATE]
        final_out: wp.array2d[vec16],  # [T, BLOCKS]
    ):
        tile = first + wp.tid()
        start = bins.ranges[tile][0]
        x0, y0 = corner(bins, tile)
        t = wp.zeros(shape=(BLOCKS,), dtype=vec16)
        c = wp.zeros(shape=(STATE,), dtype=vec16)
        m = wp.zeros(shape=(GRADS,), dtype=vec16)
        if wp.static(mode == "plain"):
            for block in range(BLOCKS):
                t[block] = vec16(1.0)
        else:
            begin(t, final, tile)
        for k in range(start, start + steps[tile]):
            if wp.static(mode == "generated"):
                splat = bins.splats[k]
            else:
                splat = bins.splats[bins.instances[k]]
                collect(m, splat.root, slots, k)
            box = reach(splat.mean, splat.extent, x0, y0)
            here = vec16(float(k - start))
            for by in range(box[2], box[3] + 1):
                for bx in range(box[0], box[1] + 1):
                    block = 4 * by + bx
                    x = splat.mean[0] - x0
                    y = splat.mean[1] - y0
                    column = vec16(float(4 * bx))
                    row = vec16(float(4 * by))
                    if wp.static(mode == "generated"):
                        dx = vec16(x) - LANE_X - column
                        dy = vec16(y) - LANE_Y - row
                        z = exponent(dx, dy, splat.root[0], splat.root[1], splat.root[2])
                        raw = fall_at(z) * splat.opacity
                        alpha = alpha_of(where_less(here, count[tile, block], raw, vec16(-1.0)), alphas)
                    else:
                        dx = spread(m, MEAN_X, x) - LANE_X - column
                        dy = spread(m, MEAN_Y, y) - LANE_Y - row
                        xx = spread(m, XX, splat.root[0])
                        xy = spread(m, XY, splat.root[1])
                        z = exponent(dx, dy, xx, xy, spread(m, YY, splat.root[2]))
                        raw = times(fall_known(z, fall_value(z)), spread(m, OPACITY, splat.opacity))
                        alpha = opaque(raw, alphas, here, count[tile, block])
                    if wp.static(mode == "plain"):
                        front = t[block]
                    else:
                        front = front_of(t, block, alpha, kept, k)
                    w = times(alpha, front)
                    if wp.static(mode == "generated"):
                        for channel in range(3):
                            c[block * CHANNELS + channel] += w * splat.color[channel]
                        if wp.static(CHANNELS > 3):
                            c[block * CHANNELS + 3] += w * splat.depth
                    else:
                        for channel in range(3):
                            c[block * CHANNELS + channel] += times(
                                w, spread(m, CHANNEL + channel, splat.color[channel])
                            )
                        if wp.static(CHANNELS > 3):
                            c[block * CHANNELS + 3] += times(w, spread(m, CHANNEL + 3, splat.depth))
                    t[block] -= w
        for i in range(STATE):
            color_out[tile, i] = c[i]
        for block in range(BLOCKS):
            final_out[tile, block] = t[block]

    return walk

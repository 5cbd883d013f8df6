"""The adjoint of the blend on CUDA by differentiating its whole loop with Warp: ``reversible`` and ``stored``.

As on the CPU (:mod:`warp_splat.kernels.cpu.taped`), with two differences. T is a variable of the thread. A Gaussian is
read as one vector, whose custom gradient sums over the block's pixels and writes the instance's row. All threads read
it from global memory: they would all add to the adjoint of a staged element.
"""

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.compiler import once
from warp_splat.kernels.cuda.adjoint import row_of
from warp_splat.kernels.cuda.blend import BLOCK_OPTIONS, staged_of
from warp_splat.kernels.cuda.warps import COLUMNS, WARP, block_sum, column_of, vec10
from warp_splat.kernels.falloff import make_fall_value, make_falloff
from warp_splat.kernels.slots import CHANNEL, MEAN_X, MEAN_Y, OPACITY, XX, XY, YY
from warp_splat.kernels.splat import BlendVariant, Splat2D, exponent, odds_of
from warp_splat.kernels.step import conic_from_root, opaque
from warp_splat.kernels.structs import BinsView


@wp.func
def begin(final: float):
    return 1.0


@wp.func_replay(begin)
def replay_begin(final: float):
    return final


@wp.func_grad(begin)
def adj_begin(final: float, adj_ret: float):
    pass


@wp.func
def behind_of(front: float, w: float):
    """Transmittance behind the Gaussian."""
    return front - w


@wp.func_replay(behind_of)
def replay_behind_of(front: float, w: float):
    return front  # undone already


@wp.func_grad(behind_of)
def adj_behind_of(front: float, w: float, adj_ret: float):
    wp.adjoint[front] += adj_ret
    wp.adjoint[w] -= adj_ret


@once
def make_walk(mode: str, variant: BlendVariant) -> wp.Kernel:
    """The blend over the instances that were blended, for its generated adjoint in ``mode``."""
    CHANNELS, GRADS = variant.channels, variant.columns
    fall_known, fall_value = make_falloff(variant.falloff).known, make_fall_value(variant.falloff, float)

    @wp.func
    def front_of(t: float, alpha: float, kept: wp.array2d[float], k: int, thread: int):
        """Transmittance in front of the Gaussian."""
        return t

    @wp.func_replay(front_of)
    def replay_front_of(t: float, alpha: float, kept: wp.array2d[float], k: int, thread: int):
        if wp.static(mode == "stored"):
            return kept[k, thread]
        else:
            return t + t * odds_of(alpha)

    @wp.func_grad(front_of)
    def adj_front_of(t: float, alpha: float, kept: wp.array2d[float], k: int, thread: int, adj_ret: float):
        wp.adjoint[t] += adj_ret

    @wp.func
    def read(splat: Splat2D, slots: wp.array2d[float], slot: int, thread: int):
        """The Gaussian as one vector; its gradient, summed over the block's pixels, becomes the instance's row."""
        return staged_of(splat)

    @wp.func_grad(read)
    def adj_read(splat: Splat2D, slots: wp.array2d[float], slot: int, thread: int, adj_ret: vec10):
        conic = conic_from_root(wp.vec3(adj_ret[XX], adj_ret[XY], adj_ret[YY]), splat.root)
        total = block_sum(row_of(wp.vec2(adj_ret[MEAN_X], adj_ret[MEAN_Y]), conic, adj_ret), thread)
        column = column_of(thread, COLUMNS)
        if thread < WARP and column >= 0 and column < GRADS:
            slots[slot, column] = total

    @wp.kernel(module="unique", module_options={**BLOCK_OPTIONS, "enable_backward": True})
    def walk(
        bins: BinsView,
        alphas: wp.vec2,
        final: wp.array2d[float],  # [T, THREADS]
        count: wp.array2d[int],  # [T, THREADS]
        kept: wp.array2d[float],  # [M, THREADS], or nothing
        steps: wp.array[int],  # [T]
        slots: wp.array2d[float],  # [M, GRADS], written by the adjoint
        # out
        color_out: wp.array2d[wp.vec4],  # [T, THREADS]
        final_out: wp.array2d[float],  # [T, THREADS]
    ):
        tile, thread = wp.tid()
        start = bins.ranges[tile][0]
        x = float((tile % bins.tiles_x) * TILE + thread % TILE) + 0.5
        y = float((tile // bins.tiles_x) * TILE + thread // TILE) + 0.5
        walked = float(count[tile, thread])
        t = begin(final[tile, thread])
        color = wp.vec4(0.0)
        for k in range(start, start + steps[tile]):
            g = read(bins.splats[bins.instances[k]], slots, k, thread)
            z = exponent(g[MEAN_X] - x, g[MEAN_Y] - y, g[XX], g[XY], g[YY])
            raw = fall_known(z, fall_value(z)) * g[OPACITY]
            alpha = opaque(raw, alphas, float(k - start), walked)
            front = front_of(t, alpha, kept, k, thread)
            w = alpha * front
            if wp.static(CHANNELS > 3):
                color += wp.vec4(g[CHANNEL], g[CHANNEL + 1], g[CHANNEL + 2], g[CHANNEL + 3]) * w
            else:
                color += wp.vec4(g[CHANNEL], g[CHANNEL + 1], g[CHANNEL + 2], 0.0) * w
            t = behind_of(front, w)
        color_out[tile, thread] = color
        final_out[tile, thread] = t

    return walk

"""What is blended beside the color on CUDA: as :mod:`warp_splat.kernels.cpu.channels`, a thread per pixel.

A Gaussian's channels are read from global memory, by all threads of the block at once.
"""

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.compiler import once
from warp_splat.kernels.cuda.adjoint import clear_rest, row_of
from warp_splat.kernels.cuda.blend import BLOCK_OPTIONS, THREADS, staged_of
from warp_splat.kernels.cuda.warps import AT_ONCE, COLUMNS, WARP, block_sum, column_of, vec10, vec_channels
from warp_splat.kernels.falloff import make_falloff
from warp_splat.kernels.simd import fma
from warp_splat.kernels.slots import CHANNEL, MEAN_X, MEAN_Y, OPACITY, XX, XY, YY
from warp_splat.kernels.splat import BlendVariant, exponent
from warp_splat.kernels.step import make_reverse_step, opaque
from warp_splat.kernels.structs import BinsView
from warp_splat.kernels.tiles import first_pixel_of


@once
def make_beside(variant: BlendVariant, most: int | None = None) -> wp.Kernel:
    """The sums of weights times channels; or, with ``most``, the weights of so many strongest Gaussians."""
    fall_at, WIDTH, MOST = make_falloff(variant.falloff).value, AT_ONCE, most or 0
    vec_most = wp.types.vector(length=max(MOST, 1), dtype=float)

    @wp.kernel(module="unique", module_options=dict(BLOCK_OPTIONS))
    def beside(
        bins: BinsView,
        alphas: wp.vec2,
        count: wp.array2d[int],  # [T, THREADS]
        steps: wp.array[int],  # [T]
        rows: wp.array2d[float],  # [V, AT_ONCE] of the splats; of weights nothing
        begin: int,  # of the group
        channels: int,  # of the group
        # out
        pixels_out: wp.array3d[float],  # [H, W, C] channels, or weights [H, W, most]
        ranks_out: wp.array3d[int],  # [H, W, most] the strongest first, of equal ones the nearest; -1: no more
        median_out: wp.array2d[int],  # [H, W] -1: half of the light comes through
    ):
        tile, thread = wp.tid()
        column, line, above = first_pixel_of(bins, tile)
        column += thread % TILE
        line += thread // TILE
        x = float(column) + 0.5
        y = float(line) + 0.5
        start = bins.ranges[tile][0]
        walked = float(count[tile, thread])
        t = float(1.0)
        sums = vec_channels(0.0)
        median = int(-1)
        weights = vec_most(0.0)
        ranks = vec_most(-1.0)
        for batch in range((steps[tile] + THREADS - 1) // THREADS):
            first = batch * THREADS
            mine = vec10(0.0)
            splat = int(0)
            if first + thread < steps[tile]:
                splat = bins.instances[start + first + thread]
                mine = staged_of(bins.splats[splat])
            staged = wp.tile(mine, preserve_type=True)
            if wp.static(most is None):
                splats = wp.tile(splat)
            for j in range(wp.min(THREADS, steps[tile] - first)):
                g = staged[j]
                here = float(first + j)
                fall = fall_at(exponent(g[MEAN_X] - x, g[MEAN_Y] - y, g[XX], g[XY], g[YY]))
                alpha = opaque(fall * g[OPACITY], alphas, here, walked)
                w = alpha * t
                behind = fma(-alpha, t, t)
                if wp.static(most is None):
                    splat = splats[j]
                    for channel in range(WIDTH):
                        sums[channel] += w * rows[splat, channel]
                else:
                    if t > 0.5 and behind <= 0.5:
                        median = first + j
                t = behind
                for place in range(MOST):  # each as strong as it is pushes the weaker ones down
                    best = weights[place]
                    rank = ranks[place]
                    if best < w:
                        weights[place] = w
                        ranks[place] = here
                        w = best
                        here = rank
        if line < bins.height and column < pixels_out.shape[1]:
            line += above
            if wp.static(most is None):
                for channel in range(WIDTH):
                    if channel < channels:
                        pixels_out[line, column, begin + channel] = sums[channel]
            else:
                median_out[line, column] = median
            for place in range(MOST):
                pixels_out[line, column, place] = weights[place]
                ranks_out[line, column, place] = int(ranks[place])

    return beside


@once
def make_adj_channels(mode: str, variant: BlendVariant, most: int = 0) -> wp.Kernel:
    """The adjoint of the sums, by hand or by Warp's derivative of a step.

    By ``absolute``, instead of the means' gradients the sums of their magnitudes over the pixels, and no others. With
    ``most``, instead that of the weights of so many of a pixel's Gaussians, which have no channels.
    """
    WIDTH = most or AT_ONCE
    geometric = bool(most) or mode == "absolute"  # channels have no gradients of their own
    pixel, geometry = make_reverse_step(mode, variant.falloff, float)
    fall_at = make_falloff(variant.falloff).value
    vec_up = wp.types.vector(length=WIDTH, dtype=float)

    @wp.kernel(module="unique", module_options=dict(BLOCK_OPTIONS))
    def adj_channels(
        bins: BinsView,
        alphas: wp.vec2,
        final: wp.array2d[float],  # [T, THREADS]
        count: wp.array2d[int],  # [T, THREADS]
        steps: wp.array[int],  # [T]
        rows: wp.array2d[float],  # [V, AT_ONCE] of the splats; of weights nothing
        ranks: wp.array3d[float],  # [H, W, most] of which Gaussians the weights are; of channels nothing
        begin: int,  # of the group
        channels: int,  # of the group, or weights
        adj_pixels: wp.array3d[float],  # [H, W, C]
        # out
        slots_out: wp.array2d[float],  # [M, CHANNEL + channels or more], geometric [M, CHANNEL]
    ):
        tile, thread = wp.tid()
        column = (tile % bins.tiles_x) * TILE + thread % TILE
        line = (tile // bins.tiles_x) * TILE + thread // TILE
        x = float(column) + 0.5
        y = float(line) + 0.5
        start = bins.ranges[tile][0]
        up = vec_up(0.0)
        chosen = vec_up(-1.0)
        if line < adj_pixels.shape[0] and column < adj_pixels.shape[1]:
            for channel in range(WIDTH):
                if channel < channels:
                    up[channel] = adj_pixels[line, column, begin + channel]
                    if wp.static(most > 0):
                        chosen[channel] = ranks[line, column, channel]
        t = final[tile, thread]
        walked = float(count[tile, thread])
        adj_t = float(0.0)
        written = column_of(thread, COLUMNS)
        channel_written = column_of(thread, AT_ONCE)
        for back in range(steps[tile]):
            k = start + steps[tile] - 1 - back
            splat = bins.instances[k]
            g = staged_of(bins.splats[splat])
            dx = g[MEAN_X] - x
            dy = g[MEAN_Y] - y
            here = float(k - start)
            lit = float(0.0)
            for channel in range(WIDTH):
                if wp.static(most > 0):
                    lit += wp.where(chosen[channel] == here, up[channel], 0.0)
                else:
                    lit += up[channel] * rows[splat, channel]
            root = wp.vec3(g[XX], g[XY], g[YY])
            fall = fall_at(exponent(dx, dy, root[0], root[1], root[2]))
            front, adj_front, w, part = pixel(dx, dy, fall, root, g[OPACITY], t, adj_t, alphas, here, walked, lit)
            t = front
            adj_t = adj_front
            mean, conic = geometry(part, root, g[OPACITY])
            row = row_of(mean, conic, vec10(part[OPACITY]))
            total = block_sum(row, thread)
            if thread < WARP and written >= 0 and written < CHANNEL:
                slots_out[k, written] = total
            if wp.static(not geometric):
                more = block_sum(w * up, thread)
                if thread < WARP and channel_written >= 0 and CHANNEL + channel_written < slots_out.shape[1]:
                    slots_out[k, CHANNEL + channel_written] = more
        clear_rest(bins, tile, thread, steps[tile], slots_out)

    return adj_channels

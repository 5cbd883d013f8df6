"""The CUDA driver of the blend: one block of 256 threads per 16 x 16 tile, one pixel per thread.

Each thread stages one Gaussian of a batch of 256 in shared memory, and which warps its box touches; these blend it; the
block votes whether every pixel has stopped. A warp has 8 x 4 pixels, as blocks of the adjoint. The mathematics is that
of the CPU's lanes (:mod:`warp_splat.kernels.splat`), for one pixel.
"""

import functools

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.cuda.warps import PIXELS, WARP, across_of, ballot, blocks_of, down_of, lowest, vec10
from warp_splat.kernels.falloff import LOG2_E, make_falloff
from warp_splat.kernels.slots import CHANNEL, MEAN_X, MEAN_Y, OPACITY, XX, XY, YY
from warp_splat.kernels.splat import BlendVariant, Splat2D, advance, alpha_of, exponent, weight
from warp_splat.kernels.structs import BinsView, PixelsView

THREADS = wp.constant(TILE * TILE)  # per block

#: Of modules whose kernels run in blocks. No regrouping of sums: it would change what CPU fibers check.
BLOCK_OPTIONS = {"enable_backward": False, "block_dim": TILE * TILE}


@wp.func
def staged_of(splat: Splat2D):
    """What the loops read of a Gaussian, as one element of a tile, in a slot's columns; XX to YY are the root's."""
    return vec10(
        splat.mean[0], splat.mean[1], splat.root[0], splat.root[1], splat.root[2], splat.opacity,
        splat.color[0], splat.color[1], splat.color[2], splat.depth,
    )  # fmt: skip


@functools.cache
def make_blend_block(variant: BlendVariant) -> wp.Kernel:
    """The blend; a fourth channel carries z; with ``keep``, every T is stored for the adjoint."""
    falloff, CHANNELS = make_falloff(variant.falloff), variant.channels
    fall_at, reach_of = falloff.value, falloff.reach_of

    @wp.kernel(module="unique", module_options=dict(BLOCK_OPTIONS))
    def blend(
        bins: BinsView,
        alphas: wp.vec2,
        t_min: float,
        max_steps: int,
        background: wp.array[float],  # [3]
        # out
        pixels_out: PixelsView,
        final_out: wp.array2d[float],  # [T, THREADS] transmittance behind the last Gaussian
        count_out: wp.array2d[int],  # [T, THREADS] where the adjoint starts: instances walked before the pixel stopped
        kept_out: wp.array2d[float],  # [M, THREADS] transmittance in front of each Gaussian
    ):
        tile, thread = wp.tid()
        warp = thread // WARP
        across = across_of(thread % WARP, warp)
        down = down_of(thread % WARP, warp)
        place = down * TILE + across
        column = (tile % bins.tiles_x) * TILE + across
        line = (tile // bins.tiles_x) * TILE + down
        x = float(column) + 0.5
        y = float(line) + 0.5
        left = float((tile % bins.tiles_x) * TILE) + 0.5
        top = float((tile // bins.tiles_x) * TILE) + 0.5
        start = bins.ranges[tile][0]
        length = wp.min(bins.ranges[tile][1] - start, max_steps)
        inside = line < pixels_out.image.shape[0] and column < pixels_out.image.shape[1]
        t = float(1.0)
        if not inside:
            t = -1.0  # stopped from the beginning
        count = int(0)
        color = wp.vec3(0.0)
        far = float(0.0)
        for batch in range((length + THREADS - 1) // THREADS):
            first = batch * THREADS
            mine = vec10(0.0)
            touched = int(0)
            if first + thread < length:
                splat = bins.splats[bins.instances[start + first + thread]]
                mine = staged_of(splat)
                if wp.static(variant.keep):
                    touched = -1  # every T is kept
                else:
                    touched = blocks_of(splat, 0.5 * LOG2_E * reach_of(splat.opacity, alphas[0]), left, top)
            staged = wp.tile(mine, preserve_type=True)
            word = int(0)  # of a warp's lane: which of the warp's Gaussians touch the block of that number
            for block in range(PIXELS):
                touching = ballot((touched & (1 << block)) != 0, thread)
                if thread % WARP == block:
                    word = touching
            words = wp.tile(word)
            for group in range((wp.min(THREADS, length - first) + WARP - 1) // WARP):
                left_over = words[group * WARP + warp]
                if wp.static(not variant.keep):
                    if ballot(t >= 0.0, thread) == 0:
                        left_over = 0
                while left_over != 0:
                    j = group * WARP + lowest(left_over)
                    left_over = left_over & (left_over - 1)
                    g = staged[j]
                    fall = fall_at(exponent(g[MEAN_X] - x, g[MEAN_Y] - y, g[XX], g[XY], g[YY]))
                    alpha = alpha_of(fall * g[OPACITY], alphas)
                    behind = advance(t, alpha, t_min)
                    w = weight(t, alpha, behind)
                    if wp.static(variant.keep):
                        kept_out[start + first + j, place] = t
                    color += wp.vec3(g[CHANNEL], g[CHANNEL + 1], g[CHANNEL + 2]) * w
                    if wp.static(CHANNELS > 3):
                        far += g[CHANNEL + 3] * w
                    t = behind
                    if behind >= 0.0:
                        count = first + j + 1
            if wp.tile_max(wp.tile(t))[0] < 0.0:
                break
        t = wp.abs(t)
        final_out[tile, place] = t
        count_out[tile, place] = count
        if inside:
            for channel in range(3):
                pixels_out.image[line, column, channel] = color[channel] + t * background[channel]
            pixels_out.alpha[line, column] = 1.0 - t
            if wp.static(CHANNELS > 3):
                pixels_out.depth[line, column] = far

    return blend

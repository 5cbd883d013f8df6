"""Which Gaussians a pixel shows, on CUDA: as :mod:`warp_splat.kernels.cpu.strongest`, a thread per pixel."""

import functools

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.cuda.blend import BLOCK_OPTIONS, THREADS, staged_of, vec10
from warp_splat.kernels.falloff import make_falloff
from warp_splat.kernels.simd import fma
from warp_splat.kernels.slots import MEAN_X, MEAN_Y, OPACITY, XX, XY, YY
from warp_splat.kernels.splat import BlendVariant, exponent
from warp_splat.kernels.step import opaque
from warp_splat.kernels.structs import BinsView


@functools.cache
def make_strongest(variant: BlendVariant, most: int) -> wp.Kernel:
    """Places in the tile's list of the ``most`` strongest, those weights, and the place of the median."""
    fall_at = make_falloff(variant.falloff).value
    vec_most = wp.types.vector(length=max(most, 1), dtype=float)

    @wp.kernel(module="unique", module_options=dict(BLOCK_OPTIONS))
    def strongest(
        bins: BinsView,
        alphas: wp.vec2,
        count: wp.array2d[int],  # [T, THREADS]
        steps: wp.array[int],  # [T]
        # out
        ranks_out: wp.array3d[int],  # [H, W, most] the strongest first, of equal ones the nearest; -1: no more
        weights_out: wp.array3d[float],  # [H, W, most]
        median_out: wp.array2d[int],  # [H, W] -1: half of the light comes through
    ):
        tile, thread = wp.tid()
        column = (tile % bins.tiles_x) * TILE + thread % TILE
        line = (tile // bins.tiles_x) * TILE + thread // TILE
        x = float(column) + 0.5
        y = float(line) + 0.5
        start = bins.ranges[tile][0]
        walked = float(count[tile, thread])
        t = float(1.0)
        median = int(-1)
        weights = vec_most(0.0)
        ranks = vec_most(-1.0)
        for batch in range((steps[tile] + THREADS - 1) // THREADS):
            first = batch * THREADS
            mine = vec10(0.0)
            if first + thread < steps[tile]:
                mine = staged_of(bins.splats[bins.instances[start + first + thread]])
            staged = wp.tile(mine, preserve_type=True)
            for j in range(wp.min(THREADS, steps[tile] - first)):
                g = staged[j]
                here = float(first + j)
                fall = fall_at(exponent(g[MEAN_X] - x, g[MEAN_Y] - y, g[XX], g[XY], g[YY]))
                alpha = opaque(fall * g[OPACITY], alphas, here, walked)
                w = alpha * t
                behind = fma(-alpha, t, t)
                if t > 0.5 and behind <= 0.5:
                    median = first + j
                t = behind
                for place in range(most):  # each as strong as it is pushes the weaker ones down
                    best = weights[place]
                    rank = ranks[place]
                    if best < w:
                        weights[place] = w
                        ranks[place] = here
                        w = best
                        here = rank
        if line < median_out.shape[0] and column < median_out.shape[1]:
            median_out[line, column] = median
            for place in range(most):
                weights_out[line, column, place] = weights[place]
                ranks_out[line, column, place] = int(ranks[place])

    return strongest

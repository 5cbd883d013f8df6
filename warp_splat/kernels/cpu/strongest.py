"""Which Gaussians a pixel shows, on the CPU: the strongest of them, and the one at which half of the light is gone."""

import functools

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.compiler import IN_LANES
from warp_splat.kernels.cpu.blend import AHEAD, BLOCKS, ROWS_AHEAD, aligned, corner, walk
from warp_splat.kernels.cpu.channels import pixel_of
from warp_splat.kernels.falloff import make_falloff
from warp_splat.kernels.inline import kernel_of_parts
from warp_splat.kernels.simd import LANES, fma, times, vec16, where_less
from warp_splat.kernels.splat import BlendVariant, Splat2D, exponent
from warp_splat.kernels.step import opaque
from warp_splat.kernels.structs import BinsView


@functools.cache
def make_strongest(variant: BlendVariant, most: int) -> wp.Kernel:
    """Places in the tile's list of the ``most`` strongest, those weights, and the place of the median."""
    fall_at, way = make_falloff(variant.falloff).value, 1
    T, WALKED, MEDIAN, WEIGHT, RANK = 0, BLOCKS, 2 * BLOCKS, 3 * BLOCKS, (3 + most) * BLOCKS
    STATE = (3 + 2 * most) * BLOCKS
    mat_room = wp.types.matrix(shape=(STATE + ROWS_AHEAD + 1, LANES), dtype=float)

    def begin(k, here, out):
        return 0

    def step(k, splat, dx, dy, block, here, own, out, s, alphas):
        fall = fall_at(exponent(dx, dy, splat.root[0], splat.root[1], splat.root[2]))
        t = s[T + block]
        alpha = opaque(fall * splat.opacity, alphas, here, s[WALKED + block])
        behind = fma(-alpha, t, t)
        s[T + block] = behind
        known = s[MEDIAN + block]
        s[MEDIAN + block] = where_less(vec16(0.5), t, where_less(vec16(0.5), behind, known, here), known)
        w = times(alpha, t)
        place = here
        for j in range(most):  # each as strong as it is pushes the weaker ones down
            best = s[WEIGHT + j * BLOCKS + block]
            rank = s[RANK + j * BLOCKS + block]
            s[WEIGHT + j * BLOCKS + block] = wp.max(w, best)
            s[RANK + j * BLOCKS + block] = where_less(best, w, place, rank)
            place = where_less(best, w, rank, place)
            w = wp.min(w, best)

    def finish(k, splat, ahead, out):
        return False

    @kernel_of_parts(IN_LANES, walk=walk, begin=begin, step=step, finish=finish)
    def strongest(
        first: int,
        bins: BinsView,
        alphas: wp.vec2,
        count: wp.array2d[vec16],  # [T, BLOCKS]
        steps: wp.array[int],  # [T]
        # out
        ranks_out: wp.array3d[int],  # [H, W, most] the strongest first, of equal ones the nearest; -1: no more
        weights_out: wp.array3d[float],  # [H, W, most]
        median_out: wp.array2d[int],  # [H, W] -1: half of the light comes through
    ):
        tile = first + wp.tid()
        start = bins.ranges[tile][0]
        x0, y0 = corner(bins, tile)
        room = mat_room()
        s = wp.array(ptr=aligned(wp.address_of(room)), shape=(STATE,), dtype=vec16)
        near = wp.array(ptr=s.ptr + wp.uint64(64 * STATE), shape=(AHEAD,), dtype=Splat2D)
        for block in range(BLOCKS):
            s[T + block] = vec16(1.0)
            s[WALKED + block] = count[tile, block]
            s[MEDIAN + block] = vec16(-1.0)
            for j in range(most):
                s[WEIGHT + j * BLOCKS + block] = vec16(0.0)
                s[RANK + j * BLOCKS + block] = vec16(-1.0)
        length = steps[tile]
        walk(bins, near, start, length, way, x0, y0, median_out, begin, step, finish)
        numbers = wp.array(ptr=s.ptr + wp.uint64(64 * MEDIAN), shape=((STATE - MEDIAN) * LANES,), dtype=float)
        pixel = int(0)
        while pixel < TILE * TILE:
            x, y = pixel_of(tile, bins.tiles_x, pixel)
            if y < median_out.shape[0] and x < median_out.shape[1]:
                median_out[y, x] = int(numbers[pixel])
                for j in range(most):
                    weights_out[y, x, j] = numbers[(WEIGHT - MEDIAN + j * BLOCKS) * LANES + pixel]
                    ranks_out[y, x, j] = int(numbers[(RANK - MEDIAN + j * BLOCKS) * LANES + pixel])
            pixel += 1

    return strongest

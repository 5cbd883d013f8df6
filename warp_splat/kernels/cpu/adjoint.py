"""The adjoint of the blend on the CPU, its reverse loop by hand: ``manual`` and ``stepwise`` differ in the step.

Both recover T by division, both sum over the pixels of a tile in lanes and write one row per tile instance.
"""

import functools

import warp as wp

from warp_splat.kernels.compiler import IN_LANES
from warp_splat.kernels.cpu.blend import AHEAD, BLOCKS, ROWS_AHEAD, aligned, walk
from warp_splat.kernels.inline import kernel_of_parts
from warp_splat.kernels.simd import LANES, fma, times, vec16
from warp_splat.kernels.slots import CHANNEL, OPACITY, write_geometry
from warp_splat.kernels.splat import BlendVariant, Splat2D
from warp_splat.kernels.step import make_reverse_step
from warp_splat.kernels.structs import BinsView

vec8 = wp.types.vector(length=8, dtype=float)


@wp.func
def folded(rows: wp.array[vec16], row: int):
    """Sum of a row of lanes, which is spent.

    Folded in memory, because LLVM makes vectors of what is stored (Tried: a sum of 16 numbers, which stays scalar: 15 %
    of the loop).
    """
    halves = wp.array(ptr=rows.ptr + wp.uint64(64 * row), shape=(2,), dtype=vec8)
    quarters = wp.array(ptr=rows.ptr + wp.uint64(64 * row), shape=(4,), dtype=wp.vec4)
    halves[0] = halves[0] + halves[1]
    quarters[0] = quarters[0] + quarters[1]
    four = quarters[0]
    return (four[0] + four[2]) + (four[1] + four[3])


@functools.cache
def make_reverse(mode: str, variant: BlendVariant) -> wp.Kernel:
    """The reverse loop with the step of ``mode``."""
    CHANNELS, GRADS = variant.channels, variant.columns
    # all in one matrix: a matrix of which only rows of known numbers are used would be taken apart into scalars
    T, ADJ_T, WALKED, UP, SUMS = 0, BLOCKS, 2 * BLOCKS, 3 * BLOCKS, (3 + CHANNELS) * BLOCKS
    mat_room = wp.types.matrix(shape=(SUMS + GRADS + ROWS_AHEAD + 1, LANES), dtype=float)
    vec_grads = wp.types.vector(length=GRADS, dtype=float)
    (pixel, geometry), way = make_reverse_step(mode, variant.falloff, vec16), -1

    def begin(k, here, out, s):
        for grad in range(GRADS):
            s[SUMS + grad] = vec16(0.0)
        return 0

    def step(k, splat, dx, dy, block, here, own, out, s, alphas):
        red, green, blue = s[UP + block], s[UP + BLOCKS + block], s[UP + 2 * BLOCKS + block]
        lit = fma(red, splat.color[0], fma(green, splat.color[1], blue * splat.color[2]))
        if wp.static(CHANNELS > 3):
            lit = fma(s[UP + 3 * BLOCKS + block], splat.depth, lit)
        front, adj_front, w, part = pixel(
            dx, dy, splat.root, splat.opacity, s[T + block], s[ADJ_T + block], alphas, here, s[WALKED + block], lit
        )
        s[T + block] = front
        s[ADJ_T + block] = adj_front
        for grad in range(CHANNEL):
            s[SUMS + grad] = s[SUMS + grad] + part[grad]
        for channel in range(CHANNELS):
            row = SUMS + CHANNEL + channel
            s[row] = s[row] + times(w, s[UP + channel * BLOCKS + block])

    def finish(k, splat, ahead, slots_out, s):
        sums = vec_grads()
        grad = int(0)
        while grad < GRADS:  # as a range, which Warp unrolls, 10 % of the loop slower
            sums[grad] = folded(s, SUMS + grad)
            grad += 1
        mean, conic = geometry(sums, splat.root, splat.opacity)
        write_geometry(slots_out, k, mean, conic)
        for grad in range(OPACITY, GRADS):
            slots_out[k, grad] = sums[grad]
        return False

    @kernel_of_parts(IN_LANES, walk=walk, begin=begin, step=step, finish=finish)
    def adj_blend(
        first: int,
        bins: BinsView,
        alphas: wp.vec2,
        final: wp.array2d[vec16],  # [T, BLOCKS]
        count: wp.array2d[vec16],  # [T, BLOCKS]
        steps: wp.array[int],  # [T]
        up: wp.array2d[vec16],  # [T, BLOCKS CHANNELS]
        adj_final: wp.array2d[vec16],  # [T, BLOCKS]
        # out
        slots_out: wp.array2d[float],  # [M, GRADS]
    ):
        tile = first + wp.tid()
        start = bins.ranges[tile][0]
        room = mat_room()
        # rows of lanes: T, dL/dT (times T for manual), instances walked, upstream gradients, sums over pixels
        s = wp.array(ptr=aligned(wp.address_of(room)), shape=(SUMS + GRADS,), dtype=vec16)
        near = wp.array(ptr=s.ptr + wp.uint64(64 * (SUMS + GRADS)), shape=(AHEAD,), dtype=Splat2D)
        for block in range(BLOCKS):
            s[T + block] = final[tile, block]
            s[ADJ_T + block] = adj_final[tile, block]
            if wp.static(mode == "manual"):
                s[ADJ_T + block] = times(final[tile, block], adj_final[tile, block])
            s[WALKED + block] = count[tile, block]
            for channel in range(CHANNELS):
                s[UP + channel * BLOCKS + block] = up[tile, block * CHANNELS + channel]
        length = steps[tile]
        walk(bins, near, start, length, way, slots_out, begin, step, finish)

    return adj_blend

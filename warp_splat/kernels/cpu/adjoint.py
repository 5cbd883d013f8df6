"""The adjoint of the blend on the CPU, its reverse loop by hand: ``manual`` and ``stepwise`` differ in the step.

Both recover T by division, both sum over the pixels of a tile in lanes and write one row per tile instance.
"""

import functools

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.compiler import IN_LANES
from warp_splat.kernels.cpu.blend import AHEAD, BLOCKS, ROWS_AHEAD, aligned, mat_boxes, offset_x, offset_y, reach
from warp_splat.kernels.simd import LANES, fma, times, vec16
from warp_splat.kernels.slots import CHANNEL, MEAN_X, MEAN_Y, OPACITY, XX, XY, YY, write_geometry
from warp_splat.kernels.splat import BlendVariant, Splat2D
from warp_splat.kernels.step import make_reverse_step
from warp_splat.kernels.structs import BinsView

vec8 = wp.types.vector(length=8, dtype=float)


@wp.func
def folded(halves: wp.array[vec8], quarters: wp.array[wp.vec4], row: int):
    """Sum of a row of lanes, two and four of which make it up; the row is spent.

    Folded in memory, because LLVM makes vectors of what is stored (Tried: a sum of 16 numbers, which stays scalar: 15 %
    of the loop).
    """
    halves[2 * row] = halves[2 * row] + halves[2 * row + 1]
    quarters[4 * row] = quarters[4 * row] + quarters[4 * row + 1]
    four = quarters[4 * row]
    return (four[0] + four[2]) + (four[1] + four[3])


@functools.cache
def make_reverse(mode: str, variant: BlendVariant) -> wp.Kernel:
    """The reverse loop with the step of ``mode``."""
    CHANNELS, GRADS = variant.channels, variant.columns
    # all in one matrix: a matrix of which only rows of known numbers are used would be taken apart into scalars
    T, ADJ_T, WALKED, UP, SUMS = 0, BLOCKS, 2 * BLOCKS, 3 * BLOCKS, (3 + CHANNELS) * BLOCKS
    mat_room = wp.types.matrix(shape=(SUMS + GRADS + ROWS_AHEAD + 1, LANES), dtype=float)
    vec_grads = wp.types.vector(length=GRADS, dtype=float)
    pixel, geometry = make_reverse_step(mode, variant.falloff, vec16)

    @wp.kernel(module="unique", module_options=dict(IN_LANES))
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
        x0 = float((tile % bins.tiles_x) * TILE) + 0.5
        y0 = float((tile // bins.tiles_x) * TILE) + 0.5
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
        boxes = mat_boxes()
        sums = vec_grads()
        halves = wp.array(ptr=s.ptr + wp.uint64(64 * SUMS), shape=(2 * GRADS,), dtype=vec8)
        quarters = wp.array(ptr=s.ptr + wp.uint64(64 * SUMS), shape=(4 * GRADS,), dtype=wp.vec4)
        for back in range(steps[tile]):
            k = start + steps[tile] - 1 - back
            ahead = back & (AHEAD - 1)
            if ahead == 0:
                for j in range(wp.min(AHEAD, steps[tile] - back)):
                    near[j] = bins.splats[bins.instances[k - j]]
                for j in range(wp.min(AHEAD, steps[tile] - back)):
                    boxes[j] = reach(near[j].mean, near[j].extent, x0, y0)
            splat = near[ahead]
            box = boxes[ahead]
            here = vec16(float(k - start))
            for grad in range(GRADS):
                s[SUMS + grad] = vec16(0.0)
            by = box[2]
            while by <= box[3]:
                dy = offset_y(splat.mean, y0, by)
                bx = box[0]
                while bx <= box[1]:
                    block = (4 * by + bx) & (BLOCKS - 1)
                    dx = offset_x(splat.mean, x0, bx)
                    red, green, blue = s[UP + block], s[UP + BLOCKS + block], s[UP + 2 * BLOCKS + block]
                    lit = fma(red, splat.color[0], fma(green, splat.color[1], blue * splat.color[2]))
                    if wp.static(CHANNELS > 3):
                        lit = fma(s[UP + 3 * BLOCKS + block], splat.depth, lit)
                    front, adj_front, w, part = pixel(
                        dx, dy, splat.root, splat.opacity,
                        s[T + block], s[ADJ_T + block], alphas, here, s[WALKED + block], lit,
                    )  # fmt: skip
                    s[T + block] = front
                    s[ADJ_T + block] = adj_front
                    for grad in range(CHANNEL):
                        s[SUMS + grad] = s[SUMS + grad] + part[grad]
                    for channel in range(CHANNELS):
                        row = SUMS + CHANNEL + channel
                        s[row] = s[row] + times(w, s[UP + channel * BLOCKS + block])
                    bx += 1
                by += 1
            grad = int(0)
            while grad < GRADS:  # as a range, which Warp unrolls, 10 % of the loop slower
                sums[grad] = folded(halves, quarters, grad)
                grad += 1
            mean, conic = geometry(
                wp.vec2(sums[MEAN_X], sums[MEAN_Y]), sums[XX], sums[XY], sums[YY], splat.root, splat.opacity
            )
            write_geometry(slots_out, k, mean, conic)
            for grad in range(OPACITY, GRADS):
                slots_out[k, grad] = sums[grad]

    return adj_blend

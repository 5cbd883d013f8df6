"""The adjoint of the blend on the CPU, its reverse loop by hand: ``manual`` and ``stepwise`` differ in the step.

Both recover T by division, both sum over the pixels of a tile in lanes and write one row per tile instance.
"""

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.compiler import FORWARD_ONLY, once
from warp_splat.kernels.cpu.blend import AHEAD, BLOCKS, LANE_X, LANE_Y, ROWS_AHEAD, aligned, walk
from warp_splat.kernels.falloff import make_falloff
from warp_splat.kernels.inline import kernel_of_parts
from warp_splat.kernels.simd import LANES, VECTORS, by_width, fma, times, total, vec16, where_less
from warp_splat.kernels.slots import CHANNEL, OPACITY, write_geometry
from warp_splat.kernels.splat import BlendVariant, Splat2D
from warp_splat.kernels.step import make_reverse_step
from warp_splat.kernels.structs import BinsView, PixelsView

vec8 = wp.types.vector(length=8, dtype=float)


def _fold(count: int, answer: str) -> str:
    """C++: ``x``, the sums of ``count`` rows of lanes from ``row`` on: of what is left, halves are added four times.

    Two rows of half a length make one. Each sum has the order that it has alone.
    """
    lines, terms = [VECTORS], [f"(V&)rows.data[row + {number}]" for number in range(count)]
    for width in (8, 4, 2, 1):
        low, high = (", ".join(str(i) for i in range(2 * LANES) if i // width % 2 == side) for side in (0, 1))
        halves = f"__builtin_shufflevector(a, b, {low}) + __builtin_shufflevector(a, b, {high})"
        lines.append(f"auto fold{width} = [](V a, V b) {{ return {halves}; }};")
        terms = [f"fold{width}({a}, {b})" for a, b in zip(terms[::2], terms[1::2] or terms, strict=True)]
    return " ".join([*lines, f"V x = {terms[0]};", answer])


@wp.func_native(_fold(1, "return x[0];"))
def folded(rows: wp.array[vec16], row: int) -> float:
    """Sum of a row of lanes."""


@wp.func_native(_fold(8, "wp::vec_t<8, float> sums; for (int i = 0; i < 8; i++) sums[i] = x[i]; return sums;"))
def folded_eight(rows: wp.array[vec16], row: int) -> vec8:
    """Sums of eight rows of lanes, found together."""


@wp.func_native(by_width("", "__atomic_signal_fence(__ATOMIC_ACQ_REL);"))
def forget():
    """What follows reads memory anew. To carry the sums on, LLVM would store them twice for want of registers."""


@once
def make_upstream(variant: BlendVariant) -> wp.Kernel:
    """The start of every adjoint: upstream gradients from pixels to blocks, those that are not finite dropped."""
    CHANNELS = variant.channels
    vec_grads = wp.types.vector(length=variant.columns, dtype=float)
    mat_background = wp.types.matrix(shape=(3, LANES), dtype=float)
    mat_up = wp.types.matrix(shape=(CHANNELS + 1, LANES), dtype=float)

    @wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
    def upstream(
        first: int,
        bins: BinsView,
        background: wp.array[float],  # [3]
        final: wp.array2d[vec16],  # [T, BLOCKS]
        count: wp.array2d[vec16],  # [T, BLOCKS]
        adj_pixels: PixelsView,
        # out
        up_out: wp.array2d[vec16],  # [T, BLOCKS CHANNELS] dL/d(sum of w color, and of w z)
        adj_final_out: wp.array2d[vec16],  # [T, BLOCKS] dL/d(final), through alpha and background
        adj_background_out: wp.array2d[float],  # [T, 3]
        dropped_out: wp.array[int],  # [T] pixels whose upstream gradient is not finite
        steps_out: wp.array[int],  # [T] instances that the adjoint walks
        slots_out: wp.array[vec_grads],  # [M] zeros for those that it does not
    ):
        tile = first + wp.tid()
        column = (tile % bins.tiles_x) * TILE
        line = (tile // bins.tiles_x) * TILE
        zero = vec16(0.0)
        adj_background = mat_background()
        dropped = zero
        height = adj_pixels.image.shape[0]
        width = adj_pixels.image.shape[1]
        block = int(0)
        while block < BLOCKS:
            left = column + 4 * (block & 3)
            top = line + 4 * (block >> 2)
            u = mat_up()  # the channels, and dL/dalpha
            for lane in range(LANES):
                y = wp.min(top + lane // 4, height - 1)
                x = wp.min(left + lane % 4, width - 1)
                for channel in range(3):
                    u[channel, lane] = adj_pixels.image[y, x, channel]
                u[CHANNELS, lane] = adj_pixels.alpha[y, x]
                if wp.static(CHANNELS > 3):
                    u[3, lane] = adj_pixels.depth[y, x]
            inside = where_less(LANE_X, vec16(float(width - left)), vec16(1.0), zero)
            inside = where_less(LANE_Y, vec16(float(height - top)), inside, zero)
            finite = inside
            for row in range(CHANNELS + 1):
                finite = where_less(wp.abs(u[row]), vec16(wp.inf), finite, zero)  # not where it is NaN, either
            dropped = dropped + inside - finite
            adj_t = -where_less(zero, finite, u[CHANNELS], zero)
            for channel in range(CHANNELS):
                known = where_less(zero, finite, u[channel], zero)
                up_out[tile, block * CHANNELS + channel] = known
                if channel < 3:
                    adj_t = adj_t + known * background[channel]
                    adj_background[channel] = adj_background[channel] + times(known, final[tile, block])
            adj_final_out[tile, block] = adj_t
            block += 1
        stopped = vec16(0.0)
        for block in range(BLOCKS):
            stopped = wp.max(stopped, count[tile, block])
        longest = wp.max(stopped)
        for channel in range(3):
            adj_background_out[tile, channel] = total(adj_background[channel])
        dropped_out[tile] = int(total(dropped))
        steps_out[tile] = int(longest)
        for k in range(bins.ranges[tile][0] + int(longest), bins.ranges[tile][1]):
            slots_out[k] = vec_grads(0.0)

    return upstream


@once
def make_reverse(mode: str, variant: BlendVariant) -> wp.Kernel:
    """The reverse loop with the step of ``mode``."""
    CHANNELS, GRADS = variant.channels, variant.columns
    # all in one matrix: a matrix of which only rows of known numbers are used would be taken apart into scalars
    T, ADJ_T, WALKED, UP, SUMS = 0, BLOCKS, 2 * BLOCKS, 3 * BLOCKS, (3 + CHANNELS) * BLOCKS
    mat_room = wp.types.matrix(shape=(SUMS + GRADS + ROWS_AHEAD + 1, LANES), dtype=float)
    vec_grads = wp.types.vector(length=GRADS, dtype=float)
    (pixel, geometry), way, known = make_reverse_step(mode, variant.falloff, vec16), -1, True
    fall_at = make_falloff(variant.falloff).value

    def begin(k, here, out, s):
        for grad in range(GRADS):
            s[SUMS + grad] = vec16(0.0)
        return 0

    def step(k, splat, dx, dy, fall, block, here, own, out, s, alphas):
        red, green, blue = s[UP + block], s[UP + BLOCKS + block], s[UP + 2 * BLOCKS + block]
        lit = fma(red, splat.color[0], fma(green, splat.color[1], blue * splat.color[2]))
        if wp.static(CHANNELS > 3):
            lit = fma(s[UP + 3 * BLOCKS + block], splat.depth, lit)
        t, adj_t, walked = s[T + block], s[ADJ_T + block], s[WALKED + block]
        front, adj_front, w, part = pixel(dx, dy, fall, splat.root, splat.opacity, t, adj_t, alphas, here, walked, lit)
        s[T + block] = front
        s[ADJ_T + block] = adj_front
        forget()
        for grad in range(CHANNEL):
            s[SUMS + grad] = s[SUMS + grad] + part[grad]
        for channel in range(CHANNELS):
            row = SUMS + CHANNEL + channel
            s[row] = s[row] + times(w, s[UP + channel * BLOCKS + block])

    def finish(k, splat, ahead, slots_out, s):
        sums = vec_grads()
        eight = folded_eight(s, SUMS)
        for grad in range(8):
            sums[grad] = eight[grad]
        grad = int(8)
        while grad < GRADS:  # as a range, which Warp unrolls, 10 % of the loop slower
            sums[grad] = folded(s, SUMS + grad)
            grad += 1
        mean, conic = geometry(sums, splat.root, splat.opacity)
        write_geometry(slots_out, k, mean, conic)
        for grad in range(OPACITY, GRADS):
            slots_out[k, grad] = sums[grad]
        return False

    @kernel_of_parts(FORWARD_ONLY, walk=walk, begin=begin, step=step, finish=finish)
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
        walk(bins, near, start, length, way, known, slots_out, fall_at, begin, step, finish)

    return adj_blend

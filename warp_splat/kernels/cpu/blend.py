"""The CPU driver of the blend: one launch index per 16 x 16 tile, sixteen 4 x 4 blocks of pixels, a block in lanes.

What keeps LLVM vectorizing (benchmarks/blend.py measures it against one scalar thread per pixel):

- State that lives across Gaussians stays in memory, a row of lanes each. Phi nodes of 16 scalars defeat the SLP
  vectorizer; loads and stores of 64 bytes do not.
- No branch per lane.
- Sums over pixels stay in lanes until the end.

What keeps the loop over blocks short (each measured):

- The memory is an array made in the kernel over a local matrix. Its strides are known. Those of other arrays are not,
  and a local array reloads its own.
- It begins at a multiple of 64 bytes, which the matrix does not: rows that cross two lines cost 15 %, one that crosses
  two pages up to 25 %.
- ``block & 15``: an index that may be negative is wrapped.
- ``while``: Warp's range keeps more state.
- Boxes are found for 32 Gaussians at a time. Their reads overlap, and the processor knows early how many blocks there
  are.

Tried:

- 0 to 2 % at 1M, -4 % and less at 60,000: the adjoint asks for memory before, as the blend does (which gains 3 to 17 %)
- 22 % slower: rows of 16 pixels instead of blocks; fewer blocks can be skipped
- 5 % slower in both directions: a jump over blocks where no lane sees the Gaussian; the test costs what it saves
- 20 % slower, adjoint 5 %: one loop over the blocks of a box instead of two nested ones
- 3 % slower, adjoint 7 %: the ellipse's own end in each row of blocks instead of its box; 21 % fewer blocks, but the
  ends cost as much, and rows of different lengths are not foreseen
- 40 % slower: the same as a list of blocks without a branch
- 7 % slower, 15 % on AVX-512: blocks of a box as bits, one loop as over those that are known, whose falloff is found a
  block ahead
- adjoint 8 % slower on AVX-512: alpha / (1 - alpha) a block ahead as well; 1 % faster: fused into sums over pixels
- 7 to 10 % slower, not 2 to 4: what was seen as bits of one number, not as sixteen numbers that become bits in the end
"""

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.bound import BoundView, brightness, own_light, sure, unsure
from warp_splat.kernels.compiler import FORWARD_ONLY, once
from warp_splat.kernels.cpu.ahead import ask
from warp_splat.kernels.cpu.settle import SETTLED, make_settle, rows_from
from warp_splat.kernels.falloff import make_falloff
from warp_splat.kernels.inline import kernel_of_parts
from warp_splat.kernels.simd import LANES, VECTORS, by_width, fma, lowest, times, total, vec16, where_less
from warp_splat.kernels.splat import BlendVariant, Splat2D, advance, alpha_of, exponent, weight
from warp_splat.kernels.structs import BinsView, PixelsView
from warp_splat.kernels.tiles import first_pixel_of

BLOCKS = TILE * TILE // LANES  # per tile
NONE = wp.constant(1 << BLOCKS)  # a bit that stands for no block
AHEAD = 32  # instances that are copied, and their boxes found, together; then, whether the whole tile has stopped

ROWS_AHEAD = AHEAD * wp.types.type_size_in_bytes(Splat2D) // (4 * LANES)  # of lanes, in which that many splats fit
vec4i = wp.types.vector(length=4, dtype=int)
mat_boxes = wp.types.matrix(shape=(AHEAD, 4), dtype=int)
#: Pixel offsets of the lanes in their 4 x 4 block, row by row.
LANE_X = wp.constant(vec16(*[float(lane % 4) for lane in range(LANES)]))
LANE_Y = wp.constant(vec16(*[float(lane // 4) for lane in range(LANES)]))


@wp.func
def reach(mean: wp.vec2, extent: wp.vec2, x0: float, y0: float):
    """Blocks of the tile whose pixels the Gaussian's box touches: (first x, last x, first y, last y)."""
    x = (mean[0] - x0) * 0.25
    y = (mean[1] - y0) * 0.25
    rx = extent[0] * 0.25
    ry = extent[1] * 0.25
    # block b holds pixel centers x0 + 4 b .. x0 + 4 b + 3; clamp as float: a huge extent has no int
    return vec4i(
        int(wp.clamp(wp.ceil(x - rx - 0.75), 0.0, 4.0)),
        int(wp.clamp(wp.floor(x + rx), -1.0, 3.0)),
        int(wp.clamp(wp.ceil(y - ry - 0.75), 0.0, 4.0)),
        int(wp.clamp(wp.floor(y + ry), -1.0, 3.0)),
    )


@wp.func_native(
    VECTORS + "const float begins[] = {0.0f, 4.0f, 8.0f, 12.0f}; "
    "wp::vec_t<16, float> r; (V&)r = (V{} + value - (V&)lanes) - begins[block]; return r;"
)
def offset_in_lanes(value: float, lanes: vec16, block: int) -> vec16: ...


@wp.func
def offset_x(mean: wp.vec2, x0: float, bx: int):
    """From the pixel centers of block column ``bx`` to the mean [px]."""
    return offset_in_lanes(mean[0] - x0, LANE_X, bx)


@wp.func
def offset_y(mean: wp.vec2, y0: float, by: int):
    return offset_in_lanes(mean[1] - y0, LANE_Y, by)


#: C++: a row of lanes as sixteen numbers, one for each block. An element of a vector would go through the stack.
_MARKS = (
    "typedef unsigned short M __attribute__((may_alias)); typedef M Row __attribute__((vector_size(32))); "
    "typedef bool B __attribute__((ext_vector_type(16))); auto marks = (M*)(s.data + row); "
)
#: C++: where a pixel goes on, ``value``; else 0.
_KEPT = VECTORS + "I kept = (I)((V&)behind < 0.0f ? V{} : (V&)value); "


@wp.func_native(
    _MARKS + _KEPT + "marks[block] = "
    + by_width("__builtin_bit_cast(M, __builtin_convertvector(kept != 0, B));", "__builtin_reduce_or(kept) != 0;")
)  # fmt: skip
def mark(s: wp.array[vec16], row: int, block: int, value: vec16, behind: vec16):
    """Note in a row whether a lane of a block blends an alpha, its ``value``; its weight would underflow sooner."""


@wp.func_native(_MARKS + "return __builtin_bit_cast(M, __builtin_convertvector(*(Row*)marks != 0, B));")
def marked(s: wp.array[vec16], row: int) -> int:
    """The blocks of which a lane was noted, a bit each."""


@wp.func_native(
    _KEPT + "wp::vec_t<16, float> r; (V&)r = "
    + by_width("(V&)behind < 0.0f ? (V&)before : (V&)value;", "(V)__builtin_elementwise_max((I&)before, kept);")
    + "return r;"
)  # fmt: skip
def farther(before: vec16, value: vec16, behind: vec16) -> vec16:
    """Where a pixel goes on, ``value``, which is more than what was ``before``.

    Found among integers, which have the same order: LLVM stores a choice by a mask, for which AVX2 of AMD takes long.
    """


@wp.func
def aligned(address: wp.uint64):
    """The first multiple of 64 from ``address`` on."""
    return (address + wp.uint64(63)) & wp.uint64(0xFFFFFFFFFFFFFFC0)


@wp.func
def corner(bins: BinsView, tile: int):
    """Center of a tile's first pixel [px]."""
    column, line, _begin = first_pixel_of(bins, tile)
    return float(column) + 0.5, float(line) + 0.5


def walk(bins, near, start, count, way, known, out, fall_at, begin, step, finish, tile):
    """The loop over ``count`` instances of a list and the blocks that they reach, of which kernels put in the text.

    From ``start`` on, or (``way`` -1) towards it. Blocks are those of the Gaussian's box; or, ``known``, those in which
    the blend saw it, a fifth to a third fewer, which it has left in ``bins``. There the falloff, ``fall_at``, is
    found a block ahead: the processor works on one block while it waits for results of another. ``near`` has room for
    AHEAD splats. Parts of the kernel, for which ``out`` is: ``begin`` with a splat, its answer goes to ``step`` with a
    block; ``finish`` says whether to stop there.
    """
    boxes = mat_boxes()
    x0, y0 = corner(bins, tile)
    for number in range(count):
        k = start + number
        if wp.static(way < 0):
            k = start + count - 1 - number
        ahead = number & (AHEAD - 1)
        if ahead == 0:
            if wp.static(way > 0):
                for j in range(wp.min(AHEAD, count - number - AHEAD)):
                    ask(bins.splats, bins.instances[k + AHEAD + j])
            for j in range(wp.min(AHEAD, count - number)):  # alone, many reads are under way at a time
                near[j] = bins.splats[bins.instances[k + way * j]]
            if wp.static(not known):
                for j in range(wp.min(AHEAD, count - number)):
                    boxes[j] = reach(near[j].mean, near[j].extent, x0, y0)
        splat = near[ahead]
        here = vec16(float(k - start))
        own = begin(k, here, out)
        if wp.static(known):
            left = bins.blocks[k]
            block = lowest(left | NONE) & (BLOCKS - 1)
            dx = offset_x(splat.mean, x0, block & 3)
            dy = offset_y(splat.mean, y0, block >> 2)
            fall = fall_at(exponent(dx, dy, splat.root[0], splat.root[1], splat.root[2]))
            while left != 0:
                left &= left - 1
                next_block = lowest(left | NONE) & (BLOCKS - 1)
                next_dx = offset_x(splat.mean, x0, next_block & 3)
                next_dy = offset_y(splat.mean, y0, next_block >> 2)
                next_fall = fall_at(exponent(next_dx, next_dy, splat.root[0], splat.root[1], splat.root[2]))
                step(k, splat, dx, dy, fall, block, here, own, out)
                block, dx, dy, fall = next_block, next_dx, next_dy, next_fall
        else:
            box = boxes[ahead]
            by = box[2]
            while by <= box[3]:
                dy = offset_y(splat.mean, y0, by)
                bx = box[0]
                while bx <= box[1]:
                    block = (4 * by + bx) & (BLOCKS - 1)
                    dx = offset_x(splat.mean, x0, bx)
                    fall = fall_at(exponent(dx, dy, splat.root[0], splat.root[1], splat.root[2]))
                    step(k, splat, dx, dy, fall, block, here, own, out)
                    bx += 1
                by += 1
        stopped = finish(k, splat, ahead, out)
        if stopped:
            break


@once
def make_blend(variant: BlendVariant) -> wp.Kernel:
    """The blend; a fourth channel carries z; with ``keep``, every T is stored for the adjoint."""
    CHANNELS = variant.channels
    T, WALKED, RGB, DEPTH, SEEN = 0, BLOCKS, 2 * BLOCKS, 5 * BLOCKS, (2 + CHANNELS) * BLOCKS
    IDEAL = SEEN + 1
    STATE = IDEAL + SETTLED * variant.bound
    mat_room = wp.types.matrix(shape=(STATE + ROWS_AHEAD + 1, LANES), dtype=float)
    fall_at, way, known = make_falloff(variant.falloff).value, 1, False
    rows = rows_from(IDEAL, None if variant.ideal else RGB)
    prepare, expect, conclude = make_settle(RGB, rows, AHEAD)
    IDEAL_T, _, IDEAL_RGB, _, TOTAL, ADDED, *_ = rows

    def begin(k, here, out, s, bound, tile, bins, near, length):
        """Instances walked."""
        s[SEEN] = vec16(0.0)
        if wp.static(variant.bound):
            expect(s, bound, tile, bins, near, k, length)
        return here + vec16(1.0)

    def step(k, splat, dx, dy, fall, block, here, walked, kept_out, s, alphas, t_min, bound, tile, limits):
        raw = fall * splat.opacity
        alpha = alpha_of(raw, alphas)
        if wp.static(variant.floor):
            may = unsure(raw, bound)
            s[TOTAL + block] = s[TOTAL + block] + may
            may = times(may, brightness(splat.color, bound.shade, bound.usual))
            left = wp.abs(s[IDEAL_T + block])
            s[ADDED + block] = own_light(left, may, bound.usual, s[ADDED + block])
        if wp.static(variant.ideal):
            ideal = times(sure(raw, alphas, bound), s[IDEAL_T + block])
            for channel in range(3):
                row = IDEAL_RGB + channel * BLOCKS + block
                s[row] = fma(ideal, splat.color[channel], s[row])
            s[IDEAL_T + block] = s[IDEAL_T + block] - ideal
        behind = advance(s[T + block], alpha, t_min)
        if wp.static(variant.hides):
            behind = where_less(here, limits[tile, block], behind, wp.min(s[T + block], -s[T + block]))
        w = weight(s[T + block], alpha, behind)
        mark(s, SEEN, block, alpha, behind)
        if wp.static(variant.keep):
            kept_out[k, block] = s[T + block]
        for channel in range(3):
            row = RGB + channel * BLOCKS + block
            s[row] = fma(w, splat.color[channel], s[row])
        if wp.static(CHANNELS > 3):
            s[DEPTH + block] = fma(w, splat.depth, s[DEPTH + block])
        s[T + block] = behind
        s[WALKED + block] = farther(s[WALKED + block], walked, behind)

    def finish(k, splat, ahead, out, s, bins):
        bins.blocks[k] = marked(s, SEEN)
        stopped = bool(False)  # the whole tile
        if ahead == AHEAD - 1:
            alive = vec16(0.0)
            for block in range(BLOCKS):
                alive = alive + where_less(s[T + block], vec16(0.0), vec16(0.0), s[T + block])
            stopped = total(alive) == 0.0
        return stopped

    @kernel_of_parts(FORWARD_ONLY, walk=walk, begin=begin, step=step, finish=finish)
    def blend(
        first: int,  # tile of this slice
        bins: BinsView,  # its blocks are written
        alphas: wp.vec2,
        t_min: float,
        max_steps: int,
        background: wp.array[float],  # [3]
        bound: BoundView,
        limits: wp.array2d[vec16],  # [T, BLOCKS] instances in front of what hides, if anything does
        # out
        pixels_out: PixelsView,
        final_out: wp.array2d[vec16],  # [T, BLOCKS] transmittance behind the last Gaussian
        count_out: wp.array2d[vec16],  # [T, BLOCKS] where the adjoint starts: instances walked before the pixel stopped
        kept_out: wp.array2d[vec16],  # [M, BLOCKS] transmittance in front of each Gaussian
    ):
        tile = first + wp.tid()
        start = bins.ranges[tile][0]
        column, line, begins = first_pixel_of(bins, tile)
        room = mat_room()
        # rows of lanes: T, instances walked, sums of w color and of w z
        s = wp.array(ptr=aligned(wp.address_of(room)), shape=(STATE,), dtype=vec16)
        near = wp.array(ptr=s.ptr + wp.uint64(64 * STATE), shape=(AHEAD,), dtype=Splat2D)
        for block in range(BLOCKS):
            s[T + block] = vec16(1.0)
        for row in range(WALKED, s.shape[0]):  # as a constant, a blend that takes half as long again
            s[row] = vec16(0.0)
        if wp.static(variant.bound):
            prepare(s)
        length = wp.min(bins.ranges[tile][1] - start, max_steps)
        walk(bins, near, start, length, way, known, kept_out, fall_at, begin, step, finish)
        if wp.static(variant.bound):
            conclude(s, bound, tile, bins, length, background)
        for block in range(BLOCKS):
            s[T + block] = wp.abs(s[T + block])
            final_out[tile, block] = s[T + block]
            count_out[tile, block] = s[WALKED + block]
        block = int(0)
        while block < BLOCKS:
            left = column + 4 * (block & 3)
            top = line + 4 * (block >> 2)
            for lane in range(LANES):
                x = left + lane % 4
                y = top + lane // 4
                if y < bins.height and x < pixels_out.image.shape[1]:
                    y += begins
                    final = s[T + block][lane]
                    for channel in range(3):
                        light = s[RGB + channel * BLOCKS + block][lane] + final * background[channel]
                        pixels_out.image[y, x, channel] = light
                    pixels_out.alpha[y, x] = 1.0 - final
                    if wp.static(CHANNELS > 3):
                        pixels_out.depth[y, x] = s[DEPTH + block][lane]
            block += 1

    return blend

"""The CPU driver of the blend: one launch index per 16 x 16 tile, sixteen 4 x 4 blocks of pixels, a block in lanes.

What keeps LLVM vectorising (measured in benchmarks/blend.py; against one scalar thread per pixel more than 20 times):
state that lives across Gaussians stays in memory, in the rows of kernel-local matrices (phi nodes of 16 scalars defeat
the SLP vectoriser, loads and stores of 64 bytes do not); no branch per lane; sums over pixels stay in lanes until the
end. What keeps the loop over blocks short (each measured, together 1.7 times): matrices, since a local array reloads
its pointer and strides at every access; ``block & 15``, since an index that may be negative is wrapped; ``while``,
since Warp's range keeps more state; the next Gaussian's box found one Gaussian ahead, so that the processor knows how
many blocks there are before it gets there.
Tried: rows of 16 pixels instead of blocks, 22 % slower, because fewer blocks can be skipped; a jump over blocks where
no lane sees the Gaussian, 5 % slower in both directions, because the test costs as much as it saves; state in global
memory, which is aligned, as local matrices are not: 30 % slower, because strides are not known.
"""

import functools

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.blend import Splat2D, advance, alpha_of, exponent, make_exp, weight
from warp_splat.kernels.build import FORWARD_ONLY, IN_LANES
from warp_splat.kernels.lanes import LANE_X, LANE_Y, LANES, total, vec16, where_less

BLOCKS = TILE * TILE // LANES  # per tile
STRIDE = 32  # instances between two looks at whether the whole tile has stopped

MAX_FLOAT = wp.constant(3.4028234663852886e38)

vec4i = wp.types.vector(length=4, dtype=int)
mat_blocks = wp.types.matrix(shape=(BLOCKS, LANES), dtype=float)  # a number per pixel of a tile


@wp.func
def reach(mean: wp.vec2, extent: wp.vec2, x0: float, y0: float):
    """Blocks of the tile whose pixels the Gaussian's box touches: (first x, last x, first y, last y)."""
    x = (mean[0] - x0) * 0.25
    y = (mean[1] - y0) * 0.25
    rx = extent[0] * 0.25
    ry = extent[1] * 0.25
    # block b holds pixel centres x0 + 4 b .. x0 + 4 b + 3; clamp as float: a huge extent has no int
    return vec4i(
        int(wp.clamp(wp.ceil(x - rx - 0.75), 0.0, 4.0)),
        int(wp.clamp(wp.floor(x + rx), -1.0, 3.0)),
        int(wp.clamp(wp.ceil(y - ry - 0.75), 0.0, 4.0)),
        int(wp.clamp(wp.floor(y + ry), -1.0, 3.0)),
    )


@wp.func
def offset_x(mean: wp.vec2, x0: float, bx: int):
    """From the pixel centres of block column ``bx`` to the mean [px]."""
    return (vec16(mean[0] - x0) - LANE_X) - vec16(float(4 * bx))


@wp.func
def offset_y(mean: wp.vec2, y0: float, by: int):
    return (vec16(mean[1] - y0) - LANE_Y) - vec16(float(4 * by))


@wp.func
def finite(x: float):
    """Neither infinite nor NaN; wp.isfinite is a call on the CPU."""
    return wp.abs(x) <= MAX_FLOAT


@functools.cache
def make_blend(depth: bool, exp_degree: int | None, keep: bool) -> wp.Kernel:
    """The blend; with ``depth``, a fourth channel carries z; with ``keep``, every T is stored for the adjoint."""
    CHANNELS = 4 if depth else 3
    STATE = BLOCKS * CHANNELS
    mat_state = wp.types.matrix(shape=(STATE, LANES), dtype=float)
    exp2_minus = make_exp(exp_degree)

    @wp.kernel(module="unique", module_options=dict(IN_LANES))
    def blend(
        first: int,  # tile of this slice
        tiles_x: int,
        ranges: wp.array[wp.vec2i],  # [T] first and last instance of a tile
        instances: wp.array[wp.vec2i],  # [M] (splat, slot), by tile, front to back
        splats: wp.array[Splat2D],  # [V]
        alpha_min: float,
        t_min: float,
        max_steps: int,
        background: wp.array[float],  # [3]
        # out
        image_out: wp.array3d[float],  # [H, W, 3]
        alpha_out: wp.array2d[float],  # [H, W]
        depth_out: wp.array2d[float],  # [H, W] sum of w z
        final_out: wp.array2d[vec16],  # [T, BLOCKS] transmittance behind the last Gaussian
        count_out: wp.array2d[vec16],  # [T, BLOCKS] where the adjoint starts: instances walked before the pixel stopped
        kept_out: wp.array2d[vec16],  # [M, BLOCKS] transmittance in front of each Gaussian
    ):
        tile = first + wp.tid()
        span = ranges[tile]
        column = (tile % tiles_x) * TILE
        line = (tile // tiles_x) * TILE
        x0 = float(column) + 0.5
        y0 = float(line) + 0.5
        t = mat_blocks(1.0)
        count = mat_blocks(0.0)
        c = mat_state(0.0)
        last = span[0] + wp.min(span[1] - span[0], max_steps) - 1
        ahead = vec4i(0)
        for k in range(span[0], last + 1):
            splat = splats[instances[k][0]]
            box = ahead
            if k == span[0]:
                box = reach(splat.mean, splat.extent, x0, y0)
            following = splats[instances[wp.min(k + 1, last)][0]]
            ahead = reach(following.mean, following.extent, x0, y0)
            walked = vec16(float(k - span[0] + 1))
            by = box[2]
            while by <= box[3]:
                dy = offset_y(splat.mean, y0, by)
                bx = box[0]
                while bx <= box[1]:
                    block = (4 * by + bx) & (BLOCKS - 1)
                    dx = offset_x(splat.mean, x0, bx)
                    fall = exp2_minus(exponent(dx, dy, splat.root[0], splat.root[1], splat.root[2]))
                    alpha = alpha_of(fall * splat.opacity, alpha_min)
                    behind = advance(t[block], alpha, t_min)
                    w = weight(t[block], alpha, behind)
                    if wp.static(keep):
                        kept_out[k, block] = t[block]
                    for channel in range(3):
                        c[channel * BLOCKS + block] = c[channel * BLOCKS + block] + w * splat.color[channel]
                    if wp.static(depth):
                        c[3 * BLOCKS + block] = c[3 * BLOCKS + block] + w * splat.depth
                    t[block] = behind
                    count[block] = where_less(behind, vec16(0.0), count[block], walked)
                    bx += 1
                by += 1
            if (k & (STRIDE - 1)) == STRIDE - 1:
                alive = vec16(0.0)
                for block in range(BLOCKS):
                    alive = alive + where_less(t[block], vec16(0.0), vec16(0.0), t[block])
                if total(alive) == 0.0:
                    break
        for block in range(BLOCKS):
            t[block] = wp.max(t[block], -t[block])
            final_out[tile, block] = t[block]
            count_out[tile, block] = count[block]
        block = int(0)
        while block < BLOCKS:
            left = column + 4 * (block & 3)
            top = line + 4 * (block >> 2)
            for lane in range(LANES):
                x = left + lane % 4
                y = top + lane // 4
                if y < image_out.shape[0] and x < image_out.shape[1]:
                    final = t[block, lane]
                    for channel in range(3):
                        image_out[y, x, channel] = c[channel * BLOCKS + block, lane] + final * background[channel]
                    alpha_out[y, x] = 1.0 - final
                    if wp.static(depth):
                        depth_out[y, x] = c[3 * BLOCKS + block, lane]
            block += 1

    return blend


@functools.cache
def make_upstream(depth: bool) -> wp.Kernel:
    """The start of every adjoint: upstream gradients from pixels to blocks, those that are not finite dropped."""
    CHANNELS = 4 if depth else 3
    STATE = BLOCKS * CHANNELS
    mat_state = wp.types.matrix(shape=(STATE, LANES), dtype=float)

    @wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
    def upstream(
        first: int,
        tiles_x: int,
        ranges: wp.array[wp.vec2i],  # [T]
        instances: wp.array[wp.vec2i],  # [M]
        background: wp.array[float],  # [3]
        final: wp.array2d[vec16],  # [T, BLOCKS]
        count: wp.array2d[vec16],  # [T, BLOCKS]
        adj_image: wp.array3d[float],  # [H, W, 3]
        adj_alpha: wp.array2d[float],  # [H, W]
        adj_depth: wp.array2d[float],  # [H, W]
        # out
        up_out: wp.array2d[vec16],  # [T, STATE] dL/d(sum of w color, and of w z)
        adj_final_out: wp.array2d[vec16],  # [T, BLOCKS] dL/d(final), through alpha and background
        adj_background_out: wp.array2d[float],  # [T, 3]
        dropped_out: wp.array[int],  # [T] pixels whose upstream gradient is not finite
        steps_out: wp.array[int],  # [T] instances that the adjoint walks
        slots_out: wp.array2d[float],  # [M, GRADS] zeros for those that it does not
    ):
        tile = first + wp.tid()
        column = (tile % tiles_x) * TILE
        line = (tile // tiles_x) * TILE
        up = mat_state(0.0)
        adj_final = mat_blocks(0.0)
        t = mat_blocks()
        for block in range(BLOCKS):
            t[block] = final[tile, block]
        adj_background = wp.vec3(0.0)
        dropped = int(0)
        block = int(0)
        while block < BLOCKS:
            left = column + 4 * (block & 3)
            top = line + 4 * (block >> 2)
            for lane in range(LANES):
                x = left + lane % 4
                y = top + lane // 4
                if y < adj_image.shape[0] and x < adj_image.shape[1]:
                    u = wp.vec3(adj_image[y, x, 0], adj_image[y, x, 1], adj_image[y, x, 2])
                    adj_t = -adj_alpha[y, x]
                    far = float(0.0)
                    if wp.static(depth):
                        far = adj_depth[y, x]
                    if finite(u[0]) and finite(u[1]) and finite(u[2]) and finite(adj_t) and finite(far):
                        for channel in range(3):
                            up[block * CHANNELS + channel, lane] = u[channel]
                            adj_t += u[channel] * background[channel]
                            adj_background[channel] += u[channel] * t[block, lane]
                        if wp.static(depth):
                            up[block * CHANNELS + 3, lane] = far
                        adj_final[block, lane] = adj_t
                    else:
                        dropped += 1
            block += 1
        for i in range(STATE):
            up_out[tile, i] = up[i]
        longest = float(0.0)
        for block in range(BLOCKS):
            adj_final_out[tile, block] = adj_final[block]
            longest = wp.max(longest, wp.max(count[tile, block]))
        for channel in range(3):
            adj_background_out[tile, channel] = adj_background[channel]
        dropped_out[tile] = dropped
        steps_out[tile] = int(longest)
        for k in range(ranges[tile][0] + int(longest), ranges[tile][1]):
            for grad in range(slots_out.shape[1]):
                slots_out[instances[k][1], grad] = 0.0

    return upstream

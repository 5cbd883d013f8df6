"""The CPU driver of the blend: one launch index per 16 x 16 tile, sixteen 4 x 4 blocks of pixels, a block in lanes.

What keeps LLVM vectorising (measured in benchmarks/blend.py; against one scalar thread per pixel more than 20 times):
state that lives across Gaussians stays in kernel-local arrays of vec16 (phi nodes of 16 scalars defeat the SLP
vectoriser, loads and stores of 64 bytes do not); no branch per lane; sums over pixels stay in lanes until the end.
Tried: rows of 16 pixels instead of blocks, 22 % slower, because fewer blocks can be skipped; a jump over blocks where
no lane sees the Gaussian, 5 % slower in both directions, because the test costs as much as it saves.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.blend import (
    Splat2D,
    adj_alpha_blend,
    adj_alpha_of,
    advance,
    alpha_of,
    falloff,
    recover,
    weight,
)
from warp_splat.kernels.build import FORWARD_ONLY
from warp_splat.kernels.lanes import LANE_X, LANE_Y, LANES, times, total, vec16, where_less

BLOCKS = TILE * TILE // LANES  # per tile
STRIDE = 32  # instances between two looks at whether the whole tile has stopped

vec4i = wp.types.vector(length=4, dtype=int)


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


class BlendKernels(NamedTuple):
    """A forward kernel and the adjoint that belongs to it."""

    forward: wp.Kernel
    adjoint: wp.Kernel


@functools.cache
def make_blend(depth: bool) -> BlendKernels:
    """The blend and its hand-written adjoint (``manual``); with ``depth``, a fourth channel carries z."""
    CHANNELS = 4 if depth else 3
    GRADS = 6 + CHANNELS  # mean, conic, opacity, channels
    STATE = BLOCKS * CHANNELS
    module_options = dict(FORWARD_ONLY)

    @wp.kernel(module="unique", module_options=module_options)
    def blend(
        first: int,  # tile of this slice
        tiles_x: int,
        ranges: wp.array[wp.vec2i],  # [T] first and last instance of a tile
        instances: wp.array[wp.vec2i],  # [M] (splat, slot), by tile, front to back
        splats: wp.array[Splat2D],  # [V]
        background: wp.array[float],  # [3]
        # out
        image_out: wp.array3d[float],  # [H, W, 3]
        alpha_out: wp.array2d[float],  # [H, W]
        depth_out: wp.array2d[float],  # [H, W] sum of w z
        final_out: wp.array2d[vec16],  # [T, BLOCKS] transmittance behind the last Gaussian
        count_out: wp.array2d[vec16],  # [T, BLOCKS] where the adjoint starts: instances walked before the pixel stopped
    ):
        tile = first + wp.tid()
        span = ranges[tile]
        column = (tile % tiles_x) * TILE
        line = (tile // tiles_x) * TILE
        x0 = float(column) + 0.5
        y0 = float(line) + 0.5
        t = wp.zeros(shape=(BLOCKS,), dtype=vec16)
        count = wp.zeros(shape=(BLOCKS,), dtype=vec16)
        c = wp.zeros(shape=(STATE,), dtype=vec16)
        for block in range(BLOCKS):
            t[block] = vec16(1.0)
        for k in range(span[0], span[1]):
            splat = splats[instances[k][0]]
            box = reach(splat.mean, splat.extent, x0, y0)
            walked = vec16(float(k - span[0] + 1))
            for by in range(box[2], box[3] + 1):
                dy = vec16(splat.mean[1] - y0 - float(4 * by)) - LANE_Y
                for bx in range(box[0], box[1] + 1):
                    block = 4 * by + bx
                    dx = vec16(splat.mean[0] - x0 - float(4 * bx)) - LANE_X
                    alpha = alpha_of(falloff(dx, dy, splat.root) * splat.opacity)
                    w = weight(t[block], alpha)
                    for channel in range(3):
                        c[block * CHANNELS + channel] = c[block * CHANNELS + channel] + w * splat.color[channel]
                    if wp.static(depth):
                        c[block * CHANNELS + 3] = c[block * CHANNELS + 3] + w * splat.depth
                    behind = advance(t[block], alpha)
                    t[block] = behind
                    count[block] = where_less(behind, vec16(0.0), count[block], walked)
            if (k & (STRIDE - 1)) == STRIDE - 1:
                brightest = t[0]
                for block in range(1, BLOCKS):
                    brightest = wp.max(brightest, t[block])
                if wp.max(brightest) < 0.0:
                    break
        for block in range(BLOCKS):
            t[block] = wp.max(t[block], -t[block])
            final_out[tile, block] = t[block]
            count_out[tile, block] = count[block]
        for pixel in range(TILE * TILE):
            block = pixel // LANES
            lane = pixel % LANES
            x = column + 4 * (block % 4) + lane % 4
            y = line + 4 * (block // 4) + lane // 4
            if y < image_out.shape[0] and x < image_out.shape[1]:
                final = t[block][lane]
                for channel in range(3):
                    image_out[y, x, channel] = c[block * CHANNELS + channel][lane] + final * background[channel]
                alpha_out[y, x] = 1.0 - final
                if wp.static(depth):
                    depth_out[y, x] = c[block * CHANNELS + 3][lane]

    @wp.kernel(module="unique", module_options=module_options)
    def adj_blend(
        first: int,
        tiles_x: int,
        ranges: wp.array[wp.vec2i],
        instances: wp.array[wp.vec2i],
        splats: wp.array[Splat2D],
        background: wp.array[float],
        final: wp.array2d[vec16],
        count: wp.array2d[vec16],
        adj_image: wp.array3d[float],  # [H, W, 3]
        adj_alpha: wp.array2d[float],  # [H, W]
        adj_depth: wp.array2d[float],  # [H, W]
        # out
        slots_out: wp.array2d[float],  # [M, GRADS] mean 2, conic 3, opacity 1, channels: one row per tile instance
        adj_background_out: wp.array2d[float],  # [T, 3]
        dropped_out: wp.array[int],  # [T] pixels whose upstream gradient is not finite
    ):
        tile = first + wp.tid()
        span = ranges[tile]
        column = (tile % tiles_x) * TILE
        line = (tile // tiles_x) * TILE
        x0 = float(column) + 0.5
        y0 = float(line) + 0.5
        t = wp.zeros(shape=(BLOCKS,), dtype=vec16)
        walked = wp.zeros(shape=(BLOCKS,), dtype=vec16)
        behind = wp.zeros(shape=(BLOCKS,), dtype=vec16)
        up = wp.zeros(shape=(STATE,), dtype=vec16)
        m = wp.zeros(shape=(GRADS,), dtype=vec16)
        dropped = int(0)
        adj_background = wp.vec3(0.0)
        longest = float(0.0)
        for block in range(BLOCKS):
            t[block] = final[tile, block]
            walked[block] = count[tile, block]
            longest = wp.max(longest, wp.max(walked[block]))
        for pixel in range(TILE * TILE):
            block = pixel // LANES
            lane = pixel % LANES
            x = column + 4 * (block % 4) + lane % 4
            y = line + 4 * (block // 4) + lane // 4
            if y < adj_image.shape[0] and x < adj_image.shape[1]:
                u = wp.vec4(adj_image[y, x, 0], adj_image[y, x, 1], adj_image[y, x, 2], 0.0)
                adj_t = -adj_alpha[y, x]
                if wp.static(depth):
                    u[3] = adj_depth[y, x]
                if wp.isfinite(u) and wp.isfinite(adj_t):
                    for channel in range(CHANNELS):
                        up[block * CHANNELS + channel][lane] = u[channel]
                    for channel in range(3):
                        adj_t += u[channel] * background[channel]
                        adj_background[channel] += u[channel] * t[block][lane]
                    behind[block][lane] = adj_t * t[block][lane]
                else:
                    dropped += 1
        for channel in range(3):
            adj_background_out[tile, channel] = adj_background[channel]
        dropped_out[tile] = dropped
        end = span[0] + int(longest)
        for k in range(end, span[1]):
            for grad in range(GRADS):
                slots_out[instances[k][1], grad] = 0.0
        for back in range(end - span[0]):
            k = end - 1 - back
            splat = splats[instances[k][0]]
            box = reach(splat.mean, splat.extent, x0, y0)
            here = vec16(float(k - span[0]))
            for grad in range(GRADS):
                m[grad] = vec16(0.0)
            for by in range(box[2], box[3] + 1):
                dy = vec16(splat.mean[1] - y0 - float(4 * by)) - LANE_Y
                for bx in range(box[0], box[1] + 1):
                    block = 4 * by + bx
                    dx = vec16(splat.mean[0] - x0 - float(4 * bx)) - LANE_X
                    fall = falloff(dx, dy, splat.root)
                    raw = where_less(here, walked[block], fall * splat.opacity, vec16(0.0))
                    alpha = alpha_of(raw)
                    inverse = recover(alpha)
                    front = times(t[block], inverse)
                    w = times(alpha, front)
                    lit = vec16(0.0)
                    for channel in range(3):
                        lit = lit + up[block * CHANNELS + channel] * splat.color[channel]
                        m[6 + channel] = m[6 + channel] + times(w, up[block * CHANNELS + channel])
                    if wp.static(depth):
                        lit = lit + up[block * CHANNELS + 3] * splat.depth
                        m[9] = m[9] + times(w, up[block * CHANNELS + 3])
                    adj_raw = adj_alpha_of(raw, adj_alpha_blend(front, inverse, behind[block], lit))
                    behind[block] = behind[block] + times(w, lit)
                    t[block] = front
                    adj_fall = times(adj_raw, fall)  # dL/dopacity; times opacity: -dL/dq
                    adj_x = times(adj_fall, dx)
                    adj_y = times(adj_fall, dy)
                    m[0] = m[0] + adj_x
                    m[1] = m[1] + adj_y
                    m[2] = m[2] + times(adj_x, dx)
                    m[3] = m[3] + times(adj_x, dy)
                    m[4] = m[4] + times(adj_y, dy)
                    m[5] = m[5] + adj_fall
            slot = instances[k][1]
            sx = total(m[0])
            sy = total(m[1])
            adj_u = -2.0 * splat.opacity * (splat.root[0] * sx + splat.root[1] * sy)
            adj_v = -2.0 * splat.opacity * splat.root[2] * sy
            slots_out[slot, 0] = splat.root[0] * adj_u
            slots_out[slot, 1] = splat.root[1] * adj_u + splat.root[2] * adj_v
            slots_out[slot, 2] = -0.5 * splat.opacity * total(m[2])
            slots_out[slot, 3] = -splat.opacity * total(m[3])
            slots_out[slot, 4] = -0.5 * splat.opacity * total(m[4])
            slots_out[slot, 5] = total(m[5])
            for channel in range(CHANNELS):
                slots_out[slot, 6 + channel] = total(m[6 + channel])

    return BlendKernels(blend, adj_blend)

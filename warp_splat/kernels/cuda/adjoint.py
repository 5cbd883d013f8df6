"""The adjoint of the blend on CUDA, in all modes of the CPU's: a tile's list is walked back to front.

The gradients of a Gaussian are summed over the tile's pixels first, and then written into one row per tile instance.
So there are no atomics, and every run gives the same bits. ``manual`` and ``stepwise`` are a reverse loop by hand,
with a warp per tile (:mod:`.warps`). ``reversible`` and ``stored`` (:mod:`.taped`) are that which Warp differentiates.

A row is linear in what pixels add to it: every lane makes one of its own pixels, and the rows are summed. Tried,
``manual`` on sm_90, in instructions of warps for a tile instance:

- 2,046, 4 barriers: a block of 256 threads, a thread per pixel, ``wp.tile_sum`` (of all eight warps)
- 596: a warp of eight pixels a lane, and sums by halves; 540 with a division less exact at its end, the same to 1e-7
- the same with a pixel's mathematics in a function of its own: 195 registers instead of 127
- 614 at most, 300 to 380 where Gaussians reach 32 to 49 % of the blocks: those that the box misses are skipped
- 534 at most, 273 to 338: the exponential is the GPU's instruction
- 474 at most, 232 to 273: a reciprocal of one instruction, ellipses instead of boxes; what is staged takes 13 (this)
- 530, 80 registers, 128 bytes an instance: a lane per Gaussian, without sums; pixels' states go along the warp
"""

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.compiler import once
from warp_splat.kernels.cuda import warps
from warp_splat.kernels.cuda.blend import BLOCK_OPTIONS, THREADS, staged_of
from warp_splat.kernels.falloff import LOG2_E, make_falloff
from warp_splat.kernels.slots import CHANNEL, MEAN_X, MEAN_Y, OPACITY, XX, XY, YY
from warp_splat.kernels.splat import BlendVariant, exponent
from warp_splat.kernels.step import make_reverse_step
from warp_splat.kernels.structs import BinsView, PixelsView


@wp.func
def row_of(mean: wp.vec2, conic: wp.vec3, rest: warps.vec10):
    """A slot: mean and conic, then opacity and channels as they are in ``rest``."""
    row = rest
    for i in range(2):
        row[MEAN_X + i] = mean[i]
    for i in range(3):
        row[XX + i] = conic[i]
    return row


@wp.func
def clear_rest(bins: BinsView, tile: int, thread: int, steps: int, slots_out: wp.array2d[float]):
    """Zeros for the tile's instances behind the first ``steps``, which no adjoint walks."""
    first = bins.ranges[tile][0] + steps
    count = bins.ranges[tile][1] - first
    for batch in range((count + THREADS - 1) // THREADS):
        place = batch * THREADS + thread
        if place < count:  # not by first + place, which may be more than 32 bits hold
            for grad in range(slots_out.shape[1]):
                slots_out[first + place, grad] = 0.0


@once
def make_upstream(variant: BlendVariant) -> wp.Kernel:
    """The start of every adjoint: upstream gradients by tile and thread, those that are not finite dropped."""
    CHANNELS = variant.channels

    @wp.kernel(module="unique", module_options=dict(BLOCK_OPTIONS))
    def upstream(
        bins: BinsView,
        background: wp.array[float],  # [3]
        final: wp.array2d[float],  # [T, THREADS]
        count: wp.array2d[int],  # [T, THREADS]
        adj_pixels: PixelsView,
        # out
        up_out: wp.array2d[wp.vec4],  # [T, THREADS] dL/d(sum of w color, and of w z)
        adj_final_out: wp.array2d[float],  # [T, THREADS] dL/d(final), through alpha and background
        adj_background_out: wp.array2d[float],  # [T, 3]
        dropped_out: wp.array[int],  # [T] pixels whose upstream gradient is not finite
        steps_out: wp.array[int],  # [T] instances that the adjoint walks
        slots_out: wp.array2d[float],  # [M, GRADS] zeros for those that it does not
    ):
        tile, thread = wp.tid()
        column = (tile % bins.tiles_x) * TILE + thread % TILE
        line = (tile // bins.tiles_x) * TILE + thread // TILE
        up = wp.vec4(0.0)
        adj_t = float(0.0)
        lit = wp.vec3(0.0)  # of the background
        dropped = int(0)
        image = adj_pixels.image
        if line < image.shape[0] and column < image.shape[1]:
            u = wp.vec4(image[line, column, 0], image[line, column, 1], image[line, column, 2], 0.0)
            adj_alpha = adj_pixels.alpha[line, column]
            if wp.static(CHANNELS > 3):
                u[3] = adj_pixels.depth[line, column]
            if wp.isfinite(u) and wp.isfinite(adj_alpha):
                up = u
                color = wp.vec3(u[0], u[1], u[2])
                adj_t = wp.dot(color, wp.vec3(background[0], background[1], background[2])) - adj_alpha
                lit = color * final[tile, thread]
            else:
                dropped = 1
        up_out[tile, thread] = up
        adj_final_out[tile, thread] = adj_t
        sums = wp.tile_sum(wp.tile(lit, preserve_type=True))[0]
        bad = wp.tile_sum(wp.tile(dropped))[0]
        walked = count[tile, thread]
        steps = wp.tile_max(wp.tile(walked))[0]
        if thread == 0:
            for channel in range(3):
                adj_background_out[tile, channel] = sums[channel]
            dropped_out[tile] = bad
            steps_out[tile] = steps
        clear_rest(bins, tile, thread, steps, slots_out)

    return upstream


@once
def make_reverse(mode: str, variant: BlendVariant) -> wp.Kernel:
    """The reverse loop by hand, its step by hand (``manual``) or by Warp (``stepwise``); a warp per tile."""
    CHANNELS, GRADS = variant.channels, variant.columns
    reach_of = make_falloff(variant.falloff).reach_of
    pixel, geometry = make_reverse_step(mode, variant.falloff, float)
    fall_at = make_falloff(variant.falloff).value

    @wp.kernel(module="unique", module_options=dict(warps.WARP_OPTIONS))
    def adj_blend(
        bins: BinsView,
        alphas: wp.vec2,
        final: wp.array2d[float],  # [T, THREADS]
        count: wp.array2d[int],  # [T, THREADS]
        steps: wp.array[int],  # [T]
        up: wp.array2d[wp.vec4],  # [T, THREADS]
        adj_final: wp.array2d[float],  # [T, THREADS]
        # out
        slots_out: wp.array2d[float],  # [M, GRADS]
    ):
        tile, lane = wp.tid()
        left = float((tile % bins.tiles_x) * TILE) + 0.5
        top = float((tile // bins.tiles_x) * TILE) + 0.5
        start = bins.ranges[tile][0]
        column = warps.column_of(lane, warps.COLUMNS)
        ts = warps.vec_pixels(0.0)
        adj_ts = warps.vec_pixels(0.0)
        walked = warps.vec_pixels(0.0)
        ups = warps.mat_pixels(0.0)
        for p in range(warps.PIXELS):
            place = warps.down_of(lane, p) * TILE + warps.across_of(lane, p)
            u = up[tile, place]
            ts[p] = final[tile, place]
            walked[p] = float(count[tile, place])
            adj_ts[p] = adj_final[tile, place]
            if wp.static(mode == "manual"):
                adj_ts[p] = adj_ts[p] * ts[p]
            for channel in range(CHANNELS):
                ups[channel, p] = u[channel]
        for batch in range((steps[tile] + warps.WARP - 1) // warps.WARP):
            last = steps[tile] - 1 - batch * warps.WARP
            mine = warps.vec10(0.0)
            touched = int(0)
            if last - lane >= 0:
                splat = bins.splats[bins.instances[start + last - lane]]
                mine = staged_of(splat)
                z_most = 0.5 * LOG2_E * reach_of(splat.opacity, alphas[0])
                touched = warps.blocks_of(splat, z_most, left, top)
            staged = wp.tile(mine, preserve_type=True)
            blocks = wp.tile(touched)
            for j in range(wp.min(warps.WARP, last + 1)):
                g = staged[j]
                root = wp.vec3(g[XX], g[XY], g[YY])
                touched = blocks[j]
                here = float(last - j)
                sums = warps.vec10(0.0)
                for p in range(warps.PIXELS):
                    if (touched & (1 << p)) != 0:  # the same for all lanes
                        dx = g[MEAN_X] - (left + float(warps.across_of(lane, p)))
                        dy = g[MEAN_Y] - (top + float(warps.down_of(lane, p)))
                        lit = ups[0, p] * g[CHANNEL] + ups[1, p] * g[CHANNEL + 1] + ups[2, p] * g[CHANNEL + 2]
                        if wp.static(CHANNELS > 3):
                            lit += ups[3, p] * g[CHANNEL + 3]
                        fall = fall_at(exponent(dx, dy, root[0], root[1], root[2]))
                        front, adj_front, w, part = pixel(
                            dx, dy, fall, root, g[OPACITY], ts[p], adj_ts[p], alphas, here, walked[p], lit
                        )
                        sums += warps.vec10(
                            part[MEAN_X], part[MEAN_Y], part[XX], part[XY], part[YY], part[OPACITY],
                            w * ups[0, p], w * ups[1, p], w * ups[2, p], w * ups[3, p],
                        )  # fmt: skip
                        ts[p] = front
                        adj_ts[p] = adj_front
                mean, conic = geometry(sums, root, g[OPACITY])
                row = row_of(mean, conic, sums)
                total = warps.lane_sum(row, lane)
                k = start + last - j
                if column >= 0 and column < GRADS:
                    slots_out[k, column] = total

    return adj_blend

"""The CUDA driver of the blend: a block of two warps per 16 x 16 tile, four pixels a lane.

A warp has four blocks of 8 x 4 pixels: half a tile. Each thread stages one Gaussian of a batch of 64 in shared memory,
and which blocks its ellipse touches; the warps blend those that touch one of theirs. They vote whether every pixel has
stopped. The mathematics is that of the CPU's lanes (:mod:`warp_splat.kernels.splat`), for one pixel.
"""

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.bound import BoundView, Since
from warp_splat.kernels.compiler import once
from warp_splat.kernels.cuda import warps
from warp_splat.kernels.cuda.settle import EACH, at_start, conclude, expect, make_ideal, vec_each
from warp_splat.kernels.falloff import LOG2_E, make_falloff
from warp_splat.kernels.simd import lowest
from warp_splat.kernels.slots import CHANNEL, MEAN_X, MEAN_Y, OPACITY, XX, XY, YY
from warp_splat.kernels.splat import BlendVariant, Splat2D, advance, alpha_of, exponent, weight
from warp_splat.kernels.structs import BinsView, PixelsView
from warp_splat.kernels.tiles import first_pixel_of

THREADS = wp.constant(TILE * TILE)  # of a block of other kernels: one per pixel
BATCH = wp.constant(TILE * TILE // 4)  # Gaussians that the blend stages at once, and its threads
TOUCHED = wp.constant(10)  # which blocks: behind a slot's columns, of what is staged

#: Of modules whose kernels run in blocks. No regrouping of sums: it would change what CPU fibers check.
BLOCK_OPTIONS = {"enable_backward": False, "block_dim": TILE * TILE}
BLEND_OPTIONS = {**BLOCK_OPTIONS, "block_dim": TILE * TILE // 4}


@wp.func
def staged_of(splat: Splat2D):
    """What the loops read of a Gaussian, as one element of a tile, in a slot's columns; XX to YY are the root's."""
    return warps.vec10(
        splat.mean[0], splat.mean[1], splat.root[0], splat.root[1], splat.root[2], splat.opacity,
        splat.color[0], splat.color[1], splat.color[2], splat.depth,
    )  # fmt: skip


@wp.func
def with_blocks(row: warps.vec10, touched: int):
    """What loops read of a Gaussian, and which blocks it touches.

    Shared memory takes and gives twelve numbers by four, without conflicts of banks.
    """
    staged = warps.vec12()
    for column in range(warps.COLUMNS):
        staged[column] = row[column]
    staged[TOUCHED] = wp.cast(touched, float)
    return staged


@wp.func
def going_of(ts: vec_each, thread: int):
    """Blocks of the warp in which a pixel has not stopped, a bit for each."""
    going = int(0)
    for p in range(EACH):
        if warps.ballot(ts[p] >= 0.0, thread) != 0:
            going |= 1 << p
    return going


@wp.func
def write_pixel(pixels_out: PixelsView, background: wp.array[float], y: int, x: int, sums: wp.vec4, t: float):
    """Write a pixel, if the image has its column: sums of color and depth, and what shines through."""
    if x < pixels_out.image.shape[1]:
        for channel in range(3):
            pixels_out.image[y, x, channel] = sums[channel] + t * background[channel]
        pixels_out.alpha[y, x] = 1.0 - t
        if pixels_out.depth.shape[0] > 0:
            pixels_out.depth[y, x] = sums[3]


@wp.func
def place_of(lane: int, block: int):
    """The pixel of a lane in one of its blocks, row by row."""
    return warps.down_of(lane, block) * TILE + warps.across_of(lane, block)


@once
def make_blend(variant: BlendVariant) -> wp.Kernel:
    """The blend; a fourth channel carries z; with ``keep``, every T is stored for the adjoint."""
    falloff, CHANNELS = make_falloff(variant.falloff), variant.channels
    fall_at, reach_of = falloff.value, falloff.reach_of
    of_picture, blend_ideal = make_ideal(variant)

    @wp.kernel(module="unique", module_options=dict(BLEND_OPTIONS))
    def blend(
        bins: BinsView,
        alphas: wp.vec2,
        t_min: float,
        max_steps: int,
        background: wp.array[float],  # [3]
        bound: BoundView,
        limits: wp.array2d[float],  # [T, THREADS] instances in front of what hides, if anything does
        # out
        pixels_out: PixelsView,
        final_out: wp.array2d[float],  # [T, THREADS] transmittance behind the last Gaussian
        count_out: wp.array2d[int],  # [T, THREADS] where the adjoint starts: instances walked before the pixel stopped
        kept_out: wp.array2d[float],  # [M, THREADS] transmittance in front of each Gaussian
    ):
        tile, thread = wp.tid()
        lane = thread % warps.WARP
        half = (thread // warps.WARP) * EACH  # the first of the warp's blocks
        column, line, above = first_pixel_of(bins, tile)
        left = float(column) + 0.5
        top = float(line) + 0.5
        start = bins.ranges[tile][0]
        length = wp.min(bins.ranges[tile][1] - start, max_steps)
        settled = at_start()
        since = Since()
        ts = vec_each(1.0)
        counts = vec_each(float(length))
        reds = vec_each(0.0)
        greens = vec_each(0.0)
        blues = vec_each(0.0)
        fars = vec_each(0.0)
        for p in range(EACH):
            y = line + warps.down_of(lane, half + p)
            x = column + warps.across_of(lane, half + p)
            if y >= bins.height or x >= pixels_out.image.shape[1]:
                ts[p] = -1.0  # stopped from the beginning
                counts[p] = 0.0
        going = going_of(ts, thread)
        for batch in range((length + BATCH - 1) // BATCH):
            first = batch * BATCH
            if wp.static(variant.bound):
                settled = of_picture(settled, ts, reds, greens, blues)
                count = wp.min(BATCH, length - first)
                settled, since = expect(settled, bound, since, bins, tile, lane, half, start + first, count)
            mine = warps.vec12(0.0)
            if first + thread < length:
                splat = bins.splats[bins.instances[start + first + thread]]
                touched = int(-1)  # every T is kept, or every pixel's bound
                if wp.static(not (variant.keep or variant.bound)):
                    touched = warps.blocks_of(splat, 0.5 * LOG2_E * reach_of(splat.opacity, alphas[0]), left, top)
                mine = with_blocks(staged_of(splat), touched)
            staged = wp.tile(mine, preserve_type=True)
            for group in range(wp.static(int(BATCH) // int(warps.WARP))):
                looked_at = going
                if wp.static(variant.keep):
                    looked_at = -1
                listed = staged[group * warps.WARP + lane]
                left_over = warps.ballot(((wp.cast(listed[TOUCHED], int) >> half) & looked_at) != 0, thread)
                while left_over != 0:
                    j = group * warps.WARP + lowest(left_over)
                    left_over = left_over & (left_over - 1)
                    g = staged[j]
                    touched = (wp.cast(g[TOUCHED], int) >> half) & looked_at
                    here = float(first + j)
                    for p in range(EACH):
                        if (touched & (1 << p)) != 0:  # the same for all lanes
                            dx = g[MEAN_X] - (left + float(warps.across_of(lane, half + p)))
                            dy = g[MEAN_Y] - (top + float(warps.down_of(lane, half + p)))
                            fall = fall_at(exponent(dx, dy, g[XX], g[XY], g[YY]))
                            alpha = alpha_of(fall * g[OPACITY], alphas)
                            if wp.static(variant.bound):
                                settled = blend_ideal(settled, p, ts[p], fall, g, alphas, bound)
                            behind = advance(ts[p], alpha, t_min)
                            if wp.static(variant.hides):
                                behind = wp.where(here < limits[tile, place_of(lane, half + p)], behind, -wp.abs(ts[p]))
                            if behind < 0.0:
                                counts[p] = wp.min(counts[p], here)
                            w = weight(ts[p], alpha, behind)
                            if wp.static(variant.keep):
                                kept_out[start + first + j, place_of(lane, half + p)] = ts[p]
                            reds[p] += g[CHANNEL] * w
                            greens[p] += g[CHANNEL + 1] * w
                            blues[p] += g[CHANNEL + 2] * w
                            if wp.static(CHANNELS > 3):
                                fars[p] += g[CHANNEL + 3] * w
                            ts[p] = behind
                going = going_of(ts, thread)
            votes = wp.tile(going)
            if (votes[0] | votes[warps.WARP]) == 0:
                break
        settled = of_picture(settled, ts, reds, greens, blues)
        for p in range(EACH):
            place = place_of(lane, half + p)
            final_out[tile, place] = wp.abs(ts[p])
            count_out[tile, place] = int(counts[p])
            shown = wp.vec4(reds[p], greens[p], blues[p], fars[p])
            y = line + place // TILE
            if y < bins.height:
                write_pixel(pixels_out, background, above + y, column + place % TILE, shown, wp.abs(ts[p]))
            if wp.static(variant.bound):
                conclude(settled, p, shown, ts[p], background, bound, since, bins, tile, lane, half, length)

    return blend

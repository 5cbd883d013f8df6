"""The loss and its adjoint on CUDA: L1 and structural similarity (:mod:`warp_splat.kernels.ssim`), a kernel each.

A block takes a strip of a band of rows and goes down, a thread per number of a row, colors side by side. The threads
show each other a row of both images, and blur it along. What has been blurred of the last eleven rows stays in a
thread's registers, to be blurred along columns. Threads at both ends of a strip only lend their numbers.
"""

import warp as wp

from warp_splat.kernels.simd import where_less
from warp_splat.kernels.ssim import similarity
from warp_splat.kernels.window import CHANNELS, MOMENTS, RADIUS, SLOPES, WEIGHTS, WINDOW

THREADS = wp.constant(256)
BAND = wp.constant(64)  # rows of a block; it blurs ten more along
HALO = wp.constant(RADIUS * CHANNELS)  # threads at each end that lend
STRIP = wp.constant(256 - 2 * RADIUS * CHANNELS)  # numbers of a row that a block compares

vec_moments = wp.types.vector(length=MOMENTS, dtype=float)
mat_moments = wp.types.matrix(shape=(WINDOW, MOMENTS), dtype=float)
mat_slopes = wp.types.matrix(shape=(WINDOW, SLOPES), dtype=float)

wp.set_module_options({"enable_backward": False, "block_dim": 256})


@wp.struct
class PicturesView:
    """What is compared, as rows of H x L numbers."""

    image: wp.array2d[float]  # [H, L]
    limits: wp.vec2  # within which the image is compared
    target: wp.array2d[float]  # [H, L], or nothing
    levels: wp.array2d[wp.uint8]  # [H, L] the target times 255, or nothing
    centers: wp.array[float]  # [2] what is subtracted from either (p, q)


@wp.func
def pair_at(pictures: PicturesView, row: int, place: int):
    """Image and target at a place, less their centers; 0 outside."""
    pair = wp.vec2(0.0, 0.0)
    image = pictures.image
    if row >= 0 and row < image.shape[0] and place >= 0 and place < image.shape[1]:
        low, high, given = pictures.limits[0], pictures.limits[1], image[row, place]
        value = where_less(given, low, low, where_less(high, given, high, given))  # NaN stays
        target = float(0.0)
        if pictures.levels.shape[0] > 0:
            target = float(pictures.levels[row, place]) / 255.0
        else:
            target = pictures.target[row, place]
        pair = wp.vec2(value - pictures.centers[0], target - pictures.centers[1])
    return pair


@wp.func
def outside(place: int, step: int, size: int):
    """The share of the window around a place that lies outside of 0 .. ``size``, taps ``step`` numbers apart."""
    share = float(0.0)
    for tap in range(WINDOW):
        there = place + step * (tap - RADIUS)
        if there < 0 or there >= size:
            share += WEIGHTS[tap]
    return share


@wp.func
def lender(thread: int, tap: int):
    """The thread that has the number of a tap; those at the ends have no use for what they find."""
    return wp.min(wp.max(thread + CHANNELS * (tap - RADIUS), 0), THREADS - 1)


@wp.func
def share_of(tile: int, thread: int, height: int, length: int):
    """The rows of a block, from and to; the place in them of a thread's number, and whether it is compared here."""
    strips = (length + STRIP - 1) // STRIP
    top = (tile // strips) * BAND
    place = (tile % strips) * STRIP + thread - HALO
    return top, wp.min(top + BAND, height), place, thread >= HALO and thread < THREADS - HALO and place < length


@wp.kernel
def compare_block(
    pictures: PicturesView,
    weights: wp.vec3,  # of |x - y|, of SSIM, and of 1 in the loss
    # out
    sums_out: wp.array[float],  # [blocks] part of the loss
    slopes_out: wp.array3d[float],  # [SLOPES, H, L]
):
    tile, thread = wp.tid()
    height = pictures.image.shape[0]
    length = pictures.image.shape[1]
    top, bottom, place, compares = share_of(tile, thread, height, length)
    p = pictures.centers[0]
    q = pictures.centers[1]
    missing = outside(place, CHANNELS, length)
    ring = mat_moments(0.0)
    loss = float(0.0)
    for ahead in range(top - RADIUS, bottom + RADIUS):
        own = pair_at(pictures, ahead, place)
        staged = wp.tile(own, preserve_type=True)
        moments = vec_moments(0.0)
        for tap in range(WINDOW):
            pair = staged[lender(thread, tap)]
            wx = pair[0] * WEIGHTS[tap]
            wy = pair[1] * WEIGHTS[tap]
            moments += vec_moments(wx, wy, wx * pair[0], wy * pair[1], wx * pair[1])
        for i in range(WINDOW - 1):
            ring[i] = ring[i + 1]
        ring[WINDOW - 1] = moments
        if compares and ahead >= top and ahead < bottom:
            loss += weights[0] * wp.abs(own[0] - own[1] + (p - q))
        row = ahead - RADIUS
        if compares and row >= top:
            sums = vec_moments(0.0)
            for tap in range(WINDOW):
                sums += ring[tap] * WEIGHTS[tap]
            above = outside(row, 1, height)
            ssim, mean, square, product = similarity(sums, missing * (1.0 - above) + above, p, q)
            loss += weights[1] * ssim
            slopes_out[0, row, place] = mean
            slopes_out[1, row, place] = square
            slopes_out[2, row, place] = product
    if tile == 0 and thread == 0:
        loss += weights[2]
    total = wp.tile_sum(wp.tile(loss))[0]
    if thread == 0:
        sums_out[tile] = total


@wp.kernel
def adj_compare_block(
    pictures: PicturesView,
    weights: wp.vec3,
    slopes: wp.array3d[float],  # [SLOPES, H, L]
    adj_loss: wp.array[float],  # [1]
    # out
    adj_image_out: wp.array2d[float],  # [H, L]
):
    tile, thread = wp.tid()
    height = pictures.image.shape[0]
    length = pictures.image.shape[1]
    top, bottom, place, compares = share_of(tile, thread, height, length)
    p = pictures.centers[0]
    q = pictures.centers[1]
    ring = mat_slopes(0.0)
    for ahead in range(top - RADIUS, bottom + RADIUS):
        own = wp.vec3(0.0)
        if ahead >= 0 and ahead < height and place >= 0 and place < length:
            own = wp.vec3(slopes[0, ahead, place], slopes[1, ahead, place], slopes[2, ahead, place])
        staged = wp.tile(own, preserve_type=True)
        blurred = wp.vec3(0.0)
        for tap in range(WINDOW):
            blurred += staged[lender(thread, tap)] * WEIGHTS[tap]
        for i in range(WINDOW - 1):
            ring[i] = ring[i + 1]
        ring[WINDOW - 1] = blurred
        row = ahead - RADIUS
        if compares and row >= top:
            sums = wp.vec3(0.0)
            for tap in range(WINDOW):
                sums += ring[tap] * WEIGHTS[tap]
            pair = pair_at(pictures, row, place)
            delta = pair[0] - pair[1] + (p - q)
            adj = where_less(0.0, delta, weights[0], where_less(delta, 0.0, -weights[0], 0.0))
            adj += weights[1] * (sums[0] + 2.0 * pair[0] * sums[1] + pair[1] * sums[2])
            given = pictures.image[row, place]
            if pictures.limits[0] < given and given < pictures.limits[1]:
                adj_image_out[row, place] = adj * adj_loss[0]
            else:  # NaN, too
                adj_image_out[row, place] = 0.0

"""The window of structural similarity: sums over 11 pixels along rows, then along columns.

An image is a matrix of rows of interleaved channels, padded by zeros. A tap k pixels away lies k times ``CHANNELS``
floats away, and sixteen neighboring floats fill a register, of whichever channels they are.
"""

import math

import warp as wp

from warp_splat.kernels.simd import LANES, fma, vec16

WINDOW = 11
RADIUS = WINDOW // 2
CHANNELS = 3
ROWS = 2  # blurred along columns at once: all but two of the rows that their windows cover are the same
RING = 16  # rows kept, a power of two that holds those windows
MOMENTS, SLOPES = 5, 3  # planes: x, y, x x, y y, x y; dSSIM / dm1, de11, de12

_bell = [math.exp(-((tap - RADIUS) ** 2) / (2.0 * 1.5**2)) for tap in range(WINDOW)]
_weights = [value / sum(_bell) for value in _bell]
WEIGHTS = wp.constant(wp.types.vector(length=WINDOW, dtype=float)(*_weights))
#: The same between zeros: of rows that only the next row's window covers, or only the last row's.
WEIGHTS_OF_ROWS = wp.constant(vec16(*[0.0] * (ROWS - 1), *_weights, *[0.0] * (LANES - WINDOW - ROWS + 1)))
NOT_NEGATIVE = wp.constant(0x7FFFFFFF)  # of an index, which is wrapped if the compiler must fear that it may be


@wp.func
def part(rows: wp.uint64, groups: int, number: int):
    """The row of lanes ``number`` of those from an address on: an array whose strides the compiler knows."""
    return wp.array(ptr=rows + wp.uint64(4 * LANES * groups) * wp.uint64(number), shape=(groups,), dtype=vec16)


@wp.func
def seen_by(tap: int, padded: wp.array[vec16]):
    """A padded row as one of the window's taps sees it: element g is what lies that far from group g."""
    address = padded.ptr + wp.uint64(4 * (LANES + CHANNELS * (tap - RADIUS)))
    return wp.array(ptr=address, shape=(padded.shape[0],), dtype=vec16)


@wp.func
def blur_moments(x: wp.array[vec16], y: wp.array[vec16], moments_out: wp.array2d[vec16]):
    """The moments [G, MOMENTS] of two padded rows [G + 2], blurred along them."""
    for group in range(moments_out.shape[0]):
        place = group & NOT_NEGATIVE
        mx = vec16(0.0)
        my = vec16(0.0)
        xx = vec16(0.0)
        yy = vec16(0.0)
        xy = vec16(0.0)
        for tap in range(WINDOW):
            a = seen_by(tap, x)[place]
            b = seen_by(tap, y)[place]
            wa = a * WEIGHTS[tap]
            wb = b * WEIGHTS[tap]
            mx = mx + wa
            my = my + wb
            xx = fma(wa, a, xx)
            yy = fma(wb, b, yy)
            xy = fma(wa, b, xy)
        moments_out[group, 0] = mx
        moments_out[group, 1] = my
        moments_out[group, 2] = xx
        moments_out[group, 3] = yy
        moments_out[group, 4] = xy


@wp.func
def blur_slopes(dmu: wp.array[vec16], dxx: wp.array[vec16], dxy: wp.array[vec16], slopes_out: wp.array2d[vec16]):
    """Padded rows [G + 2] of the slopes, blurred along them, [G, SLOPES]."""
    for group in range(slopes_out.shape[0]):
        place = group & NOT_NEGATIVE
        mu = vec16(0.0)
        xx = vec16(0.0)
        xy = vec16(0.0)
        for tap in range(WINDOW):
            mu = fma(seen_by(tap, dmu)[place], WEIGHTS[tap], mu)
            xx = fma(seen_by(tap, dxx)[place], WEIGHTS[tap], xx)
            xy = fma(seen_by(tap, dxy)[place], WEIGHTS[tap], xy)
        slopes_out[group, 0] = mu
        slopes_out[group, 1] = xx
        slopes_out[group, 2] = xy


def make_blur_columns(planes: int):
    """A function that blurs ``planes`` planes along columns, for ROWS rows at once."""
    mat_sums = wp.types.matrix(shape=(ROWS * planes, LANES), dtype=float)

    @wp.func
    def blur_columns(ring: wp.array3d[vec16], row: int, ahead: int, blurred_out: wp.array3d[vec16]):
        """From the ring [RING, G, planes], with rows before ``ahead``, to those from ``row`` on [ROWS, G, planes]."""
        for group in range(ring.shape[1]):
            sums = mat_sums()
            for other in range(wp.max(row - RADIUS, 0), ahead):
                for plane in range(planes):
                    value = ring[other & (RING - 1), group, plane]
                    for which in range(ROWS):
                        weight = WEIGHTS_OF_ROWS[(other - row + RADIUS + ROWS - 1 - which) & (LANES - 1)]
                        sums[which * planes + plane] = fma(value, weight, sums[which * planes + plane])
            for which in range(ROWS):
                for plane in range(planes):
                    blurred_out[which, group, plane] = sums[which * planes + plane]

    return blur_columns


blur_moments_along_columns = make_blur_columns(MOMENTS)
blur_slopes_along_columns = make_blur_columns(SLOPES)

"""Structural similarity and its adjoint (Wang et al. 2004).

The window is the reference's: 11 pixels, sigma 1.5, zeros outside the image.

An image is a matrix of rows of interleaved channels; rows are padded by zeros, so that a tap k pixels away lies k
times ``channels`` floats away and sixteen neighbouring floats fill a register whatever channel they belong to. With
blur(.) the window, mu1 = blur(x), mu2 = blur(y), E11 = blur(x x), E22 = blur(y y), E12 = blur(x y):

    A = 2 mu1 mu2 + C1            B = 2 (E12 - mu1 mu2) + C2
    C = mu1^2 + mu2^2 + C1        D = E11 + E22 - mu1^2 - mu2^2 + C2        SSIM = A B / (C D)

In float32 the differences lose their digits where x is large and flat. So the kernels see x - p and y - q inside the
image, p and q near the middle of the values, and zeros outside. With m1 = blur(x - p), m2 = blur(y - q),
e11 = blur((x - p)^2), e12 = blur((x - p) (y - q)) and s = blur(1) (below 1 near the border only),

    mu1 = m1 + p s,     E12 - mu1 mu2 = e12 - m1 m2 + (1 - s) (p m2 + q m1 + p q s)     (E11, E22 likewise)

    dSSIM/dm1 = 2 (mu2 B - (mu2 - q) A) / (C D) - 2 SSIM (mu1 / C - (mu1 - p) / D)
    dSSIM/de11 = -SSIM / D,   dSSIM/de12 = 2 A / (C D)
    dL/dx = blur(dL/dm1) + 2 (x - p) blur(dL/de11) + (y - q) blur(dL/de12)
"""

import math

import warp as wp

from warp_splat.kernels.build import FORWARD_ONLY
from warp_splat.kernels.lanes import LANES, fill, over, times, total, vec16, where_less

wp.set_module_options(FORWARD_ONLY)

WINDOW = 11
RADIUS = WINDOW // 2
CHANNELS = 3
C1 = wp.constant(0.01**2)
C2 = wp.constant(0.03**2)
vec16b = wp.types.vector(length=LANES, dtype=wp.uint8)
IOTA = wp.constant(vec16(*[float(lane) for lane in range(LANES)]))

_bell = [math.exp(-((tap - RADIUS) ** 2) / (2.0 * 1.5**2)) for tap in range(WINDOW)]
WEIGHTS = wp.constant(wp.types.vector(length=WINDOW, dtype=float)(*[value / sum(_bell) for value in _bell]))


@wp.func
def inside(values: vec16, start: int, length: int):
    """``values`` where start + lane < length, else 0: what lies in the padding right of the image."""
    return where_less(IOTA, vec16(float(length - start)), values, vec16(0.0))


@wp.func
def neighbours(rows: wp.array2d[float], taps: wp.array2d[vec16], row: int, start: int):
    """Floats ``start`` .. ``start + 15`` of a row, 0 beyond its end."""
    length = rows.shape[1]
    if start + LANES <= length:
        return taps[row, start]
    values = vec16(0.0)
    for lane in range(length - start):
        values[lane] = rows[row, start + lane]
    return values


@wp.func
def neighbours(rows: wp.array2d[wp.uint8], taps: wp.array2d[vec16b], row: int, start: int):
    """The same of bytes, divided by 255."""
    length = rows.shape[1]
    values = vec16(0.0)
    if start + LANES <= length:
        levels = taps[row, start]
        for lane in range(LANES):
            values[lane] = float(levels[lane])
    else:
        for lane in range(length - start):
            values[lane] = float(rows[row, start + lane])
    return over(values, vec16(255.0))


@wp.func
def between(values: vec16, limits: wp.vec2):
    """``values`` no less than ``limits[0]``, no more than ``limits[1]``; NaN stays."""
    low = vec16(limits[0])
    high = vec16(limits[1])
    return where_less(values, low, low, where_less(high, values, high, values))


@wp.func
def column_weights(row: int, height: int):
    """The window's weights for a column through ``row``, 0 for those outside the image."""
    weights = WEIGHTS
    for tap in range(WINDOW):
        if row + tap - RADIUS < 0 or row + tap - RADIUS >= height:
            weights[tap] = 0.0
    return weights


@wp.kernel
def pad(
    first: int,  # row of this slice
    image: wp.array2d[float],  # [H, L]
    taps: wp.array2d[vec16],  # [H, L - 15] the same: element p holds floats p .. p + 15 of a row
    center: float,
    limits: wp.vec2,
    # out
    padded_out: wp.array2d[vec16],  # [H, G + 2] the image within the limits, minus the center, between groups of zeros
):
    row = first + wp.tid()
    groups = padded_out.shape[1] - 2
    padded_out[row, 0] = vec16(0.0)
    padded_out[row, groups + 1] = vec16(0.0)
    for group in range(groups):
        start = LANES * group
        values = between(neighbours(image, taps, row, start), limits) - vec16(center)
        padded_out[row, group + 1] = inside(values, start, image.shape[1])


@wp.kernel
def pad_bytes(
    first: int,
    image: wp.array2d[wp.uint8],  # [H, L], to be divided by 255
    taps: wp.array2d[vec16b],
    center: float,
    # out
    padded_out: wp.array2d[vec16],  # [H, G + 2]
):
    row = first + wp.tid()
    groups = padded_out.shape[1] - 2
    padded_out[row, 0] = vec16(0.0)
    padded_out[row, groups + 1] = vec16(0.0)
    for group in range(groups):
        start = LANES * group
        values = neighbours(image, taps, row, start) - vec16(center)
        padded_out[row, group + 1] = inside(values, start, image.shape[1])


@wp.kernel
def blur_rows(
    first: int,  # row of this slice
    x: wp.array2d[vec16],  # [H, P - 15] element p holds floats p .. p + 15 of a padded row
    y: wp.array2d[vec16],
    # out
    moments_out: wp.array3d[vec16],  # [H, 5, G] x, y, x x, y y, x y, blurred along rows
):
    row = first + wp.tid()
    for group in range(moments_out.shape[2]):
        mx = vec16(0.0)
        my = vec16(0.0)
        xx = vec16(0.0)
        yy = vec16(0.0)
        xy = vec16(0.0)
        for tap in range(WINDOW):
            place = LANES * (group + 1) + CHANNELS * (tap - RADIUS)
            a = x[row, place]
            b = y[row, place]
            wa = a * WEIGHTS[tap]
            wb = b * WEIGHTS[tap]
            mx = mx + wa
            my = my + wb
            xx = xx + times(wa, a)
            yy = yy + times(wb, b)
            xy = xy + times(wa, b)
        moments_out[row, 0, group] = mx
        moments_out[row, 1, group] = my
        moments_out[row, 2, group] = xx
        moments_out[row, 3, group] = yy
        moments_out[row, 4, group] = xy


@wp.kernel
def compare(
    first: int,
    x: wp.array2d[vec16],  # [H, P - 15]
    y: wp.array2d[vec16],
    moments: wp.array3d[vec16],  # [H, 5, G]
    missing: wp.array[vec16],  # [G] share of the window beyond the ends of a row
    centers: wp.vec2,  # p, q
    length: int,  # floats in a row of the image
    # out
    sums_out: wp.array2d[float],  # [H, 2] sum of |x - y| and of SSIM over the row
    slopes_out: wp.array3d[vec16],  # [H, 3, G] dSSIM / dm1, de11, de12; 0 outside the image
):
    row = first + wp.tid()
    height = moments.shape[0]
    difference = vec16(0.0)
    similarity = vec16(0.0)
    one = vec16(1.0)
    p = centers[0]
    q = centers[1]
    weights = column_weights(row, height)
    above = float(0.0)  # share of the window above or below the image
    for tap in range(WINDOW):
        above += WEIGHTS[tap] - weights[tap]
    for group in range(moments.shape[2]):
        mx = vec16(0.0)
        my = vec16(0.0)
        xx = vec16(0.0)
        yy = vec16(0.0)
        xy = vec16(0.0)
        # unrolled as in adj_blur_columns, five planes are slower: 7.5 ms against 5.2; so is a while loop, 9.6; strips
        # of 8 groups, whose eleven rows fit in the first cache, change nothing
        for other in range(wp.max(row - RADIUS, 0), wp.min(row + RADIUS + 1, height)):
            w = WEIGHTS[other - row + RADIUS]
            mx = mx + moments[other, 0, group] * w
            my = my + moments[other, 1, group] * w
            xx = xx + moments[other, 2, group] * w
            yy = yy + moments[other, 3, group] * w
            xy = xy + moments[other, 4, group] * w
        outside = missing[group] * (1.0 - above) + vec16(above)  # 1 - s, exactly 0 where the window fits
        inner = one - outside
        mu_x = mx + inner * p
        mu_y = my + inner * q
        covariance = xy - times(mx, my) + times(outside, my * p + mx * q + inner * (p * q))
        variances = xx + yy - times(mx, mx) - times(my, my)
        variances = variances + times(outside, (mx * p + my * q) * 2.0 + inner * (p * p + q * q))
        a = times(mu_x, mu_y) * 2.0 + fill(C1, mu_x)
        b = covariance * 2.0 + fill(C2, mu_x)
        c = over(one, times(mu_x, mu_x) + times(mu_y, mu_y) + fill(C1, mu_x))
        d = over(one, wp.max(variances, vec16(0.0)) + fill(C2, mu_x))  # rounding must not make it negative
        scale = times(c, d)
        ssim = times(times(a, b), scale)
        start = LANES * group
        similarity = similarity + inside(ssim, start, length)
        delta = x[row, start + LANES] - y[row, start + LANES] + inside(vec16(p - q), start, length)
        difference = difference + wp.max(delta, -delta)
        far_x = mu_x - vec16(p)
        far_y = mu_y - vec16(q)
        slope = times(times(mu_y, b) - times(far_y, a), scale) - times(ssim, times(mu_x, c) - times(far_x, d))
        slopes_out[row, 0, group] = inside(slope * 2.0, start, length)
        slopes_out[row, 1, group] = inside(-times(ssim, d), start, length)
        slopes_out[row, 2, group] = inside(times(a, scale) * 2.0, start, length)
    sums_out[row, 0] = total(difference)
    sums_out[row, 1] = total(similarity)


@wp.kernel
def adj_blur_columns(
    first: int,
    slopes: wp.array3d[vec16],  # [H, 3, G]
    # out
    slopes_out: wp.array3d[vec16],  # [H, 3, G + 2] blurred along columns, a group of zeros at either end
):
    row = first + wp.tid()
    height = slopes.shape[0]
    groups = slopes.shape[2]
    for which in range(3):
        slopes_out[row, which, 0] = vec16(0.0)
        slopes_out[row, which, groups + 1] = vec16(0.0)
    weights = column_weights(row, height)
    for group in range(groups):
        dmu = vec16(0.0)
        dxx = vec16(0.0)
        dxy = vec16(0.0)
        for tap in range(WINDOW):
            w = weights[tap]
            other = wp.clamp(row + tap - RADIUS, 0, height - 1)
            dmu = dmu + slopes[other, 0, group] * w
            dxx = dxx + slopes[other, 1, group] * w
            dxy = dxy + slopes[other, 2, group] * w
        slopes_out[row, 0, group + 1] = dmu
        slopes_out[row, 1, group + 1] = dxx
        slopes_out[row, 2, group + 1] = dxy


@wp.kernel
def adj_compare(
    first: int,
    image: wp.array2d[float],  # [H, L] as given to pad
    taps: wp.array2d[vec16],
    limits: wp.vec2,
    x: wp.array2d[vec16],  # [H, P - 15]
    y: wp.array2d[vec16],
    slopes: wp.array3d[vec16],  # [H, 3, P - 15] blurred along columns
    gap: float,  # p - q
    adj_l1: float,  # dL / d(sum of |x - y|)
    adj_ssim: float,  # dL / d(sum of SSIM)
    # out
    adj_image_out: wp.array2d[float],  # [H, L]
    adj_taps_out: wp.array2d[vec16],
):
    row = first + wp.tid()
    length = image.shape[1]
    for group in range((length + LANES - 1) // LANES):
        dmu = vec16(0.0)
        dxx = vec16(0.0)
        dxy = vec16(0.0)
        for tap in range(WINDOW):
            place = LANES * (group + 1) + CHANNELS * (tap - RADIUS)
            dmu = dmu + slopes[row, 0, place] * WEIGHTS[tap]
            dxx = dxx + slopes[row, 1, place] * WEIGHTS[tap]
            dxy = dxy + slopes[row, 2, place] * WEIGHTS[tap]
        a = x[row, LANES * (group + 1)]
        b = y[row, LANES * (group + 1)]
        zero = vec16(0.0)
        delta = a - b + vec16(gap)
        sign = where_less(zero, delta, vec16(1.0), where_less(delta, zero, vec16(-1.0), zero))
        adj = sign * adj_l1 + (dmu + times(a, dxx) * 2.0 + times(b, dxy)) * adj_ssim
        start = LANES * group
        given = neighbours(image, taps, row, start)
        adj = where_less(vec16(limits[0]), given, where_less(given, vec16(limits[1]), adj, zero), zero)
        if start + LANES <= length:
            adj_taps_out[row, start] = adj
        else:
            for lane in range(length - start):
                adj_image_out[row, start + lane] = adj[lane]

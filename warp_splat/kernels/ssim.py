"""Structural similarity and its adjoint (Wang et al. 2004).

The window (:mod:`.window`) is the reference's: 11 pixels, sigma 1.5, zeros outside the image. With blur(.) it,
mu1 = blur(x), mu2 = blur(y), E11 = blur(x x), E22 = blur(y y), E12 = blur(x y):

    A = 2 mu1 mu2 + C1            B = 2 (E12 - mu1 mu2) + C2
    C = mu1^2 + mu2^2 + C1        D = E11 + E22 - mu1^2 - mu2^2 + C2        SSIM = A B / (C D)

In float32 the differences lose their digits where x is large and flat. So the kernels see x - p and y - q inside the
image, p and q near the middle of the values, and zeros outside. With m1 = blur(x - p), m2 = blur(y - q),
e11 = blur((x - p)^2), e12 = blur((x - p) (y - q)) and s = blur(1) (below 1 near the border only),

    mu1 = m1 + p s,     E12 - mu1 mu2 = e12 - m1 m2 + (1 - s) (p m2 + q m1 + p q s)     (E11, E22 likewise)

    dSSIM/dm1 = 2 (mu2 B - (mu2 - q) A) / (C D) - 2 SSIM (mu1 / C - (mu1 - p) / D)
    dSSIM/de11 = -SSIM / D,   dSSIM/de12 = 2 A / (C D)
    dL/dx = blur(dL/dm1) + 2 (x - p) blur(dL/de11) + (y - q) blur(dL/de12)

A launch index is a band of rows. What has been blurred along rows waits in a ring of the band, in the cache, to be
blurred along columns. Tried:

- 1.5 x the time, and on two threads as slow as on one: whole planes in memory
- no faster: one group of lanes through all steps before the next
- no faster: four rows at once instead of two
"""

from typing import Any

import warp as wp

from warp_splat.kernels import window
from warp_splat.kernels.compiler import FORWARD_ONLY
from warp_splat.kernels.simd import LANES, fill, over, times, total, vec16, where_less

wp.set_module_options(FORWARD_ONLY)

C1 = wp.constant(0.01**2)
C2 = wp.constant(0.03**2)
vec16b = wp.types.vector(length=LANES, dtype=wp.uint8)
IOTA = wp.constant(vec16(*[float(lane) for lane in range(LANES)]))


@wp.func
def inside(values: vec16, start: int, length: int):
    """``values`` where start + lane < length, else 0: what lies in the padding right of the image."""
    return where_less(IOTA, vec16(float(length - start)), values, vec16(0.0))


@wp.func
def neighbors(rows: wp.array2d[float], taps: wp.array2d[vec16], row: int, start: int):
    """Floats ``start`` .. ``start + 15`` of a row, 0 beyond its end."""
    length = rows.shape[1]
    if start + LANES <= length:
        return taps[row, start]
    values = vec16(0.0)
    for lane in range(length - start):
        values[lane] = rows[row, start + lane]
    return values


@wp.func
def neighbors(rows: wp.array2d[wp.uint8], taps: wp.array2d[vec16b], row: int, start: int):
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


@wp.struct
class Pictures:
    """What is compared, each as numbers and as taps: element p holds numbers p .. p + 15 of a row."""

    image: wp.array2d[float]  # [H, L]
    image_taps: wp.array2d[vec16]  # [H, L - 15]
    limits: wp.vec2
    target: wp.array2d[float]  # [H, L], or nothing
    target_taps: wp.array2d[vec16]  # [H, L - 15], or nothing
    levels: wp.array2d[wp.uint8]  # [H, L] the target times 255, or nothing
    level_taps: wp.array2d[vec16b]  # [H, L - 15], or nothing
    centers: wp.vec2  # p, q


@wp.func
def photograph(
    target: wp.array2d[float],
    target_taps: wp.array2d[vec16],
    levels: wp.array2d[wp.uint8],
    level_taps: wp.array2d[vec16b],
    row: int,
    start: int,
):
    """:func:`neighbors` of the one of the two that has rows."""
    if levels.shape[0] > 0:
        return neighbors(levels, level_taps, row, start)
    return neighbors(target, target_taps, row, start)


@wp.func
def between(values: vec16, limits: wp.vec2):
    """``values`` no less than ``limits[0]``, no more than ``limits[1]``; NaN stays."""
    low = vec16(limits[0])
    high = vec16(limits[1])
    return where_less(values, low, low, where_less(high, values, high, values))


@wp.func
def similarity(moments: Any, outside: Any, p: float, q: float):
    """SSIM, and its derivatives by m1, e11 and e12, from the moments m1, m2, e11, e22, e12; ``outside`` is 1 - s."""
    mx = moments[0]
    my = moments[1]
    squares = moments[2] + moments[3]
    product = moments[4]
    one = fill(1.0, mx)
    inner = one - outside
    mu_x = mx + inner * p
    mu_y = my + inner * q
    covariance = product - times(mx, my) + times(outside, my * p + mx * q + inner * (p * q))
    variances = squares - times(mx, mx) - times(my, my)
    variances = variances + times(outside, (mx * p + my * q) * 2.0 + inner * (p * p + q * q))
    a = times(mu_x, mu_y) * 2.0 + fill(C1, mu_x)
    b = covariance * 2.0 + fill(C2, mu_x)
    c = over(one, times(mu_x, mu_x) + times(mu_y, mu_y) + fill(C1, mu_x))
    d = over(one, wp.max(variances, fill(0.0, mx)) + fill(C2, mu_x))  # rounding must not make it negative
    scale = times(c, d)
    ssim = times(times(a, b), scale)
    far_x = mu_x - fill(p, mx)
    far_y = mu_y - fill(q, mx)
    slope = times(times(mu_y, b) - times(far_y, a), scale) - times(ssim, times(mu_x, c) - times(far_x, d))
    return ssim, slope * 2.0, -times(ssim, d), times(a, scale) * 2.0


@wp.func
def compare_row(
    moments: wp.array2d[vec16],  # [G, MOMENTS]
    missing: wp.array[vec16],
    centers: wp.vec2,
    row: int,
    height: int,
    length: int,
    # out
    slopes_out: wp.array2d[vec16],  # [SLOPES, G + 2]
):
    """The slopes of a row, and the sum of its SSIM."""
    p = centers[0]
    q = centers[1]
    zero = vec16(0.0)
    groups = missing.shape[0]
    above = float(0.0)  # share of the window above or below the image
    for tap in range(window.WINDOW):
        if row + tap - window.RADIUS < 0 or row + tap - window.RADIUS >= height:
            above += window.WEIGHTS[tap]
    for plane in range(window.SLOPES):
        slopes_out[plane, 0] = zero
        slopes_out[plane, groups + 1] = zero
    sums = zero
    for group in range(groups):
        outside = missing[group] * (1.0 - above) + vec16(above)  # 1 - s, exactly 0 where the window fits
        ssim, mean, square, product = similarity(moments[group], outside, p, q)
        start = LANES * group
        sums = sums + inside(ssim, start, length)
        slopes_out[0, group + 1] = inside(mean, start, length)
        slopes_out[1, group + 1] = inside(square, start, length)
        slopes_out[2, group + 1] = inside(product, start, length)
    return total(sums)


@wp.kernel
def compare(
    first: int,  # band of this slice
    bounds: wp.array[int],  # [B + 1] rows where bands begin
    pictures: Pictures,
    missing: wp.array[vec16],  # [G] share of the window beyond the ends of a row
    # out
    padded_out: wp.array3d[vec16],  # [B, 2, G + 2] a row of the image within the limits minus p, and of the target
    ring_out: wp.array4d[vec16],  # [B, RING, G, MOMENTS] blurred along rows
    blurred_out: wp.array4d[vec16],  # [B, ROWS, G, MOMENTS] along columns, too
    sums_out: wp.array2d[float],  # [H, 2] sum of |x - y| and of SSIM over the row
    slopes_out: wp.array3d[vec16],  # [H, SLOPES, G + 2] 0 outside the image
):
    band = first + wp.tid()
    # in front of the loop: read in it, the loss takes a third longer
    image = pictures.image
    image_taps = pictures.image_taps
    limits = pictures.limits
    target = pictures.target
    target_taps = pictures.target_taps
    levels = pictures.levels
    level_taps = pictures.level_taps
    height = image.shape[0]
    length = image.shape[1]
    groups = missing.shape[0]
    centers = pictures.centers
    p = centers[0]
    q = centers[1]
    zero = vec16(0.0)
    x = window.part(padded_out.ptr, groups + 2, 2 * band)
    y = window.part(padded_out.ptr, groups + 2, 2 * band + 1)
    for side in range(2):
        x[side * (groups + 1)] = zero
        y[side * (groups + 1)] = zero
    ring = ring_out[band]
    blurred = blurred_out[band]
    row = bounds[band]
    ahead = wp.max(row - window.RADIUS, 0)
    while row < bounds[band + 1]:
        while ahead < wp.min(row + window.ROWS + window.RADIUS, height):
            difference = zero
            for group in range(groups):
                start = LANES * group
                a = between(neighbors(image, image_taps, ahead, start), limits) - vec16(p)
                b = photograph(target, target_taps, levels, level_taps, ahead, start) - vec16(q)
                x[group + 1] = inside(a, start, length)
                y[group + 1] = inside(b, start, length)
                delta = inside(a - b + vec16(p - q), start, length)
                difference = difference + wp.abs(delta)
            if ahead >= bounds[band] and ahead < bounds[band + 1]:
                sums_out[ahead, 0] = total(difference)
            window.blur_moments(x, y, ring[ahead & (window.RING - 1)])
            ahead += 1
        window.blur_moments_along_columns(ring, row, ahead, blurred)
        which = int(0)
        while which < window.ROWS and row < bounds[band + 1]:
            sums_out[row, 1] = compare_row(blurred[which], missing, centers, row, height, length, slopes_out[row])
            which += 1
            row += 1


@wp.kernel
def adj_compare(
    first: int,
    bounds: wp.array[int],  # [B + 1]
    pictures: Pictures,
    slopes: wp.array3d[vec16],  # [H, SLOPES, G + 2]
    adj_l1: float,  # dL / d(sum of |x - y|)
    adj_ssim: float,  # dL / d(sum of SSIM)
    # out
    ring_out: wp.array4d[vec16],  # [B, RING, G, SLOPES]
    blurred_out: wp.array4d[vec16],  # [B, ROWS, G, SLOPES]
    adj_image_out: wp.array2d[float],  # [H, L]
    adj_taps_out: wp.array2d[vec16],  # [H, L - 15]
):
    band = first + wp.tid()
    # in front of the loop: read in it, the loss takes a third longer
    image = pictures.image
    image_taps = pictures.image_taps
    limits = pictures.limits
    target = pictures.target
    target_taps = pictures.target_taps
    levels = pictures.levels
    level_taps = pictures.level_taps
    height = image.shape[0]
    length = image.shape[1]
    groups = slopes.shape[2] - 2
    p = pictures.centers[0]
    q = pictures.centers[1]
    zero = vec16(0.0)
    ring = ring_out[band]
    blurred = blurred_out[band]
    row = bounds[band]
    ahead = wp.max(row - window.RADIUS, 0)
    while row < bounds[band + 1]:
        while ahead < wp.min(row + window.ROWS + window.RADIUS, height):
            dmu = window.part(slopes.ptr, groups + 2, window.SLOPES * ahead)
            dxx = window.part(slopes.ptr, groups + 2, window.SLOPES * ahead + 1)
            dxy = window.part(slopes.ptr, groups + 2, window.SLOPES * ahead + 2)
            window.blur_slopes(dmu, dxx, dxy, ring[ahead & (window.RING - 1)])
            ahead += 1
        window.blur_slopes_along_columns(ring, row, ahead, blurred)
        which = int(0)
        while which < window.ROWS and row < bounds[band + 1]:
            for group in range(groups):
                start = LANES * group
                given = neighbors(image, image_taps, row, start)
                a = between(given, limits) - vec16(p)
                b = photograph(target, target_taps, levels, level_taps, row, start) - vec16(q)
                delta = a - b + vec16(p - q)
                sign = where_less(zero, delta, vec16(1.0), where_less(delta, zero, vec16(-1.0), zero))
                adj = blurred[which, group, 0] + times(a, blurred[which, group, 1]) * 2.0
                adj = sign * adj_l1 + (adj + times(b, blurred[which, group, 2])) * adj_ssim
                adj = where_less(vec16(limits[0]), given, where_less(given, vec16(limits[1]), adj, zero), zero)
                if start + LANES <= length:
                    adj_taps_out[row, start] = adj
                else:
                    for lane in range(length - start):
                        adj_image_out[row, start + lane] = adj[lane]
            which += 1
            row += 1

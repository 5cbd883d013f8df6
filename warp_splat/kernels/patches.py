"""What a photograph shows, found in others: a plane for each pixel, by patches that look alike (Bleyer et al. 2011).

A plane of a camera is a vector m with m . p = 1 for its points p. So 1 / depth along a ray is m . ray, and a homography
takes a pixel's surroundings to another camera.
"""

import warp as wp

from warp_splat.kernels.compiler import FORWARD_ONLY

REACH, SPACING = 2, 2  # of a patch: samples to each side, and pixels between them
SAMPLES = float((2 * REACH + 1) ** 2)
FLAT = 1.0e-7  # product of two patches' sums of squares in which nothing is told apart
FAR = 5  # pixels, an odd number, to the farther neighbors that are asked
STEPS = 11  # planes tried: of 8 neighbors, of any depth, 2 like the best
LIKE = 0.04  # share by which their depths differ from its


@wp.struct
class Other:
    """A photograph to look in."""

    picture: wp.array2d[float]  # [H, W] 0 to 1
    lens: wp.vec4  # fx, fy, cx, cy [px]
    rotation: wp.mat33  # to it from the camera that looks
    translation: wp.vec3


@wp.func
def interpolated(picture: wp.array2d[float], u: float, v: float):
    """The value at a place [px], between four pixels."""
    x = wp.clamp(u - 0.5, 0.0, float(picture.shape[1]) - 1.001)
    y = wp.clamp(v - 0.5, 0.0, float(picture.shape[0]) - 1.001)
    i, j = int(x), int(y)
    upper = wp.lerp(picture[j, i], picture[j, i + 1], x - float(i))
    return wp.lerp(upper, wp.lerp(picture[j + 1, i], picture[j + 1, i + 1], x - float(i)), y - float(j))


@wp.func
def correlation(m: wp.vec3, ray: wp.vec3, x: int, y: int, lens: wp.vec4, picture: wp.array2d[float], other: Other):
    """Correlation of a pixel's patch with what another photograph shows of plane m, -1 to 1; -1: it is not there."""
    onto = other.rotation + wp.outer(other.translation, m)
    p = onto * ray
    u, v = other.lens[0] * p[0] / p[2] + other.lens[2], other.lens[1] * p[1] / p[2] + other.lens[3]
    inside = wp.min(wp.min(u, float(other.picture.shape[1]) - u), wp.min(v, float(other.picture.shape[0]) - v))
    if p[2] <= 0.0 or inside < 1.0:
        return -1.0
    sums, squares, product = wp.vec2(), wp.vec2(), float(0.0)
    for j in range(-REACH, REACH + 1):
        for i in range(-REACH, REACH + 1):
            q = p + onto * wp.vec3(float(i * SPACING) / lens[0], float(j * SPACING) / lens[1], 0.0)
            row, column = wp.clamp(y + j * SPACING, 0, picture.shape[0] - 1), x + i * SPACING
            a, z = picture[row, wp.clamp(column, 0, picture.shape[1] - 1)], wp.max(q[2], 1.0e-6)
            b = interpolated(
                other.picture, other.lens[0] * q[0] / z + other.lens[2], other.lens[1] * q[1] / z + other.lens[3]
            )
            sums, squares, product = sums + wp.vec2(a, b), squares + wp.vec2(a * a, b * b), product + a * b
    spread = squares - wp.cw_mul(sums, sums) / SAMPLES
    return (product - sums[0] * sums[1] / SAMPLES) / wp.sqrt(wp.max(spread[0] * spread[1], 0.0) + FLAT)


@wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
def search(
    first: int,  # pixel of this slice
    turn: int,  # even: pixels of one color of a checkerboard, which read those of the other
    farness: wp.vec2,  # smallest and largest 1 / depth
    lens: wp.vec4,  # fx, fy, cx, cy [px]
    picture: wp.array2d[float],  # [H, W] 0 to 1
    others: wp.array[Other],  # [K]
    # out
    planes_out: wp.array2d[wp.vec3],  # [H, W] the best so far
    scores_out: wp.array2d[float],  # [H, W] mean of its three largest correlations; above 1: it stays
):
    i = first + wp.tid()
    right, lower = picture.shape[1] - 1, picture.shape[0] - 1
    x, y = i % (right + 1), i // (right + 1)
    m, best = wp.vec3(planes_out[y, x]), float(scores_out[y, x])
    if best > 1.0 or (x + y + turn) % 2 == 1:
        return
    ray = wp.vec3((float(x) + 0.5 - lens[2]) / lens[0], (float(y) + 0.5 - lens[3]) / lens[1], 1.0)
    state = wp.rand_init(turn, i)
    for step in range(-1, STEPS):
        tried = wp.vec3(m)
        if step >= 0 and step < 8:  # mirrored at the edges, where they are of the other color, too
            away = wp.where(step % 2 == 0, 1, -1) * wp.where(step < 4, 1, FAR)
            column = right - wp.abs(right - wp.abs(x + wp.where(step % 4 < 2, away, 0)))
            tried = wp.vec3(planes_out[lower - wp.abs(lower - wp.abs(y + wp.where(step % 4 < 2, 0, away))), column])
        elif step == 8:
            tried = wp.vec3(0.0, 0.0, wp.lerp(farness[0], farness[1], wp.randf(state)))
        elif step > 8:
            lean = wp.dot(m, ray) * wp.vec2(wp.randf(state, -1.0, 1.0), wp.randf(state, -1.0, 1.0))
            tried = m + wp.vec3(lean[0], lean[1], -lean[0] * ray[0] - lean[1] * ray[1])
            tried = tried * (1.0 + wp.randf(state, -LIKE, LIKE))
        nearness, top = wp.dot(tried, ray), wp.vec3(-1.0, -1.0, -1.0)
        if nearness >= farness[0] and nearness <= farness[1]:
            for k in range(others.shape[0]):  # others may have something in front: three suffice
                score = correlation(tried, ray, x, y, lens, picture, others[k])
                low = wp.min(top[0], score)
                top = wp.vec3(wp.max(top[0], score), wp.max(top[1], low), wp.max(top[2], wp.min(top[1], low)))
        if (top[0] + top[1] + top[2]) / 3.0 > best:
            m, best = tried, (top[0] + top[1] + top[2]) / 3.0
    planes_out[y, x] = m
    scores_out[y, x] = best

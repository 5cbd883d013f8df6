"""What the kernel of all projections is put together from, but for what differs between projections.

These are not called: their bodies take the place of the calls (:mod:`warp_splat.kernels.inline`). So a number may be
one Gaussian's, or sixteen.
"""

import warp as wp

from warp_splat.kernels.simd import equal, fill, fma, inverse, less, pick, root, times

# of a quaternion's largest entry; beyond, a power of two comes first, so that squares neither vanish nor overflow
SMALL, ENLARGED = wp.constant(2.0**-30), wp.constant(2.0**90)
LARGE, REDUCED = wp.constant(2.0**30), wp.constant(2.0**-70)


def all_finite(mx, my, mz, qw, qx, qy, qz, sx, sy, sz, opacity):
    """Mask: 0 times what is not finite is NaN; wp.isfinite is a call per number on the CPU."""
    none = fill(0.0, opacity)
    nought = fma(mx, none, fma(my, none, fma(mz, none, times(opacity, none))))
    nought = fma(qw, none, fma(qx, none, fma(qy, none, fma(qz, none, nought))))
    return equal(fma(sx, none, fma(sy, none, fma(sz, none, nought))), none)


def rotation(qw, qx, qy, qz, size):
    """The matrix of a quaternion whose largest entry is ``size``, row by row."""
    one = fill(1.0, size)
    two = fill(2.0, size)
    small = less(size, fill(SMALL, size))
    large = less(fill(LARGE, size), size)
    scale = pick(small, fill(ENLARGED, size), pick(large, fill(REDUCED, size), one))
    w = times(qw, scale)
    x = times(qx, scale)
    y = times(qy, scale)
    z = times(qz, scale)
    per_norm = inverse(root(fma(w, w, fma(x, x, fma(y, y, times(z, z))))))
    w = times(w, per_norm)
    x = times(x, per_norm)
    y = times(y, per_norm)
    z = times(z, per_norm)
    return (
        one - times(two, fma(y, y, times(z, z))),
        times(two, times(x, y) - times(w, z)),
        times(two, fma(x, z, times(w, y))),
        times(two, fma(x, y, times(w, z))),
        one - times(two, fma(x, x, times(z, z))),
        times(two, times(y, z) - times(w, x)),
        times(two, times(x, z) - times(w, y)),
        times(two, fma(y, z, times(w, x))),
        one - times(two, fma(x, x, times(y, y))),
    )


def taken_along(n00, n01, n02, n10, n11, n12, n20, n21, n22, x, y, z):
    """A matrix times a vector."""
    return (
        fma(n00, x, fma(n01, y, times(n02, z))),
        fma(n10, x, fma(n11, y, times(n12, z))),
        fma(n20, x, fma(n21, y, times(n22, z))),
    )


def offset(camera, here, x, y, z):
    """From the camera's center; from the world's origin in place of what is left out."""
    none = fill(0.0, x)
    return (
        (pick(here, x, none) - fill(camera.center[0], x)) - fill(camera.center_low[0], x),
        (pick(here, y, none) - fill(camera.center[1], x)) - fill(camera.center_low[1], x),
        (pick(here, z, none) - fill(camera.center[2], x)) - fill(camera.center_low[2], x),
    )


def turned_or_not(here, w, x, y, z, size):
    """A quaternion and its largest entry; one that turns nothing in place of what is left out."""
    one = fill(1.0, x)
    none = fill(0.0, x)
    return pick(here, w, one), pick(here, x, none), pick(here, y, none), pick(here, z, none), pick(here, size, one)


def sized_or_one(here, x, y, z):
    """Scales; ones in place of what is left out."""
    one = fill(1.0, x)
    return pick(here, x, one), pick(here, y, one), pick(here, z, one)


def covariance(a10, a11, a12, a20, a21, a22):
    """A A', and its determinant as a sum of squares."""
    c0 = times(a11, a22) - times(a12, a21)
    c1 = times(a12, a20) - times(a10, a22)
    c2 = times(a10, a21) - times(a11, a20)
    return (
        fma(a10, a10, fma(a11, a11, times(a12, a12))),
        fma(a10, a20, fma(a11, a21, times(a12, a22))),
        fma(a20, a20, fma(a21, a21, times(a22, a22))),
        fma(c0, c0, fma(c1, c1, times(c2, c2))),
    )

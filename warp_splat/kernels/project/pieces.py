"""What the kernel of all projections is put together from, but for what differs between projections."""

import functools
from typing import NamedTuple

import warp as wp

from warp_splat.kernels.project.camera_view import CameraView
from warp_splat.kernels.simd import TYPES, equal, fill, fma, inverse, less, pick, root, rounded_down, rounded_up, times

# of a quaternion's largest entry; beyond, a power of two comes first, so that squares neither vanish nor overflow
SMALL, ENLARGED = wp.constant(2.0**-30), wp.constant(2.0**90)
LARGE, REDUCED = wp.constant(2.0**30), wp.constant(2.0**-70)


class Pieces(NamedTuple):
    """Functions for a number of lanes."""

    largest: wp.Function
    all_finite: wp.Function
    rotation: wp.Function
    taken_along: wp.Function
    covers_pixel: wp.Function
    offset: wp.Function
    turned_or_not: wp.Function
    sized_or_one: wp.Function


@functools.cache
def make_pieces(lanes: int) -> Pieces:
    """Of ``lanes`` Gaussians at once."""
    number = TYPES[lanes].number

    @wp.func
    def largest(a: number, b: number, c: number, d: number):
        """The largest magnitude, without a gradient: it chooses a factor that normalization takes out again."""
        return wp.max(wp.max(wp.max(a, -a), wp.max(b, -b)), wp.max(wp.max(c, -c), wp.max(d, -d)))

    @wp.func_grad(largest)
    def adj_largest(a: number, b: number, c: number, d: number, adj_ret: number):
        pass

    @wp.func
    def all_finite(
        mx: number,
        my: number,
        mz: number,
        qw: number,
        qx: number,
        qy: number,
        qz: number,
        sx: number,
        sy: number,
        sz: number,
        opacity: number,
    ):
        """Mask: 0 times what is not finite is NaN; wp.isfinite is a call per number on the CPU."""
        none = fill(0.0, opacity)
        nought = fma(mx, none, fma(my, none, fma(mz, none, times(opacity, none))))
        nought = fma(qw, none, fma(qx, none, fma(qy, none, fma(qz, none, nought))))
        return equal(fma(sx, none, fma(sy, none, fma(sz, none, nought))), none)

    @wp.func
    def rotation(qw: number, qx: number, qy: number, qz: number, size: number):
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

    @wp.func
    def taken_along(
        n00: number,
        n01: number,
        n02: number,
        n10: number,
        n11: number,
        n12: number,
        n20: number,
        n21: number,
        n22: number,
        x: number,
        y: number,
        z: number,
    ):
        """A matrix times a vector."""
        return (
            fma(n00, x, fma(n01, y, times(n02, z))),
            fma(n10, x, fma(n11, y, times(n12, z))),
            fma(n20, x, fma(n21, y, times(n22, z))),
        )

    @wp.func
    def covers_pixel(mean: number, extent: number, size: float):
        """Mask: a pixel center of a row of ``size`` pixels lies within ``extent`` of ``mean``."""
        first = wp.max(rounded_up(mean - extent - fill(0.5, mean)), fill(0.0, mean))
        last = wp.min(rounded_down(mean + extent - fill(0.5, mean)), fill(size - 1.0, mean))
        return fill(1.0, mean) - less(last, first)

    @wp.func_grad(covers_pixel)
    def adj_covers_pixel(mean: number, extent: number, size: float, adj_ret: number):
        pass

    @wp.func
    def offset(camera: CameraView, here: number, x: number, y: number, z: number):
        """From the camera's center; from the world's origin in place of what is left out."""
        none = fill(0.0, x)
        return (
            (pick(here, x, none) - fill(camera.center[0], x)) - fill(camera.center_low[0], x),
            (pick(here, y, none) - fill(camera.center[1], x)) - fill(camera.center_low[1], x),
            (pick(here, z, none) - fill(camera.center[2], x)) - fill(camera.center_low[2], x),
        )

    @wp.func
    def turned_or_not(here: number, w: number, x: number, y: number, z: number, size: number):
        """A quaternion and its largest entry; one that turns nothing in place of what is left out."""
        one = fill(1.0, x)
        none = fill(0.0, x)
        return pick(here, w, one), pick(here, x, none), pick(here, y, none), pick(here, z, none), pick(here, size, one)

    @wp.func
    def sized_or_one(here: number, x: number, y: number, z: number):
        """Scales; ones in place of what is left out."""
        one = fill(1.0, x)
        return pick(here, x, one), pick(here, y, one), pick(here, z, one)

    return Pieces(largest, all_finite, rotation, taken_along, covers_pixel, offset, turned_or_not, sized_or_one)

"""How far a Gaussian reaches in the image, and whether that meets the center of a pixel: without gradients."""

import warp as wp

from warp_splat.kernels.falloff import in_each_lane
from warp_splat.kernels.inline import without_gradient
from warp_splat.kernels.simd import TYPES, fill, fma, less, root, rounded_down, rounded_up, times


def make_extent(reach_of: wp.Function, lanes: int) -> tuple[wp.Function, wp.Function]:
    """The box and the circle around what is at least ``alpha_min``, and whether a side of the box covers a pixel.

    ``reach_of`` says where the falloff ends.
    """
    number = TYPES[lanes][0]
    reaches = in_each_lane(reach_of) if lanes > 1 else reach_of

    @without_gradient(number, number, number)
    def support(opacity: number, alpha_min: float, xx: number, xy: number, yy: number):
        """Half sides of the box where alpha >= alpha_min, its farthest point's distance, rounded up [px]."""
        reach = reaches(opacity, alpha_min)
        widest = (xx + yy + root(fma(xx - yy, xx - yy, times(xy, xy) * 4.0))) * 0.5  # variance of the long axis
        return (
            root(times(reach, xx)),
            root(times(reach, yy)),
            wp.min(rounded_up(root(times(reach, widest))), fill(1.0e9, opacity)),
        )

    @without_gradient(number)
    def covers_pixel(mean: number, extent: number, size: float):
        """Mask: a pixel center of a row of ``size`` pixels lies within ``extent`` of ``mean``."""
        first = wp.max(rounded_up(mean - extent - fill(0.5, mean)), fill(0.0, mean))
        last = wp.min(rounded_down(mean + extent - fill(0.5, mean)), fill(size - 1.0, mean))
        return fill(1.0, mean) - less(last, first)

    return support, covers_pixel

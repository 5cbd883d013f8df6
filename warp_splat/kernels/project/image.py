"""The image of a Gaussian: where it lies, its covariance there, its opacity. A part of the kernels that need it.

With A = J W R S (2 x 3, rows a1, a2; J the derivative of the lens at the mean, W the camera's rotation, R S the
Gaussian's rotation and scales), the projected covariance is A A' + e I, e = ``blur``. Its determinant is computed as

    |a1 x a2|^2 + e (|a1|^2 + |a2|^2) + e^2,

a sum of positive terms: the usual a c - b^2 loses every digit for needles. No dynamic loop.
"""

from collections.abc import Callable

import warp as wp

from warp_splat.config import COMPENSATION_MIN
from warp_splat.kernels.project import Projection
from warp_splat.kernels.project.camera_view import turn
from warp_splat.kernels.project.pieces import covariance
from warp_splat.kernels.simd import fill, fma, less, over, pick, root, times


def parts_of_image(projection: Projection, lanes: int) -> dict[str, Callable]:
    """By name: what puts a Gaussian into the image, and what that is put together from (:mod:`.pieces`)."""
    lens, outline = projection.functions(lanes)

    def image(camera, x, y, z, m00, m01, m02, m10, m11, m12, m20, m21, m22, sx, sy, sz, opacity, here):
        """Mean [px], covariance and determinant, opacity after antialiasing, and whether there is an outline.

        Of a Gaussian at x, y, z in the camera, with the matrix m of its quaternion and its scales.
        """
        one = fill(1.0, here)
        px, py, j00, j01, j02, j10, j11, j12 = lens(camera, x, y, z)
        # a1, a2; scaled last, or needles would lose digits of the scales' gradients
        a10 = times(sx, fma(j00, m00, fma(j01, m10, times(j02, m20))))
        a11 = times(sy, fma(j00, m01, fma(j01, m11, times(j02, m21))))
        a12 = times(sz, fma(j00, m02, fma(j01, m12, times(j02, m22))))
        a20 = times(sx, fma(j10, m00, fma(j11, m10, times(j12, m20))))
        a21 = times(sy, fma(j10, m01, fma(j11, m11, times(j12, m21))))
        a22 = times(sz, fma(j10, m02, fma(j11, m12, times(j12, m22))))
        drawn = here
        if wp.static(projection.outline is not None):
            r20 = turn(camera, 2, 0, one)
            r21 = turn(camera, 2, 1, one)
            r22 = turn(camera, 2, 2, one)
            t0 = fma(r20, m00, fma(r21, m10, times(r22, m20)))
            t1 = fma(r20, m01, fma(r21, m11, times(r22, m21)))
            t2 = fma(r20, m02, fma(r21, m12, times(r22, m22)))
            px, py, a10, a11, a12, a20, a21, a22, drawn = outline(
                camera, z, px, py, a10, a11, a12, a20, a21, a22, t0, t1, t2, sx, sy, sz, drawn
            )
        xx, xy, yy, sharp = covariance(a10, a11, a12, a20, a21, a22)
        blur = fill(camera.blur, one)
        det = fma(blur, xx + yy, fma(blur, blur, sharp))
        xx = xx + blur
        yy = yy + blur
        shown = pick(drawn, opacity, one)
        if camera.antialiasing != 0:  # before any test of the opacity
            least = fill(COMPENSATION_MIN, one)
            share = over(sharp, det)
            shown = times(shown, root(pick(less(least, share), share, least)))
        return px, py, xx, xy, yy, det, shown, drawn

    return {"image": image, "lens": lens, "covariance": covariance} | ({"outline": outline} if outline else {})

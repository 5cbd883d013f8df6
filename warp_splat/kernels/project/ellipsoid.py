"""The exact outline of the ellipsoid x' Sigma^-1 x = k^2 instead of the Gaussian (Qi, Cai and Han 2024, with k = 3).

It follows from its dual conic, K (k^2 Sigma - p p') K' for a center p. With a3 = k / z (third row of W R S) and
r = 1 - |a3|^2 that is, without a difference of large numbers,

    the mean moved by -(a1 a3, a2 a3) k / r
    the covariance, divided by k^2, A (I - a3 a3')^-1 A' / r
    hence the rows of A (a_i + (a_i a3) / (r + sqrt(r)) a3) / sqrt(r)

We take k = 2. Against the volume (benchmarks/volume.py) its footprint is better than the affine one by 4 to 7 dB,
that of k = 3 worse by 1 to 6.
"""

import warp as wp

from warp_splat.config import OUTLINE, OUTLINE_REACH
from warp_splat.kernels.compiler import once
from warp_splat.kernels.project import Projection
from warp_splat.kernels.project.affine import make_pinhole
from warp_splat.kernels.project.camera_view import CameraView
from warp_splat.kernels.simd import TYPES, fill, fma, func_of, less, over, pick, root, times

LEAST_REST = wp.constant(1.0 - (OUTLINE / OUTLINE_REACH) ** 2)


def make_lens(lanes: int) -> wp.Function:
    """The pinhole camera; the outline needs no limits of the slopes."""
    return make_pinhole(lanes, limited=False)


@once
def make_outline(lanes: int) -> wp.Function:
    """The mean and the rows of A that belong to the outline."""

    @func_of(TYPES[lanes].number, camera=CameraView)
    def outline(camera, z, px, py, a10, a11, a12, a20, a21, a22, t0, t1, t2, sx, sy, sz, drawn):
        one = fill(1.0, z)
        k = fill(OUTLINE, z)
        k_per_z = over(k, z)
        a30 = times(times(k_per_z, sx), t0)
        a31 = times(times(k_per_z, sy), t1)
        a32 = times(times(k_per_z, sz), t2)
        rest = one - (fma(a30, a30, fma(a31, a31, times(a32, a32))))
        has_outline = times(drawn, less(fill(LEAST_REST, z), rest))
        rest = pick(has_outline, rest, one)
        shift1 = fma(a10, a30, fma(a11, a31, times(a12, a32)))
        shift2 = fma(a20, a30, fma(a21, a31, times(a22, a32)))
        along_x = times(over(k, rest), shift1)
        along_y = times(over(k, rest), shift2)
        shrink = root(rest)
        shift1 = over(shift1, rest + shrink)
        shift2 = over(shift2, rest + shrink)
        return (
            px - along_x,
            py - along_y,
            over(fma(shift1, a30, a10), shrink),
            over(fma(shift1, a31, a11), shrink),
            over(fma(shift1, a32, a12), shrink),
            over(fma(shift2, a30, a20), shrink),
            over(fma(shift2, a31, a21), shrink),
            over(fma(shift2, a32, a22), shrink),
            has_outline,
        )

    return outline


PROJECTION = Projection(make_lens, make_outline)

"""The adjoint of the projection where a lens's coefficients are learned: it finds their gradients beside all others.

Each group of Gaussians has coefficients of its own here, so that no two write into one place. All are the same ones;
what Warp's adjoint finds for each is summed outside. Only the adjoint is ever launched, after
:func:`.shared.make_project`, and what it finds for the Gaussians is what that kernel's adjoint does, bit for bit. A
kernel for the coefficients alone, as first tried, took as long again as projection and adjoint.
"""

import functools

import warp as wp

from warp_splat.kernels.columns import columns, rows
from warp_splat.kernels.compiler import DIFFERENTIABLE
from warp_splat.kernels.inline import kernel_of_parts
from warp_splat.kernels.project import Projection
from warp_splat.kernels.project.camera_view import CameraView, turn
from warp_splat.kernels.project.image import make_image, parts_of_image
from warp_splat.kernels.project.pieces import make_pieces
from warp_splat.kernels.simd import TYPES, fill, fma, inverse, less, pick, real, root, some, times


@functools.cache
def make_bend(projection: Projection, lanes: int) -> wp.Kernel:
    """Of ``lanes`` Gaussians at once, by a projection that is learned."""
    number, integer, row2, row3, row4 = TYPES[lanes]
    pieces, image = make_pieces(lanes), make_image(projection, lanes)
    largest, offset, rotation = pieces.largest, pieces.offset, pieces.rotation
    turned_or_not, sized_or_one = pieces.turned_or_not, pieces.sized_or_one
    parts = {"offset": offset, "rotation": rotation, "image": image}
    parts |= {"turned_or_not": turned_or_not, "sized_or_one": sized_or_one} | parts_of_image(projection, lanes)

    @kernel_of_parts(DIFFERENTIABLE, **parts)
    def bend(
        first: int,  # group of Gaussians of this slice
        camera: CameraView,
        coefficients: wp.array2d[float],  # [N / lanes, K] of the lens's formula
        means: wp.array[row3],  # [N / lanes] world
        quats: wp.array[row4],  # [N / lanes] wxyz, any norm
        scales: wp.array[row3],  # [N / lanes] world
        opacities: wp.array[number],  # [N / lanes] 0..1
        radii: wp.array[integer],  # [N / lanes] px, above 0 where the Gaussian is drawn
        # out
        means2d_out: wp.array[row2],  # [N / lanes] px
        conics_out: wp.array[row3],  # [N / lanes] 1/px^2
        opacities_out: wp.array[number],  # [N / lanes] after antialiasing
        depths_out: wp.array[number],  # [N / lanes]
    ):
        g = first + wp.tid()
        opacity = opacities[g]
        zero = fill(0.0, opacity)
        one = fill(1.0, opacity)
        here = less(zero, real(radii[g]))
        if not some(here):
            return
        mx, my, mz = columns(means[g])
        qw, qx, qy, qz = columns(quats[g])
        sx, sy, sz = columns(scales[g])
        size = largest(qw, qx, qy, qz)
        ox, oy, oz = offset(camera, here, mx, my, mz)
        r20 = turn(camera, 2, 0, one)
        r21 = turn(camera, 2, 1, one)
        r22 = turn(camera, 2, 2, one)
        depth = fma(r20, ox, fma(r21, oy, times(r22, oz)))
        if wp.static(projection.wide):
            depth = root(fma(ox, ox, fma(oy, oy, times(oz, oz))))
        z = pick(here, depth, one)
        if wp.static(projection.wide):
            z = fma(r20, ox, fma(r21, oy, times(r22, oz)))
        qw, qx, qy, qz, size = turned_or_not(here, qw, qx, qy, qz, size)
        m00, m01, m02, m10, m11, m12, m20, m21, m22 = rotation(qw, qx, qy, qz, size)
        sx, sy, sz = sized_or_one(here, sx, sy, sz)
        x = fma(turn(camera, 0, 0, one), ox, fma(turn(camera, 0, 1, one), oy, times(turn(camera, 0, 2, one), oz)))
        y = fma(turn(camera, 1, 0, one), ox, fma(turn(camera, 1, 1, one), oy, times(turn(camera, 1, 2, one), oz)))
        px, py, xx, xy, yy, det, opacity, here = image(
            camera, x, y, z, m00, m01, m02, m10, m11, m12, m20, m21, m22, sx, sy, sz, opacity, here
        )
        means2d_out[g] = rows(pick(here, px, zero), pick(here, py, zero))
        per_det = inverse(det)
        conics_out[g] = rows(
            pick(here, times(yy, per_det), zero),
            pick(here, times(-xy, per_det), zero),
            pick(here, times(xx, per_det), zero),
        )
        opacities_out[g] = pick(here, opacity, zero)
        depths_out[g] = pick(here, depth, zero)

    return bend

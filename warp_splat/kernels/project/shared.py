"""The kernel of all projections: a Gaussian's mean, conic, opacity and extent in the image. Its adjoint is Warp's.

Here is what decides, in :mod:`.image` the mathematics. Written out in numbers, because a number may be sixteen: a third
of the time of vectors and matrices of one Gaussian. Tried:

- columns instead of rows in memory: no processor reads ahead in sixty places at once
- a function for the products of three: an adjoint of 12.9 ms instead of 8.2
- names of vectors of their own: LLVM leaves them as calls
- 32 Gaussians: they do not become vectors
- zeros written here instead of by the caller: the adjoint reads them, and gains nothing
"""

import warp as wp

from warp_splat.kernels.columns import columns, rows
from warp_splat.kernels.compiler import DIFFERENTIABLE, once
from warp_splat.kernels.inline import kernel_of_parts, without_gradient
from warp_splat.kernels.project import Projection
from warp_splat.kernels.project.camera_view import CameraView, turn
from warp_splat.kernels.project.extent import make_extent
from warp_splat.kernels.project.image import parts_of_image
from warp_splat.kernels.project.pieces import all_finite, offset, rotation, sized_or_one, taken_along, turned_or_not
from warp_splat.kernels.simd import TYPES, equal, fill, fma, inverse, less, pick, real, root, some, times, whole

UNSEEN = wp.constant(1)  # what radii hold before the forward pass
INVALID = wp.constant(-1)  # not finite, as an input or when projected, or a quaternion of zero


@once
def make_project(projection: Projection, reach_of: wp.Function, lanes: int, expose: wp.Function | None) -> wp.Kernel:
    """The geometry of ``lanes`` Gaussians at once: 16 on a CPU, 1 on a GPU.

    ``reach_of`` says where their falloff ends (:mod:`warp_splat.kernels.falloff`). ``expose``: the camera moves while
    its rows are read (:mod:`.rolling`).

    Of a projection that is learned, only the adjoint is launched, after the forward pass of the one that is not. Its
    kernel takes the lens's coefficients behind ``first``, one row for each group, so that no two write into one place.
    What Warp's adjoint finds for each is summed outside. Tried: a kernel for the coefficients alone, which takes as
    long again as projection and adjoint.
    """
    number, integer, row2, row3, row4 = TYPES[lanes]
    turns = wp.array2d[row4] if expose else wp.array[row4]

    support, covers_pixel = make_extent(reach_of, lanes)
    parts = {"all_finite": all_finite, "offset": offset, "turned_or_not": turned_or_not, "rotation": rotation}
    parts |= {"taken_along": taken_along, "sized_or_one": sized_or_one} | parts_of_image(projection, lanes)
    image = parts["image"]

    @without_gradient(number)
    def largest(a: number, b: number, c: number, d: number):
        """The largest magnitude; no gradient, since it chooses a factor that normalization takes out again."""
        return wp.max(wp.max(wp.max(a, -a), wp.max(b, -b)), wp.max(wp.max(c, -c), wp.max(d, -d)))

    @kernel_of_parts(DIFFERENTIABLE, **parts)
    def project(
        first: int,  # group of Gaussians of this slice
        camera: CameraView,
        means: wp.array[row3],  # [N / lanes] world
        quats: turns,  # [N / lanes] wxyz, any norm; with a shutter [N / lanes, 3], for `expose`
        scales: wp.array[row3],  # [N / lanes] world
        opacities: wp.array[number],  # [N / lanes] 0..1
        # out: zero where culled; the caller clears them, all but the radii
        means2d_out: wp.array[row2],  # [N / lanes] px
        conics_out: wp.array[row3],  # [N / lanes] 1/px^2, (xx, xy, yy)
        opacities_out: wp.array[number],  # [N / lanes] after antialiasing
        depths_out: wp.array[number],  # [N / lanes] z in the camera
        extents_out: wp.array[row2],  # [N / lanes] px, half sides of the box where alpha >= alpha_min
        radii_out: wp.array[integer],  # [N / lanes] px, farthest such point; 0 (culled), INVALID if not; read first
    ):
        g = first + wp.tid()
        mx, my, mz = columns(means[g])
        if wp.static(expose is None):
            qw, qx, qy, qz = columns(quats[g])
        else:
            qw, qx, qy, qz = columns(quats[g, 0])
        sx, sy, sz = columns(scales[g])
        opacity = opacities[g]
        zero = fill(0.0, opacity)
        one = fill(1.0, opacity)
        finite = all_finite(mx, my, mz, qw, qx, qy, qz, sx, sy, sz, opacity)
        size = largest(qw, qx, qy, qz)
        valid = times(finite, less(zero, size))
        # the adjoint skips what the forward pass left out: no work, and no 0 times infinity
        here = times(valid, less(zero, real(radii_out[g])))
        radii_out[g] = whole(valid - one)  # 0 or INVALID
        ox, oy, oz = offset(camera, here, mx, my, mz)
        if wp.static(expose is not None):
            ox, oy, oz, n00, n01, n02, n10, n11, n12, n20, n21, n22 = expose(camera, quats, g, ox, oy, oz)
        r20 = turn(camera, 2, 0, one)
        r21 = turn(camera, 2, 1, one)
        r22 = turn(camera, 2, 2, one)
        depth = fma(r20, ox, fma(r21, oy, times(r22, oz)))
        if wp.static(projection.wide):
            depth = root(fma(ox, ox, fma(oy, oy, times(oz, oz))))
        here = times(here, less(fill(camera.near, one), depth))
        if not some(here):
            return
        # harmless numbers take the place of those that are left out
        z = pick(here, depth, one)
        if wp.static(projection.wide):
            z = fma(r20, ox, fma(r21, oy, times(r22, oz)))
        qw, qx, qy, qz, size = turned_or_not(here, qw, qx, qy, qz, size)
        m00, m01, m02, m10, m11, m12, m20, m21, m22 = rotation(qw, qx, qy, qz, size)
        if wp.static(expose is not None):
            m00, m10, m20 = taken_along(n00, n01, n02, n10, n11, n12, n20, n21, n22, m00, m10, m20)
            m01, m11, m21 = taken_along(n00, n01, n02, n10, n11, n12, n20, n21, n22, m01, m11, m21)
            m02, m12, m22 = taken_along(n00, n01, n02, n10, n11, n12, n20, n21, n22, m02, m12, m22)
        sx, sy, sz = sized_or_one(here, sx, sy, sz)
        x = fma(turn(camera, 0, 0, one), ox, fma(turn(camera, 0, 1, one), oy, times(turn(camera, 0, 2, one), oz)))
        y = fma(turn(camera, 1, 0, one), ox, fma(turn(camera, 1, 1, one), oy, times(turn(camera, 1, 2, one), oz)))
        px, py, xx, xy, yy, det, opacity, here = image(
            camera, x, y, z, m00, m01, m02, m10, m11, m12, m20, m21, m22, sx, sy, sz, opacity, here
        )
        bounded = equal(times(det, zero), zero)  # else too large for float32 numbers, about 4e9 px
        code = valid - one - times(here, one - bounded)
        radii_out[g] = whole(code)
        here = times(times(here, bounded), one - less(opacity, fill(camera.alpha_min, one)))
        extent_x, extent_y, farthest = support(opacity, camera.alpha_min, xx, xy, yy)
        inside = times(covers_pixel(px, extent_x, camera.size[0]), covers_pixel(py, extent_y, camera.size[1]))
        here = times(here, inside)
        if not some(here):
            return
        means2d_out[g] = rows(pick(here, px, zero), pick(here, py, zero))
        per_det = inverse(det)
        conics_out[g] = rows(
            pick(here, times(yy, per_det), zero),
            pick(here, times(-xy, per_det), zero),
            pick(here, times(xx, per_det), zero),
        )
        opacities_out[g] = pick(here, opacity, zero)
        depths_out[g] = pick(here, depth, zero)
        extents_out[g] = rows(pick(here, extent_x, zero), pick(here, extent_y, zero))
        radii_out[g] = whole(pick(here, farthest, code))

    return project

"""EWA splatting with an affine camera (Zwicker et al. 2001; Kerbl et al. 2023, eq. 5): linearized at the mean."""

import warp as wp

from warp_splat.kernels.compiler import once
from warp_splat.kernels.project import Projection, lens
from warp_splat.kernels.project.camera_view import CameraView, turn
from warp_splat.kernels.simd import TYPES, fill, fma, inverse, less, over, pick, times


@once
def make_pinhole(lanes: int, limited: bool = True) -> wp.Function:
    """The pinhole camera; ``limited``: its derivative far outside the image is that at the limits of the slopes."""
    number = TYPES[lanes].number

    @wp.func
    def pinhole(camera: CameraView, x: number, y: number, z: number):
        fx = fill(camera.focal[0], z)
        fy = fill(camera.focal[1], z)
        u = over(x, z)
        v = over(y, z)
        px = fma(fx, u, fill(camera.principal[0], z))
        py = fma(fy, v, fill(camera.principal[1], z))
        if wp.static(limited):  # there the linearization is worthless
            u_min = fill(camera.slope_min[0], z)
            u_max = fill(camera.slope_max[0], z)
            v_min = fill(camera.slope_min[1], z)
            v_max = fill(camera.slope_max[1], z)
            u = pick(less(u, u_min), u_min, pick(less(u_max, u), u_max, u))
            v = pick(less(v, v_min), v_min, pick(less(v_max, v), v_max, v))
        per_z = inverse(z)
        kx = times(fx, per_z)
        ky = times(fy, per_z)
        return (
            px,
            py,
            times(kx, turn(camera, 0, 0, z) - times(u, turn(camera, 2, 0, z))),
            times(kx, turn(camera, 0, 1, z) - times(u, turn(camera, 2, 1, z))),
            times(kx, turn(camera, 0, 2, z) - times(u, turn(camera, 2, 2, z))),
            times(ky, turn(camera, 1, 0, z) - times(v, turn(camera, 2, 0, z))),
            times(ky, turn(camera, 1, 1, z) - times(v, turn(camera, 2, 1, z))),
            times(ky, turn(camera, 1, 2, z) - times(v, turn(camera, 2, 2, z))),
        )

    return pinhole


through = lens.through  # a lens with distortion
PROJECTION = Projection(make_pinhole)

"""The gradient of the camera, as sums over what the adjoint of the projection has found for each Gaussian.

The geometry depends on the offset o from the camera's center and on the Gaussian's axes, both as the camera sees them;
colors on o in the world. So a turn of the world about the camera and a shift of the world have the gradients

    turn    sum o x g + Im(h q*) / 2    g: of the mean, without what came through its color; q, h: quaternion, its own
    shift   sum g + what came through the color

The offset from the principal point and the rows of A (:mod:`.shared`) are proportional to the focal lengths. So the
conic C = (A A' + e I)^-1 says all, without a difference of large numbers. With D = diag(1, 0) for fx, diag(0, 1) for fy

    fx dC/dfx        = 2 e C D C - (C D + D C)
    fx dopacity/dfx  = e C_xx opacity    under antialiasing

That holds for every projection and every lens whose limits and coefficients stay as they are.
"""

from typing import Any

import warp as wp

from warp_splat.config import COMPENSATION_MIN
from warp_splat.kernels.columns import columns
from warp_splat.kernels.compiler import FORWARD_ONLY, once
from warp_splat.kernels.project.camera_view import CameraView
from warp_splat.kernels.simd import TYPES, equal, fill, fma, inner, less, pick, root, times


@wp.func
def total_where(mask: Any, x: Any):
    """Sum over the lanes where a mask is set."""
    return inner(pick(mask, x, fill(0.0, x)), fill(1.0, x))


@once
def make_adj_pose(lanes: int) -> wp.Kernel:
    """Of ``lanes`` Gaussians at once."""
    number, _integer, _row2, row3, row4 = TYPES[lanes]

    @wp.func
    def cross(ax: number, ay: number, az: number, bx: number, by: number, bz: number):
        return times(ay, bz) - times(az, by), times(az, bx) - times(ax, bz), times(ax, by) - times(ay, bx)

    @wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
    def adj_pose(
        first: int,  # group of Gaussians of this slice
        camera: CameraView,
        means: wp.array[row3],  # [N / lanes] world
        quats: wp.array[row4],  # [N / lanes] wxyz, any norm
        adj_means: wp.array[row3],  # [N / lanes]
        adj_placed: wp.array[row3],  # [N / lanes] the part that did not come through colors
        adj_quats: wp.array[row4],  # [N / lanes]
        # out
        sums_out: wp.array2d[float],  # [N / lanes, 6] of the group: turn, shift; in the world's axes
    ):
        g = first + wp.tid()
        x, y, z = columns(means[g])
        ox = (x - fill(camera.center[0], x)) - fill(camera.center_low[0], x)
        oy = (y - fill(camera.center[1], x)) - fill(camera.center_low[1], x)
        oz = (z - fill(camera.center[2], x)) - fill(camera.center_low[2], x)
        gx, gy, gz = columns(adj_placed[g])
        turn_x, turn_y, turn_z = cross(ox, oy, oz, gx, gy, gz)
        qw, qx, qy, qz = columns(quats[g])
        hw, hx, hy, hz = columns(adj_quats[g])
        axes_x, axes_y, axes_z = cross(qx, qy, qz, hx, hy, hz)
        half = fill(0.5, x)
        turn_x = fma(half, times(qw, hx) - times(hw, qx) + axes_x, turn_x)
        turn_y = fma(half, times(qw, hy) - times(hw, qy) + axes_y, turn_y)
        turn_z = fma(half, times(qw, hz) - times(hw, qz) + axes_z, turn_z)
        gx, gy, gz = columns(adj_means[g])
        zero = fill(0.0, x)
        finite = equal(times(turn_x + turn_y + turn_z + gx + gy + gz, zero), zero)
        sums_out[g, 0] = total_where(finite, turn_x)
        sums_out[g, 1] = total_where(finite, turn_y)
        sums_out[g, 2] = total_where(finite, turn_z)
        sums_out[g, 3] = total_where(finite, gx)
        sums_out[g, 4] = total_where(finite, gy)
        sums_out[g, 5] = total_where(finite, gz)

    return adj_pose


@once
def make_adj_intrinsics(lanes: int) -> wp.Kernel:
    """Of ``lanes`` Gaussians at once."""
    number, _integer, row2, row3, _row4 = TYPES[lanes]

    @wp.func
    def stretch(camera: CameraView, xx: number, xy: number, adj_xx: number, adj_xy: number, adj_yy: number):
        """What the conic says of a longer focal length along x."""
        one = fill(1.0, xx)
        blur_xx = times(fill(2.0 * camera.blur, xx), xx)
        blur_xy = times(fill(2.0 * camera.blur, xx), xy)
        return fma(
            times(adj_xx, xx),
            blur_xx - one - one,
            fma(times(adj_xy, xy), blur_xx - one, times(times(adj_yy, xy), blur_xy)),
        )

    @wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
    def adj_intrinsics(
        first: int,  # group of Gaussians of this slice
        camera: CameraView,
        opacities: wp.array[number],  # [N / lanes] before antialiasing
        means2d: wp.array[row2],  # [N / lanes] px
        conics: wp.array[row3],  # [N / lanes] 1/px^2
        opacities2d: wp.array[number],  # [N / lanes]
        adj_means2d: wp.array[row2],  # [N / lanes]
        adj_conics: wp.array[row3],  # [N / lanes]
        adj_opacities2d: wp.array[number],  # [N / lanes]
        # out
        sums_out: wp.array2d[float],  # [N / lanes, 4] of the group: fx and fy times their gradients, cx, cy
    ):
        g = first + wp.tid()
        px, py = columns(means2d[g])
        xx, xy, yy = columns(conics[g])
        adj_px, adj_py = columns(adj_means2d[g])
        adj_xx, adj_xy, adj_yy = columns(adj_conics[g])
        along_x = fma(adj_px, px - fill(camera.principal[0], px), stretch(camera, xx, xy, adj_xx, adj_xy, adj_yy))
        along_y = fma(adj_py, py - fill(camera.principal[1], px), stretch(camera, yy, xy, adj_yy, adj_xy, adj_xx))
        zero = fill(0.0, px)
        if camera.antialiasing != 0:
            opacity = opacities2d[g]
            free = less(times(opacities[g], root(fill(COMPENSATION_MIN, px))), opacity)
            fainter = pick(free, times(times(fill(camera.blur, px), opacity), adj_opacities2d[g]), zero)
            along_x = fma(fainter, xx, along_x)
            along_y = fma(fainter, yy, along_y)
        seen = times(less(zero, xx), equal(times(along_x + along_y + adj_px + adj_py, zero), zero))
        sums_out[g, 0] = total_where(seen, along_x)
        sums_out[g, 1] = total_where(seen, along_y)
        sums_out[g, 2] = total_where(seen, adj_px)
        sums_out[g, 3] = total_where(seen, adj_py)

    return adj_intrinsics

"""From 3D Gaussians to 2D ones: EWA splatting with an affine camera (Zwicker et al. 2001; Kerbl et al. 2023, eq. 5).

With A = J W R S (2 x 3, rows a1, a2; J the Jacobian of the projection at the mean, W the camera's rotation, R S the
Gaussian's rotation and scales), the projected covariance is A A' + e I, e = BLUR. Its determinant is computed as

    |a1 x a2|^2 + e (|a1|^2 + |a2|^2) + e^2,

a sum of positive terms: the usual a c - b^2 loses every digit for needles. No dynamic loop: the adjoint is Warp's.
Tried: sixteen Gaussians in lanes, as in the blends; 330 lines to turn rows into columns and back, for 14 -> 11 and
33 -> 25 ms of a step of 245 (195,000 Gaussians, degree 3): what limits both is reading and adding up rows of SH.
Tried: SH of a degree as one matrix, its product with the basis Warp's; the adjoint takes 10 % longer. Without the SLP
vectoriser 15 % longer; regrouping of sums changes nothing.

The exact outline of the ellipsoid x' Sigma^-1 x = k^2 instead (Qi, Cai and Han 2024, with k = 3) follows from its
dual conic, K (k^2 Sigma - p p') K' for a centre p. With a3 = k / z (third row of W R S) and r = 1 - |a3|^2 that is,
without a difference of large numbers, the mean moved by -(a1 a3, a2 a3) k / r and, divided by k^2, the covariance
A (I - a3 a3')^-1 A' / r: rows a_i become (a_i + (a_i a3) / (r + sqrt(r)) a3) / sqrt(r). We take k = 2: against the
volume (warp_splat.compare.volume) its footprint is better than the affine one by 4 to 8 dB, that of k = 3 worse by 1
to 6.
"""

import warp as wp

from warp_splat.config import BLUR, COMPENSATION_MIN, NEAR, OUTLINE, OUTLINE_REACH
from warp_splat.kernels.blend import reach_of
from warp_splat.kernels.build import DIFFERENTIABLE
from warp_splat.kernels.harmonics import evaluate_sh

wp.set_module_options(DIFFERENTIABLE)

UNSEEN = wp.constant(1)  # what radii hold before the forward pass
CULLED = wp.constant(0)
INVALID = wp.constant(-1)  # not finite, as an input or when projected, or a quaternion of zero


@wp.struct
class CameraView:
    """What the kernels need of a camera and its options."""

    rotation: wp.mat33  # camera_from_world
    center: wp.vec3  # world
    center_low: wp.vec3  # what float32 cut off the center: far from the origin, all of the accuracy
    focal: wp.vec2  # px
    principal: wp.vec2  # px
    size: wp.vec2  # px, (W, H)
    slope_min: wp.vec2  # clamp of (x/z, y/z) in the Jacobian
    slope_max: wp.vec2
    sh_degree: int
    antialiasing: int
    ellipsoid: int  # 1: outline of the ellipsoid instead of the affine projection
    alpha_min: float


@wp.func
def largest(quat: wp.vec4):
    """Largest entry, without a gradient: what is divided by it is normalized afterwards."""
    return wp.max(wp.max(wp.abs(quat)), 1.0e-37)


@wp.func_grad(largest)
def adj_largest(quat: wp.vec4, adj_ret: float):
    pass


@wp.func
def rotation_matrix(quat: wp.vec4):
    """Rotation of a quaternion (w, x, y, z) of any norm but 0; scaled first, so that denormals keep their direction."""
    q = wp.normalize(quat * (1.0 / largest(quat)))
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@wp.func
def support(opacity: float, alpha_min: float, xx: float, xy: float, yy: float):
    """Half sides of the box where alpha >= alpha_min, and the distance of its farthest point [px]; no gradient."""
    reach = reach_of(opacity, alpha_min)
    widest = 0.5 * (xx + yy + wp.length(wp.vec2(xx - yy, 2.0 * xy)))  # variance of the long axis
    return wp.vec3(wp.sqrt(reach * xx), wp.sqrt(reach * yy), wp.sqrt(reach * widest))


@wp.func_grad(support)
def adj_support(opacity: float, alpha_min: float, xx: float, xy: float, yy: float, adj_ret: wp.vec3):
    pass


@wp.func
def covers_pixel(mean: float, extent: float, size: float):
    """Whether a pixel centre of a row of ``size`` pixels lies within ``extent`` of ``mean``."""
    first = wp.max(wp.ceil(mean - extent - 0.5), 0.0)
    return first <= wp.min(wp.floor(mean + extent - 0.5), size - 1.0)


@wp.kernel
def project(
    first: int,  # Gaussian of this slice
    camera: CameraView,
    means: wp.array[wp.vec3],  # [N] world
    quats: wp.array[wp.vec4],  # [N] wxyz, any norm
    scales: wp.array[wp.vec3],  # [N] world
    opacities: wp.array[float],  # [N] 0..1
    sh_dc: wp.array2d[wp.vec3],  # [N, 1]
    sh_rest: wp.array2d[wp.vec3],  # [N, K - 1]
    # out: zero where culled, so the caller clears them; all but the radii
    means2d_out: wp.array[wp.vec2],  # [N] px
    conics_out: wp.array[wp.vec3],  # [N] 1/px^2, (xx, xy, yy)
    opacities_out: wp.array[float],  # [N] after antialiasing
    colors_out: wp.array[wp.vec3],  # [N]
    depths_out: wp.array[float],  # [N] z in the camera
    extents_out: wp.array[wp.vec2],  # [N] px, half sides of the box where alpha >= alpha_min
    radii_out: wp.array[int],  # [N] px, farthest point where alpha >= alpha_min; CULLED, INVALID if not; read first
):
    i = first + wp.tid()
    if radii_out[i] <= 0:  # the adjoint skips what the forward pass left out: no work, and no 0 times infinity
        return
    radii_out[i] = CULLED
    mean = means[i]
    quat = quats[i]
    scale = scales[i]
    opacity = opacities[i]
    zero = wp.vec3(0.0)  # 0 times what is not finite is NaN; wp.isfinite is a call per number on the CPU
    zero_if_finite = wp.dot(mean, zero) + wp.dot(quat, wp.vec4(0.0)) + wp.dot(scale, zero) + opacity * 0.0
    if not zero_if_finite == 0.0 or quat == wp.vec4(0.0):
        radii_out[i] = INVALID
        return
    offset = (mean - camera.center) - camera.center_low
    p = camera.rotation * offset
    z = p[2]
    if not z > NEAR:
        return
    slope = wp.vec2(p[0] / z, p[1] / z)
    u = slope[0]
    v = slope[1]
    if camera.ellipsoid == 0:  # the linearization is worthless far outside the image; the outline is not
        u = wp.clamp(u, camera.slope_min[0], camera.slope_max[0])
        v = wp.clamp(v, camera.slope_min[1], camera.slope_max[1])
    toward = wp.vec3(camera.rotation[2, 0], camera.rotation[2, 1], camera.rotation[2, 2])
    j1 = (camera.focal[0] / z) * (
        wp.vec3(camera.rotation[0, 0], camera.rotation[0, 1], camera.rotation[0, 2]) - u * toward
    )
    j2 = (camera.focal[1] / z) * (
        wp.vec3(camera.rotation[1, 0], camera.rotation[1, 1], camera.rotation[1, 2]) - v * toward
    )
    axes = rotation_matrix(quat)
    a1 = wp.cw_mul(scale, j1 * axes)
    a2 = wp.cw_mul(scale, j2 * axes)
    mean2d = wp.vec2(camera.focal[0] * slope[0] + camera.principal[0], camera.focal[1] * slope[1] + camera.principal[1])
    if camera.ellipsoid != 0:
        a3 = (OUTLINE / z) * wp.cw_mul(scale, toward * axes)
        rest = 1.0 - wp.dot(a3, a3)
        if not rest > 1.0 - (OUTLINE / OUTLINE_REACH) * (OUTLINE / OUTLINE_REACH):
            return
        shift = wp.vec2(wp.dot(a1, a3), wp.dot(a2, a3))
        mean2d = mean2d - (OUTLINE / rest) * shift
        stretch = 1.0 / (rest + wp.sqrt(rest))
        a1 = (a1 + stretch * shift[0] * a3) / wp.sqrt(rest)
        a2 = (a2 + stretch * shift[1] * a3) / wp.sqrt(rest)
    area = wp.cross(a1, a2)
    xx = wp.dot(a1, a1)
    yy = wp.dot(a2, a2)
    sharp = wp.dot(area, area)
    det = sharp + BLUR * (xx + yy) + BLUR * BLUR
    if camera.antialiasing != 0:  # before any test of the opacity
        opacity = opacity * wp.sqrt(wp.max(sharp / det, COMPENSATION_MIN))
    if not det * 0.0 == 0.0:  # too large for float32 numbers, about 4e9 px
        radii_out[i] = INVALID
        return
    if not opacity >= camera.alpha_min:
        return
    xy = wp.dot(a1, a2)
    extent = support(opacity, camera.alpha_min, xx + BLUR, xy, yy + BLUR)
    if not (covers_pixel(mean2d[0], extent[0], camera.size[0]) and covers_pixel(mean2d[1], extent[1], camera.size[1])):
        return
    color = evaluate_sh(camera.sh_degree, wp.normalize(offset), sh_dc, sh_rest, i) + wp.vec3(0.5)
    if not wp.dot(color, zero) == 0.0:
        radii_out[i] = INVALID
        return
    means2d_out[i] = mean2d
    conics_out[i] = wp.vec3(yy + BLUR, -xy, xx + BLUR) / det
    opacities_out[i] = opacity
    colors_out[i] = wp.max(color, wp.vec3(0.0))
    depths_out[i] = z
    extents_out[i] = wp.vec2(extent[0], extent[1])
    radii_out[i] = int(wp.min(wp.ceil(extent[2]), 1.0e9))


@wp.kernel(enable_backward=False)
def quarantine(
    first: int,
    radii: wp.array[int],  # [N]
    # out: gradients, cleared where one of a Gaussian's is not finite
    means_out: wp.array[wp.vec3],
    quats_out: wp.array[wp.vec4],
    scales_out: wp.array[wp.vec3],
    opacities_out: wp.array[float],
    sh_dc_out: wp.array2d[wp.vec3],
    sh_rest_out: wp.array2d[wp.vec3],
    dropped_out: wp.array[int],  # [N] 1 where that happened
):
    i = first + wp.tid()
    if radii[i] > 0:
        zero = wp.vec3(0.0)
        geometry = wp.dot(means_out[i], zero) + wp.dot(quats_out[i], wp.vec4(0.0)) + wp.dot(scales_out[i], zero)
        if not geometry + opacities_out[i] * 0.0 + wp.dot(sh_dc_out[i, 0], zero) == 0.0:
            means_out[i] = wp.vec3(0.0)
            quats_out[i] = wp.vec4(0.0)
            scales_out[i] = wp.vec3(0.0)
            opacities_out[i] = 0.0
            sh_dc_out[i, 0] = wp.vec3(0.0)
            for k in range(sh_rest_out.shape[1]):
                sh_rest_out[i, k] = wp.vec3(0.0)
            dropped_out[i] = 1

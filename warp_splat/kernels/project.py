"""From 3D Gaussians to 2D ones: EWA splatting with an affine camera (Zwicker et al. 2001; Kerbl et al. 2023, eq. 5).

With A = J W R S (2 x 3, rows a1, a2; J the Jacobian of the projection at the mean, W the camera's rotation, R S the
Gaussian's rotation and scales), the projected covariance is A A' + e I, e = BLUR. Its determinant is computed as

    |a1 x a2|^2 + e (|a1|^2 + |a2|^2) + e^2,

a sum of positive terms: the usual a c - b^2 loses every digit for needles. No dynamic loop: the adjoint is Warp's.

Written out in numbers, because a number may be sixteen (:mod:`warp_splat.kernels.simd`): against vectors and
matrices of one Gaussian, 12.0 -> 3.5 ms and, the adjoint, 25.3 -> 8.2 (194,000 Gaussians, one thread); since then 2.2
and 4.2, with fewer divisions and without gradients that nobody asks for. Tried: columns instead of rows in memory,
which no processor reads ahead in sixty places at once; a function for the products of three (an adjoint of 12.9 ms);
names of vectors of their own, which LLVM leaves as calls; 32 Gaussians, which do not become vectors; zeros written here
instead of by the caller (the adjoint reads them, and gains nothing).

The exact outline of the ellipsoid x' Sigma^-1 x = k^2 instead (Qi, Cai and Han 2024, with k = 3) follows from its
dual conic, K (k^2 Sigma - p p') K' for a centre p. With a3 = k / z (third row of W R S) and r = 1 - |a3|^2 that is,
without a difference of large numbers, the mean moved by -(a1 a3, a2 a3) k / r and, divided by k^2, the covariance
A (I - a3 a3')^-1 A' / r: rows a_i become (a_i + (a_i a3) / (r + sqrt(r)) a3) / sqrt(r). We take k = 2: against the
volume (warp_splat.compare.volume) its footprint is better than the affine one by 4 to 8 dB, that of k = 3 worse by 1
to 6.
"""

import functools

import warp as wp

from warp_splat.config import BLUR, COMPENSATION_MIN, NEAR, OUTLINE, OUTLINE_REACH
from warp_splat.kernels.compiler import DIFFERENTIABLE_LANES, IN_ORDER
from warp_splat.kernels.falloff import reach_of
from warp_splat.kernels.simd import (
    LANES,
    TYPES,
    columns,
    equal,
    fill,
    inverse,
    less,
    over,
    pick,
    real,
    root,
    rounded_down,
    rounded_up,
    rows,
    some,
    times,
    vec16,
    whole,
)

wp.set_module_options(IN_ORDER)

# of a quaternion's largest entry; beyond, a power of two comes first, so that squares neither vanish nor overflow
SMALL, ENLARGED = wp.constant(2.0**-30), wp.constant(2.0**90)
LARGE, REDUCED = wp.constant(2.0**30), wp.constant(2.0**-70)
UNSEEN = wp.constant(1)  # what radii hold before the forward pass
CULLED = wp.constant(0)
LEAST_REST = wp.constant(1.0 - (OUTLINE / OUTLINE_REACH) ** 2)
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


@functools.cache
def make_project(lanes: int, reach_of: wp.Function = reach_of) -> wp.Kernel:
    """The geometry of ``lanes`` Gaussians at once: 16 on a CPU, 1 on a GPU. Its adjoint is Warp's.

    ``reach_of`` says where their falloff ends (:mod:`warp_splat.kernels.falloff`).
    """
    number, integer, row2, row3, row4 = TYPES[lanes]

    @wp.func
    def turn(camera: CameraView, row: int, column: int, like: number):
        """An entry of the camera's rotation, without a gradient, which would take a quarter of the adjoint."""
        return fill(camera.rotation[row, column], like)

    @wp.func_grad(turn)
    def adj_turn(camera: CameraView, row: int, column: int, like: number, adj_ret: number):
        pass

    @wp.func
    def largest(a: number, b: number, c: number, d: number):
        """The largest magnitude, without a gradient: it chooses a factor that normalization takes out again."""
        return wp.max(wp.max(wp.max(a, -a), wp.max(b, -b)), wp.max(wp.max(c, -c), wp.max(d, -d)))

    @wp.func_grad(largest)
    def adj_largest(a: number, b: number, c: number, d: number, adj_ret: number):
        pass

    @wp.func
    def reaches(opacity: vec16, alpha_min: float):
        """``reach_of`` in every lane."""
        r = vec16()
        for lane in range(LANES):
            r[lane] = reach_of(opacity[lane], alpha_min)
        return r

    reaches = reaches if lanes > 1 else reach_of

    @wp.func
    def support(opacity: number, alpha_min: float, xx: number, xy: number, yy: number):
        """Half sides of the box where alpha >= alpha_min, its farthest point's distance, rounded up [px]."""
        reach = reaches(opacity, alpha_min)
        widest = (xx + yy + root(times(xx - yy, xx - yy) + times(xy, xy) * 4.0)) * 0.5  # variance of the long axis
        return (
            root(times(reach, xx)),
            root(times(reach, yy)),
            wp.min(rounded_up(root(times(reach, widest))), fill(1.0e9, opacity)),
        )

    @wp.func_grad(support)
    def adj_support(
        opacity: number, alpha_min: float, xx: number, xy: number, yy: number, a: number, b: number, c: number
    ):
        pass

    @wp.func
    def covers_pixel(mean: number, extent: number, size: float):
        """Mask: a pixel centre of a row of ``size`` pixels lies within ``extent`` of ``mean``."""
        first = wp.max(rounded_up(mean - extent - fill(0.5, mean)), fill(0.0, mean))
        last = wp.min(rounded_down(mean + extent - fill(0.5, mean)), fill(size - 1.0, mean))
        return fill(1.0, mean) - less(last, first)

    @wp.func_grad(covers_pixel)
    def adj_covers_pixel(mean: number, extent: number, size: float, adj_ret: number):
        pass

    @wp.kernel(module="unique", module_options=dict(DIFFERENTIABLE_LANES))
    def project(
        first: int,  # group of Gaussians of this slice
        camera: CameraView,
        means: wp.array[row3],  # [N / lanes] world
        quats: wp.array[row4],  # wxyz, any norm
        scales: wp.array[row3],  # world
        opacities: wp.array[number],  # 0..1
        # out: zero where culled; the caller clears them, all but the radii
        means2d_out: wp.array[row2],  # px
        conics_out: wp.array[row3],  # 1/px^2, (xx, xy, yy)
        opacities_out: wp.array[number],  # after antialiasing
        depths_out: wp.array[number],  # z in the camera
        extents_out: wp.array[row2],  # px, half sides of the box where alpha >= alpha_min
        radii_out: wp.array[integer],  # px, farthest point where alpha >= alpha_min; CULLED, INVALID if not; read first
    ):
        g = first + wp.tid()
        mx, my, mz = columns(means[g])
        qw, qx, qy, qz = columns(quats[g])
        sx, sy, sz = columns(scales[g])
        opacity = opacities[g]
        zero = fill(0.0, opacity)
        one = fill(1.0, opacity)
        # 0 times what is not finite is NaN; wp.isfinite is a call per number on the CPU
        nought = times(mx, zero) + times(my, zero) + times(mz, zero) + times(opacity, zero)
        nought = nought + times(qw, zero) + times(qx, zero) + times(qy, zero) + times(qz, zero)
        finite = equal(nought + times(sx, zero) + times(sy, zero) + times(sz, zero), zero)
        size = largest(qw, qx, qy, qz)
        valid = times(finite, less(zero, size))
        # the adjoint skips what the forward pass left out: no work, and no 0 times infinity
        here = times(valid, less(zero, real(radii_out[g])))
        radii_out[g] = whole(valid - one)  # CULLED or INVALID
        ox = (pick(here, mx, zero) - fill(camera.center[0], one)) - fill(camera.center_low[0], one)
        oy = (pick(here, my, zero) - fill(camera.center[1], one)) - fill(camera.center_low[1], one)
        oz = (pick(here, mz, zero) - fill(camera.center[2], one)) - fill(camera.center_low[2], one)
        r20 = turn(camera, 2, 0, one)
        r21 = turn(camera, 2, 1, one)
        r22 = turn(camera, 2, 2, one)
        depth = times(r20, ox) + times(r21, oy) + times(r22, oz)
        here = times(here, less(fill(NEAR, one), depth))
        if not some(here):
            return
        # harmless numbers take the place of those that are left out
        z = pick(here, depth, one)
        size = pick(here, size, one)
        scale = pick(
            less(size, fill(SMALL, one)),
            fill(ENLARGED, one),
            pick(less(fill(LARGE, one), size), fill(REDUCED, one), one),
        )
        w = times(pick(here, qw, one), scale)
        x = times(pick(here, qx, zero), scale)
        y = times(pick(here, qy, zero), scale)
        q = times(pick(here, qz, zero), scale)
        per_norm = inverse(root(times(w, w) + times(x, x) + times(y, y) + times(q, q)))
        w = times(w, per_norm)
        x = times(x, per_norm)
        y = times(y, per_norm)
        q = times(q, per_norm)
        # R
        two = fill(2.0, one)
        m00 = one - times(two, times(y, y) + times(q, q))
        m01 = times(two, times(x, y) - times(w, q))
        m02 = times(two, times(x, q) + times(w, y))
        m10 = times(two, times(x, y) + times(w, q))
        m11 = one - times(two, times(x, x) + times(q, q))
        m12 = times(two, times(y, q) - times(w, x))
        m20 = times(two, times(x, q) - times(w, y))
        m21 = times(two, times(y, q) + times(w, x))
        m22 = one - times(two, times(x, x) + times(y, y))
        sx = pick(here, sx, one)
        sy = pick(here, sy, one)
        sz = pick(here, sz, one)
        # the mean in the image
        r00 = turn(camera, 0, 0, one)
        r01 = turn(camera, 0, 1, one)
        r02 = turn(camera, 0, 2, one)
        r10 = turn(camera, 1, 0, one)
        r11 = turn(camera, 1, 1, one)
        r12 = turn(camera, 1, 2, one)
        fx = fill(camera.focal[0], one)
        fy = fill(camera.focal[1], one)
        u = over(times(r00, ox) + times(r01, oy) + times(r02, oz), z)
        v = over(times(r10, ox) + times(r11, oy) + times(r12, oz), z)
        px = times(fx, u) + fill(camera.principal[0], one)
        py = times(fy, v) + fill(camera.principal[1], one)
        if camera.ellipsoid == 0:  # the linearization is worthless far outside the image; the outline is not
            u_min = fill(camera.slope_min[0], one)
            u_max = fill(camera.slope_max[0], one)
            v_min = fill(camera.slope_min[1], one)
            v_max = fill(camera.slope_max[1], one)
            u = pick(less(u, u_min), u_min, pick(less(u_max, u), u_max, u))
            v = pick(less(v, v_min), v_min, pick(less(v_max, v), v_max, v))
        # J W
        per_z = inverse(z)
        kx = times(fx, per_z)
        ky = times(fy, per_z)
        j00 = times(kx, r00 - times(u, r20))
        j01 = times(kx, r01 - times(u, r21))
        j02 = times(kx, r02 - times(u, r22))
        j10 = times(ky, r10 - times(v, r20))
        j11 = times(ky, r11 - times(v, r21))
        j12 = times(ky, r12 - times(v, r22))
        # a1, a2; scaled last, or needles would lose digits of the scales' gradients
        a10 = times(sx, times(j00, m00) + times(j01, m10) + times(j02, m20))
        a11 = times(sy, times(j00, m01) + times(j01, m11) + times(j02, m21))
        a12 = times(sz, times(j00, m02) + times(j01, m12) + times(j02, m22))
        a20 = times(sx, times(j10, m00) + times(j11, m10) + times(j12, m20))
        a21 = times(sy, times(j10, m01) + times(j11, m11) + times(j12, m21))
        a22 = times(sz, times(j10, m02) + times(j11, m12) + times(j12, m22))
        if camera.ellipsoid != 0:
            outline = fill(OUTLINE, one)
            near = over(outline, z)
            a30 = times(times(near, sx), times(r20, m00) + times(r21, m10) + times(r22, m20))
            a31 = times(times(near, sy), times(r20, m01) + times(r21, m11) + times(r22, m21))
            a32 = times(times(near, sz), times(r20, m02) + times(r21, m12) + times(r22, m22))
            rest = one - (times(a30, a30) + times(a31, a31) + times(a32, a32))
            here = times(here, less(fill(LEAST_REST, one), rest))
            rest = pick(here, rest, one)
            shift1 = times(a10, a30) + times(a11, a31) + times(a12, a32)
            shift2 = times(a20, a30) + times(a21, a31) + times(a22, a32)
            px = px - times(over(outline, rest), shift1)
            py = py - times(over(outline, rest), shift2)
            shrink = root(rest)
            shift1 = over(shift1, rest + shrink)
            shift2 = over(shift2, rest + shrink)
            a10 = over(a10 + times(shift1, a30), shrink)
            a11 = over(a11 + times(shift1, a31), shrink)
            a12 = over(a12 + times(shift1, a32), shrink)
            a20 = over(a20 + times(shift2, a30), shrink)
            a21 = over(a21 + times(shift2, a31), shrink)
            a22 = over(a22 + times(shift2, a32), shrink)
        c0 = times(a11, a22) - times(a12, a21)
        c1 = times(a12, a20) - times(a10, a22)
        c2 = times(a10, a21) - times(a11, a20)
        xx = times(a10, a10) + times(a11, a11) + times(a12, a12)
        xy = times(a10, a20) + times(a11, a21) + times(a12, a22)
        yy = times(a20, a20) + times(a21, a21) + times(a22, a22)
        sharp = times(c0, c0) + times(c1, c1) + times(c2, c2)
        blur = fill(BLUR, one)
        det = sharp + times(blur, xx + yy) + times(blur, blur)
        xx = xx + blur
        yy = yy + blur
        opacity = pick(here, opacity, one)
        if camera.antialiasing != 0:  # before any test of the opacity
            least = fill(COMPENSATION_MIN, one)
            share = over(sharp, det)
            opacity = times(opacity, root(pick(less(least, share), share, least)))
        bounded = equal(times(det, zero), zero)  # else too large for float32 numbers, about 4e9 px
        code = valid - one - times(here, one - bounded)
        radii_out[g] = whole(code)
        here = times(times(here, bounded), one - less(opacity, fill(camera.alpha_min, one)))
        extent_x, extent_y, farthest = support(opacity, camera.alpha_min, xx, xy, yy)
        here = times(
            here, times(covers_pixel(px, extent_x, camera.size[0]), covers_pixel(py, extent_y, camera.size[1]))
        )
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


@wp.kernel
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

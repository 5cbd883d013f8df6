"""From 3D Gaussians to 2D ones: EWA splatting with an affine camera (Zwicker et al. 2001; Kerbl et al. 2023, eq. 5).

With A = J W R S (2 x 3, rows a1, a2; J the Jacobian of the projection at the mean, W the camera's rotation, R S the
Gaussian's rotation and scales), the projected covariance is A A' + e I, e = BLUR. Its determinant is computed as

    |a1 x a2|^2 + e (|a1|^2 + |a2|^2) + e^2,

a sum of positive terms: the usual a c - b^2 loses every digit for needles. No dynamic loop: the adjoint is Warp's.

Written out in numbers, because a number may be sixteen (:mod:`warp_splat.kernels.numbers`): against vectors and
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
from warp_splat.kernels.numbers import make_numbers, make_rows2, make_rows3, make_rows4
from warp_splat.kernels.splat import reach_of

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
def make_project(lanes: int) -> wp.Kernel:
    """The geometry of ``lanes`` Gaussians at once: 16 on a CPU, 1 on a GPU. Its adjoint is Warp's."""
    number, integer, fill, less, equal, some, pick, root, inverse, up, down, real, whole = make_numbers(lanes)
    pair, _, join2 = make_rows2(lanes)
    triple, split3, join3 = make_rows3(lanes)
    quadruple, split4, _ = make_rows4(lanes)
    mul, div = wp.cw_mul, wp.cw_div

    @wp.func
    def turn(camera: CameraView, row: int, column: int):
        """An entry of the camera's rotation, without a gradient, which would take a quarter of the adjoint."""
        return number(camera.rotation[row, column])

    @wp.func_grad(turn)
    def adj_turn(camera: CameraView, row: int, column: int, adj_ret: number):
        pass

    @wp.func
    def largest(a: number, b: number, c: number, d: number):
        """The largest magnitude, without a gradient: it chooses a factor that normalization takes out again."""
        return wp.max(wp.max(wp.max(a, -a), wp.max(b, -b)), wp.max(wp.max(c, -c), wp.max(d, -d)))

    @wp.func_grad(largest)
    def adj_largest(a: number, b: number, c: number, d: number, adj_ret: number):
        pass

    @wp.func
    def support(opacity: number, alpha_min: float, xx: number, xy: number, yy: number):
        """Half sides of the box where alpha >= alpha_min, its farthest point's distance, rounded up [px]."""
        reach = number()
        for lane in range(lanes):
            reach[lane] = reach_of(opacity[lane], alpha_min)
        widest = (xx + yy + root(mul(xx - yy, xx - yy) + mul(xy, xy) * 4.0)) * 0.5  # variance of the long axis
        return root(mul(reach, xx)), root(mul(reach, yy)), wp.min(up(root(mul(reach, widest))), fill(1.0e9))

    @wp.func_grad(support)
    def adj_support(
        opacity: number, alpha_min: float, xx: number, xy: number, yy: number, a: number, b: number, c: number
    ):
        pass

    @wp.func
    def covers_pixel(mean: number, extent: number, size: float):
        """Mask: a pixel centre of a row of ``size`` pixels lies within ``extent`` of ``mean``."""
        first = wp.max(up(mean - extent - number(0.5)), number(0.0))
        last = wp.min(down(mean + extent - number(0.5)), number(size - 1.0))
        return number(1.0) - less(last, first)

    @wp.func_grad(covers_pixel)
    def adj_covers_pixel(mean: number, extent: number, size: float, adj_ret: number):
        pass

    @wp.kernel(module="unique", module_options=dict(DIFFERENTIABLE_LANES))
    def project(
        first: int,  # group of Gaussians of this slice
        camera: CameraView,
        means: wp.array[triple],  # [N / lanes] world
        quats: wp.array[quadruple],  # wxyz, any norm
        scales: wp.array[triple],  # world
        opacities: wp.array[number],  # 0..1
        # out: zero where culled; the caller clears them, all but the radii
        means2d_out: wp.array[pair],  # px
        conics_out: wp.array[triple],  # 1/px^2, (xx, xy, yy)
        opacities_out: wp.array[number],  # after antialiasing
        depths_out: wp.array[number],  # z in the camera
        extents_out: wp.array[pair],  # px, half sides of the box where alpha >= alpha_min
        radii_out: wp.array[integer],  # px, farthest point where alpha >= alpha_min; CULLED, INVALID if not; read first
    ):
        g = first + wp.tid()
        zero = fill(0.0)
        one = fill(1.0)
        mx, my, mz = split3(means[g])
        qw, qx, qy, qz = split4(quats[g])
        sx, sy, sz = split3(scales[g])
        opacity = opacities[g]
        # 0 times what is not finite is NaN; wp.isfinite is a call per number on the CPU
        nought = mul(mx, zero) + mul(my, zero) + mul(mz, zero) + mul(opacity, zero)
        nought = nought + mul(qw, zero) + mul(qx, zero) + mul(qy, zero) + mul(qz, zero)
        finite = equal(nought + mul(sx, zero) + mul(sy, zero) + mul(sz, zero), zero)
        size = largest(qw, qx, qy, qz)
        valid = mul(finite, less(zero, size))
        # the adjoint skips what the forward pass left out: no work, and no 0 times infinity
        here = mul(valid, less(zero, real(radii_out[g])))
        radii_out[g] = whole(valid - one)  # CULLED or INVALID
        ox = (pick(here, mx, zero) - fill(camera.center[0])) - fill(camera.center_low[0])
        oy = (pick(here, my, zero) - fill(camera.center[1])) - fill(camera.center_low[1])
        oz = (pick(here, mz, zero) - fill(camera.center[2])) - fill(camera.center_low[2])
        r20 = turn(camera, 2, 0)
        r21 = turn(camera, 2, 1)
        r22 = turn(camera, 2, 2)
        depth = mul(r20, ox) + mul(r21, oy) + mul(r22, oz)
        here = mul(here, less(fill(NEAR), depth))
        if not some(here):
            return
        # harmless numbers take the place of those that are left out
        z = pick(here, depth, one)
        size = pick(here, size, one)
        scale = pick(less(size, fill(SMALL)), fill(ENLARGED), pick(less(fill(LARGE), size), fill(REDUCED), one))
        w = mul(pick(here, qw, one), scale)
        x = mul(pick(here, qx, zero), scale)
        y = mul(pick(here, qy, zero), scale)
        q = mul(pick(here, qz, zero), scale)
        per_norm = inverse(root(mul(w, w) + mul(x, x) + mul(y, y) + mul(q, q)))
        w = mul(w, per_norm)
        x = mul(x, per_norm)
        y = mul(y, per_norm)
        q = mul(q, per_norm)
        # R
        two = fill(2.0)
        m00 = one - mul(two, mul(y, y) + mul(q, q))
        m01 = mul(two, mul(x, y) - mul(w, q))
        m02 = mul(two, mul(x, q) + mul(w, y))
        m10 = mul(two, mul(x, y) + mul(w, q))
        m11 = one - mul(two, mul(x, x) + mul(q, q))
        m12 = mul(two, mul(y, q) - mul(w, x))
        m20 = mul(two, mul(x, q) - mul(w, y))
        m21 = mul(two, mul(y, q) + mul(w, x))
        m22 = one - mul(two, mul(x, x) + mul(y, y))
        sx = pick(here, sx, one)
        sy = pick(here, sy, one)
        sz = pick(here, sz, one)
        # the mean in the image
        r00 = turn(camera, 0, 0)
        r01 = turn(camera, 0, 1)
        r02 = turn(camera, 0, 2)
        r10 = turn(camera, 1, 0)
        r11 = turn(camera, 1, 1)
        r12 = turn(camera, 1, 2)
        fx = fill(camera.focal[0])
        fy = fill(camera.focal[1])
        u = div(mul(r00, ox) + mul(r01, oy) + mul(r02, oz), z)
        v = div(mul(r10, ox) + mul(r11, oy) + mul(r12, oz), z)
        px = mul(fx, u) + fill(camera.principal[0])
        py = mul(fy, v) + fill(camera.principal[1])
        if camera.ellipsoid == 0:  # the linearization is worthless far outside the image; the outline is not
            u_min = fill(camera.slope_min[0])
            u_max = fill(camera.slope_max[0])
            v_min = fill(camera.slope_min[1])
            v_max = fill(camera.slope_max[1])
            u = pick(less(u, u_min), u_min, pick(less(u_max, u), u_max, u))
            v = pick(less(v, v_min), v_min, pick(less(v_max, v), v_max, v))
        # J W
        per_z = inverse(z)
        kx = mul(fx, per_z)
        ky = mul(fy, per_z)
        j00 = mul(kx, r00 - mul(u, r20))
        j01 = mul(kx, r01 - mul(u, r21))
        j02 = mul(kx, r02 - mul(u, r22))
        j10 = mul(ky, r10 - mul(v, r20))
        j11 = mul(ky, r11 - mul(v, r21))
        j12 = mul(ky, r12 - mul(v, r22))
        # a1, a2; scaled last, or needles would lose digits of the scales' gradients
        a10 = mul(sx, mul(j00, m00) + mul(j01, m10) + mul(j02, m20))
        a11 = mul(sy, mul(j00, m01) + mul(j01, m11) + mul(j02, m21))
        a12 = mul(sz, mul(j00, m02) + mul(j01, m12) + mul(j02, m22))
        a20 = mul(sx, mul(j10, m00) + mul(j11, m10) + mul(j12, m20))
        a21 = mul(sy, mul(j10, m01) + mul(j11, m11) + mul(j12, m21))
        a22 = mul(sz, mul(j10, m02) + mul(j11, m12) + mul(j12, m22))
        if camera.ellipsoid != 0:
            outline = fill(OUTLINE)
            near = div(outline, z)
            a30 = mul(mul(near, sx), mul(r20, m00) + mul(r21, m10) + mul(r22, m20))
            a31 = mul(mul(near, sy), mul(r20, m01) + mul(r21, m11) + mul(r22, m21))
            a32 = mul(mul(near, sz), mul(r20, m02) + mul(r21, m12) + mul(r22, m22))
            rest = one - (mul(a30, a30) + mul(a31, a31) + mul(a32, a32))
            here = mul(here, less(fill(LEAST_REST), rest))
            rest = pick(here, rest, one)
            shift1 = mul(a10, a30) + mul(a11, a31) + mul(a12, a32)
            shift2 = mul(a20, a30) + mul(a21, a31) + mul(a22, a32)
            px = px - mul(div(outline, rest), shift1)
            py = py - mul(div(outline, rest), shift2)
            shrink = root(rest)
            shift1 = div(shift1, rest + shrink)
            shift2 = div(shift2, rest + shrink)
            a10 = div(a10 + mul(shift1, a30), shrink)
            a11 = div(a11 + mul(shift1, a31), shrink)
            a12 = div(a12 + mul(shift1, a32), shrink)
            a20 = div(a20 + mul(shift2, a30), shrink)
            a21 = div(a21 + mul(shift2, a31), shrink)
            a22 = div(a22 + mul(shift2, a32), shrink)
        c0 = mul(a11, a22) - mul(a12, a21)
        c1 = mul(a12, a20) - mul(a10, a22)
        c2 = mul(a10, a21) - mul(a11, a20)
        xx = mul(a10, a10) + mul(a11, a11) + mul(a12, a12)
        xy = mul(a10, a20) + mul(a11, a21) + mul(a12, a22)
        yy = mul(a20, a20) + mul(a21, a21) + mul(a22, a22)
        sharp = mul(c0, c0) + mul(c1, c1) + mul(c2, c2)
        blur = fill(BLUR)
        det = sharp + mul(blur, xx + yy) + mul(blur, blur)
        xx = xx + blur
        yy = yy + blur
        opacity = pick(here, opacity, one)
        if camera.antialiasing != 0:  # before any test of the opacity
            least = fill(COMPENSATION_MIN)
            share = div(sharp, det)
            opacity = mul(opacity, root(pick(less(least, share), share, least)))
        bounded = equal(mul(det, zero), zero)  # else too large for float32 numbers, about 4e9 px
        code = valid - one - mul(here, one - bounded)
        radii_out[g] = whole(code)
        here = mul(mul(here, bounded), one - less(opacity, fill(camera.alpha_min)))
        extent_x, extent_y, farthest = support(opacity, camera.alpha_min, xx, xy, yy)
        here = mul(here, mul(covers_pixel(px, extent_x, camera.size[0]), covers_pixel(py, extent_y, camera.size[1])))
        if not some(here):
            return
        means2d_out[g] = join2(pick(here, px, zero), pick(here, py, zero))
        per_det = inverse(det)
        conics_out[g] = join3(
            pick(here, mul(yy, per_det), zero), pick(here, mul(-xy, per_det), zero), pick(here, mul(xx, per_det), zero)
        )
        opacities_out[g] = pick(here, opacity, zero)
        depths_out[g] = pick(here, depth, zero)
        extents_out[g] = join2(pick(here, extent_x, zero), pick(here, extent_y, zero))
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

"""Real spherical harmonics up to degree 3, with the signs of the reference implementation."""

import warp as wp

from warp_splat.kernels.build import DIFFERENTIABLE

wp.set_module_options(DIFFERENTIABLE)

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2A, C2B, C2C = 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
C3A, C3B, C3C, C3D, C3E = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)


@wp.func
def evaluate_sh(
    degree: int,
    d: wp.vec3,
    dc: wp.array2d[wp.vec3],  # [N, 1]
    rest: wp.array2d[wp.vec3],  # [N, K - 1]
    i: int,
):
    """Sum of the coefficients of Gaussian ``i`` up to ``degree``, in unit direction ``d``.

    Reads arrays, unlike the other pieces, so that inactive degrees are neither loaded nor given a gradient.
    """
    color = C0 * dc[i, 0]
    if degree > 0:
        x = d[0]
        y = d[1]
        z = d[2]
        color += C1 * (z * rest[i, 1] - y * rest[i, 0] - x * rest[i, 2])
        if degree > 1:
            xx = x * x
            yy = y * y
            zz = z * z
            color += C2A * (x * y * rest[i, 3] - y * z * rest[i, 4] - x * z * rest[i, 6])
            color += C2B * (2.0 * zz - xx - yy) * rest[i, 5] + C2C * (xx - yy) * rest[i, 7]
            if degree > 2:
                color += C3B * x * y * z * rest[i, 9] - C3A * y * (3.0 * xx - yy) * rest[i, 8]
                color -= C3C * (4.0 * zz - xx - yy) * (y * rest[i, 10] + x * rest[i, 12])
                color += C3D * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * rest[i, 11]
                color += C3E * z * (xx - yy) * rest[i, 13] - C3A * x * (xx - 3.0 * yy) * rest[i, 14]
    return color

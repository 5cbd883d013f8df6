"""Real spherical harmonics up to degree 3, with the signs of the reference implementation."""

import warp as wp

from warp_splat.kernels.build import FORWARD_ONLY

wp.set_module_options(FORWARD_ONLY)

vec15 = wp.types.vector(length=15, dtype=float)

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
def basis(degree: int, d: wp.vec3):
    """Values of the functions of degree 1 to ``degree`` in unit direction ``d``; 0 beyond."""
    b = vec15()
    if degree > 0:
        x = d[0]
        y = d[1]
        z = d[2]
        b[0] = -C1 * y
        b[1] = C1 * z
        b[2] = -C1 * x
        if degree > 1:
            xx = x * x
            yy = y * y
            zz = z * z
            b[3] = C2A * x * y
            b[4] = -C2A * y * z
            b[5] = C2B * (2.0 * zz - xx - yy)
            b[6] = -C2A * x * z
            b[7] = C2C * (xx - yy)
            if degree > 2:
                shared = -C3C * (4.0 * zz - xx - yy)
                b[8] = -C3A * y * (3.0 * xx - yy)
                b[9] = C3B * x * y * z
                b[10] = shared * y
                b[11] = C3D * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
                b[12] = shared * x
                b[13] = C3E * z * (xx - yy)
                b[14] = -C3A * x * (xx - 3.0 * yy)
    return b


@wp.func
def weighted_basis(degree: int, offset: wp.vec3, weights: vec15):
    """Sum of the functions in the direction of ``offset``, weighted."""
    return wp.dot(basis(degree, wp.normalize(offset)), weights)

"""Gradients that are not finite are not spread."""

import warp as wp

from warp_splat.kernels.compiler import FORWARD_ONLY

wp.set_module_options(FORWARD_ONLY)


@wp.kernel
def quarantine(
    first: int,
    radii: wp.array[int],  # [N]
    # out: gradients, cleared where one of a Gaussian's is not finite
    means_out: wp.array[wp.vec3],  # [N]
    quats_out: wp.array[wp.vec4],  # [N]
    scales_out: wp.array[wp.vec3],  # [N]
    opacities_out: wp.array[float],  # [N]
    sh_dc_out: wp.array2d[wp.vec3],  # [N]
    sh_rest_out: wp.array2d[wp.vec3],  # [N]
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

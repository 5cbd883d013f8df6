"""Adam for the Gaussians that an image shows (the reference's ``sparse_adam``). Forward only."""

import warp as wp

from warp_splat.kernels.build import DIFFERENTIABLE

# sums keep their order: regrouped, v would overflow for gradients above 1e19
wp.set_module_options({**DIFFERENTIABLE, "enable_backward": False})


@wp.kernel
def adam_rows(
    first: int,
    radii: wp.array[int],  # [N] px; rows with 0 keep their value and moments
    grads: wp.array2d[float],  # [N, D]
    rate: float,
    beta1: float,
    beta2: float,
    eps: float,
    # out
    values_out: wp.array2d[float],  # [N, D]
    first_moments_out: wp.array2d[float],  # [N, D]
    second_moments_out: wp.array2d[float],  # [N, D]
):
    row = first + wp.tid()
    if radii[row] > 0:
        for column in range(grads.shape[1]):
            grad = grads[row, column]
            m = beta1 * first_moments_out[row, column] + (1.0 - beta1) * grad
            v = beta2 * second_moments_out[row, column] + (1.0 - beta2) * grad * grad
            first_moments_out[row, column] = m
            second_moments_out[row, column] = v
            values_out[row, column] = values_out[row, column] - rate * m / (wp.sqrt(v) + eps)

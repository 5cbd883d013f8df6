"""Adam for the Gaussians that an image shows (the reference's ``sparse_adam``). Forward only."""

import functools

import warp as wp

from warp_splat.kernels.compiler import IN_ORDER


@functools.cache
def make_adam(columns: int, pieces: int) -> wp.Kernel:
    """The step of a table of ``pieces`` times ``columns`` numbers per Gaussian, a piece per index.

    Tried: a loop over the numbers, three times slower on the CPU, because LLVM does not vectorize it.
    """
    row_type = wp.types.vector(length=columns, dtype=float)

    @wp.func
    def root(x: row_type):
        r = row_type()
        for column in range(columns):
            r[column] = wp.sqrt(x[column])
        return r

    @wp.kernel(module="unique", module_options=dict(IN_ORDER))  # regrouped, v overflows for gradients above 1e19
    def adam_rows(
        first: int,
        radii: wp.array[int],  # [N] px; Gaussians with 0 keep their value and moments
        grads: wp.array[row_type],  # [N pieces]
        rate: float,
        beta1: float,
        beta2: float,
        eps: float,
        # out
        values_out: wp.array[row_type],  # [N pieces]
        first_moments_out: wp.array[row_type],  # [N pieces]
        second_moments_out: wp.array[row_type],  # [N pieces]
    ):
        row = first + wp.tid()
        if radii[row // pieces] > 0:
            grad = grads[row]
            m = beta1 * first_moments_out[row] + (1.0 - beta1) * grad
            v = beta2 * second_moments_out[row] + wp.cw_mul((1.0 - beta2) * grad, grad)
            first_moments_out[row] = m
            second_moments_out[row] = v
            values_out[row] = values_out[row] - rate * wp.cw_div(m, root(v) + row_type(eps))

    return adam_rows

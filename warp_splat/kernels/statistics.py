"""What a growth remembers of the gradients of the 2D means."""

import warp as wp

from warp_splat.kernels.columns import columns
from warp_splat.kernels.compiler import FORWARD_ONLY, once
from warp_splat.kernels.simd import TYPES, equal, fill, less, pick, real, root, times


@once
def make_observe(lanes: int) -> wp.Kernel:
    """Of ``lanes`` Gaussians at once."""
    number, integer, row2, _row3, _row4 = TYPES[lanes]

    @wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
    def observe(
        first: int,  # group of Gaussians of this slice
        half_size: wp.vec2,  # px, of the image
        adj_means2d: wp.array[row2],  # [N / lanes]
        radii: wp.array[integer],  # [N / lanes] px
        # out
        gradients_out: wp.array[number],  # [N / lanes] the norm in NDC units is added, where it is finite
        views_out: wp.array[number],  # [N / lanes] 1 is added, where it is drawn
    ):
        g = first + wp.tid()
        x, y = columns(adj_means2d[g])
        x = x * half_size[0]
        y = y * half_size[1]
        norm = root(times(x, x) + times(y, y))
        zero = fill(0.0, norm)
        gradients_out[g] = gradients_out[g] + pick(equal(times(norm, zero), zero), norm, zero)
        views_out[g] = views_out[g] + less(zero, real(radii[g]))

    return observe

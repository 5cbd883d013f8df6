"""Scales from their logarithms, opacities from logits, and the way back. The same on every processor.

Exponentials are ours: the C library's, torch's and NumPy's differ from processor to processor.
"""

import math
from typing import Any

import warp as wp

from warp_splat.kernels.compiler import FORWARD_ONLY, once
from warp_splat.kernels.falloff import LOG2_E
from warp_splat.kernels.simd import TYPES, equal, fill, halved, less, over, pick, times, whole

LARGEST = wp.constant(88.0)  # logarithm of a scale; float32 ends soon after
LEAST = wp.constant(-87.0)
LARGEST_SCALE = wp.constant(1.6e38)  # hardly less than exp(LARGEST)
ROUNDING = wp.constant(1.5 * 2.0**23)  # added and subtracted, it leaves a whole number
#: Of log 2: so few digits that whole numbers times them are exact, and the rest.
LN_2_HIGH, LN_2_LOW = wp.constant(0.693359375), wp.constant(math.log(2.0) - 0.693359375)
TAYLOR = wp.constant(wp.types.vector(length=8, dtype=float)(*[1.0 / math.factorial(power) for power in range(8)]))


@wp.func
def exp_of(x: Any):
    """e^x to 2e-7 of itself, x no less than LEAST and no more than LARGEST; NaN stays."""
    bounded = wp.max(wp.min(x, fill(LARGEST, x)), fill(LEAST, x))
    n = (fill(ROUNDING, x) - bounded * LOG2_E) - fill(ROUNDING, x)
    r = (bounded + n * LN_2_HIGH) + n * LN_2_LOW
    p = fill(TAYLOR[7], x)
    for power in range(7):
        p = fill(TAYLOR[6 - power], x) + times(r, p)
    return pick(equal(x, x), halved(p, whole(n)), x)


@wp.func
def logistic(x: Any):
    one = fill(1.0, x)
    return over(one, one + exp_of(-x))


@wp.func
def adj_exp(scale: Any, adj_scale: Any):
    """Of its value; zero where that is the largest, which does not change."""
    return pick(less(scale, fill(LARGEST_SCALE, scale)), times(adj_scale, scale), fill(0.0, scale))


@wp.func
def adj_logistic(opacity: Any, adj_opacity: Any):
    """Of its value."""
    return times(times(adj_opacity, fill(1.0, opacity) - opacity), opacity)


@once
def make_activate(lanes: int) -> wp.Kernel:
    """The activations of ``lanes`` Gaussians at once."""
    number = TYPES[lanes].number

    @wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
    def activate(
        first: int,  # group of Gaussians of this slice
        logarithms: wp.array[number],  # [3 N / lanes]
        logits: wp.array[number],  # [N / lanes]
        # out
        scales_out: wp.array[number],  # [3 N / lanes]
        opacities_out: wp.array[number],  # [N / lanes]
    ):
        g = first + wp.tid()
        for k in range(3):
            scales_out[3 * g + k] = exp_of(logarithms[3 * g + k])
        opacities_out[g] = logistic(logits[g])

    return activate


@once
def make_adj_activate(lanes: int) -> wp.Kernel:
    """The adjoint of :func:`make_activate`'s kernel, from its results."""
    number = TYPES[lanes].number

    @wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
    def adj_activate(
        first: int,  # group of Gaussians of this slice
        scales: wp.array[number],  # [3 N / lanes]
        opacities: wp.array[number],  # [N / lanes]
        adj_scales: wp.array[number],  # [3 N / lanes]
        adj_opacities: wp.array[number],  # [N / lanes]
        # out
        logarithms_out: wp.array[number],  # [3 N / lanes]
        logits_out: wp.array[number],  # [N / lanes]
    ):
        g = first + wp.tid()
        for k in range(3):
            logarithms_out[3 * g + k] = adj_exp(scales[3 * g + k], adj_scales[3 * g + k])
        logits_out[g] = adj_logistic(opacities[g], adj_opacities[g])

    return adj_activate

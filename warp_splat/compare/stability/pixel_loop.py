"""Extremes of the pixel loop: opacities at their ends, long chains, the edge of the stop, odd upstream gradients."""

from dataclasses import replace
from functools import partial

import numpy as np
import torch

from warp_splat.compare.scenes import at_pixels, cloud, distinct_depths, look, tensors
from warp_splat.compare.stability import verdict as check
from warp_splat.compare.stability.verdict import EPS, GRADIENT_LIMIT, Case, Outcome, Problem, rendered, truth
from warp_splat.config import T_MIN, RasterOptions

CHAIN_CLAIM = "transmittance recovered over the chain: error of the gradients within n eps"
CHAINS = (100, 1_000, 10_000, 100_000)  # layers
EVERYTHING = RasterOptions(alpha_min=0.0, t_min=0.0)
EDGE_STEPS = range(-18, 19, 3)  # units in the last place that an opacity is moved at the edge of the early stop


def logits() -> Problem:
    """Opacity logits of +-100 among ordinary ones, through the trainer's activation."""
    arrays = cloud(1, 40)
    values = np.tile([100.0, -100.0, 40.0, -40.0, 1.0, 0.0, -1.0, -2.0], 5)
    return Problem(tensors(arrays | {"opacities": values, "scales": np.log(arrays["scales"])}), raw=True)


def clamp() -> Problem:
    """Opacities of 0.99 and a few units in the last place around it, centered on pixels: alpha is at the clamp."""
    camera = look(8, 8, seed=None)
    arrays = cloud(2, 24, camera, opacity=(0.99, 0.99), sigma=(0.8, 1.5))
    pixels = np.stack([np.arange(24) % 8 + 0.5, np.arange(24) // 8 * 2 + 0.5], 1)
    arrays["means"] = at_pixels(pixels, distinct_depths(np.random.default_rng(2), 24, 2, 8), camera)
    arrays["opacities"] = np.float32(0.99) + np.arange(-12, 12) * np.float64(np.spacing(np.float32(0.99)))
    return Problem(tensors(arrays), camera, continuous=True)


def opacity_one() -> Problem:
    """Opacity 1 everywhere: every pixel stops after one or two."""
    return Problem(tensors(cloud(3, 60, opacity=(1.0, 1.0))))


def chain(layers: int) -> Problem:
    """So many Gaussians over a 2 x 2 image, all blended; together they let e^-5 or so through."""
    camera = look(2, 2, seed=None)
    arrays = cloud(4, layers, camera, sigma=(4, 8), opacity=(2.5 / layers, 7.5 / layers), aspect=0.5)
    return Problem(tensors(arrays), camera, EVERYTHING, gradient_limit=max(GRADIENT_LIMIT, layers * EPS))


def underflow() -> Problem:
    """Without a stop, 80 layers of alpha 0.5 to 0.9: transmittance falls below float32's smallest number."""
    camera = look(2, 2, seed=None)
    return Problem(tensors(cloud(5, 80, camera, sigma=(4, 8), opacity=(0.6, 0.95))), camera, EVERYTHING)


def tile() -> Problem:
    """100,000 small Gaussians in one tile; pixels stop after some thousands."""
    camera = look(4, 4, seed=None)
    return Problem(tensors(cloud(6, 100_000, camera, sigma=(0.2, 0.6), opacity=(0.004, 0.02))), camera)


def edge(steps: int, side: float) -> Problem:
    """Four layers of opacity 0.9 leave T = 1e-4 within rounding; ``side`` times that is where a pixel stops.

    ``steps`` units in the last place are added to the second opacity.
    """
    camera = look(1, 1, seed=None)
    arrays = cloud(7, 6, camera, sigma=(20, 30), aspect=0.5)
    arrays["means"] = at_pixels(np.full((6, 2), 0.5), np.linspace(2, 4, 6), camera)
    arrays["opacities"] = np.full(6, np.float32(0.9), dtype=np.float64)
    arrays["opacities"][1] += steps * np.spacing(np.float32(0.9))
    return Problem(tensors(arrays), camera, RasterOptions(t_min=side * T_MIN))


EDGES = {steps: [partial(edge, steps, side) for side in (1.01, 0.99)] for steps in EDGE_STEPS}


def stop_edge(mode: str) -> Outcome:
    """Image and gradients must both be those of one decision, whichever rounding made it."""
    chosen, counts = [], [0, 0]
    for steps, builds in EDGES.items():
        asked = edge(steps, 1.0)
        outcomes = [check.judge(truth(build)._replace(problem=asked), mode) for build in builds]
        decision = int(outcomes[1].value_error < outcomes[0].value_error)
        counts[decision] += 1
        chosen.append(outcomes[decision])
    worst = max(chosen, key=lambda outcome: (len(outcome.failures), outcome.gradient_error))
    value_error = max(outcome.value_error for outcome in chosen)
    says = f"T = {T_MIN:g} within rounding"
    return worst._replace(says=says, value_error=value_error, counted=f"stopped {counts[0]}, went on {counts[1]}")


def ordinary() -> Problem:
    """Nothing extreme: what odd upstream gradients meet."""
    return Problem(tensors(cloud(8, 60)))


def _gradients(upstream: tuple[torch.Tensor, torch.Tensor], mode: str):
    problem = truth(ordinary).problem
    leaves = check.leaves_of(problem, torch.float32)
    out = check.draw_case(problem, leaves, mode)
    return out, check.gradients_by_name(out, upstream, leaves)


def zero_upstream(mode: str) -> Outcome:
    """No gradient in, none out, to the bit."""
    out, gradients = _gradients(tuple(torch.zeros_like(weight) for weight in truth(ordinary).upstream), mode)
    largest = max(value.abs().max().item() for value in gradients.values())
    failures = () if largest == 0 else (f"gradient of {largest:.1e} out of nothing",)
    return Outcome("gradient 0", 0.0, largest, 0.0, check.count_text(pixels=out.dropped.pixels), failures)


def nan_upstream(mode: str) -> Outcome:
    """A pixel whose upstream gradient is NaN counts as one whose is zero: every other bit is the same."""
    worst, failures, dropped = 0.0, [], 0
    for which in (0, 1):  # in the image's gradient, in alpha's
        results = []
        for value in (float("nan"), 0.0):
            upstream = tuple(weight.clone() for weight in truth(ordinary).upstream)
            upstream[0][9, 7] = 0.0
            upstream[1][9, 7] = 0.0
            upstream[which][9, 7] = value
            out, gradients = _gradients(upstream, mode)
            results.append(gradients)
            if out.dropped.pixels != (expected := int(value != 0.0)):
                failures.append(f"dropped {out.dropped.pixels} pixels, not {expected}")
            dropped += out.dropped.pixels
        for name, value in results[0].items():
            if not torch.equal(value, results[1][name]):
                failures.append(f"gradient of {name} changed")
                worst = max(worst, (value - results[1][name]).abs().max().item())
    return Outcome("the other pixels' gradients", 0.0, worst, 0.0, check.count_text(pixels=dropped), tuple(failures))


CASES = (
    rendered("logits_100", "blending", "sigmoid saturates; alpha is clamped, or below the cut", logits),
    rendered("clamp_0.99", "blending", "alpha within rounding of the clamp: the image has no step there", clamp),
    rendered("opacity_1", "blending", "clamped at 0.99, no gradient through the clamp", opacity_one),
    *(rendered(f"chain_{layers}", "blending", CHAIN_CLAIM, partial(chain, layers)) for layers in CHAINS),
    rendered("chain_underflow", "blending", "without a stop, T below 1e-38: gradients as in float64", underflow),
    rendered("tile_100000", "blending", "100,000 Gaussians in one tile: image and gradients as in float64", tile),
    Case("stop_edge", "blending", "T within rounding of t_min: one decision, the adjoint's too", stop_edge),
    Case("upstream_0", "upstream", "no gradient in, none out, to the bit", zero_upstream),
    rendered("upstream_1e30", "upstream", "gradients 1e30 times as large", lambda: replace(ordinary(), gain=1e30)),
    Case("upstream_nan", "upstream", "the pixel is dropped and counted, every other bit is the same", nan_upstream),
)

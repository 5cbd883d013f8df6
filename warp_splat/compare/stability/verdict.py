"""One extreme input, rendered and differentiated in float32 by the package and in float64 by the oracle, and compared.

A verdict asks for: nothing but finite numbers where float64 has them; image and alpha within a limit; every gradient
within a limit in relative L2; what is left out counted as stated. Pixels that hang on rounding
(:attr:`warp_splat.compare.oracle.Render.fragile`) get no upstream gradient, and there an image may be off by what one
Gaussian adds.

A limit above the usual one is never chosen. It is measured, as the condition of the problem: how far the float64 truth
itself moves when its inputs move by half a unit in the last place of float32 (Higham 2002, 1.6).
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch

from warp_splat.camera import Camera
from warp_splat.compare import oracle
from warp_splat.compare.scenes import look
from warp_splat.compare.truth import draw_exactly
from warp_splat.config import RasterOptions
from warp_splat.gaussians import Activate
from warp_splat.raster import api
from warp_splat.raster.data import Gaussians

EPS = 2.0**-24  # float32, half a unit in the last place of 1
FLOAT_MAX = torch.finfo(torch.float32).max
IMAGE_LIMIT = 1e-4  # largest error of image and alpha
GRADIENT_LIMIT = 2e-4  # relative L2 of each gradient
SHARE = 0.02  # at a fragile pixel: one decision moves a weight of at most about 1e-2
FRAGILE_LIMIT = 0.5  # share of the pixels; above, too little of the image would be compared
TRIALS = 16  # random perturbations, of which the worst counts


@dataclass(frozen=True, eq=False)
class Problem:
    """An extreme input and what is stated of it.

    Args:
        gaussians: float32 tensors by the names of :class:`warp_splat.gaussians.GaussianModel`, N rows.
        camera: what looks at them.
        options: as for :func:`warp_splat.rasterize`.
        raw: scales are logarithms and opacities logits, as a trainer keeps them.
        left_out: indices of Gaussians that are not drawn although float64 could.
        invalid: how many of those are counted in ``RenderOutput.invalid``.
        gain: factor of the upstream gradients.
        conditioned: limits are no less than the condition of the problem.
        continuous: no decision of this input makes a step in the image, so that fragile pixels are compared, too.
        gradient_limit: relative L2.
    """

    gaussians: dict[str, torch.Tensor]
    camera: Camera = field(default_factory=look)
    options: RasterOptions = field(default_factory=RasterOptions)
    raw: bool = False
    left_out: tuple[int, ...] = ()
    invalid: int = 0
    gain: float = 1.0
    conditioned: bool = False
    continuous: bool = False
    gradient_limit: float = GRADIENT_LIMIT


class Outcome(NamedTuple):
    """What was measured, and every statement that did not hold."""

    says: str  # float64
    value_error: float = 0.0
    gradient_error: float | None = None  # None where there is no gradient
    gradient_limit: float = 0.0
    counted: str = "-"
    failures: tuple[str, ...] = ()


def bounded(says: str, what: str, error: float, limit: float, counted: str = "-") -> Outcome:
    """That one error is below its limit."""
    failures = () if error < limit else (f"{what} off by {error:.1e} > {limit:.1e}",)
    return Outcome(says, error, counted=counted, failures=failures)


class Case(NamedTuple):
    """A named extreme: ``run`` takes the adjoint mode, or "" where none is involved (not ``modal``)."""

    name: str
    group: str
    claim: str  # the stated outcome
    run: Callable[[str], Outcome]
    modal: bool = True
    build: Callable[[], Problem] | None = None  # of a case that is rendered


class Expected(NamedTuple):
    """Float64's answer, on all N rows: zero gradients for what is left out or overflows."""

    problem: Problem
    says: str
    out: oracle.Render
    upstream: tuple[torch.Tensor, torch.Tensor]  # of image and alpha
    gradients: dict[str, torch.Tensor]
    overflows: torch.Tensor  # [N] bool, a gradient leaves float32's range: all of that Gaussian's are dropped, counted
    image_limit: float
    gradient_limits: dict[str, float]


def leaves_of(problem: Problem, dtype: torch.dtype) -> dict[str, torch.Tensor]:
    """Leaves by name: the parameters and the background, which is light blue."""
    leaves = {name: tensor.to(dtype, copy=True) for name, tensor in problem.gaussians.items()}
    leaves["background"] = torch.tensor([0.25, 0.5, 0.75], dtype=dtype)
    return {name: tensor.requires_grad_() for name, tensor in leaves.items()}


def activated(problem: Problem, leaves: dict[str, torch.Tensor]) -> Gaussians:
    """As the renderer takes them, through the trainer's activations if ``raw``; in float64, through torch's."""
    if problem.raw:
        raw = leaves["scales"], leaves["opacities"]
        exact = raw[0].dtype == torch.float64
        scales, opacities = (raw[0].clamp_max(88.0).exp(), raw[1].sigmoid()) if exact else Activate.apply(*raw)
        leaves = leaves | {"scales": scales, "opacities": opacities}
    return Gaussians(**{name: leaves[name] for name in Gaussians._fields})


def draw_case(problem: Problem, leaves: dict[str, torch.Tensor], mode: str) -> api.RenderOutput:
    """The package's render; without the checks of arguments, as in training, where something is left out."""
    gaussians, rest = activated(problem, leaves), (problem.camera, leaves["background"])
    if problem.invalid:
        return api.render(gaussians, *rest, problem.options, mode)
    return api.rasterize(*gaussians[:4], gaussians[4:], *rest, mode, problem.options)


def gradients_by_name(out, upstream: tuple, leaves: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Gradients of all leaves and of means2d."""
    wanted = leaves | {"means2d": out.means2d}
    gradients = torch.autograd.grad([out.image, out.alpha], list(wanted.values()), list(upstream))
    return dict(zip(wanted, gradients, strict=True))


@functools.cache
def truth(build: Callable[[], Problem]) -> Expected:
    """What float64 says of the input, and the limits; computed once per input."""
    problem = build()
    count = len(problem.gaussians["means"])
    kept = torch.tensor(sorted(set(range(count)) - set(problem.left_out)), dtype=torch.int64)
    drawn = replace(problem, gaussians={name: rows[kept] for name, rows in problem.gaussians.items()})
    leaves = leaves_of(drawn, torch.float64)
    out = draw_exactly(activated(drawn, leaves), drawn.camera, leaves["background"], drawn.options)
    generator, shape = torch.Generator().manual_seed(1), out.fragile.shape
    upstream = torch.randn(*shape, 3, generator=generator), torch.randn(*shape, generator=generator)
    for weight in upstream:
        weight.mul_(problem.gain)[out.fragile] = 0
    gradients = gradients_by_name(out, tuple(weight.double() for weight in upstream), leaves)
    moved_image, moved = _condition(drawn, out, upstream, gradients) if problem.conditioned else (0.0, {})

    overflows = torch.zeros(count, dtype=torch.bool)
    for name, rows in gradients.items():
        if name != "background":
            gradients[name] = rows.new_zeros(count, *rows.shape[1:])
            gradients[name][kept] = rows
        if name in problem.gaussians:
            overflows |= (gradients[name].abs() > FLOAT_MAX).view(count, -1).any(1)
    largest = max((value.abs().max().item() for value in gradients.values() if value.numel()), default=0.0)
    says = f"image {out.image.min().item():.2f}..{out.image.max().item():.2f}, gradient to {largest:.1e}"
    for name in problem.gaussians:
        gradients[name][overflows] = 0
    out = out._replace(image=out.image.detach(), alpha=out.alpha.detach(), means2d=out.means2d.detach())
    limits = {name: max(problem.gradient_limit, moved.get(name, 0.0)) for name in gradients}
    return Expected(problem, says, out, upstream, gradients, overflows, max(IMAGE_LIMIT, moved_image), limits)


def _condition(problem: Problem, out, upstream, gradients) -> tuple[float, dict[str, float]]:
    """How far image and gradients move in float64 when inputs, camera and 2D means move by half a unit of float32."""
    camera = problem.camera
    depth = (problem.gaussians["means"].double().numpy() - camera.center) @ camera.forward
    means2d = out.means2d.detach().numpy()
    image, moved = 0.0, dict.fromkeys(gradients, 0.0)
    for trial in range(TRIALS):
        rng = np.random.default_rng(trial)
        leaves = leaves_of(problem, torch.float64)
        with torch.no_grad():
            for name in problem.gaussians:
                leaves[name].copy_(torch.from_numpy(_nudge(leaves[name].numpy(), rng)))
            pixels = (_nudge(means2d, rng) - means2d) / [camera.fx, camera.fy]
            leaves["means"] += torch.from_numpy(depth[:, None] * pixels @ camera.rotation[:2])
        lens = {key: float(_nudge(np.float64(getattr(camera, key)), rng)) for key in ("fx", "fy", "cx", "cy")}
        rotation = _nudge(camera.rotation, rng)
        nudged = replace(camera, rotation=rotation, translation=-rotation @ camera.center, **lens)
        other = draw_exactly(activated(problem, leaves), nudged, leaves["background"], problem.options)
        image = max(image, _pixel_errors(other, out)[~out.fragile].max().item())
        for name, value in gradients_by_name(other, tuple(weight.double() for weight in upstream), leaves).items():
            moved[name] = max(moved[name], relative_error(value, gradients[name], problem.gain))
    return image, moved


def _nudge(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Each value half a unit of its last place in float32 up or down."""
    step = 0.5 * np.spacing(np.abs(values).astype(np.float32)).astype(np.float64)
    return values + step * rng.choice([-1.0, 1.0], np.shape(values))


def relative_error(value: torch.Tensor, exact: torch.Tensor, gain: float = 1.0) -> float:
    """L2 of the difference over L2 of the truth (no less than 1e-6 of the upstream gradients' ``gain``); never NaN."""
    error = ((value.double() - exact).norm() / exact.norm().clamp_min(1e-6 * gain)).item()
    return error if error == error else float("inf")  # NaN would win no comparison


def _pixel_errors(out, exact: oracle.Render) -> torch.Tensor:
    """Largest error of color and alpha, [H, W]."""
    return torch.maximum((out.image - exact.image).abs().amax(2), (out.alpha - exact.alpha).abs()).detach().double()


def judge(expected: Expected, mode: str) -> Outcome:
    """Render, differentiate and judge."""
    problem, exact = expected.problem, expected.out
    leaves = leaves_of(problem, torch.float32)
    out = draw_case(problem, leaves, mode)
    gradients = gradients_by_name(out, expected.upstream, leaves)
    wrong = [name for name, value in gradients.items() if not value.isfinite().all()]
    error = _pixel_errors(out, exact)
    sure = torch.ones_like(exact.fragile) if problem.continuous else ~exact.fragile
    value_error = error[sure].max().item() if sure.any() else 0.0
    share = SHARE * max(1.0, exact.image.max().item())
    errors = {name: relative_error(value, expected.gradients[name], problem.gain) for name, value in gradients.items()}
    worst = max(errors, key=lambda name: errors[name] / expected.gradient_limits[name])
    off = [(name, errors[name], limit) for name, limit in expected.gradient_limits.items()]
    dropped, dropped_now = int(expected.overflows.sum()), out.dropped.gaussians
    statements = [
        (out.image.isfinite().all() and out.alpha.isfinite().all(), "image not finite"),
        (not wrong, f"gradient not finite: {', '.join(wrong)}"),
        (sure.double().mean().item() > 1 - FRAGILE_LIMIT, f"only {int(sure.sum())} pixels to compare"),
        (value_error < expected.image_limit, f"image off by {value_error:.1e} > {expected.image_limit:.1e}"),
        (not (error[~sure] > share).any(), "image off by more than one Gaussian at a fragile pixel"),
        *((error < limit, f"gradient of {name} off by {error:.1e} > {limit:.1e}") for name, error, limit in off),
        (not out.radii[list(problem.left_out)].any(), "drawn although it should be left out"),
        (out.invalid == problem.invalid, f"counted {out.invalid} invalid, not {problem.invalid}"),
        (dropped_now == dropped, f"dropped gradients of {dropped_now} Gaussians, not {dropped}"),
        (out.dropped.pixels == 0, f"dropped {out.dropped.pixels} pixels"),
    ]
    failures = tuple(statement for holds, statement in statements if not holds)
    counted = count_text(culled=int((out.radii == 0).sum()), invalid=out.invalid, dropped=dropped_now)
    return Outcome(expected.says, value_error, errors[worst], expected.gradient_limits[worst], counted, failures)


def count_text(**counts: int) -> str:
    """What was counted, such as "culled 3, invalid 1"; "-" for nothing."""
    return ", ".join(f"{name} {number}" for name, number in counts.items() if number) or "-"


def rendered(name: str, group: str, claim: str, build: Callable[[], Problem]) -> Case:
    """A case that compares a render and its gradients with the oracle's."""
    return Case(name, group, claim, lambda mode: judge(truth(build), mode), build=build)

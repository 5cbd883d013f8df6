"""Do the renderer's gradients agree with finite differences, on a scene of your own? For whoever changes the renderer.

:mod:`warp_splat.raster.differences` says what is differenced, and how jumps and rounding are kept out.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from numbers import Integral

import torch

from warp_splat.camera import Camera
from warp_splat.config import ADJOINTS, RasterOptions
from warp_splat.errors import InputError
from warp_splat.kernels.falloff import Falloff, make_evaluate
from warp_splat.raster import checks, differences
from warp_splat.raster.camera_parameters import CameraParameters
from warp_splat.raster.differences import INTERMEDIATES, RUNGS, SHAPES, MovableScene, Trial
from warp_splat.runtime.launch import launch
from warp_splat.text import format_table

MODES = (*ADJOINTS, "generated", "plain")  # the last two, which rasterize refuses, are there to be compared
PLACES = 14  # at which a falloff is tried: powers of 2
ASIDE, SLACK = 0.01, 1e-3  # from a reach to either side; what rounding and a polynomial may be off by
PEAKS = 5  # Gaussians of the largest gradients that are looked at alone


@dataclass(frozen=True)
class GradientRow:
    """One parameter; ``error`` and ``uncertainty`` are relative to the root mean square of ``differences``."""

    name: str
    analytic: tuple[float, ...]  # gradient times direction, for each direction
    differences: tuple[float, ...]  # the same by finite differences
    uncertainties: tuple[float, ...]  # of the differences
    error: float  # root mean square of analytic - differences
    uncertainty: float  # root mean square
    pixels: float  # share of the pixels that the parameter reaches and that stayed in the loss
    verdict: str  # "agrees", "off", or "unclear": the uncertainty is more than ten times the tolerance


@dataclass(frozen=True)
class WorstGaussian:
    """A Gaussian that, moved alone, disagrees most among those that were tried."""

    name: str
    index: int
    analytic: float
    difference: float


@dataclass(frozen=True)
class GradientReport:
    """What :func:`check_gradients` found; ``str`` makes a table and a sentence of it."""

    adjoint: str
    tolerance: float
    rows: tuple[GradientRow, ...]
    worst: WorstGaussian | None  # of the parameter that is off most; None if none is, or it is no Gaussian's

    @property
    def ok(self) -> bool:
        """Whether no parameter is off."""
        return not self.named("off")

    def named(self, verdict: str) -> list[str]:
        """The parameters with that verdict."""
        return [row.name for row in self.rows if row.verdict == verdict]

    def __str__(self) -> str:
        headers = ("parameter", "gradient", "differences", "error", "uncertainty", "pixels", "verdict")
        cells = []
        for row in self.rows:
            k = max(range(len(row.analytic)), key=lambda k: abs(row.analytic[k] - row.differences[k]))
            numbers = (f"{row.analytic[k]:.5g}", f"{row.differences[k]:.5g}", f"{row.error:.1e}")
            cells.append((row.name, *numbers, f"{row.uncertainty:.1e}", f"{100 * row.pixels:.0f} %", row.verdict))
        return f"{format_table(headers, cells)}\n\n{self._sentence()}"

    def _sentence(self) -> str:
        off, unclear = self.named("off"), self.named("unclear")
        text = f"off by more than {self.tolerance:g} and the uncertainty: {', '.join(off)}" if off else "nothing is off"
        if worst := self.worst:
            text += f" (most in {worst.name}; there, Gaussian {worst.index} alone has {worst.analytic:.5g} instead of "
            text += f"{worst.difference:.5g})"
        rest = f"; too uncertain to tell: {', '.join(unclear)}" if unclear else ""
        return f"Adjoint {self.adjoint!r}: {text}{rest}."


def check_gradients(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    sh: torch.Tensor | tuple[torch.Tensor, torch.Tensor],
    camera: Camera | CameraParameters,
    background: torch.Tensor | tuple[float, float, float] = (0.0, 0.0, 0.0),
    adjoint: str = "manual",
    options: RasterOptions | None = None,
    parameters: Sequence[str] | None = None,
    directions: int = 8,
    tolerance: float = 0.002,
    seed: int = 0,
) -> GradientReport:
    """Compare the gradients of :func:`warp_splat.rasterize` with finite differences and name those that are off.

    Args:
        means: as all down to ``options``: what :func:`warp_splat.rasterize` takes.
        quats: [N, 4].
        scales: [N, 3], world units.
        opacities: [N].
        sh: [N, K, 3], or the pair.
        camera: pinhole camera; with :class:`CameraParameters`, "rotation", "translation" (the twist), "focal" and
            "principal" are checked, too, with a rolling shutter also "last_rotation" and "last_translation", with
            coefficients of a lens "coefficients".
        background: RGB.
        adjoint: the mode to check; also "generated" and "plain" (known to be wrong), which are there to be compared.
        options: what to compute, without its bound; with ``depth``, it is part of the loss.
        parameters: names of what to check; None: "means", "quats", "scales", "opacities", "sh" and "background". Also
            "means2d", "conics", "opacities2d", "colors" and "depths", which lie on the way to the image: their
            differences see binning and blend alone.
        directions: random directions per parameter, at least 1; in each, every Gaussian moves by the same share of its
            natural size, in deeply layered scenes some of them.
        tolerance: error, relative to the root mean square of the differences, that is allowed beyond their uncertainty.
        seed: of weights and directions, from 0 to below 2^63.

    Returns:
        A :class:`GradientReport`: ``ok``, ``rows``, and a table by ``print``.

    Raises:
        InputError: as for :func:`warp_splat.rasterize`; if a parameter has no such name; if a number is out of range;
            if the falloff of ``options`` is none.
    """
    options = _check(adjoint, options, camera, parameters, directions, tolerance, seed)
    names = differences.inputs_of(camera) if parameters is None else tuple(parameters)
    gaussians = checks.check_gaussians(means, quats, scales, opacities, sh)
    background = checks.check_background(background, means.device)
    checks.check_tolerance(options)
    checks.check_hidden_from(options, base := checks.check_camera(camera), means.device)
    with checks.explained(options, means, [base]):
        scene = MovableScene(gaussians, background, camera, replace(options, bound=False), adjoint, int(seed))
    if options.falloff:
        _check_falloff(options.falloff, means.device)
    checks.explain_invalid(scene.out.invalid, quats)
    trials = {name: differences.try_directions(scene, name, directions, tolerance) for name in names}
    rows = tuple(_judge(name, trials[name], tolerance) for name in names)
    of_gaussians = {*SHAPES, "sh", *INTERMEDIATES}
    off = {row.name: row.error for row in rows if row.verdict == "off" and row.name in of_gaussians}
    name = max(off, key=lambda name: off[name], default="")
    return GradientReport(adjoint, tolerance, rows, _find_worst(scene, name, trials[name]) if off else None)


def _check_falloff(falloff: Falloff, device: torch.device) -> None:
    """Raise InputError if it does not start at 1, is not finite, rises, or if its reach is not its inverse.

    The inverse is looked at from both sides, since a falloff may end by a jump.
    """
    exponents = torch.arange(PLACES, device=device, dtype=torch.float32)
    x, places = torch.exp2(exponents), torch.cat([exponents[:1], torch.exp2(exponents[1:] - PLACES / 2)])

    def at(q: torch.Tensor) -> tuple[list[float], torch.Tensor]:
        found = torch.empty_like(q), torch.empty_like(q)
        launch(make_evaluate(falloff), len(q), [q, x], found, device=device)
        return found[0].tolist(), found[1]

    falls, reaches = at(places)
    for q, value, before in zip(places.tolist(), falls, [1.0, *falls], strict=False):
        expected = "1" if q == 0 else f"a finite number, at most {before:.6g} as nearer to the mean,"
        if not (abs(value - 1.0) < SLACK if q == 0 else -math.inf < value < before + SLACK):
            raise InputError(f"options.falloff.fall: expected {expected} at q = {q:g}, got {value:g}; correct it.")
    nearer, farther = ((reaches * (1 + side) + side).clamp_min(0.0) for side in (-ASIDE, ASIDE))
    for number, reach, above, below in zip(x.tolist(), reaches.tolist(), at(nearer)[0], at(farther)[0], strict=True):
        if not (reach < math.inf and above * number > 1 - SLACK and below * number < 1 + SLACK):
            raise InputError(
                f"options.falloff.reach: expected the q where fall has come down to 1 / x, got {reach:g} for x = "
                f"{number:g}, around which fall goes from {above:g} to {below:g}; give the inverse of fall."
            )


def _check(adjoint, options, camera, parameters, directions, tolerance, seed) -> RasterOptions:
    """The options to use. Raises InputError for what :func:`check_gradients` itself demands of its arguments."""
    checks.check_choice("adjoint", adjoint, MODES)
    known = differences.inputs_of(camera) + INTERMEDIATES
    given = parameters if isinstance(parameters, (list, tuple)) else ()
    if parameters is not None and not (given and all(checks.is_one_of(name, known) for name in given)):
        raise InputError(f"parameters: expected a list of some of {', '.join(known)}, got {parameters!r}.")
    if not (isinstance(directions, int) and directions >= 1):
        raise InputError(f"directions: expected a whole number, at least 1, got {directions!r}.")
    if not (isinstance(tolerance, (int, float)) and 0 < tolerance < 1):
        raise InputError(f"tolerance: expected a number between 0 and 1, got {tolerance!r}.")
    if isinstance(seed, bool) or not (isinstance(seed, Integral) and 0 <= int(seed) < 2**63):
        raise InputError(f"seed: expected a whole number from 0 to below 2^63, got {seed!r}.")
    options = checks.check_options(ADJOINTS[0], options)
    if options.falloff and not {"conics", "opacities2d"}.isdisjoint(parameters or ()):
        raise InputError(
            "parameters: expected no conics and no opacities2d with a falloff of your own, since differences know "
            "the Gaussian's reach alone; leave them out."
        )
    return options


def _rms(values: Sequence[float]) -> float:
    return math.sqrt(math.fsum(value**2 for value in values) / len(values))


def _judge(name: str, trials: list[Trial], tolerance: float) -> GradientRow:
    """A parameter's directions as a row."""
    analytic = tuple(trial.analytic for trial in trials)
    differences = tuple(trial.quotient.value for trial in trials)
    uncertainties = tuple(trial.quotient.uncertainty for trial in trials)
    scale, gap, doubt = _rms(differences), _rms([trial.gap for trial in trials]), _rms(uncertainties)
    if scale:
        error, uncertainty = gap / scale, doubt / scale
    else:  # nothing moves the image, such as turning a ball: of the gradient, only rounding may be left
        error, uncertainty = math.inf if gap > doubt else 0.0, 0.0
    pixels = sum(trial.quotient.pixels for trial in trials) / len(trials)
    unclear = uncertainty > 10 * tolerance or not pixels
    # of thousands of jumps the uncertainty sees fewer than there are
    verdict = "off" if error > tolerance + (3 if unclear else 1) * uncertainty else "unclear" if unclear else "agrees"
    return GradientRow(name, analytic, differences, uncertainties, error, uncertainty, pixels, verdict)


def _find_worst(scene: MovableScene, name: str, trials: list[Trial]) -> WorstGaussian:
    """Moves Gaussians one at a time along the direction that disagrees most.

    Those of the largest gradients, and one found by halving: a Gaussian that lost its gradient is not among the former.
    """
    trial = max(trials, key=lambda trial: trial.gap)
    sizes = (trial.gradient * trial.step).abs().reshape(len(trial.step), -1).sum(1)
    peaks = sizes.topk(min(PEAKS, len(sizes))).indices
    rows = torch.arange(len(sizes), device="cpu")
    while len(rows) > 1:
        halves = {half: _try_rows(scene, name, trial.step, half, (trial.quotient.rung,)) for half in rows.chunk(2)}
        rows = max(halves, key=lambda half: halves[half].gap)
    alone = {row: _try_rows(scene, name, trial.step, row, RUNGS) for row in (*peaks.tolist(), int(rows))}
    index = max(alone, key=lambda row: alone[row].gap)
    return WorstGaussian(name, index, alone[index].analytic, alone[index].quotient.value)


def _try_rows(
    scene: MovableScene, name: str, step: torch.Tensor, rows: torch.Tensor | int, rungs: Sequence[int]
) -> Trial:
    """The part of a direction that moves some Gaussians only."""
    part = torch.zeros_like(step)
    part[rows] = step[rows]
    return differences.try_direction(scene, name, part, rungs)

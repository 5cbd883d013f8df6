"""How far a renderer's pictures and gradients are from float64: under the usual rules, and under its own."""

import functools
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from warp_splat.audit.renderer import Answer, Renderer, RendererFailed
from warp_splat.audit.small_scenes import REPEATED, SCENES, on_all_pixels
from warp_splat.compare.truth import Truth, compute_truth, draw_exactly, errors_of
from warp_splat.compare.workloads import Workload
from warp_splat.raster.data import Gaussians

LEVEL = 1 / 255  # of a screen
RUNS, QUICK = 10, 0.5  # s: what takes longer is drawn again in the scenes of REPEATED alone
GRADIENT_OFF = 1e-2  # relative L2 from which a gradient is called off
HOPELESS = 3  # failures in a row after which the rest is left out


@dataclass(frozen=True, eq=False)
class SceneRow:
    """What came of a scene. Numbers are NaN where there is no picture; ``own`` is under the renderer's own rules."""

    scene: str
    shows: str
    verdict: str
    level: str  # ok, note, warning, error
    largest: float = float("nan")
    mean: float = float("nan")
    off: float = float("nan")  # share of the pixels off by more than a level of a screen
    own: float = float("nan")  # the same share
    gradients: dict[str, float] = field(default_factory=dict)  # relative L2
    not_finite: int = 0  # numbers of picture and gradients
    same: bool = True
    pictures: tuple[np.ndarray, ...] = ()  # expected, found
    runs: int = 1  # that were compared

    def record(self) -> dict[str, Any]:
        """All but the pictures, for JSON."""
        return {name: value for name, value in vars(self).items() if name != "pictures"}


@functools.cache
def _truth(scene: str, background: tuple, degree: int) -> tuple[Workload, Truth]:
    workload = on_all_pixels(scene, SCENES[scene][1](), background, degree)
    return workload, compute_truth(workload)


def in_eight_bits(image: np.ndarray) -> np.ndarray:
    """As 8 bits would have it."""
    return np.round(np.clip(image, 0, 1) * 255) / 255


def errors_in(answer: Answer, exact: np.ndarray) -> np.ndarray:
    """Of each pixel [H, W]; what has 8 bits is compared with what is rounded alike. Not finite: infinite."""
    error = np.abs(answer.image - (in_eight_bits(exact) if answer.eight_bit else exact)).max(2)
    return np.where(np.isfinite(error), error, np.inf)


def exact_image(workload: Workload) -> np.ndarray:
    """The oracle's picture [H, W, 3] under the workload's options."""
    gaussians = Gaussians(*(tensor.double() for tensor in workload.gaussians))
    return draw_exactly(gaussians, workload.camera, workload.background.double(), workload.options).image.numpy()


def measure(
    renderer: Renderer, options: dict[str, Any], degree: int = 3, background=(0.25, 0.5, 0.75), scenes=tuple(SCENES)
) -> Iterator[SceneRow]:
    """A row for each scene; ``options`` of the oracle are the renderer's own rules."""
    failures = 0
    for scene in scenes:
        workload, truth = _truth(scene, background, degree)
        given = (workload, truth.weights.reshape(workload.camera.height, workload.camera.width, 3))
        start = time.perf_counter()
        try:
            if failures >= HOPELESS:
                raise RendererFailed(f"not tried after {HOPELESS} failures in a row")
            answer = renderer.draw(*given, RUNS if scene in REPEATED else 1)
            if answer.runs == 1 and time.perf_counter() - start < QUICK:
                answer = renderer.draw(*given, RUNS)
        except RendererFailed as error:
            failures += renderer.process is None
            yield SceneRow(scene, SCENES[scene][0], str(error), "error")
        else:
            failures = 0
            yield _judge(scene, workload, truth, answer, options)


def _judge(scene: str, workload: Workload, truth: Truth, answer: Answer, options: dict[str, Any]) -> SceneRow:
    shape = answer.image.shape[:2]
    exact, sure = truth.image.numpy().reshape(*shape, 3), truth.sure.numpy().reshape(shape)
    own = exact_image(replace(workload, options=replace(workload.options, **options)))
    error, own_error = (errors_in(answer, image)[sure] for image in (exact, own))
    off, own_off = (float((each > 1.01 * LEVEL).mean()) for each in (error, own_error))
    not_finite = int((~np.isfinite(answer.image)).sum())
    not_finite += sum(int((~value.isfinite()).sum()) for value in answer.gradients.values())
    gradients = {name: found.relative for name, found in errors_of(answer.gradients, truth).items()}
    worst = max((name for name in gradients if gradients[name] > GRADIENT_OFF), key=gradients.__getitem__, default="")
    blank = np.ptp(answer.image, axis=(0, 1)).max() == 0 and np.ptp(exact, axis=(0, 1)).max() > 0.1
    texts = {
        "draws nothing": blank,
        f"{not_finite} numbers are not finite": not_finite,
        f"{own_off:.1%} of the pixels off, which no rule explains": own_off > 0 and not blank,
        f"{off:.1%} of the pixels off, by its own rules right": off > 0 and own_off == 0,
        f"gradient of {worst} off by {gradients.get(worst, 0):.0%}": worst,
        "runs differ": not answer.same,
    }
    found = [text for text, holds in texts.items() if holds]
    wrong = blank or not_finite or own_off or not answer.same
    level = "warning" if wrong or (worst and not off) else "note" if found else "ok"
    verdict = "; ".join(found) or "as in float64"
    numbers = (float(error.max(initial=0)), float(error.mean()) if error.size else 0.0, off, own_off)
    rest = (gradients, not_finite, answer.same, (exact, answer.image), answer.runs)
    return SceneRow(scene, SCENES[scene][0], verdict, level, *numbers, *rest)


def smallest(renderer: Renderer, workload: Workload) -> tuple[Workload, Answer]:
    """Fewer Gaussians that show the fault half as much at least, found by leaving out ever smaller parts."""

    def error_of(rows: np.ndarray) -> tuple[float, Workload, Answer]:
        fewer = replace(workload, gaussians=Gaussians(*(tensor[rows] for tensor in workload.gaussians)))
        found = renderer.draw(fewer)
        return float(errors_in(found, exact_image(fewer)).max()), fewer, found

    rows = np.arange(len(workload.gaussians.means))
    most, part, answer = error_of(rows)
    size = len(rows) // 2
    with suppress(RendererFailed):  # what was drawn until then shows the fault
        while size:
            for start in range(0, len(rows), size):
                fewer = np.delete(rows, np.arange(start, min(start + size, len(rows))))
                if len(fewer) and (found := error_of(fewer))[0] >= 0.5 * most and most > 0:
                    rows, (_, part, answer) = fewer, found
                    break
            else:
                size //= 2
    return part, answer

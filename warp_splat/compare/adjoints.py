"""Adjoint against adjoint: error, time and memory, by scene and parameter.

All variants share everything but the kernel that turns upstream gradients in blocks of pixels into a row per tile
instance (:mod:`warp_splat.raster.drivers` says where they differ). Beside the modes of ``rasterize`` stand
``generated`` (``reversible`` with its inverse as the only rule by hand), ``plain`` (the loop recorded naively: wrong),
``tape`` (``manual`` between Warp's arrays, with what that adds), the thesis's loop cap, and central differences.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from warp_splat.compare.truth import TAPE, Error, Truth, compute_truth, errors_of, gradients_of, run_passes
from warp_splat.compare.workloads import CAPS, Workload
from warp_splat.errors import InputError
from warp_splat.raster.api import render
from warp_splat.runtime import timers
from warp_splat.text import Report, table_of

ON_CPU = ("generated", "plain")  # variants without kernels for a GPU
REPEATS = 5
BUDGET = 12.0  # s for the repeats of a workload; slow ones get fewer
DIFFERENCES = 12  # parameters at which central differences are computed
STEP = 3e-3  # of central differences, relative to the opacity or what is left to 1


@dataclass(frozen=True, eq=False)
class Variant:
    """A way to an image and its gradient."""

    name: str
    adjoint: str
    changes: Mapping[str, Any] = field(default_factory=dict)  # of RasterOptions

    def of(self, workload: Workload) -> Workload:
        """The workload, with this variant's changes of its options."""
        return replace(workload, options=replace(workload.options, **self.changes))


@dataclass
class Measurement:
    """One variant on one workload; None where there is no number."""

    scene: str
    variant: str
    gaussians: int
    errors: dict[str, Error] = field(default_factory=dict)  # by parameter
    image_error: float | None = None  # largest
    forward: list[float] = field(default_factory=list)  # s, of the pixel loop, and of what a tape adds
    backward: list[float] = field(default_factory=list)  # s, of their adjoints
    stages: dict[str, float] = field(default_factory=dict)  # s of all stages of rendering and differentiating
    memory: int | None = None  # bytes at the peak of a forward and backward pass, by torch's allocator
    note: str = ""
    extrapolated: bool = False  # the time

    @property
    def worst(self) -> tuple[str, float]:
        """The parameter with the largest relative error; not the background: behind much, its gradient is next to 0."""
        known = {name: error.relative for name, error in self.errors.items() if error.relative == error.relative}
        found = [(name, known[name]) for name in known if name != "background"]
        return max(found, key=lambda item: item[1]) if found else ("-", float("nan"))

    @property
    def both(self) -> float:
        """Seconds of forward and backward pass."""
        return (median(self.forward) or 0.0) + (median(self.backward) or 0.0)


def variants_of(modes: Sequence[str], device: torch.device) -> list[Variant]:
    """The modes asked for and what only the comparison has, as far as ``device`` has it."""
    of_the_cpu = ON_CPU if device.type == "cpu" else ()
    found = [Variant(mode, mode) for mode in dict.fromkeys(("manual", *modes, *of_the_cpu, TAPE))]
    return found + [Variant(f"cap {cap}", "manual", {"max_steps": cap}) for cap in CAPS]


def run_adjoints(workloads: Sequence[Workload], modes: Sequence[str], say: Report) -> list[Measurement]:
    """Every variant on every workload, and central differences."""
    results = []
    if any(workload.device.type != "cpu" for workload in workloads):
        say(f"Left out: {', '.join(ON_CPU)}, which the CPU's kernels alone have.")
    for workload in workloads:
        start = time.perf_counter()
        truth = compute_truth(workload)
        found = {variant: first_run(workload, truth, variant) for variant in variants_of(modes, workload.device)}
        time_all(workload, found)
        results += [*found.values(), central_differences(workload, truth)]
        say(f"{workload.name}: measured in {time.perf_counter() - start:.0f} s")
    return results


def first_run(workload: Workload, truth: Truth, variant: Variant) -> Measurement:
    """Error and memory; compiles and warms up the kernels."""
    result = Measurement(workload.name, variant.name, len(workload.gaussians.means))
    workload = variant.of(workload)
    try:
        image, gradients = gradients_of(workload, truth, variant.adjoint)
    except InputError as error:  # stored refuses what does not fit
        return replace(result, extrapolated=True, note=str(error))
    result.errors = errors_of(gradients, truth)
    sure = (image - truth.image).abs()[truth.sure]
    result.image_error = float(sure.max()) if len(sure) else float("nan")
    if variant.name != TAPE:  # whose arrays are Warp's
        result.memory = peak_of(lambda: run_passes(workload, variant.adjoint), workload.device)
    return result


def time_all(workload: Workload, found: dict[Variant, Measurement]) -> None:
    """Interleaved repeats over all variants that ran, fewer where one round takes long."""
    start, rounds = time.perf_counter(), 0
    stages_of: dict[Variant, list[dict[str, float]]] = {variant: [] for variant in found if found[variant].errors}
    while rounds < REPEATS and (rounds < 2 or time.perf_counter() - start < BUDGET):
        for variant, measured in stages_of.items():
            with timers.profile() as stages:
                run_passes(variant.of(workload), variant.adjoint)
            measured.append(dict(stages))
        rounds += 1
    for variant, measured in stages_of.items():
        result = found[variant]
        result.forward = [stages["blend"] + stages.get("tape", 0.0) for stages in measured]
        result.backward = [stages["adjoint of blend"] + stages.get("adjoint of tape", 0.0) for stages in measured]
        result.stages = {name: float(np.median([stages[name] for stages in measured])) for name in measured[0]}


def peak_of(run: Callable[[], object], device: torch.device) -> int:
    """Largest sum of bytes on ``device`` that torch allocated and had not yet freed during ``run``."""
    if device.type == "cuda":
        before = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
        run()
        return torch.cuda.max_memory_allocated(device) - before
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True) as profile:
        run()
    events = profile.profiler.kineto_results.events()
    steps = [event.nbytes() for event in events if event.name() == "[memory]"]  # pyright: ignore[reportAttributeAccessIssue]
    return int(np.cumsum([0, *steps]).max())


def central_differences(workload: Workload, truth: Truth) -> Measurement:
    """Time per parameter, measured; for all of them, extrapolated. Error at the largest gradients of the opacities."""
    opacities, exact = workload.gaussians.opacities, truth.gradients["opacities"]
    chosen = exact.abs().argsort(descending=True)[:DIFFERENCES]
    found, seconds = [], []
    for index in chosen:
        start, losses = time.perf_counter(), []
        step = STEP * min(float(opacities[index]), 1.0 - float(opacities[index]))
        for sign in (1, -1):
            moved = opacities.clone()
            moved[index] += sign * step
            losses.append((_loss(workload, truth, moved), float(moved[index])))
        (high, up), (low, down) = losses
        found.append((high - low) / (up - down))
        seconds.append(time.perf_counter() - start)
    count = sum(tensor.numel() for tensor in workload.gaussians)
    error = float((torch.tensor(found, dtype=torch.float64) - exact[chosen]).norm() / exact[chosen].norm())
    each = float(np.median(seconds))
    note = f"{1e3 * each:.1f} ms per parameter, times {count}: extrapolated"
    result = Measurement(workload.name, "central differences", len(opacities), note=note, extrapolated=True)
    return replace(result, errors={"opacities": Error(error)}, backward=[each * count])


def _loss(workload: Workload, truth: Truth, opacities: torch.Tensor) -> float:
    gaussians = workload.gaussians._replace(opacities=opacities)
    with torch.no_grad():
        image = render(gaussians, workload.camera, workload.background, workload.options).image
    rows, columns = workload.pixels.T
    return float((image[rows, columns].double().cpu() * truth.weights).sum())


def records(measurements: Sequence[Measurement]) -> list[dict[str, Any]]:
    """A row per scene, variant and parameter, for CSV and JSON."""
    rows = []
    for item in measurements:
        seconds = {"forward_seconds": median(item.forward), "forward_spread": half_range(item.forward)}
        seconds |= {"backward_seconds": median(item.backward), "backward_spread": half_range(item.backward)}
        for parameter, error in (item.errors or {"": Error()}).items():
            what = {"scene": item.scene, "variant": item.variant, "gaussians": item.gaussians, "parameter": parameter}
            errors = {"relative_error": error.relative, "largest_error": error.largest, "cosine": error.cosine}
            errors |= {"bias": error.bias, "image_error": item.image_error}
            rows.append({**what, **errors, **seconds, "peak_memory": item.memory, "note": item.note})
    return rows


def adjoint_table(measurements: Sequence[Measurement]) -> str:
    """A row per scene and variant: the worst parameter's error, times, memory."""
    manual = {item.scene: item for item in measurements if item.variant == "manual"}
    found = []
    for item in measurements:
        (name, error), memory = item.worst, item.memory and item.memory / 2**20
        ratio = (median(item.backward) or 0.0) / (median(manual[item.scene].backward) or 1.0)
        relative = f"{ratio:.2f}" if ratio < 100 else f"{ratio:.0e}"
        shown = {"error": error, "of": name, "memory": memory, "relative": relative if item.backward else None}
        found.append({**timed_cells(item), **shown})
    errors = {"scene": "{scene}", "variant": "{variant}", "error": "{error:.1e}", "of": "{of}"}
    times = {"forward ms": "{forward}", "backward ms": "{backward}", "x manual": "{relative}"}
    return table_of(found, {**errors, **times, "peak MiB": "{memory:.1f}"})


def timed_cells(item: Measurement) -> dict[str, str]:
    """Scene, variant and times of a measurement, as tables show them."""
    backward = _milliseconds(item.backward) + " extrapolated" * item.extrapolated
    return {"scene": item.scene, "variant": item.variant, "forward": _milliseconds(item.forward), "backward": backward}


def _milliseconds(seconds: Sequence[float]) -> str:
    if not seconds:
        return "-"
    value, around = 1e3 * (median(seconds) or 0.0), 1e3 * (half_range(seconds) or 0.0)
    return f"{value:.2f} ± {around:.2f}" if len(seconds) > 1 else f"{value:.1e}"


def median(seconds: Sequence[float]) -> float | None:
    """Median, or None."""
    return float(np.median(seconds)) if seconds else None


def half_range(seconds: Sequence[float]) -> float | None:
    """Half of the range between the quartiles, or None."""
    return float(np.subtract(*np.percentile(seconds, [75, 25])) / 2) if seconds else None

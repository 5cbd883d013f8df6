"""Tables and plots of adjoints and knobs: error against run time, memory against depth complexity, share of stages."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.ticker import LogLocator, NullLocator

from warp_splat.compare.adjoints import Measurement, half_range, median
from warp_splat.compare.knobs import KNOBS
from warp_splat.compare.workloads import CANDIDATES
from warp_splat.evaluation import report
from warp_splat.text import format_table

#: Color and marker of a variant.
STYLES = {
    "manual": (report.BLUE, "o"),
    "stepwise": (report.ORANGE, "s"),
    "reversible": (report.GREEN, "^"),
    "stored": ("#CC79A7", "D"),
    "generated": ("#E69F00", "v"),
    "plain": (report.INK, "x"),
    "tape": (report.INK, "+"),
    "cap 2048": ("#56B4E9", "1"),
    "cap 512": ("#56B4E9", "2"),
    "cap 128": ("#56B4E9", "3"),
    "central differences": ("#999999", "P"),
}
KNOB_STYLES = dict(zip(KNOBS, [(color, marker) for color, marker in STYLES.values()][:5], strict=True))
LEAST = 1e-8  # shown instead of an error of 0 on a logarithmic axis
STAGES = ("project", "bin", "blend", "adjoint of blend", "adjoint of project")


def adjoint_table(measurements: Sequence[Measurement]) -> str:
    """A row per scene and variant: the worst parameter's error, times, memory."""
    rows = []
    for item in measurements:
        manual = next(other for other in measurements if (other.scene, other.variant) == (item.scene, "manual"))
        ratio = (median(item.backward) or 0.0) / (median(manual.backward) or 1.0) if item.backward else None
        name, error = item.worst if item.errors else ("-", None)
        times = (_milliseconds(item.forward), _milliseconds(item.backward) + " extrapolated" * item.extrapolated)
        relative = _number(ratio, "{:.2f}" if ratio and ratio < 100 else "{:.0e}")
        memory = _number(item.memory and item.memory / 2**20, "{:.1f}")
        rows.append((item.scene, item.variant, _number(error, "{:.1e}"), name, *times, relative, memory))
    headers = ("scene", "variant", "error", "of", "forward ms", "backward ms", "x manual", "peak MiB")
    return format_table(headers, rows)


def knob_table(measurements: Sequence[Measurement]) -> str:
    """A row per scene and setting: image and gradient error against everything blended, times against the default."""
    rows = []
    for item in measurements:
        default = _default(measurements, item)
        name, error = item.worst
        times = _milliseconds(item.forward), _milliseconds(item.backward), f"{_both(item) / _both(default):.2f}"
        rows.append((item.scene, item.variant, f"{item.image_error:.1e}", f"{error:.1e}", name, *times))
    headers = ("scene", "setting", "image error", "gradient error", "of", "forward ms", "backward ms", "x default")
    return format_table(headers, rows)


def plot_errors(path: Path, measurements: Sequence[Measurement]) -> None:
    """Error of the worst gradient against the time of forward and backward pass, a panel per scene."""
    scenes = list(dict.fromkeys(item.scene for item in measurements))
    rows = -(-len(scenes) // 3)
    figure, grid = report.new_panels(0.8 + 2.0 * rows, rows, 3, sharey=True)
    handles = {}
    for axes, scene in zip(grid.flat, scenes, strict=False):
        report.plain_axes(axes, scene, "forward and backward [ms]")
        here = [item for item in measurements if item.scene == scene and item.backward and item.errors]
        for item in here:
            error = max(item.worst[1], LEAST)
            if item.extrapolated:  # too far to the right to be drawn
                axes.annotate(f"differences, {_both(item):.0e} s ▸", (1, error), xycoords=("axes fraction", "data"),
                              ha="right", va="center", fontsize=7, color=STYLES[item.variant][0])  # fmt: skip
                continue
            color, marker = STYLES[item.variant]
            line = axes.loglog(1e3 * _both(item), error, marker, color=color, markersize=6, linestyle="none")[0]
            handles[item.variant] = line
        drawn = [1e3 * _both(item) for item in here if not item.extrapolated]
        axes.set_xlim(0.7 * min(drawn), 1.5 * max(drawn))
        axes.set_ylim(LEAST, 3.0)
        _plain_ticks(axes)
    for axes in grid.flat[len(scenes) :]:
        axes.set_axis_off()
    figure.supylabel("relative error of the worst gradient", fontsize=9, color=report.INK)
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    report.save_figure(figure, path)


def plot_memory(path: Path, measurements: Sequence[Measurement]) -> None:
    """Peak memory against depth complexity, a line per variant."""
    figure, axes = report.new_panels(2.8, width=report.WIDTH / 2)
    report.plain_axes(axes, "peak memory of a pass [MiB]", "candidates per pixel")
    for variant in dict.fromkeys(item.variant for item in measurements):
        points = [
            (candidates, item.memory / 2**20)
            for candidates in CANDIDATES
            for item in measurements
            if (item.scene, item.variant) == (f"{candidates} layers", variant) and item.memory
        ]
        if points and not variant.startswith("cap"):
            color, marker = STYLES[variant]
            axes.loglog(*np.array(points).T, marker=marker, color=color, linewidth=1.2, markersize=5, label=variant)
    axes.legend(fontsize=8, frameon=False)
    report.save_figure(figure, path)


def plot_stages(path: Path, measurements: Sequence[Measurement], modes: Sequence[str]) -> None:
    """Share of each stage of rendering and differentiating, a bar per scene and mode."""
    chosen = [item for item in measurements if item.variant in modes and item.stages]
    figure, axes = report.new_panels(0.8 + 0.2 * len(chosen))
    report.plain_axes(axes, "share of each stage of rendering and differentiating")
    labels = [f"{item.scene}: {item.variant}" for item in chosen]
    totals = np.array([sum(item.stages.get(stage, 0.0) for stage in STAGES) for item in chosen])
    left = np.zeros(len(chosen))
    for stage, color in zip(STAGES, ("#56B4E9", "#999999", report.BLUE, report.ORANGE, "#E69F00"), strict=True):
        share = np.array([item.stages.get(stage, 0.0) for item in chosen]) / totals
        axes.barh(labels, share, left=left, color=color, height=0.75, label=stage)
        left += share
    axes.invert_yaxis()
    axes.grid(False)
    axes.set_xlim(0, 1)
    axes.margins(y=0.01)
    axes.tick_params(axis="y", labelsize=7, length=0)
    figure.legend(loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    report.save_figure(figure, path)


def plot_knobs(path: Path, measurements: Sequence[Measurement]) -> None:
    """Error of image and gradient against time, relative to the default, a row per scene."""
    scenes = list(dict.fromkeys(item.scene for item in measurements))
    figure, grid = report.new_panels(0.5 + 2.8 * len(scenes), len(scenes), 2)
    handles = {}
    for row, scene in zip(grid, scenes, strict=True):
        here = [item for item in measurements if item.scene == scene]
        for axes, what in zip(row, ("image", "gradient"), strict=True):
            report.plain_axes(axes, f"{scene}: error of the {what}", "time of the pixel loop, default (*) = 1")
            for knob, (color, marker) in KNOB_STYLES.items():
                turned = [item for item in here if item.variant.startswith(f"{knob} ")]
                times = [_both(item) / _both(_default(here, item)) for item in turned]
                errors = [item.image_error if what == "image" else item.worst[1] for item in turned]
                errors = [max(error, LEAST) for error in errors]
                handles[knob] = axes.loglog(times, errors, marker, ls="-", color=color, lw=0.8, markersize=4)[0]
                for item, *place in zip(turned, times, errors, strict=True):
                    if place[0] > 1.2 or place[1] > 1e-5:  # the others lie on one spot
                        name = item.variant.removeprefix(f"{knob} ")
                        axes.annotate(name, place, (3, 3), textcoords="offset points", fontsize=6, color=color)
            _plain_ticks(axes)
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    report.save_figure(figure, path)


def _default(measurements: Sequence[Measurement], item: Measurement) -> Measurement:
    """The same knob at its default, on the same scene."""
    knob = item.variant.split()[0]
    here = (other for other in measurements if other.scene == item.scene and other.variant.split()[0] == knob)
    return next(other for other in here if other.variant.endswith("*"))


def _plain_ticks(axes) -> None:
    """1, 2, 5, 10 along a logarithmic x axis."""
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_locator(NullLocator())


def _both(item: Measurement) -> float:
    """Seconds of forward and backward pass."""
    return (median(item.forward) or 0.0) + (median(item.backward) or 0.0)


def _number(value: float | None, pattern: str) -> str:
    return "-" if value is None else pattern.format(value)


def _milliseconds(seconds: Sequence[float]) -> str:
    if not seconds:
        return "-"
    value, around = 1e3 * (median(seconds) or 0.0), 1e3 * (half_range(seconds) or 0.0)
    return f"{value:.2f} ± {around:.2f}" if len(seconds) > 1 else f"{value:.1e}"

"""Every plot of the comparison: error against run time, growth of errors, shares of stages."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import LogLocator, NullLocator

from warp_splat.compare.adjoints import KNOBS, Measurement, knob_default
from warp_splat.compare.workloads import CANDIDATES
from warp_splat.evaluation import report

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
LEAST = 1e-8  # shown instead of an error of 0 on a logarithmic axis
STAGES = ("project", "bin", "blend", "adjoint of blend", "adjoint of project")


@dataclass
class Panel:
    """A plot beside others.

    Args:
        title: what is drawn upward.
        x: what is drawn to the right.
        lines: what :meth:`line` was given.
        notes: point, text, offset [points of type], alignment.
        limits: of the axes, in matplotlib's words; logarithmic without.
        ticks: 1, 2, 5, 10 along x.
    """

    title: str
    x: str
    lines: list[tuple[str, Any, Any, dict[str, Any]]] = field(default_factory=list)
    notes: list[tuple[tuple[float, float], str, tuple[float, float], str]] = field(default_factory=list)
    limits: dict[str, Any] = field(default_factory=dict)
    ticks: bool = False

    def line(self, name: str, x: Any, y: Any, **style: Any) -> None:
        """A curve, or a point, by its name in the legend ("" for none) and a style in matplotlib's words."""
        self.lines.append((name, x, y, style))

    def marks(self, name: str, x: Any, y: Any, look: tuple[str, str], **style: Any) -> None:
        """Likewise with markers: color and marker; joined only if ``ls`` says how."""
        self.line(name, x, y, **{"color": look[0], "marker": look[1], "markersize": 5, "ls": "", **style})


def draw_panels(path: Path, panels: Sequence[Panel], columns: int, height: float, y: str = "", **shared: Any) -> None:
    """Panels in rows of ``height`` inches under one legend."""
    figure, grid = report.new_panels(0.8 + height * -(-len(panels) // columns), -(-len(panels) // columns), columns)
    handles = {}
    for axes, panel in zip_longest(np.ravel(grid), panels):
        if panel is None:
            axes.set_axis_off()
            continue
        report.plain_axes(axes, panel.title, panel.x)
        for name, along, values, style in panel.lines:
            line = axes.plot(along, values, **style)[0]
            handles |= {name: line} if name else {}
        for note in panel.notes:
            report.label_point(axes, *note)
        axes.set(**{"xscale": "log", "yscale": "log", **shared, **panel.limits})
        axes.minorticks_off()
        if panel.ticks:
            axes.xaxis.set(major_locator=LogLocator(subs=(1, 2, 5)), minor_locator=NullLocator())
            axes.xaxis.set_major_formatter("{x:g}")
    figure.supylabel(y, fontsize=9, color=report.INK)
    look = {"loc": "outside lower center", "ncols": 5, "fontsize": 8, "frameon": False}
    figure.legend(list(handles.values()), list(handles), **look)
    report.save_figure(figure, path)


def plot_errors(path: Path, measurements: Sequence[Measurement]) -> None:
    """Error of the worst gradient against the time of forward and backward pass, a panel per scene."""
    panels = []
    for scene in dict.fromkeys(item.scene for item in measurements):
        here = [item for item in measurements if item.scene == scene and item.backward and item.errors]
        times = [1e3 * item.both for item in here if not item.extrapolated]
        limits = {"xlim": (0.7 * min(times), 1.5 * max(times)), "ylim": (LEAST, 3.0)}
        panel = Panel(scene, "forward and backward [ms]", limits=limits, ticks=True)
        for item in here:
            place = 1e3 * item.both, max(item.worst[1], LEAST)
            if item.extrapolated:  # too far to the right to be drawn
                at = (limits["xlim"][1], place[1])
                panel.notes.append((at, f"differences, {item.both:.0e} s ▸", (0, -3), "right"))
            else:
                panel.marks(item.variant, *place, STYLES[item.variant])
        panels.append(panel)
    draw_panels(path, panels, 3, 2.0, "relative error of the worst gradient")


def plot_memory(path: Path, measurements: Sequence[Measurement]) -> None:
    """Peak memory against depth complexity, a line per variant."""
    panel = Panel("peak memory of a pass [MiB]", "candidates per pixel")
    of = {(item.scene, item.variant): item.memory for item in measurements if item.memory}
    for variant in dict.fromkeys(item.variant for item in measurements if not item.variant.startswith("cap")):
        points = [(n, of[key] / 2**20) for n in CANDIDATES if (key := (f"{n} layers", variant)) in of]
        if points:
            panel.marks(variant, *np.array(points).T, STYLES[variant], ls="-", linewidth=1.2)
    draw_panels(path, [panel], 1, 2.8)


def plot_stages(path: Path, measurements: Sequence[Measurement], modes: Sequence[str]) -> None:
    """Share of each stage of rendering and differentiating, a bar per scene and mode."""
    chosen = [item for item in measurements if item.variant in modes and item.stages]
    figure, axes = report.new_panels(0.8 + 0.2 * len(chosen))
    report.plain_axes(axes, "share of each stage of rendering and differentiating")
    seconds = np.array([[item.stages.get(stage, 0.0) for stage in STAGES] for item in chosen])
    share = seconds / seconds.sum(1, keepdims=True)
    left = np.cumsum(share, 1) - share
    labels = [f"{item.scene}: {item.variant}" for item in chosen]
    for place, color in enumerate(("#56B4E9", "#999999", report.BLUE, report.ORANGE, "#E69F00")):
        axes.barh(labels, share[:, place], left=left[:, place], color=color, height=0.75, label=STAGES[place])
    axes.set(xlim=(0, 1), ymargin=0.01)
    axes.invert_yaxis()
    axes.grid(False)
    axes.tick_params(axis="y", labelsize=7, length=0)
    figure.legend(loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    report.save_figure(figure, path)


def plot_knobs(path: Path, measurements: Sequence[Measurement]) -> None:
    """Error of image and gradient against time, relative to the default, a row per scene."""
    panels = []
    for scene in dict.fromkeys(item.scene for item in measurements):
        here = [item for item in measurements if item.scene == scene]
        for what in ("image", "gradient"):
            panel = Panel(f"{scene}: error of the {what}", "time of the pixel loop, default (*) = 1", ticks=True)
            for knob, style in zip(KNOBS, STYLES.values(), strict=False):
                turned = [item for item in here if item.variant.startswith(f"{knob} ")]
                times = [item.both / knob_default(here, item).both for item in turned]
                errors = [(item.image_error or 0.0) if what == "image" else item.worst[1] for item in turned]
                errors = [max(error, LEAST) for error in errors]
                panel.marks(knob, times, errors, style, ls="-", lw=0.8)
                for item, *place in zip(turned, times, errors, strict=True):
                    if place[0] > 1.2 or place[1] > 1e-5:  # the others lie on one spot
                        panel.notes.append((tuple(place), item.variant.removeprefix(f"{knob} "), (3, 3), "left"))
            panels.append(panel)
    draw_panels(path, panels, 2, 2.8)

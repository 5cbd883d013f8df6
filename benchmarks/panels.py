"""Plots beside others under one legend."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import LogLocator, NullLocator

from warp_splat.evaluation import report


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

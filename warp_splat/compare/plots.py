"""The plot of the comparison: error against run time."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.ticker import LogLocator, NullLocator

from warp_splat.compare.adjoints import Measurement
from warp_splat.compare.workloads import CAPS
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
    **{f"cap {cap}": ("#56B4E9", str(number)) for number, cap in enumerate(CAPS, 1)},
    "central differences": ("#999999", "P"),
}
LEAST = 1e-8  # shown instead of an error of 0 on a logarithmic axis


def plot_errors(path: Path, measurements: Sequence[Measurement]) -> None:
    """Error of the worst gradient against the time of forward and backward pass, a panel per scene."""
    scenes = list(dict.fromkeys(item.scene for item in measurements))
    lines, handles = -(-len(scenes) // 3), {}
    figure, grid = report.new_panels(0.8 + 2.0 * lines, lines, 3)
    for axes in np.ravel(grid)[len(scenes) :]:
        axes.set_axis_off()
    for axes, scene in zip(np.ravel(grid), scenes, strict=False):
        here = [item for item in measurements if item.scene == scene and item.backward and item.errors]
        times = [1e3 * item.both for item in here if not item.extrapolated]
        right = 1.5 * max(times)
        report.plain_axes(axes, scene, "forward and backward [ms]")
        for item in here:
            time, error = 1e3 * item.both, max(item.worst[1], LEAST)
            if item.extrapolated:  # too far to the right to be drawn
                report.label_point(axes, (right, error), f"differences, {item.both:.0e} s ▸", (0, -3), "right")
            else:
                color, marker = STYLES[item.variant]
                (handles[item.variant],) = axes.plot(time, error, color=color, marker=marker, markersize=5, ls="")
        axes.set(xscale="log", yscale="log", xlim=(0.7 * min(times), right), ylim=(LEAST, 3.0))
        axes.minorticks_off()
        axes.xaxis.set(major_locator=LogLocator(subs=(1, 2, 5)), minor_locator=NullLocator(), major_formatter="{x:g}")
    figure.supylabel("relative error of the worst gradient", fontsize=9, color=report.INK)
    look = {"loc": "outside lower center", "ncols": 5, "fontsize": 8, "frameon": False}
    figure.legend(list(handles.values()), list(handles), **look)
    report.save_figure(figure, path)

"""Pictures of the comparison with physics: error against run time, and maps of what splatting gets wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warp_splat.compare.volume import media
from warp_splat.evaluation import report
from warp_splat.evaluation.report import FAINT, INK


def plot_integrators(path: Path, integrators: Sequence[Mapping[str, Any]], limits: Sequence[Mapping[str, Any]]) -> None:
    """Draw error against run time, a panel for each optical depth, and error against tau ds around the limits."""
    figure, grid = report.new_panels(5.4, 2, 3)
    figure.supylabel("largest error of the radiance (colors 0 to 1)", fontsize=9, color=INK)
    for axes, optical_depth in zip(grid.flat, media.OPTICAL_DEPTHS, strict=False):
        chosen = [r for r in integrators if r["optical_depth"] == optical_depth]
        _style(axes, f"optical depth {media.plain(optical_depth)}", f"run time for {media.RAYS} rays [ms]")
        for name, (*_, color, marker) in media.METHODS.items():
            stable = [(1e3 * r["seconds"], r["error"]) for r in chosen if r["method"] == name and r["stable"]]
            unstable = [1e3 * r["seconds"] for r in chosen if r["method"] == name and not r["stable"]]
            if stable:
                axes.plot(*zip(*stable, strict=True), color=color, marker=marker, markersize=4, linewidth=1.4)
            # crosses in a row of their own, above every error
            axes.plot(unstable, [6.0 if name == "Euler" else 60.0] * len(unstable), "x", color=color, markersize=5)
        axes.set_ylim(1e-16, 1e3)
        axes.axhline(media.UNSTABLE, color=INK, linewidth=0.6, linestyle=":")
    axes = grid[-1, -1]
    _style(axes, f"step limit at {media.plain(media.LIMIT_DEPTHS[-1])}", "tau ds at the peak of tau")
    for record in limits[-len(media.METHODS) :]:  # those of the densest medium
        theory, color = media.METHODS[record["method"]][2:4]
        axes.plot(record["tau_ds"], np.minimum(record["errors"], 1e6), color=color, linewidth=1.4)  # some are inf
        if np.isfinite(theory):
            axes.axvline(theory, color=color, linewidth=1, linestyle="--")
    axes.set_ylim(1e-16, 1e3)
    axes.set_xticks([1, 2, 5, 10, 20], labels=["1", "2", "5", "10", "20"])
    axes.minorticks_off()
    for name, (*_, color, marker) in media.METHODS.items():
        axes.plot([], [], color=color, marker=marker, markersize=4, label=name)
    axes.plot([], [], "x", color=INK, label="unstable: error above 1")
    axes.plot([], [], "--", color=INK, linewidth=1, label="stability limit for constant tau")
    figure.legend(loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    report.save_figure(figure, path)


def _style(axes: Any, title: str, x: str) -> None:
    report.plain_axes(axes, title, x)
    axes.set(xscale="log", yscale="log")
    axes.grid(color=FAINT, linewidth=0.5)


def plot_maps(path: Path, scenes: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Draw for each scene the truth, the renderer's image, and where each rung of the ladder is wrong."""
    from matplotlib.colors import LogNorm  # noqa: PLC0415 - half a second, only for pictures

    figure = report.new_figure(report.WIDTH, 4.2, layout="compressed")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.02, hspace=0.02)
    grid = figure.subplots(len(scenes), 1 + len(media.PARENT))
    shown = None
    for row, (scene, images) in zip(grid, scenes.items(), strict=True):
        row[0].imshow(images["truth"].clip(0, 1))
        row[0].set_ylabel(scene.replace(" at", "\nat"), fontsize=8, color=INK)
        for axes, rung in zip(row[1:], media.PARENT, strict=True):
            error = np.abs(images[rung] - images["truth"]).mean(-1)
            shown = axes.imshow(error.clip(media.LEAST_ERROR), cmap="inferno", norm=LogNorm(media.LEAST_ERROR, 0.3))
            mean = f"{error.mean():.1e}" if error.mean() > 1e-12 else "exact"
            axes.set_xlabel(mean, fontsize=8, color=INK, labelpad=2)
        for axes in row:
            axes.set_xticks([])
            axes.set_yticks([])
            axes.spines[:].set_visible(False)
    for axes, title in zip(grid[0], ("truth", *media.PARENT), strict=True):
        axes.set_title(title, fontsize=8, fontweight="bold", color=INK)
    bar = figure.colorbar(shown, ax=grid, orientation="horizontal", fraction=0.05, aspect=70, extend="both")
    bar.set_label("|error|, mean of the channels (colors 0 to 1); under each map its mean", fontsize=8)
    bar.ax.tick_params(labelsize=8, labelcolor=INK)
    report.save_figure(figure, path)

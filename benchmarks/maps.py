"""Images beside maps of how far others are from them."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.colors import LogNorm

from warp_splat.evaluation import report

MOST_ERROR = 0.3  # of maps


def plot_maps(
    path: Path, rows: Mapping[str, Sequence[tuple[str, np.ndarray, np.ndarray | None]]], height: float, least: float
) -> None:
    """Draw images in rows: a title, the truth, and what is to be compared with it, or None for the truth itself."""
    figure = report.new_figure(report.WIDTH, height, layout="compressed")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.02, hspace=0.02)
    grid = figure.subplots(len(rows), max(len(row) for row in rows.values()))
    shown = None
    for line, (cells, (name, row)) in enumerate(zip(grid, rows.items(), strict=True)):
        cells[0].set_ylabel(name, fontsize=7, color=report.INK)
        for axes, (title, truth, found) in zip(cells, row, strict=True):
            if found is None:
                axes.imshow(np.nan_to_num(truth, nan=1.0).clip(0, 1))
            else:
                error = np.abs(found - truth).mean(-1)
                shown = axes.imshow(error.clip(least), cmap="inferno", norm=LogNorm(least, MOST_ERROR))
                mean = np.nanmean(error)
                axes.set_xlabel(f"{mean:.1e}" if mean > 1e-12 else "exact", fontsize=7, color=report.INK, labelpad=1)
            if not line:
                axes.set_title(title, fontsize=7, fontweight="bold", color=report.INK)
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
    bar = figure.colorbar(shown, ax=grid, orientation="horizontal", fraction=0.05, aspect=70, extend="both")
    bar.set_label("|error|, mean of the channels (colors 0 to 1); under each map its mean", fontsize=8)
    bar.ax.tick_params(labelsize=8, labelcolor=report.INK)
    report.save_figure(figure, path)

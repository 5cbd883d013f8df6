"""Pictures and tables of a result: views beside photographs, training curves, time by stage.

Colors are those of Okabe and Ito (2008), which people with color vision deficiencies can tell apart.
"""

from __future__ import annotations

import datetime
import itertools
import os
import platform
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from warp_splat.errors import InputError
from warp_splat.formats.files import atomic_write
from warp_splat.runtime.interrupts import later

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLUE, ORANGE, GREEN = "#0072B2", "#D55E00", "#009E73"
INK, FAINT = "#222222", "#d9d9d9"
DPI = 200  # sharp on dense displays at the width of a README, about 850 px
WIDTH = 8.0  # inches
TALLEST = 4.0  # height of a picture on a sheet in widths of its cell, at most; a taller one is drawn narrower
DIFFERENCE_GAIN = 4  # a difference of a quarter of the range is white


Row = tuple[str, np.ndarray, np.ndarray, str]  # of a sheet: name, photograph, render, what to say of it


def contact_sheet(path: str | Path, sections: Mapping[str, Sequence[Row]], columns: int = 1) -> None:
    """Draw views as photograph, render and their absolute difference, 1600 pixels wide.

    The last is the mean over the channels, amplified fourfold; a bar at the head gives its scale in levels of 255.

    Args:
        path: the file to write, .png, or .jpg for a smaller one.
        sections: views under a heading each, which may be empty; of each view its name, photograph and render,
            [H, W, 3] uint8 of one size, and what to say of it.
        columns: views side by side, at most 4; more than one suits portrait photographs.

    Raises:
        InputError: if there are no views, or a photograph and its render differ in size; if the file cannot be written.
    """
    lines: list[tuple[str, Sequence[Row]]] = []  # a heading, or none, and the views below it, side by side
    for title, rows in sections.items():
        starts = range(0, len(rows), columns)
        lines += [(title if start == 0 else "", rows[start : start + columns]) for start in starts]
    if not lines:
        raise InputError("sections: expected at least one view, got none.")
    margin, gap, text, heading = 0.1, 0.04, 0.22, 0.26  # inches
    cell = (WIDTH - 2 * margin - (columns - 1) * 2 * gap) / (3 * columns)
    shapes = [max(photo.shape[0] / photo.shape[1] for _, photo, *_ in line) for _, line in lines]
    heights = [min(shape, TALLEST) * (cell - gap) for shape in shapes]
    titles = [heading * (bool(title) or number == 0) for number, (title, _) in enumerate(lines)]
    figure = new_figure(WIDTH, heading + sum(heights) + sum(titles) + len(lines) * (text + gap) + margin)
    top = figure.get_figheight()
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, WIDTH), ylim=(0, top), autoscale_on=False)  # in inches
    axes.set_axis_off()
    _draw_scale(axes, WIDTH - margin - gap, top - heading + 0.04)
    lefts = [margin + column * (3 * cell + 2 * gap) for column in range(max(len(line) for _, line in lines))]
    for number, ((title, line), height, extra) in enumerate(zip(lines, heights, titles, strict=True)):
        top -= extra
        _write(figure, margin, top + 0.04, title, weight="bold")
        if number == 0:
            top -= heading
            for left, (place, head) in itertools.product(lefts, enumerate(("photo", "render", "error"))):
                _write(figure, left + place * cell, top + 0.04, head, weight="bold")
        top -= text + height
        for left, (name, photo, render, said) in zip(lefts, line, strict=False):
            told = [said] if cell > 2 else said.split(", ")[: 1 + (cell > 1)]  # as many as there is room for
            captions = (_shorten(name, cell), *told, *[""] * (2 - len(told)))
            pictures = (photo, render, _difference(photo, render))
            for place, (picture, caption) in enumerate(zip(pictures, captions, strict=True)):
                _place_picture(axes, (left + place * cell, top, cell - gap, height), picture, caption)
        top -= gap
    save_figure(figure, path)


def plot_training(path: str | Path, history: Sequence[Mapping[str, float]], split: str = "test") -> None:
    """Draw loss, PSNR and number of Gaussians over the iterations and PSNR over seconds, as far as they were recorded.

    Args:
        path: the file to write, such as .png.
        history: records with ``iteration`` and any of ``loss``, ``psnr`` [dB], ``gaussians`` and ``seconds``, in order.
        split: of which views the PSNR is.

    Raises:
        InputError: if nothing was recorded; if the file cannot be written.
    """
    quality = f"{split} PSNR [dB]"
    panels = (
        ("iteration", "loss", "loss", BLUE),
        ("iteration", "psnr", quality, ORANGE),
        ("seconds", "psnr", quality, ORANGE),
        ("iteration", "gaussians", "Gaussians", GREEN),
    )
    drawn = []
    for x, key, title, color in panels:
        points = [(record[x], record[key]) for record in history if x in record and key in record]
        drawn += [(x, key, title, color, np.array(points, dtype=np.float64).T)] * bool(points)
    if not drawn:
        raise InputError("history: expected records with loss, psnr or gaussians, got none.")
    figure, grid = new_panels(2.5, 1, len(drawn))
    for axes, (x, key, title, color, (along, values)) in zip(np.ravel(grid), drawn, strict=True):
        plain_axes(axes, title, x)
        if key == "loss":
            axes.plot(along, values, color=color, linewidth=0.6, alpha=0.25)
        smooth = _smooth(values) if key == "loss" else values
        axes.plot(along, smooth, color=color, linewidth=1.8, marker="o" if key == "psnr" else "", markersize=4)
        if key == "psnr":
            label_point(axes, (along[-1], values[-1]), f"{values[-1]:.2f}", (0, -14), "right")
        else:
            axes.set_ylim(bottom=0)
        axes.yaxis.set_major_formatter(_thousands)
        axes.xaxis.set_major_formatter(_thousands)
    save_figure(figure, path)


def plot_profile(path: str | Path, stages: Mapping[str, float]) -> None:
    """Draw the time of each stage as a bar with its share of the whole.

    Args:
        path: the file to write, such as .png.
        stages: milliseconds of each stage, in the order of the data flow, which becomes the order of the bars.

    Raises:
        InputError: if there are no stages; if the file cannot be written.
    """
    if not stages:
        raise InputError("stages: expected at least one, got none.")
    times = np.array(list(stages.values()), dtype=np.float64)
    total = times.sum()
    figure, axes = new_panels(0.7 + 0.28 * len(times))
    plain_axes(axes, f"time by stage, {total:.3g} ms in all")
    axes.grid(False)
    axes.barh(list(stages), times, color=BLUE, height=0.7)
    for row, time in enumerate(times):
        share = 100 * time / total if total > 0 else 0.0
        label_point(axes, (time, row), f"{time:.3g} ms  ({share:.0f} %)", (4, -3), "left")
    axes.invert_yaxis()
    axes.set_xlim(0, 1.2 * max(times.max(), 1e-9))
    axes.set_xticks([])
    axes.spines["bottom"].set_visible(False)
    axes.tick_params(axis="y", length=0)
    save_figure(figure, path)


def machine() -> str:
    """Processor, cores, operating system and date."""
    info = Path("/proc/cpuinfo")
    named = re.search(r"model name\s*:\s*(.*)", info.read_text() if info.exists() else "")
    processor = named[1] if named else platform.processor() or platform.machine()
    return f"{processor}, {os.cpu_count()} cores, {platform.system()}, {datetime.date.today()}"


def _difference(photo: np.ndarray, render: np.ndarray) -> np.ndarray:
    """[H, W] uint8: mean absolute difference of the channels, amplified and cut at white."""
    if photo.shape != render.shape:
        raise InputError(f"rows: expected a render of shape {photo.shape}, got {render.shape}.")
    return np.minimum(DIFFERENCE_GAIN * np.abs(photo.astype(np.float64) - render).mean(axis=2), 255).astype(np.uint8)


def _smooth(values: np.ndarray) -> np.ndarray:
    """Running mean over a twentieth of the values, centered, or what there is of it at the ends."""
    window = np.ones(2 * (len(values) // 40) + 1)
    return np.convolve(values, window, "same") / np.convolve(np.ones_like(values), window, "same")


def new_figure(width: float, height: float, layout: Literal["constrained", "compressed"] | None = None) -> Figure:
    """An empty figure in inches that belongs to no pyplot state and needs no display."""
    with later():
        from matplotlib.figure import Figure  # noqa: PLC0415 - half a second, only for pictures

    warnings.filterwarnings("ignore", "Glyph", UserWarning)  # of letters in names that the font has not
    return Figure(figsize=(width, height), dpi=DPI, layout=layout, facecolor="white")


def new_panels(height: float, rows: int = 1, columns: int = 1, **shared) -> tuple[Figure, Any]:
    """A figure in inches with axes in rows and columns, [rows, columns]; one alone for 1 x 1."""
    figure = new_figure(WIDTH, height, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=rows * columns == 1, **shared)


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure, whole or not at all. Raises InputError if the file cannot be written."""
    with atomic_write(path) as temporary:
        figure.savefig(temporary)


def _place_picture(axes: Axes, box: tuple[float, float, float, float], picture: np.ndarray, title: str) -> None:
    """Show ``picture`` in ``box`` = (left, bottom, width, height) [inches], from its top, and a title above it."""
    left, bottom, width, height = box
    inches, top = min(width / picture.shape[1], height / picture.shape[0]), bottom + height
    place = (left, left + inches * picture.shape[1], top - inches * picture.shape[0], top)
    axes.imshow(picture, cmap="inferno", vmin=0, vmax=255, aspect="auto", extent=place)
    _write(axes.figure, left, top + 0.035, title)


def _draw_scale(axes: Axes, right: float, bottom: float) -> None:
    """What the colors of an error mean, ending at ``right`` [inches]."""
    bar, words = 0.8, 0.62  # inches
    start = right - words - bar
    _write(axes.figure, start - 0.06, bottom, "error, mean of the channels:  0", align="right")
    _place_picture(axes, (start, bottom, bar, 0.1), np.linspace(0, 255, 256)[None].repeat(32, 0), "")
    _write(axes.figure, start + bar + 0.06, bottom, f"{255 / DIFFERENCE_GAIN:.0f} of 255")


def _write(figure: Figure, left: float, bottom: float, text: str, weight: str = "normal", align: str = "left") -> None:
    """Text that begins, or ends, at a place in inches."""
    style = {"fontsize": 9 if weight == "bold" else 8, "fontweight": weight, "color": INK, "parse_math": False}
    figure.text(left, bottom, text, ha=align, transform=figure.dpi_scale_trans, **style)


def _shorten(name: str, inches: float) -> str:
    """The end of a name that is too long for its cell: views of one scene differ there."""
    letters = int(inches * 15)  # of 8 points, about 1/15 inch each
    return name if len(name) <= letters else "…" + name[1 - letters :]


def plain_axes(axes: Axes, title: str, x: str = "") -> None:
    """The look of all plots: a bold title in place of a label, few lines, a faint grid; ``x`` is told below."""
    axes.set_xlabel(x, fontsize=9, color=INK)
    axes.set_title(title, loc="left", fontsize=10, fontweight="bold", color=INK, parse_math=False)  # of a path, maybe
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.spines["bottom"].set_color(FAINT)
    axes.tick_params(labelsize=9, labelcolor=INK, color=FAINT)
    axes.grid(axis="y", color=FAINT, linewidth=0.6)
    axes.set_axisbelow(True)


def label_point(axes: Axes, at: tuple[float, float], text: str, offset: tuple[float, float], align: str) -> None:
    """Write ``text`` beside a point, ``offset`` in points of type."""
    axes.annotate(text, at, offset, textcoords="offset points", ha=align, fontsize=9, color=INK)


def _thousands(value: float, _position: int) -> str:
    """1500 as 1.5k, 2e6 as 2M, small numbers as they are."""
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:.3g}{letter}"
    return f"{value:.3g}"

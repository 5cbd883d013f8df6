"""Renders beside photographs, in the reference's folders, and their metrics: as numbers, a table and a sheet."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from warp_splat.camera import Camera
from warp_splat.evaluation import report
from warp_splat.evaluation.metrics import Metric, psnr, write_results
from warp_splat.formats.files import write_text
from warp_splat.formats.png import load_png, save_png
from warp_splat.scene.decoding import in_turn
from warp_splat.scene.types import View
from warp_splat.text import Report, format_table

POSE = "PSNR_POSE"  # PSNR from where the model says that a photograph was taken
DECIBELS = ("PSNR", "CC_PSNR", POSE)
#: From a camera, exposed as the photograph of a name: [H, W, 3] uint8.
Picture = Callable[[Camera, str], np.ndarray]
TOLD = 10  # views, at most, in the table that is printed


def write_views(picture: Picture, views: list[View], folder: Path) -> Iterator[tuple[View, np.ndarray]]:
    """Write ``renders/00000.png``, ``gt/00000.png`` and, of views with one, ``masks/00000.png`` ... in ``folder``.

    One after another: each view, in memory, and its render. At the end, surplus images of an earlier run are removed:
    metrics are taken over all that lie there.
    """
    kept = set()
    for index, view in enumerate(in_turn(views)):
        render = picture(view.camera, view.name)
        pictures = {"renders": render, "gt": view.picture}
        if view.mask is not None:
            pictures["masks"] = np.repeat(255 * view.mask[..., None], 3, axis=2)
        for name, pixels in pictures.items():
            save_png(folder / name / f"{index:05d}.png", pixels)
            kept.add(folder / name / f"{index:05d}.png")
        yield view, render
    for old in [path for name in ("renders", "gt", "masks") for path in folder.glob(f"{name}/*.png")]:
        if old.stem.isdigit() and old not in kept:
            old.unlink()


class Comparison(NamedTuple):
    """One view, seen and rendered."""

    view: View
    render: Path  # of the same size
    values: dict[str, float]  # of each metric


def evaluate_views(
    picture: Picture,
    views: list[View],
    model_folder: Path,
    split: str,
    iteration: int,
    extra: dict,
    metrics: Mapping[str, Metric],
    where_taken: Callable[[View], Camera] | None = None,
) -> tuple[dict[str, float], list[Comparison]]:
    """Render ``views`` into ``<model>/<split>/ours_<iteration>``, and take ``metrics`` of these 8-bit images.

    With ``where_taken``, also the PSNR of renders from there, under a name of its own.

    Returns:
        The mean of each metric, and each view with its values.

    Raises:
        InputError: if a file cannot be written.
    """
    compared, folder = [], model_folder / split / f"ours_{iteration}"
    for index, (view, render) in enumerate(write_views(picture, views, folder)):
        photo, mask = view.picture, view.mask
        values = {name: measure(render, photo, mask) for name, measure in metrics.items()}
        if where_taken:
            values[POSE] = psnr(picture(where_taken(view), view.name), photo, mask)
        compared.append(Comparison(views[index], folder / "renders" / f"{index:05d}.png", values))
    per_view = {name: {view.render.name: view.values[name] for view in compared} for name in compared[0].values}
    means = {name: sum(values.values()) / len(values) for name, values in per_view.items()}
    write_results(model_folder, iteration, {**means, **extra}, per_view)
    return means, compared


def show_views(compared: list[Comparison], folder: Path, split: str, iteration: int, say: Report) -> None:
    """A sheet of the worst and the best views, and a table of all: ``contact_sheet.png``, ``per_view.md``.

    ``say`` gets the table, or the worst of its lines where there are many.

    Raises:
        InputError: if a file cannot be written.
    """
    ranked = sorted(compared, key=lambda view: view.values["PSNR"])
    portrait = compared[0].view.camera.height > compared[0].view.camera.width
    columns, each = (2, 4) if portrait else (1, 3)  # whole lines
    what = f"{len(compared)} {split} views after {iteration} iterations"
    if len(ranked) <= 2 * each:
        sections = {f"{what}, the worst first": ranked}
    else:
        sections = {f"the worst of {what}": ranked[:each], "the best": ranked[: -each - 1 : -1]}
    rows = {
        title: [(one.view.name, one.view.picture, load_png(one.render), metrics_line(one.values)) for one in some]
        for title, some in sections.items()
    }
    report.contact_sheet(folder / "contact_sheet.png", rows, columns)
    write_text(folder / "per_view.md", f"{what}:\n\n{_table(compared)}\n")
    if len(ranked) > TOLD:
        say(f"The worst {TOLD} of {what} (all of them in {folder / 'per_view.md'}):")
    say(_table(ranked[:TOLD]))


def metrics_line(values: Mapping[str, float]) -> str:
    """PSNR 27.68 dB, CC_PSNR 28.10 dB, SSIM 0.8514, ..."""
    order = sorted(values, key=lambda name: name not in DECIBELS)
    return ", ".join(f"{name} {_rounded(name, values[name])}{' dB' * (name in DECIBELS)}" for name in order)


def _table(views: list[Comparison]) -> str:
    names = list(views[0].values)
    rows = [(view.view.name, *(_rounded(name, view.values[name]) for name in names)) for view in views]
    return format_table(("view", *names), rows)


def _rounded(metric: str, value: float) -> str:
    return f"{value:.2f}" if metric in DECIBELS else f"{value:.4f}"

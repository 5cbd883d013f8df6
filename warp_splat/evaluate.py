"""Renders beside photographs, in the reference's folders, and their metrics."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from warp_splat.camera import Camera
from warp_splat.formats.png import save_png
from warp_splat.metrics import evaluate_folder, write_results
from warp_splat.scene.types import View


def write_views(picture: Callable[[Camera], np.ndarray], views: list[View], folder: Path) -> list[np.ndarray]:
    """Write ``renders/00000.png``, ``gt/00000.png`` and, of views with one, ``masks/00000.png`` ... in ``folder``.

    Returns the renders. Surplus images of an earlier run are removed: metrics are taken over all that lie there.
    """
    renders = []
    kept = set()
    for index, view in enumerate(views):
        renders.append(picture(view.camera))
        pictures = {"renders": renders[-1], "gt": view.picture}
        if view.mask is not None:
            pictures["masks"] = np.repeat(255 * view.mask[..., None], 3, axis=2)
        for name, pixels in pictures.items():
            save_png(folder / name / f"{index:05d}.png", pixels)
            kept.add(folder / name / f"{index:05d}.png")
    for old in [path for name in ("renders", "gt", "masks") for path in folder.glob(f"{name}/*.png")]:
        if old.stem.isdigit() and old not in kept:
            old.unlink()
    return renders


def evaluate_views(
    picture: Callable[[Camera], np.ndarray],
    views: list[View],
    model_folder: Path,
    split: str,
    iteration: int,
    extra: dict,
) -> tuple[dict[str, float], list[tuple[str, np.ndarray, np.ndarray, float]]]:
    """Render ``views`` into ``<model>/<split>/ours_<iteration>``, then PSNR and SSIM of the saved 8-bit images.

    Returns:
        The mean of each metric, and for each view its name, photograph, render and PSNR [dB].

    Raises:
        InputError: if a file cannot be written.
    """
    folder = model_folder / split / f"ours_{iteration}"
    renders = write_views(picture, views, folder)
    means, per_view = evaluate_folder(folder)
    write_results(model_folder, iteration, means, per_view, extra)
    values = per_view["PSNR"].values()
    return means, [(v.name, v.picture, r, p) for v, r, p in zip(views, renders, values, strict=True)]

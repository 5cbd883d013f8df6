"""``warp-splat clean``: leaves out floaters, Gaussians that hang right before few cameras.

A Gaussian is one if the training views that carry it are few, by their weights w: (sum w)^2 / (sum w^2) < ``views``;
and if it lies nearer to them than most of what they show. Both are needed. Tried, held-out PSNR of models of two
scenes, 31.57 and 21.78 dB before:

- 31.59 and 21.76 dB: both
- 31.45 and 21.97 dB: less than 1.5 views alone; the edges of a scene have no more either, and one view lost 0.95 dB
- 31.38 and 21.75 dB: less than 2 views alone
- 31.57 and 21.79 dB: instead of near, before what many views carry, by an adjoint of an image of that
"""

import numpy as np
import torch

from warp_splat.config import CleanConfig
from warp_splat.errors import InputError
from warp_splat.evaluation.metrics import psnr
from warp_splat.evaluation.report import contact_sheet
from warp_splat.formats.splats import SplatArrays
from warp_splat.pruning.opened import Opened, as_held, output_of, write
from warp_splat.pruning.score import ViewSetting, weights
from warp_splat.pruning.thinning import model_of, tuned

SHOWN = 3  # views on the sheet: those that changed most


def clean(config: CleanConfig) -> int:
    """Clean as ``config`` says; returns the process's exit code.

    Raises:
        InputError: if the model, its scene or an option is not usable; if nothing would be left.
    """
    output = output_of(config, "cleaned.ply")
    opened = Opened(config)
    before = opened.file.splats
    if (found := floaters(before, opened.setting, config.views, config.near)).all():
        raise InputError(f"{config.model}: nothing would be left; choose lower --views or --near.")
    left = as_held(output, opened.file._replace(splats=before.take(np.flatnonzero(~found))))
    splats = left.splats
    if config.steps:
        parts = {*str(opened.trained.get("parts", "")).split(","), "floaters"}
        trained = {**opened.trained, "parts": ",".join(sorted(parts))}
        splats = tuned(opened.scene, left, opened.setting, len(splats.means), config.steps, trained, opened.exposures)
    saved = write(output, opened, splats)
    opened.print_quality(before, saved)
    sheet = output.with_suffix(".sheet.png")
    _draw(opened, before, splats, sheet)
    print(f"  the views that changed most, before and after: {sheet}")
    return int(saved != output)


def floaters(splats: SplatArrays, setting: ViewSetting, views: float, near: float) -> np.ndarray:
    """Which Gaussians hang right before few cameras, [N] bool.

    Args:
        splats: the model.
        setting: the training views.
        views: that carry a Gaussian, below which it may be one.
        near: its depth in them, below which it may be one, as a share of the depth of half of what they show.
    """
    model = model_of(splats, setting)
    with torch.no_grad():
        gaussians = model.activated()
    total, squares, nearness = torch.zeros(3, len(model), dtype=torch.float64, device=model.device)
    for view in setting.views:
        weight, depth = weights(gaussians, view, setting)
        order = torch.argsort(depth)
        ahead = torch.cumsum(weight[order], 0)
        middle = depth[order][torch.searchsorted(ahead, 0.5 * ahead[-1:]).clamp_max(len(order) - 1)].clamp_min(1e-12)
        total += weight
        squares += weight**2
        nearness += weight * (depth / middle)
    return ((total**2 < views * squares) & (nearness < near * total)).cpu().numpy()


def _draw(opened: Opened, before: SplatArrays, after: SplatArrays, path) -> None:
    """A sheet of the views that changed most, before and after."""
    views = [*opened.scene.test, *opened.scene.train]
    pictures = [opened.picture_of(splats) for splats in (before, after)]
    pair = lambda view: [picture(view.camera, view.name) for picture in pictures]  # noqa: E731 - memory holds few
    changes = [np.abs(one.astype(int) - other).mean() for one, other in map(pair, views)]
    sections: dict[str, list] = {"before": [], "after": []}
    for index in np.argsort(changes, kind="stable")[::-1][:SHOWN]:
        view = views[index]
        for rows, render in zip(sections.values(), pair(view), strict=True):
            rows.append((view.name, view.picture, render, f"PSNR {psnr(render, view.picture, view.mask):.2f} dB"))
    contact_sheet(path, sections)

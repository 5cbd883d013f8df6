"""Depths where views of a model do not agree on one: from the photographs themselves."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
import warp as wp
from tqdm import tqdm

from warp_splat.camera import Camera
from warp_splat.kernels.patches import REACH, SPACING, Other, search
from warp_splat.meshing.fusion import Drawn, agreed, image_at, lens_of, nearest_to, relative
from warp_splat.raster.beside import rays
from warp_splat.runtime.launch import launch
from warp_splat.scene.types import View

MOST, FEWEST = 1 << 16, 8  # pixels of a photograph that is looked at, larger ones are made smaller; of an edge
LOOKED_IN, ALONG = 10, 0.5  # others, the nearest that look about the same way; cosine of that
TURNS = 6  # half of the pixels take part in each
LEAST, CONFIRMING = 0.5, 0.05  # correlation of what counts; share of the nearest views that have to see it there, too
RANGE = 1.25  # times the largest depth of the model, and the smallest by it: what is beyond is not looked for
PATCH = torch.nn.MaxPool2d(2 * REACH * SPACING + 1, 1, REACH * SPACING)
AROUND, ALIKE = 5, 0.05  # edge [px] of what a median is taken of; share of it within which a pixel takes it over


def filled(views: Sequence[Drawn], kept: list[Drawn], photographs: Sequence[View]) -> list[Drawn]:
    """The views with depths that others confirm: the ``kept`` of the model's, and what photographs tell elsewhere.

    Photographs that a lens distorts tell nothing, and others not where they are masked.
    """
    drawn = torch.cat([view.depth[view.depth > 0] for view in views])
    if not len(drawn) or any(photograph.camera.lens or photograph.camera.shutter for photograph in photographs):
        return kept
    near, far = (float(drawn.kthvalue(1 + int(share * len(drawn))).values) for share in (0.01, 0.99))
    small, found = [_small(view, photograph) for view, photograph in zip(views, photographs, strict=True)], []
    for i, (view, known) in enumerate(zip(tqdm(small, "comparing photographs", leave=False), kept, strict=True)):
        facing = [other for other in nearest_to(i, small) if other.camera.rotation[2] @ view.camera.rotation[2] > ALONG]
        depth = image_at(known.depth[..., None], view.camera)[..., 0]
        planes = _planes(view, depth, facing[:LOOKED_IN], wp.vec2(1 / far / RANGE, RANGE / near))
        nearness = _nearness(image_at(planes, known.camera), known.camera)
        found.append(_joined(known, torch.where(nearness > 0, 1 / nearness, 0.0)))
    return [_joined(known, new.depth) for known, new in zip(kept, agreed(found, CONFIRMING), strict=True)]


def _joined(view: Drawn, depth: torch.Tensor) -> Drawn:
    """With these depths where it has none."""
    return view._replace(depth=torch.where(view.depth > 0, view.depth, depth))


def _small(view: Drawn, photograph: View) -> Drawn:
    """The view with few enough pixels, and its photograph in gray [H, W, 1], 0 to 1; below where it is masked."""
    share = min(1.0, math.sqrt(MOST / view.depth.numel()))
    small = Drawn(view.camera.resized(*(max(int(share * size), FEWEST) for size in view.depth.T.shape)), *view[1:])
    gray = torch.from_numpy(photograph.picture).float().mean(2, keepdim=True) / 255
    image, depth = image_at(gray, small.camera, "area"), image_at(view.depth[..., None], small.camera)[..., 0]
    if photograph.mask is not None:
        hidden = torch.from_numpy(photograph.mask[..., None] == 0).float()
        image[image_at(hidden, small.camera, "area") > 0] = -1.0
    return small._replace(depth=depth, image=image)


def _nearness(planes: torch.Tensor, camera: Camera) -> torch.Tensor:
    """1 / depth of planes of a camera's pixels, [H, W]."""
    return (rays(replace(camera, rotation=np.eye(3)), planes.device) * planes).sum(-1)


def _planes(view: Drawn, known: torch.Tensor, seen: Sequence[Drawn], nearness: wp.vec2) -> torch.Tensor:
    """Of a small view's pixels, [H, W, 3], at the median of the depths around them; 0 where none is found."""
    others = []
    for picture in seen:
        other = Other()
        other.picture, other.lens = wp.from_torch(picture.image[..., 0]), lens_of(picture.camera)
        other.rotation, other.translation = relative(view.camera, picture.camera)
        others.append(other)
    image = view.image[None, ..., 0]
    nothing = (PATCH(image) == -PATCH(-image))[0] | (image[0] < 0)  # to look for: it is flat, or masked
    scores = torch.where((known > 0) | nothing, 2.0, -1.0)
    guess = torch.where(known > 0, known, torch.where(nothing, 0.0, view.depth))
    planes = torch.where(guess > 0, 1 / guess, 0.0)[..., None] * torch.tensor([0.0, 0.0, 1.0])
    inputs = [nearness, lens_of(view.camera), view.image[..., 0], wp.array(others, dtype=Other, device="cpu")]
    for turn in range(TURNS):
        launch(search, scores.numel(), [turn, *inputs], [planes, scores])
    found = torch.where(scores > LEAST, _nearness(planes, view.camera), 0.0)
    around = torch.nn.functional.unfold(found[None, None], AROUND, padding=AROUND // 2)[0]
    factor = torch.where(around > 0, around, torch.nan).nanmedian(0).values.view_as(found) / found
    return torch.where((factor - 1).abs() < ALIKE, factor, 0.0)[..., None] * planes

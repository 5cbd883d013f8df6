"""Scenes on disk, COLMAP models and nerf-synthetic folders: cameras, photographs and points to start from."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warp_splat.errors import InputError
from warp_splat.scene.photos import PHOTOS, find_files, is_video, photo_root, sfm_hint
from warp_splat.scene.types import Scene, View, visible

if TYPE_CHECKING:
    from warp_splat.scene.images import Photo

__all__ = ["Scene", "View", "has_cameras", "load_scene"]

HOLD_OUT = 8  # every 8th image by name is for testing (graphdeco `llffhold`, after Barron et al. 2022)


def load_scene(
    source: str | Path,
    *,
    images: str = "images",
    resolution: int = -1,
    white_background: bool = False,
    eval: bool = False,
    report: Callable[[str], object] = print,
) -> Scene:
    """Load a folder with a COLMAP model (sparse/) or a nerf-synthetic scene (transforms_train.json).

    Args:
        source: the scene's folder.
        images: folder of a COLMAP scene's images, in ``source``; the cameras follow if they are smaller (images_4).
        resolution: 1, 2, 4 or 8 divides the images' size, another positive number is the width [px] to scale them to,
            -1 shrinks images wider than 1600 px to that (the reference's ``-r``).
        white_background: composite images with alpha on white instead of black.
        eval: hold out a test set: every 8th image by name, or transforms_test.json. Otherwise all images train.
        report: called with a line for each thing that the user should know: undistortion, a choice of models, ...

    Returns:
        The scene, in the frame of its files (x_camera = rotation @ x_world + translation; x right, y down, z forward),
        with the photographs as [H, W, 3] uint8 and points [P, 3] float32.

    Raises:
        InputError: if an argument is out of range, or a file is missing, unreadable, or disagrees with another.
    """
    if not isinstance(resolution, int) or (resolution < 1 and resolution != -1):
        raise InputError(
            f"resolution: expected a positive whole number or -1, got {resolution}; see -r in warp-splat train --help."
        )
    train, test, points, colors = read_photos(source, images, report)
    if not eval:
        train, test = train + test, []
    elif not test:
        train, test = _hold_out(train, source)
        report(f"Holding out every {HOLD_OUT}th image by name: {len(train)} images train, {len(test)} test.")
    require_visible(train, points, source)

    from warp_splat.scene.images import load_views  # noqa: PLC0415  keeps `import warp_splat` light

    views = load_views(train + test, resolution, white_background)
    return Scene(views[: len(train)], views[len(train) :], points, colors)


def read_photos(
    source: str | Path, folder: str, report: Callable[[str], object]
) -> tuple[list[Photo], list[Photo], np.ndarray, np.ndarray]:
    """All of a scene but its pixels; see :func:`load_scene`.

    Returns:
        Training and test photos as the files have them, points [P, 3], colors [P, 3].
    """
    from warp_splat.scene import blender, colmap  # noqa: PLC0415  keeps `import warp_splat` light

    source = Path(source)
    if is_video(source):
        raise InputError(
            f"{source}: expected the folder of a scene, found a video without cameras; {sfm_hint(source)}."
        )
    if not source.is_dir():
        found = "a file" if source.exists() else "nothing"
        raise InputError(f"{source}: expected the folder of a scene, found {found}; check the path given as source.")
    if (source / "sparse").is_dir():
        photos, points, colors = colmap.read(source, folder, report)
        return photos, [], points, colors
    if (source / blender.TRAIN).is_file():
        return blender.read(source)
    expected = f"expected a scene with cameras, a COLMAP model (sparse/) or {blender.TRAIN}"
    photographs = find_files(photo_root(source), PHOTOS)
    if photographs:
        raise InputError(f"{source}: {expected}, found {len(photographs)} photographs alone; {sfm_hint(source)}")
    raise InputError(f"{source}: {expected}, found neither and no photographs; give another folder as source.")


def has_cameras(source: str | Path) -> bool:
    """Whether ``source`` looks like a scene that :func:`load_scene` reads, not like photographs alone."""
    from warp_splat.scene import blender  # noqa: PLC0415  keeps `import warp_splat` light

    return (Path(source) / "sparse").is_dir() or (Path(source) / blender.TRAIN).is_file()


def _hold_out(photos: list[Photo], source: str | Path) -> tuple[list[Photo], list[Photo]]:
    photos = sorted(photos, key=lambda photo: photo.name)
    train = [photo for index, photo in enumerate(photos) if index % HOLD_OUT]
    if not train:
        raise InputError(
            f"{source}: expected at least 2 images when a test set is held out, found {len(photos)}, which leaves "
            "none to train on; add images or leave out --eval."
        )
    return train, photos[::HOLD_OUT]


def require_visible(photos: list[Photo], points: np.ndarray, source: str | Path) -> None:
    """Refuse a scene that would only render black, as one in another tool's axes does."""
    if any(visible(photo.camera, points).any() for photo in photos):
        return
    raise InputError(
        f"{source}: expected points in front of the cameras, but none of the {len(photos)} training cameras sees any "
        f"of the {len(points)} points; the poses' axes are probably mixed up: COLMAP has world to camera in OpenCV "
        "axes, transforms_train.json camera to world in OpenGL axes."
    )

"""What training reads: cameras, photographs, masks and points."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warp_splat.color import from_srgb
from warp_splat.config import LENSES, NEAR
from warp_splat.errors import InputError
from warp_splat.formats.coordinates import read_coordinates
from warp_splat.scene.photos import PHOTOS, ImageFinder, find_files, is_video, jpeg_hint, photo_root, sfm_hint
from warp_splat.scene.types import Scene, View, nearest_shown, visible
from warp_splat.text import Report

if TYPE_CHECKING:
    from warp_splat.scene.images import Photo

__all__ = ["Scene", "View", "has_cameras", "load_scene"]

TRAIN, ALL = "transforms_train.json", "transforms.json"  # cameras of nerf-synthetic; of nerfstudio and instant-ngp
MASKS = "masks"  # the folder beside the images' or, for cameras in JSON, in the scene
ROUNDED = 1e-4  # of the distance between cameras, which may be lost by rounding
HOLD_OUT = 8  # every 8th image by name is for testing (graphdeco `llffhold`, after Barron et al. 2022)


def load_scene(
    source: str | Path,
    *,
    images: str = "images",
    resolution: int = -1,
    white_background: bool = False,
    eval: bool = False,
    invert_masks: bool = False,
    start: str = "",
    lens: str = "undistort",
    block: str = "",
    memory: float | None = None,
    report: Report = print,
) -> Scene:
    """Load a folder with a COLMAP model (sparse/), a nerf-synthetic scene (transforms_train.json) or transforms.json.

    Args:
        source: the scene's folder.
        images: folder of a COLMAP scene's images, in ``source``; the cameras follow if they are smaller (images_4).
        resolution: 1, 2, 4 or 8 divides the images' size, another positive number is the width [px] to scale them to,
            -1 shrinks images wider than 1600 px to that (the reference's ``-r``).
        white_background: composite images with alpha on white instead of black.
        eval: hold out a test set: every 8th image by name, or transforms_test.json. Otherwise all images train.
        invert_masks: of the masks in ``source``/masks, the dark part counts, not the bright one.
        start: a file of Gaussians to start from instead of the scene's points.
        lens: "undistort" resamples photographs with distortion as pinholes would have taken them; "native" keeps them,
            and their cameras have lenses.
        block: "K/N": only the photographs and points of one of the N blocks into which the scene is cut.
        memory: bytes for photographs: those that do not fit are decoded whenever they are asked for, and of many even
            those that do only once they are. None: all are decoded now.
        report: called with a line for each thing that the user should know: undistortion, a choice of models, ...

    Returns:
        The scene, in the frame of its files (x_camera = rotation @ x_world + translation; x right, y down, z forward),
        with the photographs as [H, W, 3] uint8, or float32 if they are in linear light, and points [P, 3] float32:
        the scene's own, those of ``start``, or random ones if there are none. Photographs without a pixel that counts
        are left out.

    Raises:
        InputError: if an argument is out of range, or a file is missing, unreadable, or disagrees with another.
    """
    if not isinstance(resolution, int) or (resolution < 1 and resolution != -1):
        raise InputError(f"resolution: expected a positive whole number or -1, got {resolution}; see -r in --help.")
    if lens not in LENSES:
        raise InputError(f"lens: expected one of {', '.join(LENSES)}, got {lens!r:.80}; see --lens in --help.")
    train, test, points, colors = read_photos(source, images, report, native=lens == "native")
    if not eval:
        train, test = train + test, []
    elif not test:
        train, test = _hold_out(train, source)
        report(f"Holding out every {HOLD_OUT}th image by name: {len(train)} images train, {len(test)} test.")
    from warp_splat.scene.blocks import block_of  # noqa: PLC0415  keeps `import warp_splat` light
    from warp_splat.scene.colmap import read_tracks  # noqa: PLC0415  keeps `import warp_splat` light
    from warp_splat.scene.decoding import load_views  # noqa: PLC0415
    from warp_splat.scene.start import load_start, random_points  # noqa: PLC0415

    file, drawn = None, not (start or len(points))
    if start:
        file, points, colors = load_start(start, report)
    elif drawn:
        points, colors = random_points([photo.camera for photo in train])
    cameras = [photo.camera for photo in train]
    if part := block_of(block, points, cameras, bool(read_coordinates(source))) if block else None:
        counts = len(train), len(points)
        shown = np.array([part.shown(photo.camera, points) for photo in (*train, *test)])
        own, part = shown[:, part.number], part._replace(empty=np.flatnonzero(~shown[: len(train)].any(0)).tolist())
        train, test = list(compress(train, own)), list(compress(test, own[len(train) :]))
        if not train:
            raise InputError(f"--block {block}: expected photographs that show it, found none; take fewer blocks.")
        rows = part.starts([photo.camera for photo in train], points)
        points, colors, file = points[rows], colors[rows], file and file._replace(splats=file.splats.take(rows))
        report(f"Block {block}: {len(train)} of {counts[0]} training images, {len(points)} of {counts[1]} points.")
    require_visible(train, points, start or source)
    for told in filter(None, (too_far(train), "" if drawn else too_near(train, points))):
        report(f"Warning: {told}")
    views, bound = load_views(train + test, resolution, white_background, invert_masks, memory)
    halves = (train, views[: len(train)], ""), (test, views[len(train) :], " (those held out)")
    train_views, test_views = (_drop_masked(*half, invert_masks, source, report) for half in halves)
    if views[0].linear and not start:
        colors = np.rint(255 * from_srgb(colors / 255, np.where)).astype(np.uint8)
    require_one_kind([(view.name, view.linear) for view in train_views + test_views], source)
    tracks = partial(read_tracks, Path(source)) if takes_colmap(Path(source)) else dict
    return Scene(train_views, test_views, points, colors, file, drawn, tracks, Path(source), bound, part)


def _drop_masked(
    photos: list[Photo], views: list[View], kind: str, invert_masks: bool, source: str | Path, report: Report
) -> list[View]:
    """The views with a pixel that counts; only masks are read."""
    from warp_splat.scene.images import THREADS, has_counts  # noqa: PLC0415  keeps `import warp_splat` light

    with ThreadPoolExecutor(THREADS) as pool:
        shown = pool.map(lambda photo, view: has_counts(photo, view.camera, invert_masks), photos, views)
        kept = list(compress(views, shown))
    require_unmasked(len(views), len(views) - len(kept), source, kind)
    if len(kept) < len(views):
        report(f"Leaving out {len(views) - len(kept)} of {len(views)} images that their masks cover.")
    return kept


def require_unmasked(count: int, black: int, source: str | Path, kind: str = "") -> None:
    """Refuse ``count`` photographs, of a ``kind``, if as many have black masks."""
    if 0 < count == black:
        raise InputError(
            f"{source}: expected masks that leave something to train on, and to test with, but those of all {count} "
            f"images{kind} are black; use --invert_masks, or change the masks{', or leave out --eval' * bool(kind)}."
        )


def require_one_kind(photographs: list[tuple[str, bool]], source: str | Path) -> None:
    """Refuse photographs, by name and whether they are in linear light, of which some are and some are not."""
    name, linear = photographs[0]
    if odd := [other for other, kind in photographs if kind != linear]:
        kinds = ("in linear light", "as a screen shows it")
        here, there = kinds if linear else kinds[::-1]
        raise InputError(
            f"{source}: expected photographs of one kind, but {name} is {here} and {odd[0]} {there}; convert one kind."
        )


def read_photos(
    source: str | Path, folder: str, report: Report, native: bool = False
) -> tuple[list[Photo], list[Photo], np.ndarray, np.ndarray]:
    """All of a scene but its pixels; see :func:`load_scene`.

    Returns:
        Training and test photos as the files have them, points [P, 3], colors [P, 3].
    """
    from warp_splat.scene import colmap, transforms  # noqa: PLC0415  keeps `import warp_splat` light

    if is_video(source := Path(source)):
        raise InputError(f"{source}: expected the folder of a scene, found a video; {sfm_hint(source)}")
    if not source.is_dir():
        found = "a file" if source.exists() else "nothing"
        raise InputError(f"{source}: expected the folder of a scene, found {found}; check the path given as source.")
    if takes_colmap(source):
        photos, points, colors = colmap.read_colmap(source, folder, report, native)
        return with_masks(photos, source, report), [], points, colors
    if has_transforms(source):
        train, test, points, colors = transforms.read_transforms(source, report, native)
        return with_masks(train, source, report), with_masks(test, source, report), points, colors
    expected = f"expected a scene with cameras, a COLMAP model (sparse/), {TRAIN} or {ALL}"
    if (source / "point_cloud").is_dir():
        raise InputError(f"{source}: {expected}, found a trained model; give the folder of its scene.")
    if photographs := find_files(photo_root(source), PHOTOS):
        raise InputError(f"{source}: {expected}, found {len(photographs)} photographs alone; {sfm_hint(source)}")
    hint = jpeg_hint(source) or "give another folder"
    raise InputError(f"{source}: {expected}, found none of these and no photographs; {hint}.")


def has_cameras(source: str | Path) -> bool:
    """Whether ``source`` looks like a scene that :func:`load_scene` reads, not like photographs alone."""
    return (Path(source) / "sparse").is_dir() or has_transforms(Path(source))


def has_transforms(source: Path) -> bool:
    """Whether the folder holds a file of cameras in JSON."""
    return any((source / name).is_file() for name in (TRAIN, ALL))


def takes_colmap(source: Path) -> bool:
    """Whether the cameras are read from sparse/: where pycolmap is missing, a transforms.json beside it comes first."""
    from warp_splat.scene.colmap_library import pycolmap  # noqa: PLC0415  keeps `import warp_splat` light

    return (source / "sparse").is_dir() and (pycolmap is not None or not has_transforms(source))


def with_masks(photos: list[Photo], source: Path, report: Report) -> list[Photo]:
    """The photos with the masks that lie in the scene's folder, besides those that they have."""
    if photos and (source / MASKS).is_dir():
        masks = ImageFinder(source / MASKS)
        photos = [photo if photo.mask else replace(photo, mask=masks.mask_of(photo.name)) for photo in photos]
        without = [photo.name for photo in photos if not photo.mask]
        rest = f"; {without[0]} and {len(without) - 1} others are used whole" if without else ""
        report(f"Masks for {len(photos) - len(without)} of {len(photos)} images{rest}.")
    return photos


def _hold_out(photos: list[Photo], source: str | Path) -> tuple[list[Photo], list[Photo]]:
    photos = sorted(photos, key=lambda photo: photo.name)
    if not (train := [photo for index, photo in enumerate(photos) if index % HOLD_OUT]):
        raise InputError(
            f"{source}: expected at least 2 images when a test set is held out, found {len(photos)}, which leaves "
            "none to train on; add images or leave out --eval."
        )
    return train, photos[::HOLD_OUT]


def too_far(photos: list[Photo]) -> str:
    """What to tell the user if the cameras are so far from the origin that 32 bits are too few; else nothing."""
    centers = np.array([photo.camera.center for photo in photos])
    away, spread = np.abs(centers).max(), np.ptp(centers, axis=0).max()
    if len(photos) < 2 or ROUNDED * spread >= 2.0**-24 * away or spread <= 1e-9 * away:
        return ""
    text = f"cameras are {away:.3g} from the origin and {spread:.3g} apart, too little for 32 bits"
    return f"{text}: move the origin, as warp-splat sfm --coordinates does."


def too_near(photos: list[Photo], points: np.ndarray) -> str:
    """What to tell the user if ``points`` [P, 3] come as near to the cameras as what is never drawn; else nothing."""
    if (near := nearest_shown([photo.camera for photo in photos], points)) >= 2 * NEAR:
        return ""
    return (
        f"in half of the images the nearest points are nearer than {near:.2g}, and what is nearer than {NEAR} is never "
        f"drawn: the scene is small; multiply the coordinates of its cameras and points by {1 / near:.2g}."
    )


def require_visible(photos: list[Photo], points: np.ndarray, source: str | Path) -> None:
    """Refuse a scene that would only render black, as one in another tool's axes does."""
    if not any(visible(photo.camera, points).any() for photo in photos):
        raise InputError(
            f"{source}: expected points in front of the cameras, but none of the {len(photos)} training cameras sees "
            f"any of the {len(points)} points; the poses' axes are probably mixed up: COLMAP has world to camera in "
            "OpenCV axes, transforms.json camera to world in OpenGL axes."
        )

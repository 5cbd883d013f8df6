"""What is examined: all of a scene that can be read, and a finding for each thing that cannot."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from PIL import Image

from warp_splat.errors import InputError
from warp_splat.scene import TRAIN, colmap, images, takes_colmap, transforms, with_masks
from warp_splat.scene.colmap_library import pycolmap
from warp_splat.scene.images import Photo
from warp_splat.scene.lenses import make_sampling
from warp_splat.scene.photos import ImageFinder
from warp_splat.scene.types import as_shown
from warp_splat.text import few

THUMBNAIL = 240  # px, the longer side


class Finding(NamedTuple):
    """A verdict: which check, how bad, and one sentence."""

    check: str
    level: Literal["ok", "note", "warning", "error"]
    text: str


@dataclass
class Subject:
    """A scene as far as it can be read, and what checks have measured of it, for the pictures."""

    source: Path
    root: Path  # of the images
    folder: str = "images"  # theirs, as it is named, if the scene is COLMAP's
    photos: list[Photo] = field(default_factory=list)  # whose file and camera fit each other
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))  # [P, 3] float64, finite
    model: "pycolmap.Reconstruction | None" = None  # of a COLMAP scene
    random_points: bool = False  # not measured, but drawn: of a nerf-synthetic scene
    thumbnails: dict[str, np.ndarray] = field(default_factory=dict)  # by name, [h, w, 3] uint8
    alpha: list[str] = field(default_factory=list)  # names of images with an alpha channel
    linear: list[str] = field(default_factory=list)  # in linear light
    black: list[str] = field(default_factory=list)  # whose masks are black all over
    errors: dict[str, np.ndarray] = field(default_factory=dict)  # px, of each observation of an image
    pixels: dict[str, np.ndarray] = field(default_factory=dict)  # [n, 2] px in the model's image, of each observation
    stops: dict[str, float] = field(default_factory=dict)  # gain of an image, their mean is 0
    exif: dict[str, float] = field(default_factory=dict)  # the same from EXIF, with the mean of those above

    @property
    def medians(self) -> dict[str, float]:
        """The median reprojection error of each image, px."""
        return {name: float(np.median(errors)) for name, errors in self.errors.items()}


def read_subject(source: Path, folder: str) -> tuple[Subject, list[Finding]]:
    """Read what can be read of the scene in ``source``, with its images in ``folder`` if it is COLMAP's."""
    of_colmap, findings = takes_colmap(source), []
    subject = Subject(source, source / folder if of_colmap else source, folder)
    try:
        if of_colmap:
            findings += _read_colmap(subject)
        else:
            subject.random_points = (source / TRAIN).is_file()
            train, test, points, _ = transforms.read_transforms(source, lambda line: None)
            subject.points, subject.photos = points.astype(np.float64), train + test
    except InputError as error:
        findings.append(Finding("model" if of_colmap else "transforms", "error", str(error)))
    subject.photos = with_masks(subject.photos, source, lambda line: None)
    findings += _decode(subject)
    return subject, findings


def _read_colmap(subject: Subject) -> Iterator[Finding]:
    """Read the largest model and what belongs to it. Raises InputError if there is none."""
    models: dict[str, pycolmap.Reconstruction] = {}
    for path in colmap.find_models(subject.source / "sparse"):
        try:
            models[path.relative_to(subject.source).as_posix()] = colmap.read_model(path)
        except InputError as error:
            yield Finding("model", "error", str(error))
    if not models:
        return
    counts = {name: model.num_reg_images() for name, model in models.items()}
    largest = max(counts, key=lambda name: counts[name])
    if len(models) > 1:
        yield Finding("sub-models", "warning", f"{len(models)} models {counts}: only the largest, {largest}, is used.")
    else:
        yield Finding("sub-models", "ok", f"one model, {largest}, with {counts[largest]} registered images.")
    subject.model = models[largest]
    xyz = np.array([point.xyz for point in subject.model.points3D.values()], np.float64).reshape(-1, 3)
    subject.points = xyz[(np.abs(xyz) <= np.finfo(np.float32).max).all(axis=1)]
    if odd := len(xyz) - len(subject.points):
        yield Finding("points", "warning", f"{odd} of {len(xyz)} are not finite in 32 bits; training leaves them out.")
    yield from _match_files(subject)


def _match_files(subject: Subject) -> Iterator[Finding]:
    """Find the file of each registered image and compare its size with the camera's; fills ``subject.photos``."""
    root, registered = subject.root, colmap.registered_images(subject.model)
    if not registered:
        yield Finding("files", "error", "the model has no registered images; run the mapper again.")
    missing, scaled, wrong = [], [], False
    finder, sampling = ImageFinder(root), make_sampling()
    for image in registered:
        check = "files"
        try:
            if (path := finder.find(image.name)) is None:
                missing.append(image.name)
                continue
            size = images.read_size(path)
            check = "sizes"
            subject.photos.append(colmap.photo_of(image, path, size, sampling))
            scaled += [image.name] * (size != colmap.size_of(image))
        except InputError as error:
            wrong |= check == "sizes"
            yield Finding(check, "error", str(error))
    if missing:
        hint = "copy them there" if root.is_dir() else "there is no such folder; name another with --images"
        text = f"{len(missing)} of {len(registered)} images are missing in {root}: {few(missing)}; {hint}."
        yield Finding("files", "error", text)
    if scaled and not wrong:
        text = f"{len(scaled)} images have another size than their cameras, which are scaled: {few(scaled)}."
        yield Finding("sizes", "note", text)
    elif not wrong and subject.photos:
        yield Finding("sizes", "ok", "every image has the size that its camera says.")


def _decode(subject: Subject) -> Iterator[Finding]:
    """Read every image and every mask to its end; fills the thumbnails and what the images are."""

    def read(photo: Photo) -> tuple[np.ndarray, list[list[str]]]:
        """A thumbnail, and the lists that the photo belongs to."""
        image, alpha, linear = images.read_pixels(photo.path, 0.0)
        lists = [subject.alpha] * (alpha is not None) + [subject.linear] * linear
        if photo.mask and not images.read_mask(photo.mask, (image.shape[1], image.shape[0]), False).any():
            lists.append(subject.black)
        small = Image.fromarray(as_shown(image) if linear else np.rint(255 * image.clip(0, 1)).astype(np.uint8))
        small.thumbnail((THUMBNAIL, THUMBNAIL))
        return np.array(small), lists

    with ThreadPoolExecutor(images.THREADS) as pool:
        outcomes = [pool.submit(read, photo) for photo in subject.photos]
    for photo, outcome in zip(subject.photos, outcomes, strict=True):
        try:
            subject.thumbnails[photo.name], lists = outcome.result()
            for names in lists:
                names.append(photo.name)
        except InputError as error:
            yield Finding("files", "error", str(error))
    if subject.photos and len(subject.thumbnails) == len(subject.photos):
        yield Finding("files", "ok", f"{len(subject.photos)} images of {subject.root} were read to their ends.")

"""Photographs and their lenses: taken as they are, or undistorted by pycolmap. Pixel centers are at +0.5, as ours."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warp_splat.camera import Camera
from warp_splat.errors import InputError, refusing
from warp_splat.lenses import Lens
from warp_splat.lenses.formulas import MODELS
from warp_splat.scene import images
from warp_splat.scene.colmap_library import pycolmap, require_pycolmap
from warp_splat.scene.images import Photo
from warp_splat.text import Report

Sampling = Callable[..., np.ndarray]
Pose = tuple[np.ndarray, np.ndarray]  # rotation [3, 3] and translation [3] of camera_from_world
PINHOLE = "PINHOLE"  # fx, fy, cx, cy: the model that needs no pycolmap


@dataclass(frozen=True)
class Calibration:
    """A camera model by COLMAP's name, and its parameters."""

    model: str
    width: int  # px, of the images that the parameters are for
    height: int
    params: tuple[float, ...]

    def load(self, *size: int) -> pycolmap.Camera:
        """The same for pycolmap, for images of another ``size`` if it is given. Raises InputError without pycolmap."""
        require_pycolmap(f"lens {self.model}")
        camera = pycolmap.Camera(model=self.model, width=self.width, height=self.height, params=self.params)
        if size:
            camera.rescale(*size)
        return camera


def make_sampling(native: bool = False) -> Sampling | None:
    """:func:`sampling_of`, remembering the last lenses: photographs often share one. None: nothing is resampled."""
    return None if native else functools.lru_cache(maxsize=images.THREADS)(sampling_of)


def make_photo(
    name: str, path: Path, lens: Calibration, pose: Pose, size: tuple[int, int], sampling: Sampling | None
) -> Photo:
    """The photo whose file has ``size`` = (width, height) pixels, taken through ``lens`` at a pose, world to camera.

    Raises:
        InputError: if the size does not fit the lens's, it cannot become a pinhole or, without a sampling, folds inside
            the picture, or pycolmap is needed and missing.
    """
    if not images.same_shape(size, (lens.width, lens.height)):
        raise InputError(
            f"{path}: expected {lens.width} x {lens.height} pixels as its camera has, or both scaled by one "
            f"factor, got {size[0]} x {size[1]}; use the images that the cameras were computed from."
        )
    with images.named(str(path)):
        finite = np.isfinite(lens.params).all()
        if sampling is None and finite and lens.model in MODELS:
            return Photo(name, path, _as_it_is(lens, pose).resized(*size), model=lens.model)
        if finite and lens.model == PINHOLE:
            return Photo(name, path, Camera(lens.width, lens.height, *lens.params, *pose).resized(*size))
        if not finite or (loaded := lens.load()).is_spherical():
            raise InputError(
                "expected a camera model that can be undistorted to a pinhole, with finite parameters, got "
                f"{lens.model} {np.asarray(lens.params).tolist()}; correct the model, leave this image out, or "
                "keep its lens (train with --lens native)."
            )
        if loaded.is_undistorted() and "FISHEYE" not in lens.model:  # of those it means: no more than its angles
            return Photo(name, path, _pinhole(loaded, pose).resized(*size))
        resample = functools.partial(sampling, lens, size)
        return Photo(name, path, _pinhole(_undistorted(lens, size), pose), resample, model=lens.model)


def tell_lenses(photos: list[Photo], report: Report) -> None:
    """Report what becomes of photos with distortion."""
    for verb, rest, chosen in (
        ("Undistorting", "to pinhole cameras", [photo.model for photo in photos if photo.sampling]),
        ("Keeping", "as their lenses show them", [photo.model for photo in photos if photo.camera.lens]),
    ):
        if chosen:
            report(f"{verb} {len(chosen)} of {len(photos)} images {rest} (models: {', '.join(sorted(set(chosen)))}).")


def _as_it_is(lens: Calibration, pose: Pose) -> Camera:
    """The camera with its distortion."""
    count = MODELS[lens.model][1]
    distortion = Lens(lens.model, lens.params[len(lens.params) - count :] if count else ())
    if lens.model == "EQUIRECTANGULAR":  # all around, whatever its parameters
        focal, center = (lens.width / (2 * np.pi), lens.height / np.pi), (lens.width / 2, lens.height / 2)
    else:
        focals = lens.params[: len(lens.params) - count - 2]
        focal, center = (focals[0], focals[-1]), lens.params[len(focals) : len(focals) + 2]
    return Camera(lens.width, lens.height, *focal, *center, *pose, lens=distortion)


def _pinhole(lens: pycolmap.Camera, pose: Pose) -> Camera:
    k = lens.calibration_matrix()
    return Camera(lens.width, lens.height, k[0, 0], k[1, 1], k[0, 2], k[1, 2], *pose)


def _undistorted(lens: Calibration, size: tuple[int, int]) -> pycolmap.Camera:
    """The pinhole that COLMAP's image_undistorter gives ``lens``, without blank pixels."""
    camera = lens.load(*size)
    problem = f"expected a lens that can be undistorted, pycolmap refuses {lens.model} {camera.params.tolist()}"
    with refusing(Exception, problem, "; correct the model or leave this image out."):
        return pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)


def sampling_of(lens: Calibration, size: tuple[int, int], pinhole: tuple[float, ...]) -> np.ndarray:
    """Where in the distorted image each pixel of the undistorted one lies, for :func:`images.undistort`.

    The file has ``size``; the ``pinhole`` is the other's width, height, fx, fy, cx, cy.
    """
    width, height, fx, fy, cx, cy = pinhole
    y, x = np.mgrid[:height, :width] + 0.5
    rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], 2)
    pixels = np.asarray(lens.load(*size).img_from_cam(rays.reshape(-1, 3)))
    return (pixels / size).astype(np.float32).reshape(*x.shape, 2)

"""Lenses through pycolmap: those with distortion become pinholes. Pixel centers are at +0.5, as ours."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO  # noqa: F401 - after pycolmap, whose libraries clash with its own, writing a PNG would crash
import pycolmap

from warp_splat.camera import Camera
from warp_splat.errors import InputError, reason_of
from warp_splat.scene import images
from warp_splat.scene.images import Photo

Sampling = Callable[..., np.ndarray]


def make_sampling() -> Sampling:
    """:func:`sampling_of`, remembering the last lenses: photographs often share one."""
    return functools.lru_cache(maxsize=images.THREADS)(sampling_of)


def make_photo(
    name: str,
    path: Path,
    lens: pycolmap.Camera,
    pose: tuple[np.ndarray, np.ndarray],
    size: tuple[int, int],
    sampling: Sampling,
) -> Photo:
    """The photo whose file has ``size`` = (width, height) pixels, taken through ``lens`` at a pose, world to camera.

    Raises:
        InputError: if the size does not fit the lens's, or it cannot become a pinhole.
    """
    if not images.same_shape(size, (lens.width, lens.height)):
        raise InputError(
            f"{path}: expected {lens.width} x {lens.height} pixels as its camera has, or both scaled by one "
            f"factor, got {size[0]} x {size[1]}; use the images that the cameras were computed from."
        )
    if lens.is_spherical() or not np.isfinite(lens.params).all():
        raise InputError(
            f"{path}: expected a camera model that can be undistorted to a pinhole, with finite parameters, got "
            f"{lens.model_name} {lens.params.tolist()}; correct the model or leave this image out."
        )
    with images.named(str(path)):
        if lens.is_undistorted():
            return Photo(name, path, _pinhole(lens, pose).resized(*size))
        key = (lens.model_name, lens.width, lens.height, tuple(lens.params), size)
        return Photo(name, path, _pinhole(_undistorted(_lens(*key)), pose), functools.partial(sampling, *key))


def _pinhole(lens: pycolmap.Camera, pose: tuple[np.ndarray, np.ndarray]) -> Camera:
    k = lens.calibration_matrix()
    return Camera(lens.width, lens.height, k[0, 0], k[1, 1], k[0, 2], k[1, 2], *pose)


def _lens(model: str, width: int, height: int, params: tuple[float, ...], size: tuple[int, int]) -> pycolmap.Camera:
    lens = pycolmap.Camera(model=model, width=width, height=height, params=params)
    lens.rescale(*size)
    return lens


def _undistorted(lens: pycolmap.Camera) -> pycolmap.Camera:
    """The pinhole that COLMAP's image_undistorter gives ``lens``, without blank pixels."""
    try:
        return pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), lens)
    except Exception as error:
        raise InputError(
            f"expected a lens that can be undistorted, pycolmap refuses {lens.model_name} {lens.params.tolist()} "
            f"({reason_of(error)}); correct the model or leave this image out."
        ) from error


def sampling_of(*key: object) -> np.ndarray:
    """Where in the distorted image each pixel of the undistorted one lies, for :func:`images.undistort`."""
    lens = _lens(*key)
    pinhole = _undistorted(lens)
    y, x = np.mgrid[-1 : pinhole.height + 1, -1 : pinhole.width + 1] + 0.5
    rays = pinhole.cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1))
    pixels = lens.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
    return pixels.astype(np.float32).reshape(*x.shape, 2)

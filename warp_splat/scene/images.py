"""Photographs through OpenImageIO: read, composite on the background, undistort, resize, quantize to 8 bit.

Pixels stay float32 until the last step, so 16-bit files keep their precision through the filters. The orientation tag
of EXIF is ignored: structure from motion saw the pixels as stored.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from warp_splat.camera import Camera
from warp_splat.errors import InputError
from warp_splat.scene.types import View

THREADS = 2  # OpenImageIO releases the GIL; more threads hold more decoded photographs in memory
AUTO_WIDTH = 1600  # `-r -1` shrinks wider images to this width (graphdeco, utils/camera_utils.py)
WARP_PAD = 4  # px repeated around the source: OpenImageIO's warp sees black outside of it, and its filter reaches there


@dataclass(frozen=True, eq=False)
class Photo:
    """An image file and the pinhole camera of its pixels, once undistorted."""

    name: str  # as in the scene's files
    path: Path
    camera: Camera  # after undistortion, before the resize of `-r`
    sampling: Callable[[], np.ndarray] | None = None  # makes the map of `undistort`; None: the file is undistorted


@contextmanager
def named(what: str) -> Iterator[None]:
    """Put ``what`` in front of the message of an InputError raised in the block."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{what}: {error}") from error


def target_size(width: int, height: int, resolution: int) -> tuple[int, int]:
    """Width and height [px] that the reference's ``-r`` gives an image (graphdeco, utils/camera_utils.py).

    Args:
        width: image width [px].
        height: image height [px].
        resolution: 1, 2, 4 or 8 divides; another positive value is the width to reach; -1 shrinks to 1600 px at most.
    """
    if resolution in (1, 2, 4, 8):
        size = round(width / resolution), round(height / resolution)
    else:
        scale = max(width / AUTO_WIDTH, 1.0) if resolution == -1 else width / resolution
        size = int(width / scale), int(height / scale)
    return max(size[0], 1), max(size[1], 1)


def read_size(path: Path) -> tuple[int, int]:
    """Width and height [px] from the file's header.

    Raises:
        InputError: if the file is not an image that OpenImageIO reads.
    """
    spec = _open(path).spec()
    return spec.width, spec.height


def read_lens(path: Path) -> tuple[int, int, str, float]:
    """What photographs taken through one lens share: width and height [px], the camera's model, focal length [mm].

    Raises:
        InputError: if the file is not an image that OpenImageIO reads.
    """
    spec = _open(path).spec()
    focal = spec.get_float_attribute("Exif:FocalLength")
    return spec.width, spec.height, spec.get_string_attribute("Model"), focal


def has_alpha(path: Path) -> bool:
    """Whether the image has an alpha channel. Raises InputError as :func:`read_size` does."""
    return _open(path).spec().alpha_channel >= 0


def read_rgb(path: Path, background: float) -> np.ndarray:
    """Read an image as [H, W, 3] float32, 0..1; gray becomes RGB, alpha is composited on ``background``.

    Raises:
        InputError: if the file is not an image that OpenImageIO reads, or is cut short.
    """
    file = _open(path)
    pixels = file.read_image(oiio.FLOAT)
    error = file.geterror()  # a JPEG that is cut short still gives pixels: gray ones
    if pixels is None or error:
        raise _unreadable(path, error)
    if not np.isfinite(pixels).all():
        raise _unreadable(path, "pixels that are NaN or infinite")
    spec = file.spec()
    color = pixels[..., :3] if spec.nchannels >= 3 else np.repeat(pixels[..., :1], 3, axis=-1)
    if spec.alpha_channel < 0:
        return color
    alpha = pixels[..., spec.alpha_channel, None]
    straight = spec.get_int_attribute("oiio:UnassociatedAlpha")
    return (color * alpha if straight else color) + (1 - alpha) * np.float32(background)


def undistort(image: np.ndarray, sampling: np.ndarray) -> np.ndarray:
    """Resample ``image`` [H, W, 3] float32 at the positions ``sampling``.

    Args:
        image: the image with its distortion, [H, W, 3].
        sampling: where in ``image`` [px, x then y] each pixel of the result lies, [h + 2, w + 2, 2]: with a margin of
            one pixel, because OpenImageIO takes the filter's size from differences between neighbors.

    Returns:
        The resampled image, [h, w, 3] float32.
    """
    padded = np.pad(image, ((WARP_PAD, WARP_PAD), (WARP_PAD, WARP_PAD), (0, 0)), "edge")
    st = (sampling + WARP_PAD) / (padded.shape[1], padded.shape[0])
    roi = _roi(st.shape[1], st.shape[0])  # without it the result has the size of the source
    warped = oiio.ImageBufAlgo.st_warp(_buffer(padded), _buffer(st), "catmull-rom", roi=roi, nthreads=1)
    return _pixels(warped)[1:-1, 1:-1]


def load_views(photos: list[Photo], resolution: int, white_background: bool) -> list[View]:
    """Decode ``photos`` at the size that ``resolution`` asks for (see :func:`target_size`), in their order.

    Raises:
        InputError: if a file cannot be read.
    """

    def load(photo: Photo) -> View:
        image = read_rgb(photo.path, float(white_background))
        if photo.sampling is not None:
            image = undistort(image, photo.sampling())
        camera = photo.camera.resized(*target_size(photo.camera.width, photo.camera.height, resolution))
        if (camera.height, camera.width) != image.shape[:2]:
            roi = _roi(camera.width, camera.height)
            image = _pixels(oiio.ImageBufAlgo.resize(_buffer(image), roi=roi, nthreads=1))
        quantized = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)  # the filters overshoot
        return View(photo.name, camera, quantized, photo.camera)

    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(load, photos))


def _open(path: Path) -> oiio.ImageInput:
    straight = oiio.ImageSpec()
    straight.attribute("oiio:UnassociatedAlpha", 1)  # else OpenImageIO multiplies by alpha, in the file's 8 bit
    file = oiio.ImageInput.open(str(path), straight)
    if file is None:
        raise _unreadable(path, oiio.geterror())
    return file


def _unreadable(path: Path, error: str) -> InputError:
    reason = " ".join(error.split()).rstrip(".") or "no reason given"
    return InputError(f"{path}: expected a complete image file, but it cannot be read ({reason}); replace this file.")


def _buffer(array: np.ndarray) -> oiio.ImageBuf:
    return oiio.ImageBuf(np.ascontiguousarray(array, np.float32))  # refuses arrays in Fortran's order


def _roi(width: int, height: int) -> oiio.ROI:
    return oiio.ROI(0, width, 0, height, 0, 1, 0, 3)


def _pixels(buffer: oiio.ImageBuf) -> np.ndarray:
    if buffer.has_error:
        raise RuntimeError(f"OpenImageIO: {buffer.geterror()}")
    return np.asarray(buffer.get_pixels(oiio.FLOAT))

"""Photographs: read by OpenImageIO, composited on the background, resized, undistorted, quantized to 8 bit.

Pixels stay float32 until the last step, so 16-bit files keep their precision through the filters. Files of 8 bits that
need no filter stay bytes. Files of floats, and those that say so, are in linear light and are not quantized. The
orientation tag of EXIF is ignored: structure from motion saw the pixels as stored.
"""

import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import NamedTuple

import numpy as np
import OpenImageIO as oiio
from PIL import Image
from scipy.ndimage import map_coordinates, maximum_filter, minimum_filter

from warp_splat.camera import Camera
from warp_splat.errors import InputError, reason_of, refusing
from warp_splat.scene.types import Decoded

THREADS = 2  # OpenImageIO releases the GIL; more threads hold more decoded photographs in memory
AUTO_WIDTH = 1600  # `-r -1` shrinks wider images to this width (graphdeco, utils/camera_utils.py)
PIXELS_MOST = 200_000_000  # of a file: more than any camera has, and 2.4 GB once decoded
CHANNELS_MOST = 32  # likewise: OpenImageIO decodes all of them
FLOATS = (oiio.BASETYPE.HALF, oiio.BASETYPE.FLOAT, oiio.BASETYPE.DOUBLE)
RATIO_MOST = 2**14  # of decoded to stored bytes: a black mask of one bit per pixel has half of it
BRIGHTEST = 1e12  # more than any light; filters take sums
PAD = 4  # px around what is undistorted, continued straight: splines end flat


@dataclass(frozen=True, eq=False)
class Photo:
    """An image file and the camera of its pixels: with its lens, or a pinhole once they are undistorted."""

    name: str  # as in the scene's files
    path: Path
    camera: Camera  # after undistortion, before the resize of `-r`
    sampling: Callable[..., np.ndarray] | None = None  # makes the map of `undistort`; None: the file is undistorted
    mask: Path | None = None  # an image of what counts
    model: str = "PINHOLE"  # of the lens in the scene's files


class LoadedImage(NamedTuple):
    """A decoded file."""

    color: np.ndarray  # [H, W, 3] float32, on the background
    alpha: np.ndarray | None  # [H, W] float32, 0..1; None if the file has none, or is opaque all over
    linear: bool  # in linear light, rather than as a screen shows it


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
    scale, whole = (resolution, round) if resolution in (1, 2, 4, 8) else (width / resolution, int)
    if resolution == -1:
        scale = max(width / AUTO_WIDTH, 1.0)
    return max(whole(width / scale), 1), max(whole(height / scale), 1)


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
    return spec.width, spec.height, _text(spec.get_string_attribute, "Model"), focal


def read_exposure(path: Path) -> float | None:
    """What EXIF says of how much light counts in a photograph [stops, from any zero]; None without a time.

    Raises:
        InputError: if the file is not an image that OpenImageIO reads.
    """
    spec = _open(path).spec()
    names = ("ExposureTime", "FNumber", "Exif:PhotographicSensitivity", "Exif:ISOSpeedRatings")
    time, aperture, speed, older = (spec.get_float_attribute(name) for name in names)
    if not 0 < time < math.inf:
        return None
    aperture, speed = (value if 0 < value < math.inf else 1.0 for value in (aperture, speed or older))
    return math.log2(time * speed / aperture**2)


def same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether one size is the other times a factor, up to the rounding of either side to whole pixels.

    Of fewer than 4 px, only what needs no rounding is: rounded to that, all are alike.
    """
    return abs(size[0] * other[1] - size[1] * other[0]) < (sum(other) if min(size) >= min(4, *other) else 1)


def require_shape(path: Path, kind: str, found: tuple[int, ...], size: tuple[int, int], advice: str) -> None:
    """Refuse a ``kind`` of picture of a photograph of ``size`` that is not of the :func:`same_shape`."""
    if not same_shape((found[0], found[1]), size):
        raise InputError(
            f"{path}: expected a {kind} of {size[0]} x {size[1]} pixels as its photograph has, or scaled by one "
            f"factor, got {found[0]} x {found[1]}; {advice}."
        )


def read_pixels(path: Path, background: float) -> LoadedImage:
    """Read an image, 0..1 or in linear light; gray becomes RGB, alpha is composited on ``background``.

    Raises:
        InputError: if the file is not an image that OpenImageIO reads, is cut short, or is absurdly large.
    """
    file = _open(path)
    spec = file.spec()
    kind, scale = (oiio.UINT8, 1 / 255) if spec.format.basetype == oiio.UINT8 else (oiio.FLOAT, 1.0)
    pixels = _decoded(path, file, kind) * np.float32(scale)  # as OpenImageIO does with bytes, in half of the time
    colors, behind = _channels(path, file)
    linear, color, alpha = _is_linear(spec), pixels[..., colors], pixels[..., max(behind, 0)]
    if kind == oiio.FLOAT and not ((abs(color) < BRIGHTEST).all() and np.isfinite(alpha).all()):
        raise _unreadable(path, f"pixels that are NaN or beyond {BRIGHTEST:g}")
    if behind < 0:
        return LoadedImage(color, None, linear)
    straight = spec.get_int_attribute("oiio:UnassociatedAlpha")
    color = (color * alpha[..., None] if straight else color) + (1 - alpha[..., None]) * np.float32(background)
    return LoadedImage(color, alpha if alpha.min() < 1 else None, linear)


def _channels(path: Path, file: oiio.ImageInput) -> tuple[slice | list[int], int]:
    """Where red, green and blue are, and alpha (-1: nowhere): by name in an EXR of several channels or parts."""
    spec = file.spec()
    if file.format_name() != "openexr" or max(spec.nchannels, spec.get_int_attribute("oiio:subimages")) == 1:
        return slice(3) if spec.nchannels >= 3 else [0, 0, 0], min(spec.alpha_channel, spec.nchannels - 1)
    names = [re.sub("RED$|GREEN$|BLUE$|ALPHA$", lambda word: word[0][0], name.upper()) for name in spec.channelnames]
    layers = [layer for layer in sorted({name[:-1] for name in names}) if {*names} >= {layer + c for c in "RGB"}]
    colors = "RGB" if layers else "YYY"  # gray, or luminance beside chroma
    if (layers[1:] and layers[0]) or not (layers or ("Y" in names and not {"RY", "BY", "X"} & {*names})):
        raise InputError(
            f"{path}: expected R, G, B of one layer, found {', '.join(spec.channelnames):.80}; save those."
        )
    layer = min(layers, default="")
    return [names.index(layer + c) for c in colors], names.index(layer + "A") if layer + "A" in names else -1


def _is_linear(spec: oiio.ImageSpec) -> bool:
    return spec.format.basetype in FLOATS or _text(spec.get_string_attribute, "oiio:ColorSpace").startswith("lin")


def read_kind(path: Path) -> tuple[bool, bool]:
    """Whether the pixels of a file are in linear light, and whether they may have alpha, from its header.

    Raises:
        InputError: if the file is not an image that OpenImageIO reads.
    """
    file = _open(path)
    return _is_linear(file.spec()), _channels(path, file)[1] >= 0


def read_mask(path: Path, size: tuple[int, int], invert: bool) -> np.ndarray:
    """What counts of a photograph of ``size`` = (width, height), [H, W] float32 of 0 and 1: the mask's brighter half.

    Brighter than half its brightest pixel: some tools write 0 and 1 of 255. Transparent is black.

    Args:
        path: the mask, of the photograph's size or of that times one factor.
        size: of the photograph [px].
        invert: the darker half counts instead.

    Raises:
        InputError: if the file cannot be read, or has another shape.
    """
    pixels = _read_plain(path, (1, 3))
    planes = np.moveaxis(read_pixels(path, 0.0).color if pixels is None else pixels, 2, 0)
    brightness = reduce(np.maximum, planes)  # a tenth of the time of max(axis=2)
    found = brightness.shape[1], brightness.shape[0]
    require_shape(path, "mask", found, size, "draw it on the photograph, or remove it")
    half = brightness.dtype.type(0.5 * brightness.max())  # of bytes rounded down: the same ones are brighter
    bright = ((brightness > half) != invert).astype(np.float32)
    return bright if found == size else resize(bright[..., None], *size)[..., 0]


def read_numbers(path: Path) -> np.ndarray:
    """Numbers of a file [H, W]: floats as they are, those of 16 bits as shares of 65536.

    Of several channels Z, or one that ends in depth, else the first beside alpha.

    Raises:
        InputError: if it has neither, or is not an image that OpenImageIO reads.
    """
    file = _open(path)
    spec = file.spec()
    if (kind := spec.format).basetype not in (*FLOATS, oiio.BASETYPE.UINT16):
        raise InputError(f"{path}: expected numbers of 16 bits or floats, found {kind}; save it as 16-bit PNG or EXR.")
    names = [(n != "z", not n.endswith(("depth", "depth.z", "depth.v"))) for n in map(str.lower, spec.channelnames)]
    first = min(range(len(names)), key=lambda place: (*names[place], place == spec.alpha_channel))
    numbers = _decoded(path, file, 0, 0, first, first + 1, oiio.FLOAT if kind.basetype in FLOATS else oiio.UINT16)
    return numbers[..., 0] / (1.0 if kind.basetype in FLOATS else 2.0**16)


def undistort(image: np.ndarray, sampling: np.ndarray, linear: bool) -> np.ndarray:
    """Resample ``image`` by cubic splines, in float64, whose rounding hardly ever reaches a byte.

    Args:
        image: the image with its distortion, [H, W, C] float32.
        sampling: where in ``image`` each pixel of the result lies, as shares of its width and height, [h, w, 2].
        linear: it is in linear light, where splines ring far around a lamp: stay within the pixels nearby.

    Returns:
        The resampled image, [h, w, C] float32.
    """
    places, found = np.moveaxis(sampling * np.float64(image.shape[1::-1]) + (PAD - 0.5), 2, 0)[::-1], []
    for plane in np.moveaxis(image, 2, 0).astype(np.float64):
        padded = np.pad(plane, PAD, "reflect", reflect_type="odd")
        pixels = map_coordinates(padded, places, mode="reflect")
        if linear:
            low, high = (nearby(padded, 3) for nearby in (minimum_filter, maximum_filter))
            pixels = pixels.clip(*(map_coordinates(bound, places, order=0, mode="reflect") for bound in (low, high)))
        found.append(pixels.astype(np.float32))
    return np.stack(found, 2)


def resize(image: np.ndarray, width: int, height: int, gap: float | None = None) -> np.ndarray:
    """``image`` [H, W, C] float32 through Lanczos's filter, [height, width, C]; by means to ``gap`` times it, first."""
    planes = [Image.fromarray(plane) for plane in np.ascontiguousarray(np.moveaxis(image, 2, 0))]
    return np.stack([plane.resize((width, height), Image.Resampling.LANCZOS, reducing_gap=gap) for plane in planes], 2)


def decode(photo: Photo, camera: Camera, white_background: bool, invert_masks: bool = False) -> Decoded:
    """Read a photograph for ``camera``, which is the photo's in any size.

    Raises:
        InputError: if a file cannot be read.
    """
    mask, size = read_counts(photo, camera, invert_masks), (camera.height, camera.width)
    if photo.sampling is None and (plain := _read_plain(photo.path, (3,), size)) is not None:
        return Decoded(plain, None, mask)
    pixels = read_pixels(photo.path, float(white_background))
    image = pixels.color if pixels.alpha is None else np.dstack([pixels.color, pixels.alpha])
    image = _through_lens(image, photo, camera, pixels.linear, None)
    color = np.maximum(image[..., :3], 0) if pixels.linear else _quantized(image[..., :3])
    return Decoded(color, None if pixels.alpha is None else _quantized(image[..., 3]), mask)


def read_counts(photo: Photo, camera: Camera, invert_masks: bool, rough: bool = False) -> np.ndarray | None:
    """The mask that :func:`decode` gives, read alone; of the photograph only the header is read.

    Args:
        photo: may have no mask, of which None comes.
        camera: the photo's in any size.
        invert_masks: the darker half counts.
        rough: in a fifth of the time, only pixels of which 0.9 count, not half, as the filters say.

    Raises:
        InputError: if a file cannot be read.
    """
    if photo.mask is None:
        return None
    counts = read_mask(photo.mask, read_size(photo.path), invert_masks)[..., None]
    seen = _through_lens(counts, photo, camera, linear=False, gap=3.0 if rough else None)[..., 0]
    return (seen >= (0.9 if rough else 0.5)).astype(np.uint8)


def has_counts(photo: Photo, camera: Camera, invert_masks: bool) -> bool:
    """Whether :func:`read_counts` gives any. Of a lens a thumbnail mostly tells, in a tenth of the time.

    Where 0.9 of a thumbnail's pixel count, half of one of those count that it stands for, if these are many.
    """
    sizes = [(camera, False)]
    if photo.sampling and min(camera.width, camera.height) > 32:
        sizes.insert(0, (camera.resized(camera.width // 16 + 1, camera.height // 16 + 1), True))
    return photo.mask is None or any(read_counts(photo, size, invert_masks, rough).any() for size, rough in sizes)


def _through_lens(image: np.ndarray, photo: Photo, camera: Camera, linear: bool, gap: float | None) -> np.ndarray:
    """What ``camera`` sees of the photo's file [H, W, C] float32; undistorted last, where there are fewer pixels."""
    size = camera.width, camera.height
    if photo.sampling:
        shrink = min(camera.width / photo.camera.width, 1.0)
        size = max(round(image.shape[1] * shrink), 1), max(round(image.shape[0] * shrink), 1)
    image = image if image.shape[1::-1] == size else resize(image, *size, gap)
    if photo.sampling is None:
        return image
    pinhole = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return undistort(image, photo.sampling(pinhole), linear)


def _read_plain(path: Path, channels: tuple[int, ...], size: tuple[int, int] | None = None) -> np.ndarray | None:
    """The bytes of a file that are its colors, if it has that size: they need no filter."""
    file = _open(path)
    spec = file.spec()
    if size not in (None, (spec.height, spec.width)) or spec.nchannels not in channels or _is_linear(spec):
        return None
    return _decoded(path, file, oiio.UINT8) if spec.format.basetype == oiio.UINT8 and spec.alpha_channel < 0 else None


def _quantized(image: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)  # the filters overshoot


def _open(path: Path) -> oiio.ImageInput:
    straight = oiio.ImageSpec()
    straight.attribute("oiio:UnassociatedAlpha", 1)  # else OpenImageIO multiplies by alpha, in the file's 8 bit
    with refusing(UnicodeEncodeError, f"{str(path)!a}: expected a name in UTF-8", "; rename the file, or its folder."):
        str(path).encode()
    if (file := oiio.ImageInput.open(str(path), straight)) is None:
        raise _unreadable(path, _text(oiio.geterror))
    spec = file.spec()
    pixels, least = spec.width * spec.height, spec.image_bytes() // RATIO_MOST
    if pixels > PIXELS_MOST or spec.nchannels > CHANNELS_MOST or spec.depth > 1 or least > path.stat().st_size:
        raise _unreadable(path, f"{spec.width} x {spec.height} x {spec.depth} pixels of {spec.nchannels} channels")
    if file.format_name() == "openexr" and (spec.deep or spec.roi != spec.roi_full):
        raise InputError(f"{path}: expected a flat EXR whose data window is its picture, found another; save it so.")
    return file


def _decoded(path: Path, file: oiio.ImageInput, *what) -> np.ndarray:
    pixels = file.read_image(*what)
    error = _text(file.geterror)  # a JPEG that is cut short still gives pixels: gray ones
    if pixels is None or error:
        raise _unreadable(path, error)
    return pixels


def _text(get: Callable[..., str], *arguments: str) -> str:
    """What ``get`` returns; damaged files hold bytes that are no text."""
    with suppress(UnicodeDecodeError):
        return get(*arguments)
    return "text that is damaged"


def _unreadable(path: Path, error: str) -> InputError:
    return InputError(f"{path}: expected a complete image file, found none ({reason_of(error)}); replace it.")

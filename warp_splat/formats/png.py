"""8-bit images to and from PNG (OpenImageIO), and films as MP4 (PyAV)."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from warp_splat.errors import InputError, reason_of
from warp_splat.formats.atomic import atomic_write

PNG_END = b"IEND\xaeB`\x82"  # the last chunk of every complete file, with its checksum


def save_png(path: str | Path, image: np.ndarray) -> None:
    """Write an image.

    Args:
        path: the file to write, ending in .png.
        image: [H, W, 3] uint8, sRGB.

    Raises:
        InputError: if the image has another shape or type; if the file cannot be written.
    """
    check_image(image)
    height, width, _ = image.shape
    with atomic_write(path) as temporary:
        output = oiio.ImageOutput.create(str(temporary))
        if output is None or output.format_name() != "png":
            oiio.geterror()  # taken, or OpenImageIO prints it at exit
            raise InputError(f"{path}: expected the name of a PNG file, ending in .png.")
        spec = oiio.ImageSpec(width, height, 3, "uint8")
        if not (output.open(str(temporary), spec) and output.write_image(image) and output.close()):
            raise OSError(output.geterror())
        if not temporary.read_bytes().endswith(PNG_END):  # OpenImageIO 3.2 does not notice a full disk
            raise OSError("the file was cut short; the disk may be full")


def load_png(path: str | Path) -> np.ndarray:
    """Read the colors of an image, without its alpha, as [H, W, 3] uint8.

    Raises:
        InputError: if the file is missing, damaged, or has no three colors.
    """
    unassociated = oiio.ImageSpec()  # otherwise OpenImageIO multiplies the colors by alpha
    unassociated["oiio:UnassociatedAlpha"] = 1
    source = oiio.ImageInput.open(str(path), unassociated)
    if source is None:
        raise InputError(f"{path}: could not be read as an image ({reason_of(oiio.geterror())}).")
    channels = source.spec().nchannels
    if channels < 3:
        raise InputError(f"{path}: expected an image with red, green and blue, found {channels} channel(s).")
    image = source.read_image(0, 0, 0, 3, "uint8")
    if image is None:
        raise InputError(f"{path}: the image is damaged ({reason_of(source.geterror())}); write it again.")
    return image


def save_video(path: str | Path, frames: Iterable[np.ndarray], fps: float) -> None:
    """Write frames as an MP4 that browsers and phones play: H.264, 4:2:0, BT.709 colors, index at the front.

    H.264 needs even sizes: an odd width or height is filled up by repeating the last column or row.

    Args:
        path: the file to write, ending in .mp4.
        frames: images [H, W, 3] uint8 of one size, taken one at a time.
        fps: frames per second.

    Raises:
        InputError: if there are no frames, or one differs from the first in shape or type; if PyAV is not installed; if
            the file cannot be written.
    """
    try:
        import av  # noqa: PLC0415 - optional, and large
    except ImportError as error:
        raise InputError(f"{path}: writing a film needs PyAV; install it with `pip install av`.") from error
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise InputError("frames: expected at least one image, got none.")
    check_image(first)
    height, width, _ = first.shape
    with atomic_write(path) as temporary:
        with av.open(str(temporary), "w", format="mp4", options={"movflags": "faststart"}) as container:
            stream = _h264_stream(container, width + width % 2, height + height % 2, fps)
            for frame in itertools.chain([first], frames):
                if frame.shape != first.shape or frame.dtype != np.uint8:
                    raise InputError(f"frames: expected {first.shape} uint8 each, got {frame.shape} {frame.dtype}.")
                padded = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
                picture = av.VideoFrame.from_ndarray(padded, format="rgb24")
                container.mux(stream.encode(picture.reformat(format="yuv420p", dst_colorspace="ITU709")))
            container.mux(stream.encode())


def _h264_stream(container, width: int, height: int, fps: float):
    """A stream that states its colors: players guess BT.601 or BT.709 by the size otherwise."""
    from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc  # noqa: PLC0415 - as above

    stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
    stream.options = {"crf": "18"}  # visually lossless: artifacts should be the renderer's own
    context = stream.codec_context
    context.colorspace, context.color_range = Colorspace.ITU709, ColorRange.MPEG
    context.color_primaries, context.color_trc = ColorPrimaries.BT709, ColorTrc.BT709
    return stream


def check_image(image: np.ndarray) -> None:
    """Raise InputError if this is no image [H, W, 3] uint8."""
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise InputError(f"image: expected (H, W, 3) uint8, got {image.shape} {image.dtype}.")

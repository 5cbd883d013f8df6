"""8-bit images to and from PNG (Pillow), and films as MP4 (PyAV)."""

import itertools
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import numpy as np
from PIL import Image

from warp_splat.errors import InputError, refusing
from warp_splat.formats.files import atomic_write

COMPRESSION = 3  # of 0 to 9; Pillow's 6 takes 2.5 times as long, for 10 % less of a photograph


def save_png(path: str | Path, image: np.ndarray) -> None:
    """Write an image.

    Args:
        path: the file to write, ending in .png.
        image: [H, W, 3] uint8, sRGB.

    Raises:
        InputError: if the image has another shape or type; if the file cannot be written.
    """
    check_image(image)
    if Path(path).suffix.lower() != ".png":
        raise InputError(f"{path}: expected the name of a PNG file, ending in .png.")
    with atomic_write(path) as temporary:
        Image.fromarray(image).save(temporary, compress_level=COMPRESSION)


def load_png(path: str | Path) -> np.ndarray:
    """Read the colors of an image, without its alpha, as [H, W, 3] uint8.

    Raises:
        InputError: if the file is missing, damaged, or no image.
    """
    # Pillow raises many types, SyntaxError among them
    with refusing(Exception, f"{path}: could not be read as an image", "; write it again."), Image.open(path) as image:
        if image.mode[0] in "IF":  # Pillow would cut more than 8 bits at 255
            raise InputError(f"{path}: expected 8 bits a channel, found {image.mode}; write it again.")
        return np.array(image.convert("RGB"))


def save_video(path: str | Path, frames: Iterable[np.ndarray], fps: float) -> None:
    """Write frames as an MP4 that browsers and phones play: H.264, 4:2:0, BT.709 colors, index at the front.

    H.264 needs even sizes: an odd width or height is filled up by repeating the last column or row.

    Args:
        path: the file to write, ending in .mp4.
        frames: images [H, W, 3] uint8 of one size, taken one at a time.
        fps: frames per second.

    Raises:
        InputError: if there are no frames, or one differs from the first in shape or type; if the file cannot be
            written.
    """
    import av  # noqa: PLC0415 - large, and only films need it

    frames = iter(frames)
    if (first := next(frames, None)) is None:
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

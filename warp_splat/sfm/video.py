"""Sharp frames of a video: of each of equal spans the frame with the largest variance of the Laplacian.

The measure is that of Pech-Pacheco et al. 2000 (Diatom autofocusing in brightfield microscopy), on the luma.
"""

from collections.abc import Callable, Iterator
from itertools import groupby
from pathlib import Path

import av
import numpy as np
from av.error import FFmpegError, InvalidDataError
from PIL import Image
from scipy.ndimage import laplace

from warp_splat.config import SfmConfig
from warp_splat.errors import InputError, refusing
from warp_splat.formats.files import atomic_write
from warp_splat.text import Report

SHARPNESS_WIDTH = 960  # px; frames are shrunk to this width before they are judged, and noise with them
QUALITY = 97  # of the JPEG files, 0 to 100


def sample_frames(path: Path, folder: Path, config: SfmConfig, report: Report, advance: Callable[[int], object]) -> int:
    """Write the sharpest frame of each of ``config.frames`` equal spans of a video, as JPEG named by its number.

    Args:
        path: the video; the first video stream is read, and turned as its display matrix says.
        folder: where to write; must exist.
        config: says how many frames (all, if the video has fewer), and the threads of the decoder.
        report: called with a line for each thing that the user should know.
        advance: called with the share of the video that is read, in percent, as it grows.

    Returns:
        The number of frames written.

    Raises:
        InputError: if the file is not a video that PyAV (FFmpeg) can decode.
    """
    written, damaged, count = 0, [], config.frames
    problem = f"{path}: expected a video that FFmpeg can read, but it cannot"
    with refusing(FFmpegError, problem, "; convert it to MP4 (H.264) or give another file."):
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise InputError(f"{path}: expected a video, found no video stream in it; give another file.")
            packets = (packet for packet in container.demux(container.streams.video[0]) if packet.size > 0)
            ends = [((packet.pts or 0) + (packet.duration or 0)) * packet.time_base for packet in packets]
            total, end, told = len(ends), float(max(ends, default=0)), (container.duration or 0) / av.time_base
            if end < 0.9 * told:
                report(f"warning: the video's pictures end after {end:.1f} of {told:.1f} s: is the file cut off?")
        with av.open(str(path)) as container:
            span_of = lambda numbered: min(numbered[0] * count // max(total, 1), count - 1)  # noqa: E731
            for span, numbered in groupby(enumerate(_decode(container, config.threads, damaged)), span_of):
                index, frame = max(numbered, key=lambda each: _sharpness_of(each[1]))
                pixels = np.rot90(frame.to_ndarray(format="rgb24"), round(frame.rotation / 90))
                with atomic_write(folder / f"frame_{index:06d}.jpg") as temporary:
                    Image.fromarray(np.ascontiguousarray(pixels)).save(temporary, quality=QUALITY)
                written += 1
                advance(100 * (span + 1) // count)
    if damaged:
        report(f"warning: {len(damaged)} of {total} packets of the video are damaged and were left out.")
    return written


def _sharpness_of(frame: av.VideoFrame) -> float:
    """Variance of the Laplacian: large where edges are sharp."""
    width = min(SHARPNESS_WIDTH, frame.width)
    small = frame.reformat(width=width, height=max(3, frame.height * width // frame.width), format="gray")
    return float(np.var(laplace(small.to_ndarray().astype(np.float32))[1:-1, 1:-1]))


def _decode(container, threads: int, damaged: list[int]) -> Iterator[av.VideoFrame]:
    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    stream.codec_context.thread_count = threads
    for number, packet in enumerate(container.demux(stream)):
        try:
            yield from packet.decode()
        except InvalidDataError:
            damaged.append(number)

"""What a training on this machine will cost: the one place where memory and time are guessed.

The constants are those of the README's table (full size, 7,000 steps on two cores of a CPU).
"""

from __future__ import annotations

import psutil

from warp_splat.config import CORES
from warp_splat.scene.images import target_size

GIB = 2**30
BASE = 0.7 * GIB  # Python, torch, Warp and their kernels
BYTES_PER_GAUSSIAN = 3000  # parameters, gradients, moments, lists of tiles: 1.7 GB at 241,060 Gaussians
BYTES_PER_PIXEL = 300  # of one image: buffers of the step
PIXELS_PER_GAUSSIAN = 2  # 241,060 Gaussians from photographs of 518,400 px
SECONDS_PER_PIXEL = 6.7e-7  # of a thread, for each step: 1216 s for 7,000 steps of 518,400 px on two
STEPS = {"--preset fast": 4000, "30,000 iterations": 30_000}


def forecast(sizes: list[tuple[int, int]], points: int) -> tuple[str, bool]:
    """Memory and time of a training with default options.

    Args:
        sizes: width and height [px] of each image.
        points: that training starts from.

    Returns:
        A sentence, and whether this machine has the memory.
    """
    targets = [target_size(*size, -1) for size in sizes]
    pixels = max(width * height for width, height in targets)
    photographs = 3 * sum(width * height for width, height in targets)
    gaussians = max(points, pixels // PIXELS_PER_GAUSSIAN)
    needed = BASE + photographs + BYTES_PER_GAUSSIAN * gaussians + BYTES_PER_PIXEL * pixels
    available = psutil.virtual_memory().available
    mean = sum(width * height for width, height in targets) / len(targets)
    step = mean * SECONDS_PER_PIXEL / CORES
    times = ", ".join(f"{_span(steps * step)} for {name}" for name, steps in STEPS.items())
    text = (
        f"about {needed / GIB:.1f} GiB of memory for {gaussians} Gaussians, {available / GIB:.1f} GiB are free; "
        f"roughly {times} on {CORES} CPU threads."
    )
    if needed > available:
        text = f"{text[:-1]}; take smaller images (-r 2) or fewer Gaussians (--max_gaussians)."
    return text, needed <= available


def _span(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"

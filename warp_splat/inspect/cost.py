"""What a training will take on this machine: memory (:mod:`warp_splat.training.memory`), and time, guessed."""

import psutil

from warp_splat.config import CORES
from warp_splat.presets import PRESETS
from warp_splat.scene.images import target_size
from warp_splat.training.memory import FLOAT, GIB, INSTANCES, expected_gaussians, pixel_floats, step_memory
from warp_splat.training.options import LearnOptions, ModelOptions

BASE = 0.7 * GIB  # Python, torch, Warp and their kernels
SECONDS_PER_PIXEL = 6.7e-7  # of a thread, for each step: 1216 s for 7,000 steps of 518,400 px on two
RUNS = {"--preset fast": PRESETS["fast"]["iterations"], "the default": LearnOptions.iterations}


def forecast(
    sizes: list[tuple[int, int]], points: int, linear: bool = False, masked: bool = False, alpha: bool = False
) -> tuple[str, bool]:
    """Memory and time of a training with default options.

    Args:
        sizes: width and height [px] of each image.
        points: that training starts from.
        linear: the images are in linear light.
        masked: they have masks.
        alpha: they have alpha.

    Returns:
        A sentence, and whether this machine has the memory.
    """
    targets = [target_size(*size, -1) for size in sizes]
    areas = [width * height for width, height in targets]
    gaussians, _ = expected_gaussians(points, max(areas))
    per_pixel = pixel_floats(masked, False, linear)
    coefficients = (ModelOptions.sh_degree + 1) ** 2
    step = step_memory(gaussians, coefficients, INSTANCES * gaussians, max(areas), per_pixel=per_pixel)
    photographs = sum(areas) * ((3 * FLOAT if linear else 3) + masked + alpha)
    needed, available = BASE + photographs + step, psutil.virtual_memory().available
    seconds = sum(areas) / len(areas) * SECONDS_PER_PIXEL / CORES
    times = ", ".join(f"{_span(steps * seconds)} for {name} ({steps} iterations)" for name, steps in RUNS.items())
    text = (
        f"about {needed / GIB:.1f} GiB of memory for {gaussians} Gaussians, {available / GIB:.1f} GiB are free; "
        f"roughly {times} on {CORES} CPU threads."
    )
    if needed > available:
        text = f"{text[:-1]}; take smaller images (-r 2) or fewer Gaussians (--max_gaussians)."
    return text, needed <= available


def _span(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"

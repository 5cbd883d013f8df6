"""How much memory training will take, told before it does: what measured steps took on the CPU, scaled.

Floats of a Gaussian, a tile instance and a pixel are fitted to the peaks that ``benchmarks/scaling.py`` measures: 0.84
to 1.13 of them over its sweeps. Tried:

- 0.89 to 1.23 of the peaks: every tensor of a step counted by hand, 41 numbers.
- 0.00 to 0.78 of the peaks: two steps measured as training starts, at three sizes, scaled to its end. So few Gaussians
  live in pieces of the heap that are there anyhow; it took 0.3 to 1.3 s.
"""

import psutil
import torch

from warp_splat.config import TILE
from warp_splat.runtime.launch import available_memory
from warp_splat.training.options import TrainConfig
from warp_splat.training.seams import having
from warp_splat.training.trainer import Trainer

FLOAT, GIB = 4, 2**30  # bytes
INSTANCES = 3  # of a Gaussian, guessed: 1.4 to 2.8 on photographs of 270 x 480 and 540 x 960 px
PIXELS = 2  # per Gaussian, guessed where nothing limits their number: 2.2 after 7,000 iterations at 540 x 960 px

PER_PARAMETER = 6  # floats: itself, its gradient, two moments, and what a change of the set copies
PER_GAUSSIAN = 55  # floats besides its parameters
PER_INSTANCE = 15  # floats of a pair of a Gaussian and a tile
STATES = TILE * TILE  # floats of a tile instance more, for --adjoint stored
PER_PIXEL = 25  # floats
MASKED, COMPOSITED, LINEAR = 9, 11, 28  # floats of a pixel more: masks; alpha on random backgrounds; linear light


def pixel_floats(masked: bool, composited: bool, linear: bool) -> int:
    """Floats of a pixel with what the photographs have."""
    return PER_PIXEL + MASKED * masked + COMPOSITED * composited + LINEAR * linear


def step_memory(gaussians: int, instances: int, pixels: int, config: TrainConfig, per_pixel: int = PER_PIXEL) -> int:
    """Bytes that training steps take on the CPU, beyond what the process takes before the first.

    Args:
        gaussians: N.
        instances: pairs of a Gaussian and a tile that it touches.
        pixels: of a view.
        config: says how many harmonics there are, how steps are differentiated, and whether moments have 16 bits.
        per_pixel: see :func:`pixel_floats`.
    """
    parameters = 3 + 4 + 3 + 1 + 3 * (config.model.sh_degree + 1) ** 2  # means, quats, scales, opacities, sh
    of_gaussian = (PER_PARAMETER - config.learn.half_moments) * parameters + PER_GAUSSIAN
    of_instance = PER_INSTANCE + (STATES if config.model.adjoint == "stored" else 0)
    return FLOAT * (gaussians * of_gaussian + instances * of_instance + pixels * per_pixel)


def describe(trainer: Trainer) -> tuple[str, bool]:
    """What to tell the user once kernels are loaded, memory and the Gaussians assumed, and whether that can be had."""
    scene, config, processes = trainer.scene, trainer.config, trainer.processes.local_count
    pixels = max(view.camera.width * view.camera.height for view in scene.train)
    grows, limit = trainer.growth.grows(config.learn.iterations), config.grow.max_gaussians
    count, reason = expected_gaussians(len(trainer.model), pixels, limit, grows)
    if trainer.optimizer.folder:
        size = 3 * FLOAT * sum(leaf[0].numel() for leaf in trainer.model.parameters.values()) * count
        return f"{count} Gaussians ({reason}) take {size / GIB:.1f} GiB of disk, memory where views show them.", True
    masked = any(view.mask is not None for view in scene.train)
    composited = any(having(trainer.parts, "reads_alpha")) and any(view.alpha is not None for view in scene.train)
    per_pixel = pixel_floats(masked, composited, scene.linear)

    def step(gaussians: int) -> int:
        return step_memory(gaussians, INSTANCES * gaussians, pixels, config, per_pixel)

    base, needed = psutil.Process().memory_info().rss, step(count) + scene.memory.later
    each = f" in each of {processes} processes" if processes > 1 else ""
    text = f"About {(base + needed) / GIB:.1f} GiB of memory{each} at {count} Gaussians ({reason})"
    if not limit:
        text += f", {(step(10**6) - step(0)) / GIB:.1f} GiB more for each further million"
    available = available_memory(torch.device("cpu"))
    if not (fits := processes * needed <= available):
        text += (
            f". Only {(base + available // processes) / GIB:.1f} GiB can be had: take smaller images (-r) or fewer "
            "Gaussians (--max_gaussians)"
        )
    return f"{text}.", fits


def expected_gaussians(beginning: int, pixels: int, limit: int = 0, grows: bool = True) -> tuple[int, str]:
    """How many Gaussians there will be of so many at the beginning, and why; ``pixels`` of a view."""
    if not grows:
        return beginning, "as at the beginning"
    if limit:
        return (limit, "--max_gaussians") if limit >= beginning else (beginning, "as at the beginning")
    if beginning >= (guess := pixels // PIXELS):
        return beginning, "as at the beginning, and more as they grow; --max_gaussians limits them"
    return guess, f"guessed: one for {PIXELS} px of a photograph; --max_gaussians limits them"

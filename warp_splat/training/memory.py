"""How much memory training will take, told before it does: the tensors of a step on the CPU, counted.

Few tensors are assumed to take the place of one that was freed: the pieces of a heap seldom fit what comes next. One
image is added for what such pieces still leave unused. ``benchmarks/scaling.py`` compares with measured peaks.
"""

from __future__ import annotations

import psutil
import torch

from warp_splat.config import TILE
from warp_splat.runtime.launch import available_memory
from warp_splat.training.seams import having
from warp_splat.training.trainer import Trainer

FLOAT, GIB = 4, 2**30  # bytes
INSTANCES = 3  # of a Gaussian, guessed: 1.4 to 2.8 on photographs of 270 x 480 and 540 x 960 px
PIXELS = 2  # per Gaussian, guessed where nothing limits their number: 2.2 after 7,000 iterations at 540 x 960 px

COPIES = 4  # of a parameter: itself, its gradient, and the two moments of Adam
#: Floats of a Gaussian besides its parameters.
PER_GAUSSIAN = sum(
    (
        3 + 1,  # scales, opacities
        2 + 3 + 1 + 3 + 1 + 2 + 1 + 1,  # means2d, conics, opacities2d, colors, depths, extents, radii (twice)
        2 + 3 + 1 + 3 + 1,  # their gradients, without those of the last three
        3 + 1,  # gradients of scales and opacities before activation
        1 + 2 + 2 + 1 + 3,  # depths and indices, in the sort as well, indices of the drawn (32 and 64 bits)
        12 + 2 + 2 + 1,  # Splat2D, where its rows and places end (64 bits), and where these begin
        1,  # where its rows of gradients begin, once more
        3 + 3,  # densification: its statistics, and what is added to them
    )
)
#: Floats of a tile instance.
PER_INSTANCE = sum(
    (
        2 + 9,  # splat and place, and its row of gradients
        2,  # the span of a row of tiles that one Gaussian touches, at most one for each instance
    )
)
STATES = TILE * TILE  # floats of a tile instance more, for --adjoint stored
#: Floats of a pixel.
PER_PIXEL = sum(
    (
        3 + 1 + 1 + 1,  # image, alpha, transmittance and steps in blocks
        9,  # loss: three slopes of SSIM
        7,  # rows in its rings, at most: in bands of 64 rows, the smallest
        3,  # gradient of the image; those upstream of the blend, in blocks, go where the slopes were
        3,  # an image, for which the heap has no piece that fits
    )
)
MASKED = 3 + 3 + 3  # floats of a pixel more, where masks are: both images in black, and a gradient
COMPOSITED = 3 + 1 + 1 + 3 + 3  # where alpha lets random backgrounds through: colors, what is clear, its share, the sum
LINEAR = 6 * 3 + 1 + 3 + 2 * 3  # in linear light: the steps of sRGB's curve, the photograph under it, two gradients


def pixel_floats(masked: bool, composited: bool, linear: bool) -> int:
    """Floats of a pixel with what the photographs have."""
    return PER_PIXEL + MASKED * masked + COMPOSITED * composited + LINEAR * linear


def step_memory(
    gaussians: int,
    coefficients: int,
    instances: int,
    pixels: int,
    adjoint: str = "manual",
    per_pixel: int = PER_PIXEL,
) -> int:
    """Bytes that training steps take on the CPU, beyond what the process takes before the first.

    Args:
        gaussians: N.
        coefficients: of spherical harmonics, K for each channel.
        instances: pairs of a Gaussian and a tile that it touches.
        pixels: of a view.
        adjoint: one of ADJOINTS.
        per_pixel: see :func:`pixel_floats`.
    """
    parameters = 3 + 4 + 3 + 1 + 3 * coefficients  # means, quats, scales, opacities, sh
    # while the set changes: all of the old one, and the largest tensor twice, as rows kept and with those added
    changing = parameters + 2 * max(4, 3 * (coefficients - 1))
    of_gaussian = COPIES * parameters + changing + PER_GAUSSIAN
    of_instance = PER_INSTANCE + (STATES if adjoint == "stored" else 0)
    return FLOAT * (gaussians * of_gaussian + instances * of_instance + pixels * per_pixel)


def describe(trainer: Trainer) -> str:
    """What to tell the user once kernels are loaded: memory and the Gaussians assumed, and whether that can be had."""
    scene, config, processes = trainer.scene, trainer.config, trainer.processes.local_count
    pixels = max(view.camera.width * view.camera.height for view in scene.train)
    grows, limit = trainer.growth.grows(config.learn.iterations), config.grow.max_gaussians
    count, reason = expected_gaussians(len(trainer.model), pixels, limit, grows)
    masked = any(view.mask is not None for view in scene.train)
    composited = any(having(trainer.parts, "reads_alpha")) and any(view.alpha is not None for view in scene.train)
    per_pixel = pixel_floats(masked, composited, scene.linear)

    def step(gaussians: int) -> int:
        coefficients, instances = (config.model.sh_degree + 1) ** 2, INSTANCES * gaussians
        return step_memory(gaussians, coefficients, instances, pixels, config.model.adjoint, per_pixel)

    base, needed = psutil.Process().memory_info().rss, step(count)
    each = f" in each of {processes} processes" if processes > 1 else ""
    text = f"About {(base + needed) / GIB:.1f} GiB of memory{each} at {count} Gaussians ({reason})"
    if not limit:
        text += f", {(step(10**6) - step(0)) / GIB:.1f} GiB more for each further million"
    available = available_memory(torch.device("cpu"))
    if processes * needed > available:
        text += (
            f". Only {(base + available // processes) / GIB:.1f} GiB can be had: take smaller images (-r) or fewer "
            "Gaussians (--max_gaussians)"
        )
    return f"{text}."


def expected_gaussians(beginning: int, pixels: int, limit: int = 0, grows: bool = True) -> tuple[int, str]:
    """How many Gaussians there will be, from their number at the beginning, and why; ``pixels`` of a view."""
    if not grows:
        return beginning, "as at the beginning"
    if limit:
        return max(beginning, limit), "--max_gaussians"
    guess = max(beginning, pixels // PIXELS)
    return guess, f"guessed: one for {PIXELS} px of a photograph; --max_gaussians limits them"

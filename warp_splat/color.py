"""Between linear light and what a screen shows, maps of colors, and harmonics. For NumPy and torch alike."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    import torch

TOE = 0.0031308  # below, sRGB is linear (IEC 61966-2-1)
#: On a screen, light times g is (value + PIVOT) times g^(1/2.4), but for the darkest 4 %. So maps of colors act on
#: value + PIVOT, and need no powers.
PIVOT = 0.055
#: Numbers of a map of colors, differences to the identity: a gain; 12 of an affine map (columns of a matrix, and what
#: is added); as many for each cell of brightness, height and width (Chen et al. 2007).
COLOR_MAPS = {"gain": (1,), "affine": (12,), "bilateral": (12, 4, 8, 8)}


def to_srgb(linear: Any, where: Callable) -> Any:
    """SRGB's curve (IEC 61966-2-1), continued above 1; ``where`` is that of the array's library."""
    return where(linear <= TOE, 12.92 * linear, 1.055 * linear.clip(TOE) ** (1 / 2.4) - 0.055)


def from_srgb(encoded: Any, where: Callable) -> Any:
    """The inverse of :func:`to_srgb`."""
    return where(encoded <= 12.92 * TOE, encoded / 12.92, ((encoded.clip(12.92 * TOE) + 0.055) / 1.055) ** 2.4)


def to_bytes(image: "torch.Tensor", linear: bool = False) -> "np.ndarray":
    """[H, W, 3] float image, clamped to 0..1, as uint8 for a screen; ``linear``: it is in linear light."""
    import torch  # noqa: PLC0415 - whoever reads scenes only need not wait for it

    image = image.detach().clamp(0.0, 1.0)
    return ((to_srgb(image, torch.where) if linear else image) * 255.0).round().to(torch.uint8).cpu().numpy()


def harmonics_at(x: Any, y: Any, z: Any, degree: int) -> list:
    """Of unit vectors, (degree + 1)^2 arrays as x: the recurrences of Sloan (2013), signs as in the trainers' files.

    ``even`` and ``odd`` are the cosine and the sine of m times the azimuth, times the m-th power of their radius.
    """
    found = {}
    even, odd, first = x, y, 1.0
    for m in range(degree + 1):
        before, here = 0.0, first  # Legendre's functions of the last two degrees
        for band in range(m, degree + 1):
            norm = math.sqrt((2 * band + 1) / (4 * math.pi) * math.factorial(band - m) / math.factorial(band + m))
            if m == 0:
                found[band, 0] = norm * here * x**0  # an array, too, where it is a constant
            else:
                scaled = math.sqrt(2) * norm * here
                found[band, m], found[band, -m] = scaled * even, scaled * odd
            slope, last = (2 * band + 1) / (band - m + 1), (band + m) / (band - m + 1)
            before, here = here, slope * here * z - last * before
        if m > 0:
            even, odd = x * even - y * odd, x * odd + y * even
        first *= -(2 * m + 1)
    return [found[band, m] for band in range(degree + 1) for m in range(-band, band + 1)]

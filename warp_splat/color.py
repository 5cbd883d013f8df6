"""Between linear light and what a screen shows. For NumPy's and torch's arrays alike."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    import torch

TOE = 0.0031308  # below, sRGB is linear (IEC 61966-2-1)


def to_srgb(linear: Any, where: Callable) -> Any:
    """SRGB's curve (IEC 61966-2-1), continued above 1; ``where`` is that of the array's library."""
    return where(linear <= TOE, 12.92 * linear, 1.055 * linear.clip(TOE) ** (1 / 2.4) - 0.055)


def from_srgb(encoded: Any, where: Callable) -> Any:
    """The inverse of :func:`to_srgb`."""
    return where(encoded <= 12.92 * TOE, encoded / 12.92, ((encoded.clip(12.92 * TOE) + 0.055) / 1.055) ** 2.4)


def to_bytes(image: torch.Tensor, linear: bool = False) -> np.ndarray:
    """[H, W, 3] float image, clamped to 0..1, as uint8 for a screen; ``linear``: it is in linear light."""
    import torch  # noqa: PLC0415 - whoever reads scenes only need not wait for it

    image = image.detach().clamp(0.0, 1.0)
    return ((to_srgb(image, torch.where) if linear else image) * 255.0).round().to(torch.uint8).cpu().numpy()

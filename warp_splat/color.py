"""From linear light to values that a screen shows; for NumPy's and torch's arrays alike."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

TOE = 0.0031308  # below, sRGB is linear (IEC 61966-2-1)


def to_srgb(linear: Any, where: Callable) -> Any:
    """SRGB's curve (IEC 61966-2-1), continued above 1; ``where`` is that of the array's library."""
    return where(linear <= TOE, 12.92 * linear, 1.055 * linear.clip(TOE) ** (1 / 2.4) - 0.055)


def from_srgb(encoded: Any, where: Callable) -> Any:
    """The inverse of :func:`to_srgb`."""
    return where(encoded <= 12.92 * TOE, encoded / 12.92, ((encoded.clip(12.92 * TOE) + 0.055) / 1.055) ** 2.4)

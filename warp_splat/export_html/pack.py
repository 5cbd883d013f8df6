"""Gaussians as the page holds them, and as the graphics card reads them: texels of 16 bytes, little endian.

    0   x y z               float32, offsets from an origin, 17 bits of mantissa
        log scales 0 1      int16, steps of 1/256
    1   log scale 2         int16
        opacity             uint16, 0 to 1
        rotation            three int16, (x, y, z) / (1 + w) of the unit quaternion with w >= 0, steps of 1/8192
        base color         three int16, SH coefficients of degree 0, steps of 1/256
    2.. five more SH coefficients, RGB each: int8 in steps of 2^e / 128, and e, uint8

An attribute's bytes lie together, first bytes first, before gzip: so they compress. Half a step is the largest error.
"""

from __future__ import annotations

import gzip

import numpy as np

from warp_splat.config import ALPHA_MIN
from warp_splat.formats.splats import SplatArrays, sigmoid, sizes, unit_quats

ROUNDED_BITS = 6  # of the 23 of a position's mantissa
LOG_STEPS = 256  # of scales, per factor e
ROTATION_STEPS = 8192
COLOR_STEPS = 256  # of SH coefficients of degree 0
HARMONIC_STEPS = 128  # of the others, where none of five is larger than 127 steps
LARGEST = 127.0  # SH coefficients beyond it are moved there
TEXEL = 16  # bytes
IN_TEXEL = 5  # SH coefficients of a degree above 0

CORE = np.dtype(
    [("means", "<u4", 3), ("scales", "<i2", 3), ("opacity", "<u2"), ("rotation", "<i2", 3), ("color", "<i2", 3)]
)


def shown(splats: SplatArrays, most: int = 0) -> SplatArrays:
    """The Gaussians that can be seen at all; of these the ``most`` opaque and large ones, if it is not 0.

    Args:
        splats: finite Gaussians.
        most: the largest number to keep, by opacity times the area of the largest section; 0 keeps all.
    """
    opacities = sigmoid(splats.opacities)
    rows = np.flatnonzero((opacities >= ALPHA_MIN) & splats.quats.any(axis=1))
    if 0 < most < len(rows):
        rows = np.sort(rows[np.argsort(-sizes(splats)[rows], kind="stable")[:most]])
    return SplatArrays(*(array[rows] for array in splats))


def texels(coefficients: int) -> int:
    """How many a Gaussian of this number of SH coefficients takes."""
    return 2 + -(-(coefficients - 1) // IN_TEXEL)


def pack_gaussians(splats: SplatArrays, origin: np.ndarray) -> bytes:
    """The Gaussians, compressed.

    Args:
        splats: finite Gaussians.
        origin: the point [3] that positions are relative to, world units.
    """
    count, coefficients, _ = splats.sh.shape
    quats = unit_quats(splats.quats).astype(np.float64)
    quats *= np.where(quats[:, :1] < 0, -1, 1)
    core = np.zeros(count, CORE)
    core["means"] = _rounded((splats.means - origin).astype("<f4"))
    core["scales"] = _steps(splats.scales, LOG_STEPS)
    core["opacity"] = np.round(sigmoid(splats.opacities.astype(np.float64)) * 65535)
    core["rotation"] = _steps(quats[:, 1:] / (1 + quats[:, :1]), ROTATION_STEPS)
    core["color"] = _steps(splats.sh[:, 0], COLOR_STEPS)
    rows = np.zeros((count, texels(coefficients), TEXEL), np.uint8)
    rows[:, :2] = core.view(np.uint8).reshape(count, 2, TEXEL)
    rows[:, 2:] = _harmonics(splats.sh[:, 1:], rows.shape[1] - 2)
    return gzip.compress(rows.reshape(count, rows.shape[1] * TEXEL).T.tobytes(), mtime=0)


def _rounded(values: np.ndarray) -> np.ndarray:
    """The bits of float32 numbers, rounded to the nearest that ends in ROUNDED_BITS zeros."""
    return (values.view("<u4") + np.uint32(1 << ROUNDED_BITS - 1)) >> ROUNDED_BITS << ROUNDED_BITS


def _steps(values: np.ndarray, steps: int) -> np.ndarray:
    """The nearest multiples of 1 / ``steps`` that int16 holds."""
    return np.clip(np.round(values.astype(np.float64) * steps), -32768, 32767)


def _harmonics(sh: np.ndarray, groups_of_five: int) -> np.ndarray:
    """[N, groups, TEXEL] uint8 from [N, K, 3] coefficients; steps are as small as the largest of five allows."""
    count, coefficients, _ = sh.shape
    padded = np.zeros((count, groups_of_five * IN_TEXEL, 3), np.float32)
    padded[:, :coefficients] = np.clip(sh, -LARGEST, LARGEST)
    groups = padded.reshape(count, groups_of_five, IN_TEXEL, 3)
    largest = np.abs(groups).max(axis=(2, 3), initial=0) * (HARMONIC_STEPS / 127)
    exponents = np.ceil(np.log2(np.maximum(largest, 1)))
    steps = np.round(groups * (HARMONIC_STEPS / 2**exponents)[:, :, None, None]).astype(np.int8)
    return np.concatenate(
        [steps.view(np.uint8).reshape(count, groups_of_five, TEXEL - 1), exponents.astype(np.uint8)[:, :, None]], axis=2
    )

"""Gaussians as the page holds them, and as the graphics card reads them: texels of 16 bytes, little endian.

    0   x y z               float32, offsets from an origin, 17 bits of mantissa
        log scales 0 1      int16, steps of 1/256
    1   log scale 2         int16
        opacity             uint16, 0 to 1
        rotation            three int16, (x, y, z) / (1 + w) of the unit quaternion with w >= 0, steps of 1/8192
        base color         three int16, SH coefficients of degree 0, steps of 1/256

and in a table of their own, five more SH coefficients a texel, RGB each: int8 in steps of 2^e / 128, and e, uint8.

Both are cut into parts of CHUNK Gaussians, of which a large model's first is of Gaussians that stand for many
(merge.py). An attribute's bytes lie together in a part, first bytes first, before gzip:
so they compress. Half a step is the largest error.
"""

import gzip

import numpy as np

from warp_splat.config import ALPHA_MIN
from warp_splat.formats.splats import SplatArrays, sizes
from warp_splat.formats.stored import sigmoid, unit_quats

ROUNDED_BITS = 6  # of the 23 of a position's mantissa
LOG_STEPS = 256  # of scales, per factor e
ROTATION_STEPS = 8192
COLOR_STEPS = 256  # of SH coefficients of degree 0
HARMONIC_STEPS = 128  # of the others, where none of five is larger than 127 steps
LARGEST = 127.0  # SH coefficients beyond it are moved there
TEXEL = 16  # bytes
CHUNK = 24 * 4096  # Gaussians in a part: whole rows of textures as wide as this or any smaller power of two
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
    rows = np.flatnonzero((sigmoid(splats.opacities) >= ALPHA_MIN) & splats.quats.any(axis=1))
    if 0 < most < len(rows):
        rows = np.sort(rows[np.argsort(-sizes(splats)[rows], kind="stable")[:most]])
    return splats.take(rows)


def texels(coefficients: int) -> int:
    """How many texels the harmonics above degree 0 take, of this number of SH coefficients."""
    return -(-(coefficients - 1) // IN_TEXEL)


def parts(splats: SplatArrays, origin: np.ndarray, coarse: SplatArrays | None = None) -> dict[str, bytes]:
    """The Gaussians, compressed, in the order of the page: all without harmonics, "gaussians0" and on, then those.

    Args:
        splats: finite Gaussians.
        origin: the point [3] that positions are relative to, world units.
        coarse: CHUNK others of degree 0, which become the first part.
    """
    chunks = [] if coarse is None else [coarse]
    chunks += [splats.take(slice(start, start + CHUNK)) for start in range(0, max(1, len(splats.means)), CHUNK)]
    found = {f"gaussians{index}": _compressed(_core(chunk, origin)) for index, chunk in enumerate(chunks)}
    for index, chunk in enumerate(chunks):
        if chunk.sh.shape[1] > 1:
            found[f"harmonics{index}"] = _compressed(_harmonics(chunk.sh[:, 1:]))
    return found


def _compressed(rows: np.ndarray) -> bytes:
    """Rows [N, bytes], byte by byte."""
    return gzip.compress(rows.T.tobytes(), mtime=0)


def _core(splats: SplatArrays, origin: np.ndarray) -> np.ndarray:
    """[N, 2 TEXEL] uint8: all but the harmonics above degree 0."""
    quats = unit_quats(splats.quats).astype(np.float64)
    quats *= np.where(quats[:, :1] < 0, -1, 1)
    core = np.zeros(len(quats), CORE)
    core["means"] = _rounded((splats.means - origin).astype("<f4"))
    core["scales"] = _steps(splats.scales, LOG_STEPS)
    core["opacity"] = np.round(sigmoid(splats.opacities.astype(np.float64)) * 65535)
    core["rotation"] = _steps(quats[:, 1:] / (1 + quats[:, :1]), ROTATION_STEPS)
    core["color"] = _steps(splats.sh[:, 0], COLOR_STEPS)
    return core.view(np.uint8).reshape(-1, 2 * TEXEL)


def _rounded(values: np.ndarray) -> np.ndarray:
    """The bits of float32 numbers, rounded to the nearest that ends in ROUNDED_BITS zeros."""
    return (values.view("<u4") + np.uint32(1 << ROUNDED_BITS - 1)) >> ROUNDED_BITS << ROUNDED_BITS


def _steps(values: np.ndarray, steps: int) -> np.ndarray:
    """The nearest multiples of 1 / ``steps`` that int16 holds."""
    return np.clip(np.round(values.astype(np.float64) * steps), -32768, 32767)


def _harmonics(sh: np.ndarray) -> np.ndarray:
    """[N, texels TEXEL] uint8 from [N, K, 3] coefficients; steps are as small as the largest of five allows."""
    count, coefficients, _ = sh.shape
    shape = (count, texels(coefficients + 1), IN_TEXEL, 3)
    spare = shape[1] * IN_TEXEL - coefficients
    groups = np.pad(np.clip(sh, -LARGEST, LARGEST), ((0, 0), (0, spare), (0, 0))).reshape(shape)
    largest = np.abs(groups).max(axis=(2, 3)) * (HARMONIC_STEPS / 127)
    exponents = np.ceil(np.log2(np.maximum(largest, 1)))
    steps = np.round(groups * (HARMONIC_STEPS / 2**exponents)[:, :, None, None]).astype(np.int8)
    rows = np.dstack([steps.view(np.uint8).reshape(*shape[:2], TEXEL - 1), exponents.astype(np.uint8)])
    return rows.reshape(count, shape[1] * TEXEL)

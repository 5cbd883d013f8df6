"""Gaussians as ``.splat`` files, the format of antimatter15's viewer: 32 bytes each, without a header.

Three float32 of position, three of standard deviation, then bytes: red green blue opacity, and the quaternion w x y z
as 128 * q + 128. The axes are those of the PLY file. Spherical harmonics above degree 0 have no place.
"""

import os
from pathlib import Path

import numpy as np

from warp_splat.formats.files import Unexpected, reading, write_bytes
from warp_splat.formats.splats import SplatArrays, SplatFile
from warp_splat.formats.stored import LOG_SCALES, SH_C0, clipped, log_scales, logit, sigmoid, unit_quats
from warp_splat.text import Report

ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def save_splat(path: str | Path, file: SplatFile, report: Report = print) -> None:
    """Write Gaussians as a .splat file.

    Args:
        path: the file to write.
        file: the Gaussians, at least one, of which SH degree 0 is kept.
        report: called with a part of a sentence for each kind of value that the format cannot hold.

    Raises:
        InputError: if the file cannot be written.
    """
    means, sh, opacities, scales, quats = file.splats
    colors = clipped("color", SH_C0 * sh[:, 0] + 0.5, 0, 1, report)
    rows = np.empty(len(means), ROW)
    rows["mean"] = means
    rows["scale"] = np.exp(clipped("log scale", scales, *LOG_SCALES, report))
    rows["rgba"][:, :3] = np.rint(255 * colors)
    rows["rgba"][:, 3] = np.rint(255 * sigmoid(opacities))
    rows["quat"] = np.clip(np.rint(128 * unit_quats(quats) + 128), 0, 255)
    write_bytes(path, rows.tobytes())  # NumPy does not tell when the end is missing


def load_splat(path: str | Path, report: Report = print) -> SplatFile:
    """Read a .splat file; what is no number, or a negative scale, becomes one that is not finite.

    Args:
        path: the file.
        report: not called; other formats have things to say.

    Raises:
        InputError: if the file is missing or not a whole number of rows.
    """
    with reading(path, "a .splat file, 32 bytes for each Gaussian"), open(path, "rb") as source:
        if (size := os.fstat(source.fileno()).st_size) == 0 or size % ROW.itemsize:
            raise Unexpected(f"{size} bytes; it may be cut short")
        rows = np.fromfile(source, ROW, size // ROW.itemsize)
        splats = SplatArrays(
            means=rows["mean"].astype(np.float32),
            sh=((rows["rgba"][:, None, :3] / np.float32(255) - np.float32(0.5)) / np.float32(SH_C0)),
            opacities=logit(rows["rgba"][:, 3] / 255),
            scales=log_scales(rows["scale"]),
            quats=(rows["quat"].astype(np.float32) - 128) / 128,
        )
        return SplatFile(splats)

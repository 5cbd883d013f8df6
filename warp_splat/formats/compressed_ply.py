"""Gaussians as compressed PLY files, PlayCanvas's: 16 bytes each, and one for each number of the harmonics.

Three elements. ``chunk``: the ranges of position, log scale and color (0.5 + 0.28 x coefficient) of 256 Gaussians.
``vertex``: four uint32, the position within its chunk's range (11, 10, 11 bits), the rotation (which of w x y z is
largest, then the others, 10 bits each), the scale (11, 10, 11 bits) and the color with the opacity (8 bits each).
``sh``: harmonics as ``f_rest_*`` of the PLY file, in steps of 1/32 from -4 to 4. The axes are those of the PLY file.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from warp_splat.formats.coordinates import comments_of
from warp_splat.formats.files import Unexpected
from warp_splat.formats.ply_container import ANTIALIASED, PlyTables, columns_of, write_tables
from warp_splat.formats.splats import SplatArrays, SplatFile
from warp_splat.formats.stored import SH_C0, clipped, from_smallest_three, logit, sigmoid, smallest_three
from warp_splat.text import Report

CHUNK = 256  # Gaussians that share their ranges
WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
RANGES = "min_x min_y min_z max_x max_y max_z min_scale_x min_scale_y min_scale_z".split()
RANGES += "max_scale_x max_scale_y max_scale_z min_r min_g min_b max_r max_g max_b".split()
WITHOUT_COLOR = 12  # of RANGES, in older files: colors are in 0..1 then
POINT_BITS = (11, 10, 11)
COLOR_BITS = (8, 8, 8, 8)
SCALES = (-20.0, 20.0)  # logarithms
HARMONIC_STEPS = 32.0  # of harmonics, per unit; the first and the last byte stand for the ends of the range
HARMONICS = (-4.0, 4.0)
QUAT_BITS = (10, 10, 10)


def is_compressed(tables: PlyTables) -> bool:
    """Whether an opened PLY file is one of this kind."""
    return "vertex" in tables.elements and WORDS[0] in tables.elements["vertex"].properties


def save_compressed_ply(path: str | Path, file: SplatFile, report: Report = print) -> None:
    """Write Gaussians; near ones should follow each other, since ranges of chunks are small then.

    Args:
        path: the file to write.
        file: the Gaussians.
        report: called with a part of a sentence for each kind of value that the format cannot hold.

    Raises:
        InputError: if the file cannot be written.
    """
    splats = file.splats
    count, coefficients, _ = splats.sh.shape
    scales = clipped("log scale", splats.scales, *SCALES, report)
    harmonics = clipped("harmonics", splats.sh[:, 1:], *HARMONICS, report)
    starts, ranges, shares = np.arange(0, count, CHUNK), [], []
    for values in (splats.means, scales, (0.5 + SH_C0 * splats.sh[:, 0]).astype(np.float32)):
        ends = [extreme.reduceat(values, starts) if count else values for extreme in (np.minimum, np.maximum)]
        low, high = (end.astype(np.float64).repeat(CHUNK, axis=0)[:count] for end in ends)
        ranges += ends
        shares.append((values - low) / np.where(high > low, high - low, 1))
    words = np.zeros(count, [(name, "<u4") for name in WORDS])
    words["packed_position"] = _pack(shares[0], POINT_BITS)
    largest, others = smallest_three(splats.quats)
    words["packed_rotation"] = largest << 30 | _pack(others + 0.5, QUAT_BITS)
    words["packed_scale"] = _pack(shares[1], POINT_BITS)
    words["packed_color"] = _pack(np.column_stack([shares[2], sigmoid(splats.opacities)]), COLOR_BITS)
    table = np.concatenate(ranges, axis=1).astype("<f4")
    tables = {"chunk": table.view([(name, "<f4") for name in RANGES])[:, 0], "vertex": words}
    if coefficients > 1:
        steps = np.clip(np.floor(HARMONIC_STEPS * harmonics) + 128, 0, 255).astype(np.uint8)
        rows = np.ascontiguousarray(steps.transpose(0, 2, 1)).reshape(count, 3 * (coefficients - 1))
        tables["sh"] = rows.view([(f"f_rest_{index}", "u1") for index in range(rows.shape[1])])[:, 0]
    write_tables(path, tables, [ANTIALIASED] * file.antialiased + comments_of(file.coordinates))


def read_compressed(tables: PlyTables) -> SplatArrays:
    """The Gaussians of an opened file of this kind.

    Raises:
        Unexpected: if a table or a property is missing, or of another type.
        ValueError: if tables have other lengths than each other, or the file is cut short.
    """
    words = _columns(tables, "vertex", WORDS, "u4")
    count = len(words)
    old = "chunk" in tables.elements and RANGES[-1] not in tables.elements["chunk"].properties
    ranges = _columns(tables, "chunk", RANGES[:WITHOUT_COLOR] if old else RANGES, "f4").astype(np.float64)
    if len(ranges) != -(-count // CHUNK):
        raise ValueError(f"{len(ranges)} chunks for {count} Gaussians")
    if old:
        ranges = np.pad(np.pad(ranges, ((0, 0), (0, 3))), ((0, 0), (0, 3)), constant_values=1)
    low, high = ranges.reshape(-1, 3, 2, 3).transpose(2, 1, 0, 3).repeat(CHUNK, axis=2)[:, :, :count]
    colors = _unpack(words[:, 3], COLOR_BITS)
    shares = np.stack([_unpack(words[:, 0], POINT_BITS), _unpack(words[:, 2], POINT_BITS), colors[:, :3]])
    means, scales, base = (low * (1 - shares) + high * shares).astype(np.float32)
    base = (base - np.float32(0.5)) / np.float32(SH_C0)
    return SplatArrays(
        means=means,
        sh=np.concatenate([base[:, None], _harmonics(tables, count)], axis=1),
        opacities=logit(colors[:, 3]),
        scales=scales,
        quats=from_smallest_three(words[:, 1] >> 30, _unpack(words[:, 1], QUAT_BITS) - 0.5),
    )


def _harmonics(tables: PlyTables, count: int) -> np.ndarray:
    """[N, K - 1, 3] float32, K - 1 = 0 if the file has none."""
    if "sh" not in tables.elements:
        return np.zeros((count, 0, 3), np.float32)
    names = [f"f_rest_{index}" for index in range(len(tables.elements["sh"].properties))]
    if len(names) not in (9, 24, 45):
        raise Unexpected(f"{len(names)} properties of harmonics, not 9, 24 or 45")
    if len(steps := _columns(tables, "sh", names, "u1")) != count:
        raise ValueError(f"harmonics of {len(steps)} of {count} Gaussians")
    values = (steps + np.float32(0.5) - 128) / np.float32(HARMONIC_STEPS)
    values = np.where(steps == 0, HARMONICS[0], np.where(steps == 255, HARMONICS[1], values)).astype(np.float32)
    return values.reshape(count, 3, len(names) // 3).transpose(0, 2, 1)


def _columns(tables: PlyTables, element: str, names: Sequence[str], code: str) -> np.ndarray:
    """The properties [N, len(names)] of an element, which have to have the type ``code``."""
    if element not in tables.elements:
        raise Unexpected(f"a compressed one without an element {element!r}")
    if wrong := [name for name in names if tables.elements[element].properties.get(name) != code]:
        raise Unexpected(f"a compressed one whose {element} lacks {', '.join(wrong):.200} of type {code}")
    return columns_of(tables.rows(element), names, code)


def _pack(shares: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Numbers 0..1 [N, len(bits)] in one word, the first in its highest bits."""
    shifts, most = _fields(bits)
    return (np.floor(np.clip(shares, 0, 1) * most + 0.5).astype(np.uint32) << shifts).sum(1, dtype=np.uint32)


def _unpack(words: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Numbers 0..1 [N, len(bits)] from words."""
    shifts, most = _fields(bits)
    return (words[:, None] >> shifts & most) / most


def _fields(bits: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Where numbers lie in their word, and the largest of each."""
    ends = np.cumsum(bits, dtype=np.uint32)
    return ends[-1] - ends, (1 << np.array(bits, np.uint32)) - 1

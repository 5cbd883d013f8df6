"""Gaussians as SPZ files, the compressed format of Niantic (github.com/nianticlabs/spz): 20 to 65 bytes each.

Version 2 and 3 are one gzip stream: a header of 16 bytes, then all positions (24-bit fixed point), opacities, colors,
log scales, rotations, spherical harmonics. Version 4 has a header of 32 bytes, extension records, a table of sizes and
one Zstandard stream for each of the six. All three are read. Version 3 is written, which more viewers know.

The axes are right, up, back (OpenGL's) unless an extension record names others.

Own code: the one Python package of its authors is not on PyPI, and no other is well kept.
"""

import gzip
import os
import struct
import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np
import zstandard

from warp_splat.formats.files import Unexpected, atomic_write, check_expansion, reading
from warp_splat.formats.splats import COEFFICIENTS, SplatArrays, SplatFile, frame, turned
from warp_splat.formats.stored import clipped, from_smallest_three, logit, sigmoid, smallest_three, unit_quats
from warp_splat.text import Report

MAGIC, GZIP = b"NGSP", b"\x1f\x8b"
DAMAGE = (zlib.error, EOFError, gzip.BadGzipFile, zstandard.ZstdError)  # what libraries raise then
HEADER = struct.Struct("<4sIIBBBB")  # magic, version, count, SH degree, fractional bits, flags, streams (version 4)
HEADER4 = struct.Struct("<4sIIBBBBI12x")  # ... and where the table of sizes begins
FLAG_ANTIALIASED = 1
RECORD = struct.Struct("<II")  # type and length of an extension
EXTENSION_BYTES = 2**16  # at the end of version 3, far more than any known record needs
COORDINATE_SYSTEM = 0xADBE0003
AXES = "LDB RDB LUB RUB LDF RDF LUF RUF LFD RFD LFU RFU LBD RBD LBU RBU".split()  # numbered from 1
DISPUTED = {"LFD", "RFD", "LBU", "RBU"}  # the authors' library mirrors what these letters say
COLOR_SCALE = 0.15  # of the SH coefficient of degree 0, to leave room above white and below black
SCALE_STEP, SCALE_LOW = 16.0, -10.0  # per unit of the log scale; its least
FRACTION_BITS = 12  # steps of 1/4096 world unit, as the authors write, if the scene is less than 2048 units wide
POSITION_MAX = 2**23 - 1
FIELDS = np.array([2**20, 2**10, 1], np.uint32)  # where the numbers of a rotation lie in their word
DEGREE_COEFFICIENTS = (*COEFFICIENTS, 25)  # degree 4 is read, and left out
#: What is read of a file: the numbers of its header; positions, opacities, colors, scales, rotations, harmonics,
#: decompressed; the extension records.
Packed = tuple[tuple, list[bytes], bytes]


def save_spz(path: str | Path, file: SplatFile, report: Report = print) -> None:
    """Write Gaussians as an SPZ file, version 3.

    Args:
        path: the file to write.
        file: the Gaussians.
        report: called with a part of a sentence for each kind of value that the format cannot hold.

    Raises:
        InputError: if the file cannot be written.
    """
    means, sh, opacities, scales, quats = turned(file.splats, frame("RUB").T)
    count, coefficients, _ = sh.shape
    widest = float(np.abs(means).max(initial=0.0))
    bits = min(FRACTION_BITS, max(0, int(np.floor(np.log2(POSITION_MAX / max(widest, 1.0))))))
    reach = POSITION_MAX / 2.0**bits
    fixed = np.rint(clipped("position", means, -reach, reach, report) * 2.0**bits).astype("<i4")
    colors = clipped("color coefficient", sh[:, 0], -0.5 / COLOR_SCALE, 0.5 / COLOR_SCALE, report)
    steps = SCALE_STEP * (clipped("log scale", scales, SCALE_LOW, SCALE_LOW + 255 / SCALE_STEP, report) - SCALE_LOW)
    payload = [
        HEADER.pack(MAGIC, 3, count, COEFFICIENTS.index(coefficients), bits, FLAG_ANTIALIASED * file.antialiased, 0),
        fixed[..., None].view("u1")[..., :3].tobytes(),
        _bytes(255 * sigmoid(opacities)),
        _bytes(255 * (COLOR_SCALE * colors + 0.5)),
        _bytes(steps),
        _pack_quats(quats).tobytes(),
        # all eight bits: the authors keep five and four, for 3/5 of the size; the images differ ten decibels more then
        _bytes(128 * clipped("harmonics", sh[:, 1:], -1.0, 127 / 128, report) + 128),
    ]
    # no time and no name in the header: equal Gaussians give equal bytes
    with atomic_write(path) as new, open(new, "wb") as raw, gzip.GzipFile("", "wb", 6, raw, mtime=0) as target:
        target.write(b"".join(payload))


def load_spz(path: str | Path, report: Report = print) -> SplatFile:
    """Read an SPZ file of version 2, 3 or 4.

    Args:
        path: the file.
        report: called with one line if harmonics of degree 4 were left out.

    Raises:
        InputError: if the file is missing, damaged, of another version, or expands beyond what real files do.
    """
    with reading(path, "an SPZ file of version 2, 3 or 4", *DAMAGE), open(path, "rb") as source:
        start, file_bytes = source.peek(4)[:4], os.fstat(source.fileno()).st_size
        if start != MAGIC and start[:2] != GZIP:
            raise Unexpected(f"a file that begins with {start!r}; it may be another format, or cut short")
        header, streams, records = (_read_zstd if start == MAGIC else _read_gzip)(source, file_bytes)
        _, version, count, degree, fraction_bits, flags, *_ = header
        axes, splats = _find_axes(records), _unpack(streams, version, degree, fraction_bits)
    if degree == 4:
        report(f"{path}: left out the harmonics of degree 4 of {count} Gaussians; degree 3 is the highest.")
    return SplatFile(turned(splats, frame(axes)), bool(flags & FLAG_ANTIALIASED))


def _unpack(streams: list[bytes], version: int, degree: int, fraction_bits: int) -> SplatArrays:
    positions, opacities, colors, scales, rotations, harmonics = (np.frombuffer(each, np.uint8) for each in streams)
    count = len(opacities)
    # into the upper three bytes, so that the sign is in its place
    fixed = np.pad(positions.reshape(count, 3, 3), ((0, 0), (0, 0), (1, 0)))
    sh = np.zeros((count, min(DEGREE_COEFFICIENTS[degree], COEFFICIENTS[-1]), 3), np.float32)
    sh[:, 0] = (colors.reshape(count, 3) / np.float32(255) - np.float32(0.5)) / np.float32(COLOR_SCALE)
    higher = harmonics.reshape(count, DEGREE_COEFFICIENTS[degree] - 1, 3)[:, : sh.shape[1] - 1]
    sh[:, 1:] = (higher.astype(np.float32) - 128) / 128
    return SplatArrays(
        means=((fixed.view("<i4")[..., 0] >> 8) * 2.0**-fraction_bits).astype(np.float32),
        sh=sh,
        opacities=logit(opacities / 255),
        scales=scales.reshape(count, 3) / np.float32(SCALE_STEP) + np.float32(SCALE_LOW),
        quats=_unpack_quats2(rotations) if version == 2 else _unpack_quats(rotations),
    )


def _bytes(values: np.ndarray) -> bytes:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8).tobytes()


def _pack_quats(quats: np.ndarray) -> np.ndarray:
    """Rotations as uint32: which of x y z w is largest (2 bits), then the others in that order (sign, 9 bits)."""
    largest, others = smallest_three(unit_quats(quats)[:, [1, 2, 3, 0]])
    size = np.minimum(np.rint(1022 * np.abs(others)), 511).astype("<u4")
    return largest.astype("<u4") << 30 | (np.signbit(others).astype("<u4") << 9 | size) @ FIELDS


def _unpack_quats(stream: np.ndarray) -> np.ndarray:
    packed = stream.view("<u4")
    fields = packed[:, None] // FIELDS & 1023
    size = (fields & 511) / 1022
    return from_smallest_three(packed >> 30, np.where(fields & 512, -size, size))[:, [3, 0, 1, 2]]


def _unpack_quats2(stream: np.ndarray) -> np.ndarray:
    """Version 2: x y z as bytes, w not negative."""
    xyz = stream.reshape(-1, 3).astype(np.float32) / np.float32(127.5) - 1
    return np.concatenate([np.sqrt(np.maximum(0, 1 - (xyz * xyz).sum(axis=1, keepdims=True))), xyz], axis=1)


def _sizes(version: int, count: int, degree: int, file_bytes: int) -> list[int]:
    """Bytes of the six streams; refuses what no real file of ``file_bytes`` expands to, before any is allocated."""
    if degree >= len(DEGREE_COEFFICIENTS):
        raise Unexpected(f"SH degree {degree}")
    per_row = (9, 1, 3, 3, 3 if version == 2 else 4, 3 * (DEGREE_COEFFICIENTS[degree] - 1))
    check_expansion(count, sum(per_row), file_bytes)
    return [count * row for row in per_row]


def _read_gzip(source: BinaryIO, file_bytes: int) -> Packed:
    with gzip.GzipFile(fileobj=source) as stream:
        if len(start := stream.read(HEADER.size)) < HEADER.size or start[:4] != MAGIC:
            raise Unexpected("a gzip file of something else")
        _, version, count, degree, *_ = header = HEADER.unpack(start)
        if version not in (2, 3):
            raise Unexpected(f"version {version} in a gzip file")
        streams = [_exactly(stream, size) for size in _sizes(version, count, degree, file_bytes)]
        records = stream.read(EXTENSION_BYTES)  # extensions of version 3 come last
        if stream.read(1):
            raise ValueError("the gzip stream goes on after its last Gaussian")
    return header, streams, records


def _read_zstd(source: BinaryIO, file_bytes: int) -> Packed:
    header = HEADER4.unpack(_exactly(source, HEADER4.size))
    _, version, count, degree, _, _, streams, table = header
    if version != 4:
        raise Unexpected(f"version {version}; export it as version 3 or 4")
    sizes = _sizes(version, count, degree, file_bytes)
    present = [size for index, size in enumerate(sizes) if index < 5 or degree]
    if streams != len(present) or not HEADER4.size <= table <= file_bytes:
        raise ValueError(f"{streams} streams after byte {table}")
    records = _exactly(source, table - HEADER4.size)
    entries = struct.unpack(f"<{2 * streams}Q", _exactly(source, 16 * streams))
    found = []
    for size, packed_size, announced in zip(present, entries[::2], entries[1::2], strict=True):
        if announced != size or packed_size > file_bytes:
            raise ValueError(f"a stream of {packed_size} bytes for {announced}, expected {size}")
        decoder = zstandard.ZstdDecompressor(max_window_size=2**27)
        with decoder.stream_reader(_exactly(source, packed_size)) as reader:
            found.append(_exactly(reader, size))
    return header, found + [b""] * (len(sizes) - len(found)), records


def _exactly(source, size: int) -> bytes:
    if len(data := source.read(size)) < size:
        raise ValueError(f"found {len(data)} of {size} bytes")
    return data


def _find_axes(records: bytes) -> str:
    """The axes that an extension record names, or those of a file without one."""
    place = 0
    while place + RECORD.size <= len(records):
        kind, length = RECORD.unpack_from(records, place)
        if kind == COORDINATE_SYSTEM and length == 4:
            number = int.from_bytes(records[place + RECORD.size :][:4], "little")
            axes = ("RUB", *AXES)[number] if number <= len(AXES) else f"number {number}"
            if number > len(AXES) or axes in DISPUTED:
                raise Unexpected(f"axes {axes}; export it with the axes RUB")
            return axes
        place += RECORD.size + length
    return "RUB"

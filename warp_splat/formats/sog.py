"""Gaussians as .sog files, version 2: PlayCanvas's Spatially Ordered Gaussians, lossless WebP images in a zip file.

A pixel is a Gaussian, the same in all images but the palette. Positions are 16 bits on an axis of logarithms, in two
images; scales, colors and palette are indices into codebooks of 256 numbers; rotations three bytes and which number
they leave out; harmonics an index into a palette of up to 65536. ``meta.json`` holds the rest. The description is at
developer.playcanvas.com (the SOG format). It says that axes are right, up, back; all programs there are, its authors'
among them, keep those of the PLY file, and so do we.
"""

import io
import json
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

from warp_splat.formats import files
from warp_splat.formats.palettes import ENTRIES, codebook, palette
from warp_splat.formats.splats import COEFFICIENTS, SplatArrays, SplatFile
from warp_splat.formats.stored import from_smallest_three, logit, sigmoid, smallest_three
from warp_splat.text import Report

META = "meta.json"
META_BYTES = 2**20  # fifty times that of any scene
STEPS = 2**16 - 1  # of a position
TAG = 252  # of a rotation: plus the index of the number that is left out, of w x y z
PALETTE_ROW = 64  # entries beside each other
PALETTE_MOST = 2**16
PALETTE_SHARE = 8  # Gaussians for an entry of the palette; of 4 or 16, files are 1.24 or 0.88 times as large
SPARE_PIXELS = 2**16  # that an image may have beyond twice the Gaussians
PIXEL_BYTES = 20  # of a Gaussian's images, without harmonics
DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, RuntimeError)  # what a zip file raises then


def save_sog(path: str | Path, file: SplatFile, report: Report = print) -> None:
    """Write Gaussians as a .sog file; near ones should follow each other, since images of them compress better.

    Args:
        path: the file to write.
        file: the Gaussians, at least one.
        report: not called: every range follows the values.

    Raises:
        InputError: if the file cannot be written.
    """
    means, sh, opacities, scales, quats = file.splats
    count, coefficients, _ = sh.shape
    logs = np.sign(means) * np.log1p(np.abs(means.astype(np.float64)))
    low, high = logs.min(axis=0), logs.max(axis=0)
    steps = np.rint(STEPS * (logs - low) / np.where(high > low, high - low, 1)).astype(np.uint16)
    scale_entries, scale_labels = codebook(scales)
    color_entries, color_labels = codebook(sh[:, 0])
    alphas = np.rint(255 * sigmoid(opacities.astype(np.float64))).astype(np.uint8)
    # of each part, what the JSON says, and its images, or the pixels of one
    parts: dict[str, tuple[dict, dict[str, np.ndarray]]] = {
        "means": ({"mins": low.tolist(), "maxs": high.tolist()}, {"means_l": steps & 255, "means_u": steps >> 8}),
        "scales": ({"codebook": _listed(scale_entries)}, {"scales": scale_labels}),
        "quats": ({}, {"quats": _pack_quats(quats)}),
        "sh0": ({"codebook": _listed(color_entries)}, {"sh0": np.column_stack([color_labels, alphas])}),
    }
    if coefficients > 1:
        entries, labels = palette(sh[:, 1:].reshape(count, -1), min(PALETTE_MOST, max(1024, count // PALETTE_SHARE)))
        numbers, indices = codebook(entries)
        rows = -(-len(entries) // PALETTE_ROW)
        table = np.pad(indices, ((0, rows * PALETTE_ROW - len(entries)), (0, 0)))
        indices = np.column_stack([labels & 255, labels >> 8, np.zeros_like(labels)])
        facts = {"count": len(entries), "bands": COEFFICIENTS.index(coefficients), "codebook": _listed(numbers)}
        parts["shN"] = facts, {"shN_centroids": table.reshape(rows, -1, 3), "shN_labels": indices}
    meta = {"version": 2, "asset": {"generator": "warp-splat"}, "count": count}
    if file.antialiased:
        meta |= {"antialias": True, "model": "antialiased"}
    meta |= {part: {**facts, "files": [f"{name}.webp" for name in images]} for part, (facts, images) in parts.items()}
    with files.atomic_write(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        # entries without a time, so that equal Gaussians give equal bytes; WebP is compressed already
        archive.writestr(zipfile.ZipInfo(META), json.dumps(meta, allow_nan=False))
        for name, pixels in (image for _, images in parts.values() for image in images.items()):
            image = pixels if pixels.ndim == 3 else _laid_out(pixels)
            with archive.open(zipfile.ZipInfo(f"{name}.webp"), "w") as target:
                Image.fromarray(image).save(target, "WEBP", lossless=True, exact=True, quality=80, method=4)


def load_sog(path: str | Path, report: Report = print) -> SplatFile:
    """Read a .sog file of version 2.

    Args:
        path: the file.
        report: not called; other formats have things to say.

    Raises:
        InputError: if the file is missing, damaged, of another version, or expands beyond what real files do.
    """
    with files.reading(path, "a .sog file of version 2", *DAMAGE), zipfile.ZipFile(path) as archive:
        return _Bundle(archive, Path(path).stat().st_size).file()


class _Bundle:
    """An opened .sog file: every number is checked before it is used, every image's size before it is decoded."""

    def __init__(self, archive: zipfile.ZipFile, file_bytes: int):
        self.archive = archive
        self.file_bytes = file_bytes
        self.size: tuple[int, int] | None = None  # of the images that hold the Gaussians
        self.meta = files.json_object(self._bytes(META, META_BYTES))
        version = self.meta.get("version", 1)  # the first had none
        if version != 2:
            raise files.Unexpected(f"version {version!r:.40}; save it with splat-transform, which writes version 2")
        self.count = files.whole_number(self.meta.get("count"), "count", 2**32)
        harmonics = self.meta.get("shN") is not None
        self.degree = files.whole_number(self._part("shN").get("bands"), "bands", 3) if harmonics else 0
        self.coefficients = COEFFICIENTS[self.degree]
        files.check_expansion(self.count, PIXEL_BYTES + 3 * (self.coefficients - 1), file_bytes)

    def file(self) -> SplatFile:
        """The Gaussians."""
        means, colors = self._part("means"), self._pixels("sh0", 0)
        low, high = files.numbers_of(means, "mins", 3), files.numbers_of(means, "maxs", 3)
        steps = self._pixels("means", 0)[:, :3] + 256.0 * self._pixels("means", 1)[:, :3]
        sh = np.zeros((self.count, self.coefficients, 3), np.float32)
        sh[:, 0] = self._codebook("sh0")[colors[:, :3]]
        if self.degree:
            sh[:, 1:] = self._harmonics()
        logs = low + (high - low) * (steps / STEPS)
        splats = SplatArrays(
            means=(np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32),
            sh=sh,
            opacities=logit(colors[:, 3] / 255),
            scales=self._codebook("scales")[self._pixels("scales", 0)[:, :3]],
            quats=_unpack_quats(self._pixels("quats", 0)),
        )
        return SplatFile(splats, self.meta.get("antialias") is True or self.meta.get("model") == "antialiased")

    def _part(self, name: str) -> dict:
        if not isinstance((part := self.meta.get(name)), dict):
            raise files.Unexpected(f"no object {name!r} in its {META}")
        return part

    def _codebook(self, part: str) -> np.ndarray:
        return files.numbers_of(self._part(part), "codebook", ENTRIES).astype(np.float32)

    def _pixels(self, part: str, index: int) -> np.ndarray:
        """The Gaussians' pixels [N, 4] of an image."""
        return self._image(part, index).reshape(-1, 4)[: self.count]

    def _harmonics(self) -> np.ndarray:
        """[N, K - 1, 3] float32."""
        entries = files.whole_number(self._part("shN").get("count"), "count of the palette", PALETTE_MOST)
        size = (PALETTE_ROW * (self.coefficients - 1), -(-entries // PALETTE_ROW))
        table = self._image("shN", 0, size).reshape(-1, self.coefficients - 1, 4)[:entries, :, :3]
        labels = self._pixels("shN", 1)
        indices = labels[:, 0] + 256 * labels[:, 1].astype(np.int64)
        if self.count and indices.max() >= entries:
            raise ValueError(f"index {indices.max()} into a palette of {entries}")
        return self._codebook("shN")[table][indices]

    def _image(self, part: str, index: int, size: tuple[int, int] | None = None) -> np.ndarray:
        """An image [H, W, 4] uint8 of ``size`` (width, height), or of that which holds the Gaussians."""
        names = files.entries_of(self._part(part), "files")
        if index >= len(names) or not isinstance(names[index], str):
            raise files.Unexpected(f"no name of image {index} of {part!r}")
        data = self._bytes(names[index], self.file_bytes)
        width, height = _webp_size(data, names[index])
        wanted = size or self.size
        fits = (width, height) == wanted if wanted else self.count <= width * height <= 2 * self.count + SPARE_PIXELS
        if not fits:
            other = "{}x{}".format(*wanted) if wanted else f"those of {self.count} Gaussians"
            raise ValueError(f"an image {names[index]!r:.80} of {width}x{height} pixels, expected {other}")
        if not size:
            self.size = width, height
        try:
            with Image.open(io.BytesIO(data), formats=["WEBP"]) as image:
                return np.asarray(image.convert("RGBA"))
        except (OSError, SyntaxError, Image.DecompressionBombError) as error:  # Pillow's words for damage
            raise ValueError(f"image {names[index]!r:.80}: {error}") from error

    def _bytes(self, name: str, most: int) -> bytes:
        """A file of the archive, of at most ``most`` bytes."""
        if name not in self.archive.namelist():
            raise files.Unexpected(f"no file {name!r:.80} in it")
        if (info := self.archive.getinfo(name)).compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise files.Unexpected(f"{name!r:.80} in another compression than deflate")
        with self.archive.open(info) as source:
            data = source.read(most + 1)
        if len(data) > most:
            raise ValueError(f"{name!r:.80} expands to more than {most} bytes")
        return data


def _laid_out(rows: np.ndarray) -> np.ndarray:
    """Pixels [N, C] as an image [H, W, C] uint8 with sides of whole fours, zeros at its end."""
    count, channels = rows.shape
    width = 4 * int(np.ceil(np.sqrt(count) / 4))
    height = 4 * -(-count // (4 * width))
    image = np.pad(rows.astype(np.uint8), ((0, height * width - count), (0, 0)))
    return image.reshape(height, width, channels)


def _webp_size(data: bytes, name: str) -> tuple[int, int]:
    """Width and height by the header: Pillow allocates an image as it opens it."""
    if len(data) < 30 or data[:4] != b"RIFF" or data[8:12] != b"WEBP":
        raise files.Unexpected(f"an image {name!r:.80} that is no WebP")
    match data[12:16]:
        case b"VP8L":
            bits = int.from_bytes(data[21:25], "little")
            return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
        case b"VP8X" if _is_lossless(data):
            return 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    raise files.Unexpected(f"an image {name!r:.80} whose compression changes values")


def _is_lossless(data: bytes) -> bool:
    """Whether the first image among the chunks is, and none comes before that is animated."""
    at = 12
    while at + 8 <= len(data):
        kind, size = data[at : at + 4], int.from_bytes(data[at + 4 : at + 8], "little")
        if kind in (b"VP8L", b"VP8 ", b"ANMF"):
            return kind == b"VP8L"
        at += 8 + size + size % 2
    return False


def _listed(entries: np.ndarray) -> list[float]:
    """Nine digits say which float32 a number is."""
    return [float(f"{entry:.9g}") for entry in entries]


def _pack_quats(quats: np.ndarray) -> np.ndarray:
    """Rotations as bytes [N, 4]: the three smallest of w x y z, and which is left out."""
    largest, others = smallest_three(quats)
    return np.column_stack([np.clip(np.rint(255 * (others + 0.5)), 0, 255), TAG + largest]).astype(np.uint8)


def _unpack_quats(rows: np.ndarray) -> np.ndarray:
    """Rotations [N, 4] w x y z from bytes [N, 4]."""
    if (rows[:, 3] < TAG).any():
        raise ValueError(f"a rotation marked {rows[:, 3].min()}, below {TAG}")
    return from_smallest_three(rows[:, 3] - TAG, rows[:, :3] / 255 - 0.5)

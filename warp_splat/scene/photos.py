"""Photographs without cameras: which files of a folder they are, and what to tell who trains on them."""

import functools
import os
import shlex
from pathlib import Path

from warp_splat.errors import InputError
from warp_splat.text import Report, few

PHOTOS = (".jpg", ".jpeg", ".png", ".tif", ".tiff")  # what both pycolmap and the loader read, in sRGB
OTHER_PHOTOS = (".heic", ".heif", ".webp", ".avif", ".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf")
READABLE = (*PHOTOS, ".exr", ".hdr", ".webp")  # what the loader reads, in sRGB or in linear light
VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mts", ".3gp")


def photo_root(source: Path) -> Path:
    """The folder of the photographs: ``source``, or its images/ if it has one."""
    return source / "images" if (source / "images").is_dir() else source


def find_files(root: Path, endings: tuple[str, ...], without: Path | None = None) -> list[str]:
    """Names of the files below ``root``, relative to it and sorted, whose ending is one of ``endings``.

    Hidden files and folders are left out, and all that lies in trained models and in the folder ``without``.
    """
    places = (without, *(path.parent for path in root.rglob("*/cfg_args")))
    others = {Path(os.path.realpath(place)) for place in places if place}
    names = (
        path.relative_to(root)
        for path in root.rglob("*")
        if path.suffix.lower() in endings and path.is_file() and others.isdisjoint(path.resolve().parents)
    )
    return sorted(name.as_posix() for name in names if not any(part.startswith(".") for part in name.parts))


def is_video(path: Path) -> bool:
    """Whether this is a file with a video's ending."""
    return path.is_file() and path.suffix.lower() in VIDEOS


def scene_of(source: Path) -> Path:
    """Where ``train --sfm`` puts the scene of these photographs: beside them."""
    source = source if source.name not in ("", "..") else source.resolve()
    return source.with_name(f"{source.stem if source.is_file() else source.name}_scene")


def sfm_hint(source: Path) -> str:
    """The end of a sentence on ``source`` without cameras: the command that computes them."""
    command = shlex.join(["warp-splat", "sfm", str(source), str(scene_of(source))])
    return f"compute the cameras with `{command}` and train on the new folder; `warp-splat train --sfm` does both."


def jpeg_hint(source: Path) -> str:
    """What to do with photographs of other kinds below ``source``, as a part of a sentence; nothing without any."""
    others = find_files(photo_root(source), OTHER_PHOTOS)
    return f"convert its {len(others)} files such as {others[0]!r} to JPEG or PNG" if others else ""


class ImageFinder:
    """The files of images that a scene names: of exactly this name, or else of this stem.

    Attributes:
        renamed: names that were found with another ending, and the file names.
    """

    def __init__(self, root: Path):
        self.root = root
        self.renamed: dict[str, str] = {}
        self._files = functools.cache(self._listed)

    def find(self, name: str) -> Path | None:
        """The file, or None.

        Raises:
            InputError: if the name leads out of the folder, or several files have its stem.
        """
        if (path := Path(name)).is_absolute() or ".." in path.parts:
            raise InputError(f"{self.root}: expected names of files in this folder, found {name!r:.200}; rename it.")
        if self.has(path):
            return self.root / path
        files = self._files(path.parent)
        whole = (f"{path.name}{ending}" for ending in (".png", *PHOTOS))  # where no ending is given
        alike = [file for file in whole if file in files][:1] or sorted(
            file for file in files if Path(file).stem == path.stem and file.lower().endswith(READABLE)
        )
        if len(alike) > 1:
            raise InputError(f"{self.root / path}: no such file, but several of this stem ({few(alike)}); keep one.")
        if not alike:
            return None
        if path.suffix:
            self.renamed[name] = alike[0]
        return self.root / path.with_name(alike[0])

    def has(self, path: Path) -> bool:
        """Whether there is a file of exactly this name in the folder."""
        return path.name in self._files(path.parent)

    def mask_of(self, name: str) -> Path | None:
        """In a folder of masks, that of the photograph ``name``: name.jpg.png or name.png."""
        path = Path(name)
        candidates = path.with_name(f"{path.name}.png"), path.with_suffix(".png")
        return next((self.root / candidate for candidate in candidates if self.has(candidate)), None)

    def find_all(self, names: list[str], what: str, hint: str, report: Report) -> list[Path]:
        """The files of all; says how many were found under other endings.

        Raises:
            InputError: if one is missing, or as :meth:`find`; ``what`` they are, and a ``hint`` what to do.
        """
        files = {name: self.find(name) for name in names}
        if missing := [name for name, file in files.items() if file is None]:
            raise InputError(
                f"{self.root}: expected the {len(names)} {what}, but {len(missing)} of them cannot be found, the first "
                f"is {missing[0]!r:.200}; {hint}."
            )
        if self.renamed:
            name, file = next(iter(self.renamed.items()))
            report(f"Taking {len(self.renamed)} of {len(names)} images by their stems: {file} for {name}, ...")
        return [file for name in names if (file := files[name])]

    def _listed(self, folder: Path) -> frozenset[str]:
        try:
            return frozenset(entry.name for entry in os.scandir(self.root / folder) if entry.is_file())
        except (OSError, ValueError):  # there is no such folder, or no such name can be
            return frozenset()

"""Photographs without cameras: which files of a folder they are, and what to tell who trains on them."""

from __future__ import annotations

import shlex
from pathlib import Path

PHOTOS = (".jpg", ".jpeg", ".png", ".tif", ".tiff")  # what both pycolmap and the loader read, in sRGB
OTHER_PHOTOS = (".heic", ".heif", ".webp", ".avif", ".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf")
VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mts", ".3gp")


def photo_root(source: Path) -> Path:
    """The folder of the photographs: ``source``, or its images/ if it has one."""
    return source / "images" if (source / "images").is_dir() else source


def find_files(root: Path, endings: tuple[str, ...], without: Path | None = None) -> list[str]:
    """Names of the files below ``root``, relative to it and sorted, whose ending is one of ``endings``.

    Hidden files and folders are left out, and all that lies in the folder ``without``.
    """
    outside = (lambda path: without.resolve() not in path.resolve().parents) if without else Path.is_file
    names = (
        path.relative_to(root)
        for path in root.rglob("*")
        if path.suffix.lower() in endings and path.is_file() and outside(path)
    )
    return sorted(name.as_posix() for name in names if not any(part.startswith(".") for part in name.parts))


def is_video(path: Path) -> bool:
    """Whether this is a file with a video's ending."""
    return path.is_file() and path.suffix.lower() in VIDEOS


def scene_of(source: Path) -> Path:
    """Where ``train --sfm`` puts the scene of these photographs: beside them."""
    return source.with_name(f"{source.stem if source.is_file() else source.name}_scene")


def sfm_hint(source: Path) -> str:
    """The end of a sentence on ``source`` without cameras: the command that computes them."""
    command = shlex.join(["warp-splat", "sfm", str(source), str(scene_of(source))])
    return f"compute the cameras with `{command}` and train on the new folder, or add --sfm, which does both."

"""The scene that comes with the package."""

from pathlib import Path

from warp_splat.errors import InputError


def embedded_scene() -> Path:
    """Its folder. Raises InputError if it is missing."""
    here = Path(__file__).parents[1]
    for folder in (here / "assets" / "still_life", here.parent / "assets" / "still_life"):
        if folder.is_dir():
            return folder
    raise InputError("The embedded scene is missing from this installation; name a scene with -s.")

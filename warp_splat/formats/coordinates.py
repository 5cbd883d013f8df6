"""Where a scene is in the world: ``coordinates.json`` beside its model, and how files of Gaussians repeat it.

Models stay near the origin of their frame, since float32 would round UTM coordinates to half a meter. Their axes are x
east, y down, z north, as of a camera that looks north: so every format and viewer shows them upright.
"""

import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from warp_splat.formats.files import Unexpected, read_optional_json, write_json

FILE = "coordinates.json"
KEPT = ("origin", "axes", "reference")  # of it, in files of Gaussians
COMMENT = "warp_splat coordinates "  # then JSON
AXES = "x east, y down, z north"
MODEL_FROM_WORLD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # of east, north, up from the origin
UP = np.array([0.0, -1.0, 0.0])


def read_coordinates(folder: str | Path) -> dict | None:
    """What ``coordinates.json`` in a folder says: None without one; its "origin" in the world [m] as float64.

    Raises:
        InputError: if it has no origin of three finite numbers.
    """
    return read_optional_json(Path(folder) / FILE, "coordinates as `warp-splat sfm` writes them", checked)


def write_coordinates(folder: str | Path, coordinates: dict | None) -> None:
    """Write ``coordinates.json`` to a folder; None removes it."""
    if coordinates:
        write_json(Path(folder) / FILE, coordinates)
    else:
        (Path(folder) / FILE).unlink(missing_ok=True)


def kept(found: object, axes: str = AXES) -> dict | None:
    """What a file of Gaussians with these ``axes`` repeats of them; None if they are none, or damaged."""
    with suppress(Unexpected, ValueError, TypeError, OverflowError):
        return {**{name: checked(found).get(name) for name in KEPT}, "axes": axes}
    return None


def comments_of(coordinates: dict | None) -> list[str]:
    """The comment of a PLY file that repeats them; none without any."""
    found = kept(coordinates)
    return [COMMENT + json.dumps(found)] if found else []


def of_comments(comments: Sequence[str]) -> dict | None:
    """What the comments of a PLY file repeat of them."""
    text = next((comment for comment in comments if comment.startswith(COMMENT)), COMMENT)
    with suppress(ValueError, RecursionError):
        return kept(json.loads(text.removeprefix(COMMENT)))
    return None


def checked(found: object) -> dict:
    """The same, if it has an origin of three finite numbers, and what it says of photographs is of that kind.

    Raises:
        Unexpected: otherwise; or ValueError, TypeError.
    """
    if not isinstance(found, dict) or not isinstance(origin := found.get("origin"), list) or len(origin) != 3:
        raise Unexpected("no origin of three numbers")
    residuals, *_ = told = found.get("residuals", {}), found.get("left_out", []), found.get("reference")
    if not all(map(isinstance, told, (dict, list, str | None))):
        raise Unexpected("residuals or what was left out that are not by name, or a reference that is no text")
    if not all(type(n) in (int, float) and np.isfinite(float(n)) for n in (*origin, *residuals.values())):
        raise Unexpected("what is no finite number")
    return found

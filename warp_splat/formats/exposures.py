"""How the photographs of a model were exposed: a file beside its Gaussians, for pictures that look as they do."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np

from warp_splat.color import COLOR_MAPS
from warp_splat.formats.atomic import write_text
from warp_splat.formats.model_folder import is_file_of_gaussians, ply_path
from warp_splat.formats.reading import Unexpected, reading

EXPOSURES = "exposures.json"


class Exposures(NamedTuple):
    """What :func:`warp_splat.raster.expose.expose` takes."""

    kind: str
    pivot: float
    falloff: np.ndarray  # [2]
    maps: dict[str, np.ndarray]  # by the names of photographs


def write_exposures(ply: Path, exposures: Exposures | None) -> None:
    """Write them beside a model's Gaussians. None: what an earlier training wrote there is removed.

    Raises:
        InputError: if the file cannot be written.
    """
    path = ply.parent / EXPOSURES
    if exposures is None:
        path.unlink(missing_ok=True)
        return
    maps = {name: numbers.ravel().tolist() for name, numbers in exposures.maps.items()}
    facts = {"kind": exposures.kind, "pivot": exposures.pivot, "falloff": exposures.falloff.tolist(), "maps": maps}
    write_text(path, json.dumps(facts, allow_nan=False))


def read_exposures(path: str | Path, iteration: int) -> Exposures | None:
    """Those beside the Gaussians of a model folder, or beside a file; None if there are none.

    Raises:
        InputError: if the file is damaged.
    """
    file = (Path(path) if is_file_of_gaussians(path) else ply_path(path, iteration)).parent / EXPOSURES
    if not file.exists():
        return None
    with reading(file, "exposures as training writes them"):
        try:
            facts = json.loads(file.read_text(encoding="utf-8"))
            shape, falloff = COLOR_MAPS[facts["kind"]], np.array(facts["falloff"], np.float32).reshape(2)
            maps = {name: np.array(n, np.float32).reshape(shape) for name, n in facts["maps"].items()}
            pivot = float(facts["pivot"])
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise Unexpected(f"other JSON ({error!s:.100})") from error
        if not all(np.isfinite(numbers).all() for numbers in (pivot, falloff, *maps.values())):
            raise Unexpected("numbers that are not finite")
    return Exposures(facts["kind"], pivot, falloff, maps)

"""How the photographs of a model were exposed: a file beside its Gaussians, for pictures that look as they do."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from warp_splat.color import COLOR_MAPS
from warp_splat.formats.files import Unexpected
from warp_splat.formats.model_folder import read_beside, write_beside

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
    facts = None
    if exposures is not None:
        maps = {name: numbers.ravel().tolist() for name, numbers in exposures.maps.items()}
        facts = exposures._asdict() | {"falloff": exposures.falloff.tolist(), "maps": maps}
    write_beside(ply, EXPOSURES, facts)


def read_exposures(path: str | Path, iteration: int) -> Exposures | None:
    """Those beside the Gaussians of a model folder, or beside a file; None if there are none.

    Raises:
        InputError: if the file is damaged.
    """

    def parse(facts: dict) -> Exposures:
        shape, falloff = COLOR_MAPS[facts["kind"]], np.array(facts["falloff"], np.float32).reshape(2)
        maps = {name: np.array(n, np.float32).reshape(shape) for name, n in facts["maps"].items()}
        pivot = float(facts["pivot"])
        if not all(np.isfinite(numbers).all() for numbers in (pivot, falloff, *maps.values())):
            raise Unexpected("numbers that are not finite")
        return Exposures(facts["kind"], pivot, falloff, maps)

    return read_beside(path, iteration, EXPOSURES, "exposures as training writes them", parse)

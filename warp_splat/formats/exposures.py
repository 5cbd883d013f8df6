"""``exposure.json`` of a model's folder: a map of colors for each photograph, as the reference writes and reads it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from warp_splat.formats.reading import Unexpected, reading

NAME = "exposure.json"


def read_exposures(folder: str | Path) -> dict[str, np.ndarray]:
    """By name, the maps [3, 4] float32: color @ map[:, :3] + map[:, 3]; none if there is no such file.

    Raises:
        InputError: if the file is damaged.
    """
    path = Path(folder) / NAME
    if not path.is_file():
        return {}
    with reading(path, "maps of colors [3, 4] by photograph as training writes them"):
        entries = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(entries, dict):
            raise Unexpected("other JSON")
        try:
            maps = {name: np.array(entry, np.float32) for name, entry in entries.items()}
        except (TypeError, ValueError) as error:
            raise Unexpected(f"other values ({error!s:.100})") from error
        for name, found in maps.items():
            if found.shape != (3, 4) or not np.isfinite(found).all():
                raise Unexpected(f"for {name} numbers of shape {list(found.shape)}, or such that are not finite")
    return maps

"""Maps of inverse depth in the reference's layout (Kerbl et al. 2024): a folder of files, and how to scale them.

A monocular network knows inverse depth up to a factor and an offset, which were fitted to the points of the scene.
"""

from pathlib import Path

import numpy as np

from warp_splat.errors import InputError
from warp_splat.formats.files import Unexpected, json_object, reading
from warp_splat.scene import takes_colmap
from warp_splat.scene.images import read_numbers, require_shape
from warp_splat.scene.types import Scene, View

ENDINGS = (".png", ".exr")
PARAMETERS = "sparse/0/depth_params.json"
FIT = ("scale", "offset")  # what makes 1 / depth [1 / world units] of a map
NEAR_MEDIAN = 0.2, 5.0  # times the median scale: a map outside did not fit its points


def read_inverse_depths(scene: Scene, folder: str) -> dict[View, np.ndarray]:
    """1 / depth of the training views, each [H, W] float32 as its photograph, negative where it is not known.

    Of PNG, a number counts 1 / 65536; both kinds are taken times ``scale`` plus ``offset`` of PARAMETERS (without a
    COLMAP model: in the scene's folder), which EXR can do without. Maps whose scale lies far from the median are left
    out.

    Args:
        scene: as it was loaded.
        folder: in the scene's, or anywhere.

    Raises:
        InputError: if a map or its parameters are missing, not readable, or do not fit the photograph; if all say
            nothing.
    """
    source = scene.source or Path()
    parameters = source / (PARAMETERS if takes_colmap(source) else Path(PARAMETERS).name)
    paths = {view: _find(source / folder, view) for view in scene.train}
    fits = _read_fits(parameters, [Path(v.name).with_suffix("").as_posix() for v in scene.train], paths)
    median = float(np.median([scale for scale, _ in fits if scale > 0] or [1.0]))
    low, high = (share * median for share in NEAR_MEDIAN)
    chosen = zip(paths.items(), fits, strict=True)
    found = {v: _read(p, v, scale, offset) for (v, p), (scale, offset) in chosen if low <= scale <= high}
    if not any((numbers >= 0).any() for numbers in found.values()):
        raise InputError(f"--depths {folder}: expected maps of 1 / depth, found scales or numbers below 0; fit them.")
    return found


def _find(folder: Path, view: View) -> Path:
    """The map of a photograph."""
    if view.undistorted:
        raise InputError(
            f"--depths {folder}: expected photographs as the files have them, found {view.name}, which is undistorted "
            "as it is read; use --lens native, or undistort photographs and maps first."
        )
    paths = [folder / Path(view.name).with_suffix(ending) for ending in ENDINGS]
    if not (found := [path for path in paths if path.is_file()]):
        raise InputError(f"{paths[0]}: expected a map of inverse depth for {view.name}, found none; add it.")
    return found[0]


def _read_fits(path: Path, names: list[str], maps: dict[View, Path]) -> list[list[float]]:
    """Scale and offset of each name; those of EXR are optional."""
    if not path.is_file() and all(map.suffix == ".exr" for map in maps.values()):
        return [[1.0, 0.0]] * len(names)
    if not path.is_file():
        raise InputError(
            f"{path}: expected scale and offset of each map of inverse depth, found no such file; write it, by fitting "
            "the maps to the points, or use EXR files of 1 / depth."
        )
    with reading(path, 'JSON of the kind {"NAME": {"scale": NUMBER, "offset": NUMBER}}'):
        entries = json_object(path.read_bytes())
        return [_fit(entries, name) for name in names]


def _fit(entries: dict, name: str) -> list[float]:
    if not isinstance((entry := entries.get(name)), dict):
        raise Unexpected(f"none for {name}")
    values = [entry.get(key) for key in FIT]
    if not all(isinstance(value, int | float) and np.isfinite(float(value)) for value in values):
        raise Unexpected(f"{entry!s:.80} for {name}")
    return [float(value) for value in values]


def _read(path: Path, view: View, scale: float, offset: float) -> np.ndarray:
    """The numbers nearest to each pixel, which no filter mixes over edges."""
    numbers, (height, width) = read_numbers(path), (view.camera.height, view.camera.width)
    file = view.original.width, view.original.height
    require_shape(path, "map", numbers.shape[::-1], file, "make it from the photograph")
    rows, columns = nearest_of(height, numbers.shape[0]), nearest_of(width, numbers.shape[1])
    picked = numbers[rows[:, None], columns]
    found = np.where(picked < 0.0, np.nan, picked) * scale + offset
    known = (found >= 0.0) & (found < 1e30) & (True if (mask := view.mask) is None else mask > 0)
    return np.where(known, found, -1.0).astype(np.float32)


def nearest_of(count: int, size: int) -> np.ndarray:
    """Of ``size`` pixels along a side, those nearest to each of ``count`` pixels, [count]."""
    return (np.arange(count) * 2 + 1) * size // (2 * count)

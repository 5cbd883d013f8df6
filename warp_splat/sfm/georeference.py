"""A model in the world: scale, up and origin from positions of the cameras, of GPS or of a file, or from distances."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from warp_splat.errors import InputError
from warp_splat.formats.coordinates import AXES, MODEL_FROM_WORLD
from warp_splat.formats.files import Unexpected, reading
from warp_splat.scene.colmap_library import pycolmap
from warp_splat.text import Report, few

POSITIONS, DISTANCES = ["name", "x", "y", "z"], ["name", "other", "distance"]  # first lines of files
LEAST = 3  # positions
UP = np.array((0.0, 0.0, 1.0))  # in the world
LOOSE = 0.05  # of the extent: what RANSAC takes for right
NEAR = 4.0  # times the median distance from the middle: the extent, where some lie much farther out than most
OUTLIER = 3.0  # standard deviations, as the median of the residuals tells them
COARSE = 0.1  # of the extent: GPS that errs by more is not taken
USUAL = 5.0  # units: half of what photographs show is farther away, where nothing tells the scale
TURNED = 0.7  # cosine: of where photographs have their top, or look, against up
DOUBT = " (photographs stand upside down there, or look up: are x and y exchanged?)"  # flat positions fit turned over
NO_TURN = " (along a line: check the turn about it)"  # which the cameras' tops tell alone, or nothing does
LINE = 0.1  # share of the extent that positions leave a straight line by, below which they do not tell up,
UNSURE = 0.1  # radians, if they err so much that a turn about the line is off by more
NUDGE = 1e-7  # of their size: without it, pycolmap finds nothing for points on a line, or on a plane through 0


def georeference(model: pycolmap.Reconstruction, database: Path, source: str, seed: int, say: Report) -> dict | None:
    """Turn, scale and move ``model`` into the frame of ``formats/coordinates.py``.

    Args:
        model: it is changed.
        database: whose photographs may have GPS.
        source: "auto", GPS if the photographs have it, and it is precise enough; "none"; or a CSV file whose first line
            is name,x,y,z (positions of cameras, x east, y north, z up) or name,other,distance (between cameras).
        seed: of the robust estimation.
        say: called with a line of what was found.

    Returns:
        What ``coordinates.json`` is to say, or None if the model stays as it is.

    Raises:
        InputError: if the file cannot be read, or does not fit the cameras.
    """
    images = {image.name: image for image in map(model.image, model.reg_image_ids())}
    centers = {name: image.projection_center() for name, image in images.items()}
    axes = np.mean([image.cam_from_world().rotation.matrix() for image in images.values()], axis=0)
    up = -axes[1]
    if source == "none":
        return None
    if source != "auto":
        kind, rows = read_places(Path(source))
        named = {name for names, _ in rows for name in names}
        if set() < centers.keys() & named < named:
            say(f"{source}: no registered photograph has the name {few(sorted(named - set(centers))):.200}")
        if kind == DISTANCES:
            return _by_distances(model, centers, up, rows, source, say)
        known, reference = {name: np.array(numbers) for (name, *_), numbers in rows}, Path(source).name
    else:
        known, reference = _gps(database)
    if len(names := sorted(set(known) & set(centers))) < LEAST:
        if source == "auto":
            return None
        raise InputError(
            f"{source}: expected positions of at least {LEAST} photographs that were registered, found {len(names)}; "
            f"the first column has their names, such as {min(centers)}."
        )
    world = np.array([known[name] for name in names])
    origin = np.round(np.median(world, axis=0))
    fitted, residuals, right, line = fit(np.array([centers[name] for name in names]), world - origin, up, seed)
    error = float(np.median(residuals[right])) if right.any() else np.inf
    if not _most_fit(residuals, right, world):
        span = _extent(world[right])
        text = f"{right.sum()} of {len(names)} fit within {error:.2g} m, where they span {span:.3g} m"
        if source != "auto":
            raise InputError(f"{source}: expected positions that fit the cameras, but {text}; check names and axes.")
        say(f"no coordinates, since positions do not fit the cameras: {text}")
        return None
    _move(model, fitted)
    left_out = [name for name, good in zip(names, right, strict=True) if not good]
    rest = f"; left out: {few(left_out)}" if left_out else ""
    rest += "; three always fit: give more" * int(right.sum() == LEAST)
    tops, ahead = np.stack([-axes[1], axes[2]]) @ fitted.rotation.matrix()[2]
    reference += NO_TURN * line
    reference += DOUBT if tops < -TURNED or (tops < TURNED and ahead > TURNED) else ""
    say(f"coordinates: {reference}, {right.sum()} positions fit within {error:.2g} m (median){rest}")
    return _described(origin, reference, fitted.scale, dict(zip(names, residuals.tolist(), strict=True)), left_out)


def scale_as_usual(model: pycolmap.Reconstruction) -> None:
    """Scale ``model`` so that half of what its photographs show is farther away than USUAL.

    Mappers scale it so that all cameras lie within a few units, whether they stood in a room or in a city. But what is
    nearer than ``RasterOptions.near`` is never drawn.
    """
    numbers, depths = sorted(model.reg_image_ids()), []
    for image in map(model.image, numbers[:: -(-len(numbers) // 100)]):  # a hundred tell it
        seen = [model.point3D(point.point3D_id).xyz for point in image.get_observation_points2D()]
        depths.append((image.cam_from_world() * np.array(seen).reshape(-1, 3))[:, 2])
    model.transform(pycolmap.Sim3d(USUAL / np.median(np.concatenate(depths)), pycolmap.Rotation3d(), np.zeros(3)))


def fit(
    centers: np.ndarray, world: np.ndarray, up: np.ndarray, seed: int
) -> tuple[pycolmap.Sim3d, np.ndarray, np.ndarray, bool]:
    """The similarity that takes camera centers [N, 3] to positions [N, 3], robustly.

    Positions along a line leave a turn about it open, as far as they err: ``up`` [3] of the cameras, which goes to z,
    then closes it, unless it goes along the line.

    Returns:
        The similarity; residuals [N] in the unit of ``world``; which positions were taken for right [N]; whether these
        lie along a line.
    """
    nudges = NUDGE * np.random.default_rng(seed).normal(size=(2, *world.shape))
    off = [np.linalg.norm(each - np.median(each, axis=0), axis=1) for each in (centers, world)]
    sizes = [np.median(each) or each.mean() for each in off]
    nudged, to = centers + sizes[0] * nudges[0], world + sizes[1] * nudges[1]
    far = np.minimum(*(each / (size or 1.0) for each, size in zip(off, sizes, strict=True)))
    far = far >= np.quantile(far, 2 / 3)  # in both: what strays in one of them does not count
    unit = np.median(off[1][far] / np.maximum(off[0][far], 1e-9 * (off[0].max() or 1.0)))
    wide = LOOSE * np.minimum(unit * off[0], off[1]).max() or 1.0
    for bound in (wide, min(wide, NEAR * LOOSE * sizes[1] or wide)):  # less, where most of them lie within the first
        options = pycolmap.RANSACOptions(max_error=bound, random_seed=seed)
        found = pycolmap.estimate_sim3d_robust(nudged, to, options)
        right = np.asarray(found["inlier_mask"]) if isinstance(found, dict) else np.ones(len(world), bool)
        fitted, residuals = pycolmap.Sim3d(), np.zeros(len(world))
        for _ in range(3):  # again, with the spread of those that fit
            fitted = pycolmap.estimate_sim3d(nudged[right], to[right]) or fitted
            residuals = np.linalg.norm(fitted * centers - world, axis=1)
            right = residuals <= OUTLIER * 1.4826 * np.median(residuals[right]) + 10 * NUDGE * _extent(world[right])
        if _most_fit(residuals, right, world):
            break
    middle = centers[right].mean(0)
    _, spans, (along, *_) = np.linalg.svd(centers[right] - middle)
    unsure = (np.median(residuals[right]) + 10 * NUDGE * _extent(world[right])) * np.sqrt(right.sum()) / fitted.scale
    line = bool(spans[1] < min(LINE * spans[0], unsure / UNSURE))
    if line and np.linalg.norm(np.cross(along, up)) > 0.5 * np.linalg.norm(up):  # else up tells no turn about it
        ends = [fitted.rotation * along, UP], [along, up]
        turned = pycolmap.Rotation3d(Rotation.align_vectors(*ends, weights=[np.inf, 1.0])[0].as_matrix())
        fitted = pycolmap.Sim3d(fitted.scale, turned, fitted * middle - fitted.scale * (turned * middle))
        residuals = np.linalg.norm(fitted * centers - world, axis=1)
    return fitted, residuals, right, line


def _most_fit(residuals: np.ndarray, right: np.ndarray, world: np.ndarray) -> bool:
    """Whether half of the positions were taken for right, and err little for where they lie."""
    most = right.sum() >= max(LEAST, len(world) / 2)
    return bool(most and np.median(residuals[right]) <= COARSE * _extent(world[right]))


def _extent(points: np.ndarray) -> float:
    return float(np.linalg.norm(points - points.mean(0), axis=1).max()) if len(points) else 0.0


def _by_distances(model, centers: dict, up: np.ndarray, rows: list, source: str, say: Report) -> dict:
    """The scale alone from distances [m] between cameras; up from the cameras, the origin in their middle."""
    known = [(*names, numbers[0]) for names, numbers in rows if set(names) <= set(centers)]
    measured = np.array([np.linalg.norm(centers[a] - centers[b]) for a, b, _ in known])
    true, places = np.array([distance for *_, distance in known]), np.array([*centers.values()])
    if not known or not ((true > 0) & (measured > 1e-6 * _extent(places))).all():
        raise InputError(f"{source}: expected distances above 0 of registered photographs such as {min(centers)}.")
    scale = float(np.median(true / measured))
    off = np.abs(scale * measured - true)
    if (miss := float(np.median(off / true))) > COARSE:
        raise InputError(f"{source}: expected distances that fit the cameras, found {miss:.0%} off (median); check it.")
    say(f"coordinates: {Path(source).name}, {len(off)} distances fit within {np.median(off):.2g} m (median)")
    level = Rotation.align_vectors([UP], [up if np.linalg.norm(up) > 1e-6 else UP])[0].as_matrix()  # or tops cancel
    _move(model, pycolmap.Sim3d(scale, pycolmap.Rotation3d(level), -scale * level @ places.mean(0)))
    residuals = {f"{a} to {b}": float(r) for (a, b, _), r in zip(known, off, strict=True)}
    return _described(np.zeros(3), Path(source).name, scale, residuals, [])


def _move(model: pycolmap.Reconstruction, world_from_old: pycolmap.Sim3d) -> None:
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(MODEL_FROM_WORLD), np.zeros(3)) * world_from_old)


def _described(origin: np.ndarray, reference: str, scale: float, residuals: dict, left_out: list[str]) -> dict:
    found = {"origin": origin.tolist(), "axes": AXES, "reference": reference, "scale": float(scale)}
    return {**found, "residuals": residuals, "left_out": left_out}


def _gps(database: Path) -> tuple[dict[str, np.ndarray], str]:
    """Positions in UTM [m], by the names of the photographs whose EXIF has latitude, longitude and altitude."""
    with pycolmap.Database.open(str(database)) as connection:
        names = {image.image_id: image.name for image in connection.read_all_images()}
        priors = connection.read_all_pose_priors()
    found = {names[prior.corr_data_id.id]: prior.position for prior in priors if np.isfinite(prior.position).all()}
    if not found:
        return {}, ""
    places, zone = pycolmap.GPSTransform().ellipsoid_to_utm(list(found.values()))
    latitudes = np.array([place[0] for place in found.values()])
    south, places = latitudes.mean() < 0, np.array(places)
    places[:, 1] += 1e7 * (float(south) - (latitudes < 0))  # south of the equator, 10,000 km come on top
    return dict(zip(found, places, strict=True)), f"UTM zone {zone} {'south' if south else 'north'}, WGS 84, from GPS"


def require_named(path: Path, photographs: list[str]) -> None:
    """Raise InputError if a CSV file names too few of the photographs, hours before it is needed."""
    first, rows = read_places(path)
    found, least = sum({*names} <= {*photographs} for names, _ in rows), LEAST if first == POSITIONS else 1
    if found < least:
        raise InputError(
            f"{path}: expected lines of photographs such as {photographs[0]}, {least} at least, found {found}."
        )


def read_places(path: Path) -> tuple[list[str], list[tuple[list[str], list[float]]]]:
    """The first line of a CSV file, and of the others the names and the numbers."""
    with reading(path, f"a CSV file that begins with {','.join(POSITIONS)} or {','.join(DISTANCES)}", csv.Error):
        with path.open(newline="", encoding="utf-8-sig") as file:
            first, *rows = [[cell.strip() for cell in row] for row in csv.reader(file) if "".join(row).strip()] or [[]]
        if first not in (POSITIONS, DISTANCES):
            raise Unexpected(f"{','.join(first) or 'nothing':.80}")
        text = 1 if first == POSITIONS else 2
        try:
            found = [(row[:text], [float(cell) for cell in row[text:]]) for row in rows]
        except ValueError as error:
            raise Unexpected(f"a line without numbers ({error})") from error
        for row, (_, numbers) in zip(rows, found, strict=True):
            if len(row) != len(first) or not (np.abs(numbers) < 1e12).all():
                raise Unexpected(f"the line {','.join(row):.80}")
        named, counts = np.unique([names[0] for names, _ in found], return_counts=True)
        if first == POSITIONS and (counts > 1).any():
            raise Unexpected(f"more than one line for {few(named[counts > 1]):.200}")
        return first, found

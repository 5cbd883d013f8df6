"""Scenes whose cameras are in JSON: nerf-synthetic (Mildenhall et al. 2020), nerfstudio and instant-ngp.

Poses are camera-to-world in OpenGL axes (x right, y up, z backward), in the frame of the points. ``applied_transform``
tells how nerfstudio came there from COLMAP's frame. It is ignored, so coordinates stay those of the file.
"""

import json
import reprlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from warp_splat.errors import InputError, refusing
from warp_splat.formats.files import reading
from warp_splat.formats.ply import GRAY, load_points
from warp_splat.scene import ALL, TRAIN, images
from warp_splat.scene.images import Photo
from warp_splat.scene.lenses import Calibration, Sampling, make_photo, make_sampling, tell_lenses
from warp_splat.scene.photos import ImageFinder
from warp_splat.text import Report, few

TEST = "transforms_test.json"  # beside TRAIN
POINTS, HALF_WIDTH = 100_000, 1.3  # graphdeco, scene/dataset_readers.py: "inside the bounds of the synthetic scenes"
TOLERANCE = 1e-3  # of a pose's axes, for files that round their numbers
JSON_BYTES = 2**24  # of 20,000 frames; no JSON of this size takes more than a gigabyte once parsed
LARGEST = 1e9  # of a number that describes a lens
PERSPECTIVE = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "PERSPECTIVE")
FISHEYE, PANORAMA = "OPENCV_FISHEYE", "EQUIRECTANGULAR"
UNKNOWN = ("latlong", "ftheta_p0")  # lenses of instant-ngp
FOCAL = ("fl_x", "camera_angle_x", "fl_y", "camera_angle_y")
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")  # in the order of nerfstudio's distortion_params


def read_transforms(
    source: Path, report: Report, native: bool = False
) -> tuple[list[Photo], list[Photo], np.ndarray, np.ndarray]:
    """Read the cameras in ``source``, and its points or, for nerf-synthetic, random ones.

    ``native``: lenses stay as they are, instead of becoming pinholes.

    Returns:
        Photos of the training set. Those of the test set: none without transforms_test.json or nerfstudio's lists of
        names. Points [P, 3] float32: for nerf-synthetic 100,000, uniform in [-1.3, 1.3]^3, always the same; for others
        there may be none. Colors [P, 3] uint8.

    Raises:
        InputError: if a file is missing, cannot be parsed, lacks a key, holds a matrix that is not a pose or a lens
            that cannot be undistorted.
    """
    if not (source / TRAIN).is_file():
        content = _parse(source / ALL)
        train, test = _split(source / ALL, content, _read_photos(source / ALL, content, report, native), report)
        return train, test, *_points(source, content.get("ply_file_path"), report)
    train, test = (
        [*_read_photos(path, _parse(path), report, native).values()] if path.is_file() else []
        for path in (source / TRAIN, source / TEST)
    )
    points = np.random.default_rng(0).uniform(-HALF_WIDTH, HALF_WIDTH, (POINTS, 3)).astype(np.float32)
    return train, test, points, np.full((POINTS, 3), GRAY, np.uint8)


def _parse(path: Path) -> dict[str, Any]:
    with reading(path, "a JSON object"):
        if (size := path.stat().st_size) > JSON_BYTES:
            raise InputError(f"{path}: expected at most {JSON_BYTES} bytes of JSON, found {size}; leave out frames.")
        kinds = (ValueError, RecursionError)  # of the syntax, of the encoding, or of the depth
        with refusing(kinds, f"{path}: expected JSON, but it cannot be parsed", "; correct it."):
            content = json.loads(path.read_text(encoding="utf-8-sig"))
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected a JSON object with the key frames, found another value; correct the file.")
    return content


def _read_photos(path: Path, content: dict[str, Any], report: Report, native: bool) -> dict[str, Photo]:
    """The photo of each frame, by the frame's name; a photograph that has several frames has that of the first."""
    if not isinstance((frames := _value(content, "frames", path)), list) or not frames:
        raise _wrong(path, "a list of at least one frame under the key frames", frames)
    places = [f"{path}, frame {index}" for index in range(len(frames))]
    finder = ImageFinder(path.parent)
    names = [_path(frame, "file_path", where) for frame, where in zip(frames, places, strict=True)]
    paths = finder.find_all(names, f"frames of {path.name}", "copy them there", report)
    sampling, photos, seen, again = make_sampling(native), {}, set(), []
    for name, frame, found, where in zip(names, frames, paths, places, strict=True):
        if found in seen:  # it might be trained on and held out at once
            again.append(name)
            continue
        photos[name] = _photo(_over(content, frame), found, finder, sampling, where)
        seen.add(found)
    if again:
        report(f"Leaving out {len(again)} of {len(names)} frames, whose photographs had one before: {few(again)}.")
    tell_lenses([*photos.values()], report)
    return photos


def _over(content: dict[str, Any], frame: dict[str, Any]) -> dict[str, Any]:
    """The file's values, and a frame's over them; its own focal length or angle replaces those, of y that of y.

    A list of coefficients of distortion becomes numbers of their own, so that a frame's replace the file's, too.
    """
    own, shared = ({key: value for key, value in one.items() if value is not None} for one in (frame, content))
    for values in (own, shared):
        if isinstance(listed := values.get("distortion_params"), list) and len(listed) == len(DISTORTION):
            values |= dict(zip(DISTORTION, values.pop("distortion_params"), strict=True))
    first = next((place for place, key in enumerate(FOCAL[:3]) if key in own), len(FOCAL))
    return {key: value for key, value in shared.items() if key not in FOCAL[first // 2 * 2 :]} | own


def _split(
    path: Path, content: dict[str, Any], photos: dict[str, Photo], report: Report
) -> tuple[list[Photo], list[Photo]]:
    """Photos to train on and to hold out, by nerfstudio's lists of names; all are to train on where it has none.

    Held out are those of test_filenames or, without it, of val_filenames; to train on those of train_filenames or,
    without it, the rest.
    """
    names = photos.keys()
    train, val, test = (_names(content, f"{key}_filenames", path) for key in ("train", "val", "test"))
    held_out = test or val
    to_train = train or {*names} - held_out
    if (odd := ((to_train | held_out) - {*names}) | (to_train & held_out)) or not to_train:
        problem = f"{min(odd)!r:.200} has no frame or is in two" if odd else "none is left to train on"
        raise InputError(f"{path}: expected lists of names that part the frames, but {problem}; correct the file.")
    if unused := len({*names} - to_train - held_out):
        report(f"Leaving out {unused} of {len(names)} images that {path.name} neither trains nor tests on.")
    pick = lambda chosen: [photo for name, photo in photos.items() if name in chosen]  # noqa: E731
    return pick(to_train), pick(held_out)


def _names(content: dict[str, Any], key: str, path: Path) -> set[str]:
    names = [] if content.get(key) is None else content[key]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise _wrong(path, f"{key} as a list of names", names)
    return {Path(name).as_posix() for name in names}


def _photo(values: dict[str, Any], path: Path, finder: ImageFinder, sampling: Sampling | None, where: str) -> Photo:
    """The photo of a frame; ``values`` are its own and, where it has none, those of the file."""
    size = images.read_size(path)
    pose = _pose(_value(values, "transform_matrix", where), where)
    name = path.relative_to(finder.root).as_posix()
    lens = _lens(values, size, where)
    with images.named(where):
        photo = make_photo(name, path, lens, pose, size, sampling)
    if values.get("mask_path") is None:
        return photo
    if (mask := finder.find(_path(values, "mask_path", where))) is None:
        raise InputError(f"{where}: expected the mask {values['mask_path']!r:.200}, found no such file; copy it there.")
    return replace(photo, mask=mask)


def _lens(values: dict[str, Any], size: tuple[int, int], where: str) -> Calibration:
    """The lens that a frame describes in the manner of nerfstudio, or by camera_angle_x as nerf-synthetic does."""

    def number(key: str, default: float = 0.0) -> float:
        value = values.get(key, default)
        if isinstance(value, bool) or not isinstance(value, float | int) or not abs(value) < LARGEST:
            raise _wrong(where, f"{key} as a number between -{LARGEST:g} and {LARGEST:g}", value)
        return float(value)

    if other := [key for key in UNKNOWN if values.get(key) is not None and values[key] is not False]:
        raise _wrong(where, f"a lens without {other[0]}", values[other[0]])
    width, height = number("w", size[0]), number("h", size[1])
    if not (width.is_integer() and height.is_integer() and min(width, height) >= 1):
        raise InputError(f"{where}: expected w and h as numbers of pixels, got {width} and {height}; correct the file.")
    if values.get("camera_model") == PANORAMA:
        return Calibration(PANORAMA, int(width), int(height), (width, height))
    if (listed := values.get("distortion_params")) is not None:  # else it has become numbers of their own
        raise _wrong(where, f"distortion_params as a list of {', '.join(DISTORTION)}", listed)

    def focal_of(axis: str, side: float) -> float:
        known, key = f"fl_{axis}", f"camera_angle_{axis}"
        if known in values:
            return number(known)
        angle = _value(values, key, where, f"{known} or {key}")
        if not 0 < number(key) < np.pi:
            raise _wrong(where, f"{key} between 0 and pi", angle)
        return 0.5 * side / np.tan(0.5 * angle)

    fx = focal_of("x", width)
    fy = focal_of("y", height) if "fl_y" in values or ("fl_x" not in values and "camera_angle_y" in values) else fx
    focal = (fx, fy, number("cx", width / 2), number("cy", height / 2))
    k1, k2, k3, k4, p1, p2 = (number(key) for key in DISTORTION)
    if (fisheye := values.get("is_fisheye") or False) not in (True, False):
        raise _wrong(where, "is_fisheye as true or false", fisheye)
    model = values.get("camera_model", FISHEYE if fisheye else "OPENCV")
    if model == FISHEYE and not (p1 or p2):
        params = (*focal, k1, k2, k3, k4)
    elif model in PERSPECTIVE and not (k4 or fisheye):
        model = "FULL_OPENCV" if k3 else "OPENCV" if k1 or k2 or p1 or p2 else "PINHOLE"
        bent = (*focal, k1, k2, p1, p2)
        params = {"PINHOLE": focal, "OPENCV": bent}.get(model, (*bent, k3, 0, 0, 0))
    else:
        raise InputError(
            f"{where}: expected camera_model OPENCV with k1, k2, k3, p1, p2, {FISHEYE} with k1 to k4, {PANORAMA}, got "
            f"{reprlib.repr(model)}, is_fisheye {fisheye}, k4 = {k4}, p1 = {p1}, p2 = {p2}; undistort the photographs."
        )
    return Calibration(model, int(width), int(height), params)


def _points(source: Path, name: Any, report: Report) -> tuple[np.ndarray, np.ndarray]:
    """The points of nerfstudio's ``ply_file_path``; none without."""
    if name is None:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    if (path := ImageFinder(source).find(_path({"ply_file_path": name}, "ply_file_path", source / ALL))) is None:
        raise InputError(
            f"{source / ALL}: expected the points {name!r:.200}, found no such file; copy it there, or remove the key "
            "ply_file_path to start from random points."
        )
    return load_points(path, report)


def _path(values: Any, key: str, where: str | Path) -> str:
    if not isinstance((name := _value(values, key, where)), str):
        raise _wrong(where, f"a string as {key}", name)
    return Path(name).as_posix()


def _pose(matrix: Any, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Rotation [3, 3] and translation [3] of camera_from_world from world_from_camera in OpenGL axes, [4, 4]."""
    try:
        world_from_camera = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        world_from_camera = np.empty(0)
    if world_from_camera.shape != (4, 4) or not np.isfinite(world_from_camera).all():
        raise _wrong(where, "transform_matrix with 4 x 4 finite numbers", matrix)
    given = world_from_camera[:3, :3]
    u, scales, vt = np.linalg.svd(given)  # u @ vt is the nearest rotation
    is_scaled_rotation = np.linalg.det(u @ vt) > 0 and scales[2] > 0 and scales[0] - scales[2] <= TOLERANCE * scales[0]
    if not is_scaled_rotation or not np.allclose(world_from_camera[3], (0, 0, 0, 1)):
        raise InputError(
            f"{where}: expected transform_matrix to be a rotation and a translation (camera to world), but its axes "
            "are sheared, mirrored or scaled unequally, or its last row is not 0 0 0 1; correct the file."
        )
    rotation = (_nearest_rotation(given) * (1, -1, -1)).T  # OpenGL's y and z axes point the other way
    return rotation, -(rotation * world_from_camera[:3, 3]).sum(1)


def _nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Of a matrix that is almost a rotation times a factor (Higham 1986): LAPACK's last bits differ by processor."""
    if np.abs((matrix[:, None] * matrix).sum(2) - np.eye(3)).max() <= 1e-12:  # it is one
        return matrix
    matrix = matrix / np.sqrt((matrix * matrix).sum() / 3.0)
    for _ in range(4):  # each doubles the digits, of which TOLERANCE leaves three
        cofactors = np.cross(matrix[[1, 2, 0]], matrix[[2, 0, 1]])
        matrix = 0.5 * (matrix + cofactors / (cofactors[0] * matrix[0]).sum())
    return matrix


def _wrong(where: str | Path, expected: str, found: Any) -> InputError:
    return InputError(f"{where}: expected {expected}, got {reprlib.repr(found):.100}; correct the file.")


def _value(content: Any, key: str, where: str | Path, keys: str = "") -> Any:
    if not isinstance(content, dict) or key not in content:
        raise InputError(
            f"{where}: expected the key {keys or key} (of nerf-synthetic or nerfstudio), found none; correct it."
        )
    return content[key]

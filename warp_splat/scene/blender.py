"""Scenes of nerf-synthetic: transforms_train.json and transforms_test.json beside the images (Mildenhall et al. 2020).

Poses are camera-to-world in OpenGL axes (x right, y up, z backward); the points are random.
"""

import json
import reprlib
from pathlib import Path
from typing import Any

import numpy as np

from warp_splat.camera import Camera
from warp_splat.errors import InputError
from warp_splat.scene import images
from warp_splat.scene.images import Photo

TRAIN, TEST = "transforms_train.json", "transforms_test.json"
POINTS, HALF_WIDTH = 100_000, 1.3  # graphdeco, scene/dataset_readers.py: "inside the bounds of the synthetic scenes"
GRAY = 127  # what its colors, SH2RGB(random / 255), are once stored in 8 bit
TOLERANCE = 1e-3  # of a pose's axes, for files that round their numbers


def read(source: Path) -> tuple[list[Photo], list[Photo], np.ndarray, np.ndarray]:
    """Read the cameras of a nerf-synthetic scene and make its random points.

    Returns:
        Photos of the training set; those of the test set, empty without transforms_test.json; points [100000, 3]
        float32, uniform in [-1.3, 1.3]^3, always the same; colors [100000, 3] uint8.

    Raises:
        InputError: if a file is missing, cannot be parsed, lacks a key, or holds a matrix that is not a pose.
    """
    test = _read_photos(source / TEST) if (source / TEST).is_file() else []
    points = np.random.default_rng(0).uniform(-HALF_WIDTH, HALF_WIDTH, (POINTS, 3)).astype(np.float32)
    return _read_photos(source / TRAIN), test, points, np.full((POINTS, 3), GRAY, np.uint8)


def _read_photos(path: Path) -> list[Photo]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:  # of the syntax or of the encoding
        raise InputError(f"{path}: expected JSON, but it cannot be parsed ({error}); correct the file.") from error
    angle, frames = _value(content, "camera_angle_x", path), _value(content, "frames", path)
    if not isinstance(angle, float | int) or not 0 < angle < np.pi:
        raise InputError(f"{path}: expected camera_angle_x between 0 and pi radians, got {angle!r}; correct the file.")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: expected a list of at least one frame under the key frames; correct the file.")
    places = [f"{path}, frame {index}" for index in range(len(frames))]
    names = [_image_name(frame, where, path.parent) for frame, where in zip(frames, places, strict=True)]
    missing = [name for name in names if not (path.parent / name).is_file()]
    if missing:
        raise InputError(
            f"{path}: expected the images of its {len(frames)} frames, but {len(missing)} of them cannot be found, "
            f"the first is {missing[0]!r}; copy them there."
        )
    return [
        _photo(frame, name, angle, path.parent, where) for frame, name, where in zip(frames, names, places, strict=True)
    ]


def _image_name(frame: Any, where: str, folder: Path) -> str:
    name = _value(frame, "file_path", where)
    if not isinstance(name, str):
        raise InputError(f"{where}: expected a string as file_path, got {name!r}; correct the file.")
    name = Path(name).as_posix()
    return name if (folder / name).is_file() else name + ".png"  # the synthetic scenes leave the extension out


def _photo(frame: dict, name: str, angle: float, folder: Path, where: str) -> Photo:
    width, height = images.read_size(folder / name)
    focal = 0.5 * width / np.tan(0.5 * angle)
    rotation, translation = _pose(_value(frame, "transform_matrix", where), where)
    with images.named(where):
        camera = Camera(width, height, focal, focal, width / 2, height / 2, rotation, translation)
    return Photo(name, folder / name, camera)


def _pose(matrix: Any, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Rotation [3, 3] and translation [3] of camera_from_world from world_from_camera in OpenGL axes, [4, 4]."""
    try:
        world_from_camera = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        world_from_camera = np.empty(0)
    if world_from_camera.shape != (4, 4) or not np.isfinite(world_from_camera).all():
        raise InputError(
            f"{where}: expected transform_matrix with 4 x 4 finite numbers, got {reprlib.repr(matrix)}; "
            "correct the file."
        )
    u, scales, vt = np.linalg.svd(world_from_camera[:3, :3])  # u @ vt is the nearest rotation, without the scale
    is_scaled_rotation = np.linalg.det(u @ vt) > 0 and scales[2] > 0 and scales[0] - scales[2] <= TOLERANCE * scales[0]
    if not is_scaled_rotation or not np.allclose(world_from_camera[3], (0, 0, 0, 1)):
        raise InputError(
            f"{where}: expected transform_matrix to be a rotation and a translation (camera to world), but its axes "
            "are sheared, mirrored or scaled unequally, or its last row is not 0 0 0 1; correct the file."
        )
    rotation = (u @ vt * (1, -1, -1)).T  # OpenGL's y and z axes point the other way
    return rotation, -rotation @ world_from_camera[:3, 3]


def _value(content: Any, key: str, where: str | Path) -> Any:
    if not isinstance(content, dict) or key not in content:
        raise InputError(
            f"{where}: expected the key {key} (as in nerf-synthetic), but it is missing; correct the file."
        )
    return content[key]

"""COLMAP models, binary or text, through pycolmap. COLMAP's poses are world to camera, as ours."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from warp_splat.errors import InputError, refusing
from warp_splat.scene import images
from warp_splat.scene.colmap_library import pycolmap, require_pycolmap
from warp_splat.scene.images import Photo
from warp_splat.scene.lenses import Calibration, Sampling, make_photo, make_sampling, tell_lenses
from warp_splat.scene.photos import ImageFinder
from warp_splat.scene.types import Sightings
from warp_splat.text import Report

UINT32, UINT32_PAIR, UINT64 = struct.Struct("<I"), struct.Struct("<II"), struct.Struct("<Q")
SENSOR, POSE = 8, 56  # bytes: its kind and number; quaternion and translation
CAMERA = struct.Struct("<IiQQ")  # id, model, width, height; then the parameters
IMAGE_HEAD = 64  # bytes of id, quaternion, translation, camera id; then the name, the number of keypoints, these
FRAME_HEAD = UINT32_PAIR.size + POSE  # bytes; then the number of its images, these
POINT_HEAD = 43  # bytes of id, position, color, error; then the length of the track, the track


def read_colmap(source: Path, folder: str, report: Report, native: bool) -> tuple[list[Photo], np.ndarray, np.ndarray]:
    """Read the largest model under ``source``/sparse and find its images in ``source``/``folder``.

    Args:
        source: the scene's folder.
        folder: name of the images' folder; its images may be smaller than the model's by one factor for all.
        report: called with a line for each thing that the user should know.
        native: lenses stay as they are, instead of becoming pinholes.

    Returns:
        Photos sorted by name; points [P, 3] float32, maybe none; colors [P, 3] uint8.

    Raises:
        InputError: if the model cannot be read, lacks images, or disagrees with the image files.
    """
    where, model = _largest_model(source / "sparse", report)
    if not (registered := registered_images(model)):
        raise InputError(f"{where}: expected a COLMAP model with registered images, found none; run its mapper again.")
    points, colors = _points(model, report)
    root, sampling = source / folder, make_sampling(native)
    names = [image.name for image in registered]
    hint = "copy them there or, to train, choose another folder with --images"
    paths = ImageFinder(root).find_all(names, f"images of {where}", hint, report)
    sizes = [images.read_size(path) for path in paths]
    photos = [photo_of(*each, sampling) for each in zip(registered, paths, sizes, strict=True)]
    if scaled := sum(size != size_of(image) for size, image in zip(sizes, registered, strict=True)):
        report(f"Scaling the cameras of {scaled} of {len(photos)} images to the size of the files in {root.name}.")
    tell_lenses(photos, report)
    return photos, points, colors


def read_tracks(source: Path) -> dict[str, Sightings]:
    """By image name, what the largest model under ``source``/sparse observed of its points; empty images are left out.

    Raises:
        InputError: if the model cannot be read.
    """
    _, model = _largest_model(source / "sparse", lambda line: None)
    places, tracks = {i: point.xyz for i, point in model.points3D.items()}, {}
    for image in (model.image(i) for i in model.reg_image_ids()):
        if not (seen := [point for point in image.get_observation_points2D() if point.point3D_id in places]):
            continue
        ids = np.array([point.point3D_id for point in seen], np.int64)
        slopes = np.array(image.camera.cam_from_img(np.array([point.xy for point in seen], np.float64)))
        found = Sightings(ids, np.array([places[i] for i in ids.tolist()]), slopes)
        finite = np.isfinite(slopes).all(1) & np.isfinite(found.points).all(1)
        tracks[image.name] = Sightings(*(column[finite] for column in found))
    return tracks


def find_models(sparse: Path) -> list[Path]:
    """Folders with a COLMAP model: ``sparse``/0, ``sparse`` itself, further sub-folders; not yet read.

    Raises:
        InputError: if there is none.
    """
    folders = dict.fromkeys([sparse / "0", sparse, *sorted(path for path in sparse.iterdir() if path.is_dir())])
    folders = [path for path in folders if any((path / f"cameras.{kind}").is_file() for kind in ("bin", "txt"))]
    if not folders:
        raise InputError(
            f"{sparse}: expected a COLMAP model (cameras, images and points3D as .bin or .txt) there or in a "
            "sub-folder such as 0, found none; run COLMAP's mapper or copy its model there."
        )
    return folders


def _largest_model(sparse: Path, report: Report) -> tuple[Path, pycolmap.Reconstruction]:
    folders = find_models(sparse)
    models = {path: read_model(path) for path in folders}
    largest = max(folders, key=lambda path: models[path].num_reg_images())
    if len(folders) > 1:
        counts = ", ".join(f"{path.relative_to(sparse.parent)}: {models[path].num_reg_images()}" for path in folders)
        report(f"Several COLMAP models: taking {largest.relative_to(sparse.parent)} (registered images: {counts}).")
    return largest, models[largest]


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """Read the model in ``folder``, binary or text. Raises InputError if it is cut short, damaged or unknown."""
    require_pycolmap(f"{folder} is a COLMAP model")
    for name, record_end in RECORD_ENDS.items():
        if (folder / name).is_file():
            _check_length(folder / name, record_end)
    advice = f"; export it again, for COLMAP {pycolmap.__version__} or older."
    # pycolmap raises many types, IndexError and ValueError among them
    with refusing(Exception, f"{folder}: expected a COLMAP model, but pycolmap cannot read it", advice):
        model = pycolmap.Reconstruction(str(folder))
        if not (folder / "images.bin").is_file():
            _restore_names(model, folder / "images.txt")
        for image in model.reg_image_ids():
            _ = model.image(image).name  # from binary files, pycolmap looks for it, and decodes it, only now
        return model


def _restore_names(model: pycolmap.Reconstruction, path: Path) -> None:
    """Put back the names with spaces: from text, pycolmap 4.2 takes only what is in front of the first space."""
    with path.open(encoding="utf-8") as lines:
        for line in lines:
            if line.strip() and not line.startswith("#"):
                image, *_, name = line.split(maxsplit=9)
                model.image(int(image)).name = name.strip()
                next(lines, None)  # the line of its keypoints, which may be empty


def _check_length(path: Path, record_end: Callable[[bytes, int], int | None]) -> None:
    """Refuse a file that its records do not fill: pycolmap 4.2 accepts some, and never returns from others."""
    data = path.read_bytes()
    try:
        (count,), end = UINT64.unpack_from(data), UINT64.size
        for _ in range(count):
            end = record_end(data, end)
            if end is None:  # of a camera model that is unknown: pycolmap will refuse it
                return
    except (struct.error, OverflowError, ValueError, IndexError):
        end = None
    if end != len(data):
        raise InputError(
            f"{path}: expected a COLMAP file that ends with its last record, but it is cut short or damaged (it has "
            f"{len(data)} bytes); export the model again."
        )


def _camera_end(data: bytes, start: int) -> int | None:
    _, model, width, height = CAMERA.unpack_from(data, start)
    known = {int(each): each for each in pycolmap.CameraModelId.__members__.values()}
    if model < 0 or model not in known:
        return None
    camera = pycolmap.Camera.create_from_model_id(0, known[model], 1.0, width, height)
    return start + CAMERA.size + 8 * len(camera.params)


def _list_end(data: bytes, start: int, length: struct.Struct, each: int) -> int:
    """The end of a list, which begins with its length."""
    return start + length.size + each * length.unpack_from(data, start)[0]


def _rig_end(data: bytes, start: int) -> int:
    _, sensors = UINT32_PAIR.unpack_from(data, start)
    end = start + UINT32_PAIR.size + (SENSOR if sensors else 0)
    for _ in range(sensors - 1):
        end += SENSOR + 1 + (POSE if data[end + SENSOR] else 0)
    return end


#: Where the record that starts at a place ends, in files whose records have lengths of their own.
RECORD_ENDS = {
    "rigs.bin": _rig_end,
    "cameras.bin": _camera_end,
    "frames.bin": lambda data, start: _list_end(data, start + FRAME_HEAD, UINT32, SENSOR + 8),
    "images.bin": lambda data, start: _list_end(data, data.index(b"\0", start + IMAGE_HEAD) + 1, UINT64, 24),
    "points3D.bin": lambda data, start: _list_end(data, start + POINT_HEAD, UINT64, 8),
}


def _points(model: pycolmap.Reconstruction, report: Report) -> tuple[np.ndarray, np.ndarray]:
    records = [point for _, point in sorted(model.points3D.items(), key=lambda item: item[0])]
    with np.errstate(over="ignore"):  # becomes infinite, and is dropped
        points = np.array([point.xyz for point in records], np.float32).reshape(-1, 3)
    colors = np.array([point.color for point in records], np.uint8).reshape(-1, 3)
    if not (finite := np.isfinite(points).all(axis=1)).all():
        report(f"Dropping {np.count_nonzero(~finite)} of {len(points)} points that are not finite.")
    return points[finite], colors[finite]


def size_of(image: pycolmap.Image) -> tuple[int, int]:
    """Width and height [px] that a registered image's camera has."""
    return image.camera.width, image.camera.height


def photo_of(image: pycolmap.Image, path: Path, size: tuple[int, int], sampling: Sampling | None) -> Photo:
    """The photo of a registered image; see :func:`make_photo`."""
    pose = image.cam_from_world()
    lens = Calibration(image.camera.model_name, *size_of(image), tuple(image.camera.params))
    return make_photo(image.name, path, lens, (pose.rotation.matrix(), pose.translation), size, sampling)


def registered_images(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """Those that have a pose, by name."""
    return sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)

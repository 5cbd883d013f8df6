"""COLMAP models, binary or text, through pycolmap; lenses with distortion become pinholes.

COLMAP's poses are world to camera, as ours, and its pixel centers are at +0.5.
"""

import functools
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO  # noqa: F401 - after pycolmap, whose libraries clash with its own, writing a PNG would crash
import pycolmap

from warp_splat.camera import Camera
from warp_splat.errors import InputError
from warp_splat.scene import images
from warp_splat.scene.images import Photo

UINT64 = struct.Struct("<Q")
CAMERA = struct.Struct("<IiQQ")  # id, model, width, height; then the parameters
KNOWN_MODELS = {int(model): model for model in pycolmap.CameraModelId.__members__.values() if int(model) >= 0}
IMAGE_HEAD = 64  # bytes of id, quaternion, translation, camera id; then the name, the number of keypoints, these
POINT_HEAD = 43  # bytes of id, position, color, error; then the length of the track, the track


def read(source: Path, folder: str, report: Callable[[str], object]) -> tuple[list[Photo], np.ndarray, np.ndarray]:
    """Read the largest model under ``source``/sparse and find its images in ``source``/``folder``.

    Args:
        source: the scene's folder.
        folder: name of the images' folder; its images may be smaller than the model's by one factor for all.
        report: called with a line for each thing that the user should know.

    Returns:
        Photos sorted by name; points [P, 3] float32; colors [P, 3] uint8.

    Raises:
        InputError: if the model cannot be read, lacks images or points, or disagrees with the image files.
    """
    where, model = _largest_model(source / "sparse", report)
    registered = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
    if not registered:
        raise InputError(
            f"{where}: expected a COLMAP model with registered images, found none; run COLMAP's mapper again."
        )
    points, colors = _points(where, model, report)
    return _photos(where, registered, source / folder, report), points, colors


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


def _largest_model(sparse: Path, report: Callable[[str], object]) -> tuple[Path, pycolmap.Reconstruction]:
    folders = find_models(sparse)
    models = {path: read_model(path) for path in folders}
    largest = max(folders, key=lambda path: models[path].num_reg_images())
    if len(folders) > 1:
        counts = ", ".join(f"{path.relative_to(sparse.parent)}: {models[path].num_reg_images()}" for path in folders)
        report(f"Several COLMAP models: taking {largest.relative_to(sparse.parent)} (registered images: {counts}).")
    return largest, models[largest]


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """Read the model in ``folder``, binary or text. Raises InputError if it is cut short, damaged or unknown."""
    for name, end in (("cameras.bin", _cameras_end), ("images.bin", _images_end), ("points3D.bin", _points_end)):
        if (folder / name).is_file():
            _check_length(folder / name, end)
    try:
        model = pycolmap.Reconstruction(folder)
        if not (folder / "images.bin").is_file():
            _restore_names(model, folder / "images.txt")
        return model
    except Exception as error:  # pycolmap raises many types, IndexError and ValueError among them
        reason = " ".join(str(error).split()).rstrip(".")
        raise InputError(
            f"{folder}: expected a COLMAP model, but pycolmap cannot read it ({reason}); export it again, "
            f"for COLMAP {pycolmap.__version__} or older."
        ) from error


def _restore_names(model: pycolmap.Reconstruction, path: Path) -> None:
    """Put back the names with spaces: from text, pycolmap 4.2 takes only what is in front of the first space."""
    with path.open(encoding="utf-8") as lines:
        for line in lines:
            if line.strip() and not line.startswith("#"):
                image, *_, name = line.split(maxsplit=9)
                model.image(int(image)).name = name.strip()
                next(lines, None)  # the line of its keypoints, which may be empty


def _check_length(path: Path, end: Callable[[bytes], int]) -> None:
    """Refuse a file that its records do not fill: pycolmap 4.2 accepts some, and never returns from others."""
    data = path.read_bytes()
    try:
        expected = end(data)
    except (struct.error, OverflowError, ValueError):
        expected = None
    if expected != len(data):
        raise InputError(
            f"{path}: expected a COLMAP file that ends with its last record, but it is cut short or damaged (it has "
            f"{len(data)} bytes); export the model again."
        )


def _cameras_end(data: bytes) -> int:
    (count,), end = UINT64.unpack_from(data), UINT64.size
    for _ in range(count):
        _, model, width, height = CAMERA.unpack_from(data, end)
        if model not in KNOWN_MODELS:
            return len(data)  # its number of parameters is unknown: pycolmap will refuse it
        camera = pycolmap.Camera.create_from_model_id(0, KNOWN_MODELS[model], 1.0, width, height)
        end += CAMERA.size + 8 * len(camera.params)
    return end


def _images_end(data: bytes) -> int:
    (count,), end = UINT64.unpack_from(data), UINT64.size
    for _ in range(count):
        end = data.index(b"\0", end + IMAGE_HEAD) + 1
        (keypoints,) = UINT64.unpack_from(data, end)
        end += UINT64.size + 24 * keypoints
    return end


def _points_end(data: bytes) -> int:
    (count,), end = UINT64.unpack_from(data), UINT64.size
    for _ in range(count):
        (track,) = UINT64.unpack_from(data, end + POINT_HEAD)
        end += POINT_HEAD + UINT64.size + 8 * track
    return end


def _points(
    where: Path, model: pycolmap.Reconstruction, report: Callable[[str], object]
) -> tuple[np.ndarray, np.ndarray]:
    records = [point for _, point in sorted(model.points3D.items(), key=lambda item: item[0])]
    points = np.array([point.xyz for point in records], np.float32).reshape(-1, 3)
    colors = np.array([point.color for point in records], np.uint8).reshape(-1, 3)
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        raise InputError(
            f"{where}: expected a COLMAP model with 3D points to start from, found none that is finite; triangulate "
            "them with COLMAP's point_triangulator."
        )
    if not finite.all():
        report(f"Dropping {np.count_nonzero(~finite)} of {len(points)} points that are not finite.")
    return points[finite], colors[finite]


def _photos(where: Path, registered: list[pycolmap.Image], root: Path, report: Callable[[str], object]) -> list[Photo]:
    missing = [image.name for image in registered if not (root / image.name).is_file()]
    if missing:
        raise InputError(
            f"{root}: expected the {len(registered)} images of {where}, but {len(missing)} of them cannot be found, "
            f"the first is {missing[0]!r}; copy them there or choose another folder with --images."
        )
    sampling = functools.lru_cache(maxsize=images.THREADS)(sampling_of)  # lives as long as the photos
    photos, scaled, distorted = [], 0, []
    for image in registered:
        size = images.read_size(root / image.name)
        photos.append(make_photo(image, root / image.name, size, sampling))
        scaled += size != (image.camera.width, image.camera.height)
        distorted += [] if photos[-1].sampling is None else [image.camera.model_name]
    if scaled:
        report(f"Scaling the cameras of {scaled} of {len(photos)} images to the size of the files in {root.name}.")
    if distorted:
        models = ", ".join(sorted(set(distorted)))
        report(f"Undistorting {len(distorted)} of {len(photos)} images to pinhole cameras (models: {models}).")
    return photos


def make_photo(image: pycolmap.Image, path: Path, size: tuple[int, int], sampling: Callable[..., np.ndarray]) -> Photo:
    """The photo of a registered image whose file has ``size`` = (width, height) pixels.

    Raises:
        InputError: if the size does not fit the model's camera, or its lens cannot become a pinhole.
    """
    lens = image.camera
    # The same factor for both sides, up to the rounding of either to whole pixels.
    if abs(size[0] * lens.height - size[1] * lens.width) >= lens.width + lens.height:
        raise InputError(
            f"{path}: expected {lens.width} x {lens.height} pixels as its COLMAP camera has, or both scaled by one "
            f"factor, got {size[0]} x {size[1]}; use the images that COLMAP saw."
        )
    if lens.is_spherical() or not np.isfinite(lens.params).all():
        raise InputError(
            f"{path}: expected a camera model that can be undistorted to a pinhole, with finite parameters, got "
            f"{lens.model_name} {lens.params.tolist()}; correct the model or leave this image out."
        )
    pose = image.cam_from_world()
    with images.named(str(path)):
        if lens.is_undistorted():
            return Photo(image.name, path, _pinhole(lens, pose).resized(*size))
        key = (lens.model_name, lens.width, lens.height, tuple(lens.params), size)
        return Photo(image.name, path, _pinhole(_undistorted(_lens(*key)), pose), functools.partial(sampling, *key))


def _pinhole(lens: pycolmap.Camera, pose: pycolmap.Rigid3d) -> Camera:
    k = lens.calibration_matrix()
    return Camera(lens.width, lens.height, k[0, 0], k[1, 1], k[0, 2], k[1, 2], pose.rotation.matrix(), pose.translation)


def _lens(model: str, width: int, height: int, params: tuple[float, ...], size: tuple[int, int]) -> pycolmap.Camera:
    lens = pycolmap.Camera(model=model, width=width, height=height, params=params)
    lens.rescale(*size)
    return lens


def _undistorted(lens: pycolmap.Camera) -> pycolmap.Camera:
    """The pinhole that COLMAP's image_undistorter gives ``lens``, without blank pixels."""
    try:
        return pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), lens)
    except Exception as error:
        reason = " ".join(str(error).split()).rstrip(".")
        raise InputError(
            f"expected a lens that can be undistorted, pycolmap refuses {lens.model_name} {lens.params.tolist()} "
            f"({reason}); correct the model or leave this image out."
        ) from error


def sampling_of(*key: object) -> np.ndarray:
    """Where in the distorted image each pixel of the undistorted one lies, for :func:`images.undistort`."""
    lens = _lens(*key)
    pinhole = _undistorted(lens)
    y, x = np.mgrid[-1 : pinhole.height + 1, -1 : pinhole.width + 1] + 0.5
    rays = pinhole.cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1))
    pixels = lens.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
    return pixels.astype(np.float32).reshape(*x.shape, 2)

"""Cameras and points as a COLMAP model in text: cameras.txt, images.txt, points3D.txt."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from warp_splat.camera import Camera
from warp_splat.formats.files import write_text
from warp_splat.lenses.formulas import EQUIRECTANGULAR, MODELS

#: Of each family, the model that has all its coefficients, and two focal lengths.
WHOLE = {family: (model, count) for model, (family, count) in MODELS.items()}


def write_colmap(folder: Path, cameras: Sequence[tuple[str, Camera]], points: np.ndarray, colors: np.ndarray) -> None:
    """Write a model without observations; photographs of equal intrinsics share a camera.

    Args:
        folder: where to; it is made.
        cameras: name and camera of each photograph.
        points: [P, 3], world coordinates.
        colors: [P, 3] uint8.

    Raises:
        InputError: if a file cannot be written.
    """
    lenses = [_lens_of(camera) for _, camera in cameras]
    numbers = {lens: number for number, lens in enumerate(dict.fromkeys(lenses), 1)}
    images = []
    for number, ((name, camera), lens) in enumerate(zip(cameras, lenses, strict=True), 1):
        quat = np.roll(Rotation.from_matrix(camera.rotation).as_quat(), 1)
        images += [_line([number, *quat.tolist(), *camera.translation.tolist(), numbers[lens], name]), ""]
    rows = zip(points.tolist(), colors.tolist(), strict=True)
    places = [_line([number, *place, *color, -1.0]) for number, (place, color) in enumerate(rows, 1)]
    kinds = [_line([number, *lens]) for lens, number in numbers.items()]
    for name, lines in {"cameras": kinds, "images": images, "points3D": places}.items():
        write_text(folder / f"{name}.txt", "\n".join([*lines, ""]))


def _lens_of(camera: Camera) -> tuple:
    """Model, size and parameters."""
    size, pinhole = (camera.width, camera.height), (camera.fx, camera.fy, camera.cx, camera.cy)
    if camera.lens is None:
        return "PINHOLE", *size, *pinhole
    model, count = WHOLE[camera.lens.family]
    if camera.lens.family is EQUIRECTANGULAR:
        return model, *size, *size
    found = camera.lens.coefficients
    return model, *size, *pinhole, *found, *[0.0] * (count - len(found))


def _line(values: Iterable[object]) -> str:
    return " ".join(map(str, values))

"""Cameras and points as a COLMAP model in text: cameras.txt, images.txt, points3D.txt."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from warp_splat.camera import Camera
from warp_splat.formats.atomic import write_text


def write_colmap(folder: Path, cameras: Sequence[tuple[str, Camera]], points: np.ndarray, colors: np.ndarray) -> None:
    """Write a model of PINHOLE cameras without observations; photographs of equal intrinsics share one.

    Args:
        folder: where to; it is made.
        cameras: name and camera of each photograph.
        points: [P, 3], world coordinates.
        colors: [P, 3] uint8.

    Raises:
        InputError: if a file cannot be written.
    """
    lenses = [(c.width, c.height, c.fx, c.fy, c.cx, c.cy) for _, c in cameras]
    numbers = {lens: number for number, lens in enumerate(dict.fromkeys(lenses), 1)}
    images = []
    for number, ((name, camera), lens) in enumerate(zip(cameras, lenses, strict=True), 1):
        quat = np.roll(Rotation.from_matrix(camera.rotation).as_quat(), 1)
        images += [_line([number, *quat.tolist(), *camera.translation.tolist(), numbers[lens], name]), ""]
    rows = zip(points.tolist(), colors.tolist(), strict=True)
    places = [_line([number, *place, *color, -1.0]) for number, (place, color) in enumerate(rows, 1)]
    kinds = [_line([number, "PINHOLE", *lens]) for lens, number in numbers.items()]
    for name, lines in {"cameras": kinds, "images": images, "points3D": places}.items():
        write_text(folder / f"{name}.txt", "\n".join([*lines, ""]))


def _line(values: Iterable[object]) -> str:
    return " ".join(map(str, values))

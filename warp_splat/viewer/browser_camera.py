"""From the camera of a browser to ours, and from a photograph's camera to the browser's window."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from warp_splat.camera import Camera
from warp_splat.errors import InputError

# What is closer to a photograph's camera than these counts as being there: a pixel of an image that is 500 px wide.
SAME_ANGLE = 0.002  # rad
SAME_PLACE = 0.002  # of the distance to what one looks at
USUAL_WINDOW = (16, 9)
MOST_PIXELS = 65_000  # along an edge; JPEG has 65,535

Box = tuple[slice, slice]  # rows and columns of a window


def browser_camera(wxyz, position, fov: float, width: int, height: int) -> Camera:
    """The camera of a browser's window: square pixels, the principal point in the middle.

    Args:
        wxyz: quaternion, camera to world, in the axes that both sides share (x right, y down, z forward).
        position: the camera's center, [3], world.
        fov: vertical field of view, rad.
        width: of the window, px.
        height: of the window, px.

    Raises:
        InputError: if that is no camera: a window without pixels or too large, a value that is not finite.
    """
    wxyz, position = np.asarray(wxyz, np.float64), np.asarray(position, np.float64)
    shaped = wxyz.shape == (4,) and position.shape == (3,) and max(width, height) < MOST_PIXELS
    if not (shaped and 0 < fov < np.pi and np.isfinite([*wxyz, *position]).all() and np.linalg.norm(wxyz) > 0):
        raise InputError(f"browser: expected a pose, angle and window, got {wxyz}, {position}, {fov}, {width, height}.")
    rotation = Rotation.from_quat(np.roll(wxyz, -1)).as_matrix().T
    focal = 0.5 * height / np.tan(0.5 * fov)
    return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height, rotation, -rotation @ position)


def sized(camera: Camera, pixels: float) -> Camera:
    """The same view with at most ``pixels`` of them, and no more than it has."""
    shrink = min(1.0, (pixels / (camera.width * camera.height)) ** 0.5)
    return camera.resized(max(int(camera.width * shrink), 1), max(int(camera.height * shrink), 1))


def framed(camera: Camera, width: int, height: int) -> tuple[Camera, Box]:
    """A photograph's camera for a window of ``width`` x ``height`` px, and where the photograph lies in it.

    The photograph is as large as fits, in the middle; around it the camera sees on. Where its lens cannot, as that of a
    panorama, a pinhole takes its place. It stands still where its middle row was read.
    """
    scale = min(width / camera.width, height / camera.height)
    inner = camera.resized(max(round(camera.width * scale), 1), max(round(camera.height * scale), 1))
    left, top = (width - inner.width) // 2, (height - inner.height) // 2
    size = {"width": width, "height": height, "cx": inner.cx + left, "cy": inner.cy + top, "shutter": None}
    wide = replace(inner, **size, lens=None)
    if inner.lens and not inner.lens.family.around:
        with suppress(InputError):
            wide = replace(inner, **size)
    return wide, np.s_[top : top + inner.height, left : left + inner.width]


def is_at(camera: Camera, other: Camera, distance: float) -> bool:
    """Whether ``camera`` stands where ``other`` does, as far as one sees; ``distance`` is that to the subject."""
    angle = Rotation.from_matrix(camera.rotation @ other.rotation.T).magnitude()
    return bool(angle < SAME_ANGLE and np.linalg.norm(camera.center - other.center) < SAME_PLACE * max(distance, 1e-12))


def fitting_fov(camera: Camera, width: int, height: int) -> float:
    """The vertical field of view, rad, with which a window shows all that a photograph's camera saw."""
    return 2.0 * float(np.arctan(0.5 * height / framed(camera, width, height)[0].fy))


def pivot(camera: Camera, subject: np.ndarray) -> np.ndarray:
    """What to orbit from a photograph's camera, [3]: on its axis, as far as ``subject`` is; before it in any case."""
    apart = float(np.linalg.norm(subject - camera.center))
    ahead = float((subject - camera.center) @ camera.forward)
    return camera.center + (ahead if ahead > 0.1 * apart > 0 else max(apart, 1.0)) * camera.forward

"""A camera that moves while its rows are read: how the projection is told, and its gradient."""

from typing import NamedTuple

import numpy as np
import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.errors import InputError
from warp_splat.kernels.project import Projection
from warp_splat.kernels.project.rolling import make_expose
from warp_splat.lenses.formulas import PINHOLE
from warp_splat.lenses.shutter import Shutter, cross, rotated, series
from warp_splat.runtime.sums import in_pairs


class Tangent(NamedTuple):
    """A gradient of a pose, in the camera's axes."""

    turn: np.ndarray  # [3] about the camera's center
    shift: np.ndarray  # [3] of the world


def exposed_by(camera: Camera, options: RasterOptions, lanes: int) -> wp.Function | None:
    """What a rolling shutter does to a Gaussian; None without one.

    Raises:
        InputError: if the projection is the user's own, whose rows nobody knows.
    """
    if camera.shutter is None:
        return None
    if isinstance(options.projection, Projection):
        raise InputError(
            "options.projection: expected one by name for a camera with a rolling shutter, got one of your own; choose "
            "affine, ellipsoid or unscented, or draw without the shutter (Camera.at)."
        )
    return make_expose(camera.lens.family if camera.lens else PINHOLE, lanes)


def motion_of(camera: Camera) -> np.ndarray | None:
    """Two quadruples that the kernel reads beside a quaternion; None if the camera stands still."""
    if camera.shutter is None:
        return None
    time = camera.fy / camera.height, camera.cy / camera.height - 0.5
    return np.array([[*camera.shutter.turn, time[0]], [*camera.shutter.shift, time[1]]])


def with_motion(quats: torch.Tensor, motion: np.ndarray | float, lanes: int) -> torch.Tensor:
    """Quaternions [N, 4] and the motion, for groups of ``lanes``: [N / lanes, 3, 4 lanes]."""
    groups = quats.new_empty(len(quats) // lanes, 3, lanes, 4)
    groups[:, 0] = quats.view(-1, lanes, 4)
    groups[:, 1:] = torch.as_tensor(motion).to(quats).view(-1, 1, *([4] if isinstance(motion, np.ndarray) else [1]))
    return groups.view(-1, 3, 4 * lanes)


def motion_gradient(turns: list[torch.Tensor], lanes: int, wanted: bool) -> np.ndarray:
    """Of the motion [2, 4], from that of what :func:`with_motion` made, in one order everywhere; zeros without one."""
    if not (turns and wanted):
        return np.zeros((2, 4))
    parts = torch.cat(turns).view(-1, 3, lanes, 4)[:, 1:].nan_to_num(0.0, 0.0, 0.0)
    while parts.shape[2] > 1:
        half = parts.shape[2] // 2
        parts = parts[:, :, :half] + parts[:, :, half:]
    return in_pairs(parts.reshape(-1, 8)).cpu().numpy().reshape(2, 4)


def pose_gradients(shutter: Shutter | None, middle: Tangent, motion: np.ndarray) -> tuple[Tangent, Tangent]:
    """Of the poses of the first and the last row, from that of the middle with the motion as it is, and the motion's.

    All is that of the middle where there is no shutter.

    With w the turn and J(w) the left Jacobian of the exponential, small turns a and b of the two poses change w by
    J(w)^-1 b - J(-w)^-1 a, and turn the middle by half of J(w / 2) times that, and exp(w / 2) a.
    """
    if shutter is None:
        return middle, middle
    w, shift = np.array(shutter.turn), np.array(shutter.shift)
    by_turn, by_shift = motion[:, :3]
    turn = middle.turn + cross(shift, by_shift)
    by_turn = by_turn + 0.5 * rotated(turn, -0.5 * w, 2)
    half = 0.5 * middle.shift
    first = Tangent(rotated(turn, -0.5 * w, 1) - _before_jacobian(w, by_turn), rotated(half + by_shift, -0.5 * w, 1))
    return first, Tangent(_before_jacobian(-w, by_turn), rotated(half - by_shift, 0.5 * w, 1))


def _before_jacobian(w: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """J(w)^-1 times a vector."""
    square = sum(part * part for part in w.tolist())
    factor = 0.5 * (series(square, 3) - 2.0 * series(square, 4)) / series(square, 2)
    across = cross(w, vector)
    return vector - 0.5 * across + factor * cross(w, across)

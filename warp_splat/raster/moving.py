"""A camera that moves while its rows are read: how the projection is told."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.errors import InputError
from warp_splat.kernels.project import Projection
from warp_splat.kernels.project.rolling import make_expose
from warp_splat.lenses.formulas import PINHOLE


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

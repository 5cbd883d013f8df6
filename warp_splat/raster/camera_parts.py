"""A camera that learns, in parts: what :func:`warp_splat.check_gradients` looks at one by one."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch

from warp_splat.camera import Camera
from warp_splat.lenses import Lens
from warp_splat.raster.camera_parameters import CameraParameters

INTRINSICS = ("focal", "principal")  # halves of the intrinsics
CAMERA = ("rotation", "translation", *INTRINSICS)  # and of the twist
LAST_ROW = ("last_rotation", "last_translation")  # of the last twist, where there is a rolling shutter
LENS = "coefficients"  # if they are learned
SMALL = 1e-4  # change of a coefficient that tells how far a picture moves with it


def parts_of(camera: Camera | CameraParameters) -> dict[str, torch.Tensor]:
    """By name; none of a camera that does not learn."""
    if not isinstance(camera, CameraParameters):
        return {}
    parts = dict(zip(CAMERA, (*camera.twist.split(3), *camera.intrinsics.split(2)), strict=True))
    if camera.last_twist is not None:
        parts |= dict(zip(LAST_ROW, camera.last_twist.split(3), strict=True))
    return parts | ({LENS: camera.coefficients} if camera.coefficients is not None else {})


def put_together(base: Camera, parts: Mapping[str, torch.Tensor]) -> Camera | CameraParameters:
    """The camera of :func:`parts_of`; ``parts`` may have more than its own."""
    if CAMERA[0] not in parts:
        return base
    rotation, translation, focal, principal = (parts[name] for name in CAMERA)
    last = torch.cat([parts[name] for name in LAST_ROW]) if base.shutter else None
    twist, intrinsics = torch.cat([rotation, translation]), torch.cat([focal, principal])
    return CameraParameters(base, twist, intrinsics, last, parts.get(LENS))


def natural_size(base: Camera, name: str, pixel: float) -> float | torch.Tensor:
    """What moves the picture by a pixel, at its edge if not everywhere; ``pixel`` is one at the Gaussians [world]."""
    if name == LENS:
        return _lens_sizes(base)
    name = name.removeprefix("last_")
    sizes = (1.0 / max(base.fx, base.fy), pixel, 2.0 * max(base.fx, base.fy) / base.width, 1.0)
    return dict(zip(CAMERA, sizes, strict=True))[name]


def _lens_sizes(base: Camera) -> torch.Tensor:
    """Of each coefficient, [K]."""
    assert base.lens is not None
    across, down = np.linspace(0, base.width, 9), np.linspace(0, base.height, 9)
    rays = base.rays(np.stack(np.meshgrid(across, down), -1).reshape(-1, 2))
    rays, coefficients = rays[~np.isnan(rays[:, 0])], np.array(base.lens.coefficients)
    sizes = []
    for step in SMALL * np.eye(len(coefficients)):
        moved = replace(base, lens=Lens(base.lens.model, tuple(coefficients + step)))
        sizes.append(SMALL / max(float(np.nanmax(np.abs(moved.pixels(rays) - base.pixels(rays)))), SMALL**2))
    return torch.tensor(sizes)

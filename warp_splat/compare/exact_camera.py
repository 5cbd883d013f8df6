"""Truth for a camera that learns: float64 torch, its derivative by torch.autograd. What :mod:`.oracle` takes."""

from __future__ import annotations

from types import SimpleNamespace

import torch

from warp_splat.camera import Camera


def exact_camera(
    base: Camera,
    twist: torch.Tensor,
    intrinsics: torch.Tensor,
    last_twist: torch.Tensor | None = None,
    coefficients: torch.Tensor | None = None,
) -> SimpleNamespace:
    """The camera of :class:`warp_splat.CameraParameters` as torch has it, by its own exponential and logarithm.

    How far the lens is followed stays. A rolling shutter turns by more than nothing.
    """
    fx, fy, cx, cy = intrinsics
    given = {"width": base.width, "height": base.height, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    given |= {"lens": base.lens, "reach": base.reach}
    if coefficients is not None:
        assert base.lens is not None
        given["lens"] = SimpleNamespace(model=base.lens.model, coefficients=coefficients, limit=base.lens.limit)
    first, begin = _pose(base.at(-0.5), twist)
    if last_twist is None:
        return SimpleNamespace(**given, rotation=first, translation=-first @ begin, shutter=None)
    last, end = _pose(base.at(base.height - 0.5), last_twist)
    turned = last @ first.T
    sine = 0.5 * torch.stack([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]])
    w = sine * (sine.norm().asin() / sine.norm())
    rotation = _turn(0.5 * w) @ first
    shutter = SimpleNamespace(turn=w, shift=rotation @ (end - begin))
    return SimpleNamespace(**given, rotation=rotation, translation=-rotation @ (0.5 * (begin + end)), shutter=shutter)


def _pose(camera: Camera, twist: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rotation and center [3] of a camera that is turned and moved by a twist."""
    rotation = _turn(twist[:3]) @ torch.tensor(camera.rotation)
    return rotation, -rotation.T @ (_turn(twist[:3]) @ torch.tensor(camera.translation) + twist[3:])


def _turn(w: torch.Tensor) -> torch.Tensor:
    """The rotation by a vector."""
    return torch.linalg.matrix_exp(torch.linalg.cross(w.expand(3, 3), torch.eye(3, dtype=torch.float64)).T)

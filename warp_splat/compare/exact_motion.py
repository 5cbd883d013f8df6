"""Truth for cameras that move: float64 torch, derivatives by torch.autograd. Part of :mod:`.oracle`.

One learns its pose and numbers. One has a rolling shutter: the whole truth is a picture of which each row is rendered
by a camera that stands still (``Camera.at``). This is what splatting makes of it: a Gaussian at its own time, its
surroundings linear.
"""

import math
from types import SimpleNamespace

import torch

from warp_splat.camera import Camera
from warp_splat.compare import exact_lenses

LATEST = 0.65  # time from the middle row to where the motion ends, beyond the picture
LEAST_GAIN = 0.25  # of rows read over rows passed
EDGE = 1e-3  # of the cosine of the angle up to which a wide lens is asked for a row
STEPS = 2  # of Newton's method


def exposed(points, camera, near=exact_lenses.NEAR):
    """Points [N, 3] of the camera's middle row as it sees them in time, and the derivative of that [N, 3, 3]."""
    time, later = torch.zeros_like(points[:, 0]), torch.zeros_like(points)
    for _ in range(STEPS):
        time, later = _step(points, time, camera, near)
    placed, turned, velocity = _at(points, time, camera)
    return placed, turned + velocity[:, :, None] * later[:, None, :]


def _step(points, time, camera, near):
    """Newton's next time [N], and how points change it [N, 3]: not where it ends."""
    placed, turned, velocity = _at(points, time, camera)
    pixels, jacobian = exact_lenses.seen(_held_in_view(placed, camera.lens, near), camera)
    rate = jacobian[:, 1] / camera.height
    gain = (1 - (rate * velocity).sum(1)).clamp_min(LEAST_GAIN)
    time = time + (pixels[:, 1] / camera.height - 0.5 - time) / gain
    later = torch.einsum("nij,ni->nj", turned, rate) / gain[:, None]
    return time.clamp(-LATEST, LATEST), torch.where((time.abs() < LATEST)[:, None], later, 0)


def _held_in_view(points, lens, near):
    """Points that a row's camera sees, though it may not be that row's that sees them."""
    across, z = points[:, :2].norm(dim=1, keepdim=True), points[:, 2:]
    if not exact_lenses.is_wide(lens):
        z = z.clamp_min(near)
    elif lens.model != exact_lenses.AROUND:
        angle = math.acos(math.cos(lens.limit) + EDGE)
        z = torch.where(torch.atan2(across, z) > angle, across / math.tan(angle), z)
    return torch.cat([points[:, :2], z], 1)


def _at(points, time, camera):
    """Points as the camera sees them at ``time`` [N], the rotation since the middle row, and the points' velocity."""
    turn, shift = (torch.as_tensor(part, dtype=torch.float64) for part in (camera.shutter.turn, camera.shutter.shift))
    across = _across(turn)
    turned = torch.linalg.matrix_exp(time[:, None, None] * across)
    placed = torch.einsum("nij,nj->ni", turned, points - time[:, None] * shift)
    return placed, turned, placed @ across.T - turned @ shift


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
    return torch.linalg.matrix_exp(_across(w))


def _across(w: torch.Tensor) -> torch.Tensor:
    """What the product with a vector does, as a matrix."""
    return torch.linalg.cross(w.expand(3, 3), torch.eye(3, dtype=torch.float64)).T

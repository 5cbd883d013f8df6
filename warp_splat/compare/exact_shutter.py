"""Truth for a rolling shutter: float64 torch, its derivative by torch.autograd. Part of :mod:`.oracle`.

The whole truth is a picture of which each row is rendered by a camera that stands still (``Camera.at``). This is what
splatting makes of it: a Gaussian at its own time, its surroundings linear.
"""

import math

import torch

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
    across = torch.linalg.cross(turn.expand(3, 3), torch.eye(3, dtype=torch.float64)).T
    turned = torch.linalg.matrix_exp(time[:, None, None] * across)
    placed = torch.einsum("nij,nj->ni", turned, points - time[:, None] * shift)
    return placed, turned, placed @ across.T - turned @ shift

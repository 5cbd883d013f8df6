"""Shutters that roll, in gsplat's four directions: each point is seen when the row or column reads that it falls on.

Between the two poses the camera turns about one axis and translations change linearly, as in gsplat. Where and when a
point is seen depend on each other. The fixed point is found by iterating, without gradients. One step of Newton's
method from there has the gradient of the implicit function.
"""

from collections.abc import Callable

import torch

from warp_splat.gsplat.arguments import SHUTTERS, Request
from warp_splat.gsplat.turns import rows_turned

ITERATIONS = 10
STEP = 1e-3  # px, of the central difference
FASTEST = 0.9  # pixels that a point moves along the shutter while it reads a row: beyond, it is met many times
TINY = 1e-24  # keeps the direction of no turn finite

Points = tuple[torch.Tensor, torch.Tensor]  # images of points [..., 2] px, and which of them count as seen


def moved(request: Request, points: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
    """Points [..., 3] of the world in the camera as it stands at a time [...], 0 for the first pose, 1 for the last.

    All float64, with S and C as first dimensions.
    """
    assert request.viewmats_rs is not None
    more = (slice(None), slice(None), *[None] * (time.dim() - 2))
    first, last = (matrices.double()[more] for matrices in (request.viewmats, request.viewmats_rs))
    start, end = first[..., :3, :3], last[..., :3, :3]
    turn = rows_turned(end, start.mT[..., None, :, :])
    skew = 0.5 * (turn - turn.mT)
    axis = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1)
    sine = (axis.square().sum(-1, keepdim=True) + TINY).sqrt()
    cosine = 0.5 * (turn.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True) - 1)
    axis, angle = axis / sine, torch.atan2(sine, cosine) * time[..., None]
    points = rows_turned(points, start.mT)
    axis = axis.expand_as(points)
    along = axis * (axis * points).sum(-1, keepdim=True)
    points = along + (points - along) * angle.cos() + torch.linalg.cross(axis, points) * angle.sin()
    return points + first[..., :3, 3] + (last[..., :3, 3] - first[..., :3, 3]) * time[..., None]


def see_rolling(request: Request, points: torch.Tensor, look: Callable[[torch.Tensor], Points]) -> Points:
    """Images [S, C, N, 7, 2] of points [S, 1, N, 7, 3] of the world; ``look`` tells those of points in a camera."""
    axis, reverse = SHUTTERS[request.rolling_shutter]
    size = (request.width, request.height)[axis]

    def time_of(place: torch.Tensor) -> torch.Tensor:
        share = (place - 0.5) / max(size - 1, 1)  # from the middle of the first row to that of the last
        return 1 - share if reverse else share

    def seen_at(time: torch.Tensor) -> Points:
        return look(moved(request, points, time))

    shape = torch.broadcast_shapes(points.shape[:-1], (*request.viewmats.shape[:2], 1, 1))
    with torch.no_grad():
        (places, seen), (others, seen_late) = (seen_at(points.new_full(shape, time)) for time in (0.0, 1.0))
        place = torch.where(seen, places[..., axis], others[..., axis])
        for _ in range(ITERATIONS):
            place = seen_at(time_of(place))[0][..., axis]
        after, before = (seen_at(time_of(place + step))[0][..., axis] for step in (STEP, -STEP))
        slope = (after - before) / (2 * STEP)
    place = place + (seen_at(time_of(place))[0][..., axis] - place) / (1 - slope).clamp_min(1 - FASTEST)
    return seen_at(time_of(place))[0], seen | seen_late

"""Points of the world as gsplat's cameras see them: through lenses, by shutters that roll, seven of each Gaussian.

The seven are those of Wu et al. 2025, section 4.1, with gsplat's constants. In float64: they are a sixth of a standard
deviation away from the mean, and what they say of it is multiplied by a hundred. Written as sums of squares, so that
the covariance cannot become negative. With the offsets e_i of the six images from that of the mean,
w = 1 / (6 alpha^2) and the shift m = w sum e_i:

    mean p_0 + m,  covariance w sum e_i e_i' + (beta - alpha^2) m m'

A shutter rolls in one of four directions: each point is seen when the row or column reads that it falls on. Between the
two poses the camera turns about one axis and translations change linearly. Where and when a point is seen depend on
each other. The fixed point is found by iterating, without gradients. One step of Newton's method from there has the
gradient of the implicit function.
"""

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from warp_splat.gsplat.arguments import SHUTTERS, Request
from warp_splat.lenses.formulas import perspective, radial_of

ALPHA, BETA = 0.1, 2.0  # of the transform; kappa is 0
MARGIN = 0.1  # of the image's size: a point so far outside still counts as seen
LEAST_RADIAL = 0.8  # where a lens draws points nearer to the axis than this share, it is about to fold
TINY = 1e-14  # squared distance from the axis, below which a fisheye's formula takes it for this
ITERATIONS = 10  # of a rolling shutter
STEP = 1e-3  # px, of the central difference
FASTEST = 0.9  # pixels that a point moves along the shutter while it reads a row: beyond, it is met many times
NO_TURN = 1e-24  # keeps the direction of no turn finite

Points = tuple[torch.Tensor, torch.Tensor]  # images of points [..., 2] px, and which of them count as seen


def rows_turned(rows: torch.Tensor, matrices: torch.Tensor) -> torch.Tensor:
    """Rows [..., 3] times matrices [..., 3, 3], term by term: bits of torch's own product depend on their number."""
    first, second, third = (rows[..., axis, None] * matrices[..., axis, :] for axis in range(3))
    return first + second + third


def moved(request: Request, points: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
    """Points [..., 3] of the world in the camera as it stands at a time [...], 0 for the first pose, 1 for the last.

    All float64, with S and C as first dimensions.
    """
    more = (slice(None), slice(None), *[None] * (time.dim() - 2))
    first, last = (matrices.double()[more] for matrices in (request.viewmats, request.viewmats_rs))
    start, end = first[..., :3, :3], last[..., :3, :3]
    turn = rows_turned(end, start.mT[..., None, :, :])
    skew = 0.5 * (turn - turn.mT)
    axis = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1)
    sine = (axis.square().sum(-1, keepdim=True) + NO_TURN).sqrt()
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


def see_points(request: Request, axes: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Means [S, C, N, 2] px and variances xx, xy, yy px^2 of the images, the latter's determinant, and a mask.

    ``axes``: [S, N, 3, 3], columns: the Gaussians' axes in the world, a standard deviation long.
    """
    means, offsets = request.means.double()[:, :, None], ALPHA * 3**0.5 * axes.double().mT
    points = torch.cat([means, means + offsets, means - offsets], 2)[:, None]
    look = partial(_look, request)
    if request.rolling_shutter:
        places, seen = see_rolling(request, points, look)
    else:
        viewmats = request.viewmats.double()[:, :, None, None]
        places, seen = look(rows_turned(points, viewmats[..., :3, :3].mT) + viewmats[..., :3, 3])
    off = places[..., 1:, :] - places[..., :1, :]
    weight = 1 / (6 * ALPHA**2)
    moved = weight * off.sum(-2)
    (x, y), (mx, my) = off.unbind(-1), moved.unbind(-1)
    pairs = (x, x, mx, mx), (x, y, mx, my), (y, y, my, my)
    xx, xy, yy = (weight * (a * b).sum(-1) + (BETA - ALPHA**2) * c * d for a, b, c, d in pairs)
    found = (places[..., 0, :] + moved, xx, xy, yy, (xx * yy - xy * xy).clamp_min(0.0))
    return *(part.to(request.means.dtype) for part in found), seen.any(-1)


def _look(request: Request, points: torch.Tensor) -> Points:
    """Images of points in the camera; what falls far outside of the picture does not count as seen.

    What lies behind the camera is at (0, 0), as in gsplat.
    """
    ahead = points[..., 2] > 0
    points = torch.where(ahead[..., None], points, points.new_tensor([0.0, 0.0, 1.0]))
    u, v, clear = (_fisheye if request.camera_model == "fisheye" else _pinhole)(request, *points.unbind(-1))
    places = torch.where(ahead[..., None], pixels_at(request, u, v), 0.0)
    low = -MARGIN * places.new_tensor([request.width, request.height])
    return places, ahead & clear & ((places >= low) & (places < -low / MARGIN - low)).all(-1)


def _numbers(request: Request, name: str, count: int) -> tuple[torch.Tensor, ...]:
    """Coefficients of a kind, [S, C, 1, 1] each; zeros, if there are none."""
    given = getattr(request, name)
    given = request.Ks.new_zeros(*request.Ks.shape[:2], count) if given is None else given
    return given.double()[:, :, None, None].unbind(-1)


def pixels_at(request: Request, u: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Pixels [S, C, ..., 2] of what is seen (u, v) focal lengths from the principal point."""
    Ks = request.Ks.to(u.dtype)[(slice(None), slice(None), *[None] * (u.dim() - 2))]
    return torch.stack([Ks[..., 0, 0] * u + Ks[..., 0, 2], Ks[..., 1, 1] * v + Ks[..., 1, 2]], -1)


def _pinhole(request: Request, x: torch.Tensor, y: torch.Tensor, z: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """With OpenCV's distortion: radial, tangential, and four of a thin prism; and whether it is far from a fold."""
    k1, k2, k3, k4, k5, k6 = _numbers(request, "radial_coeffs", 6)
    p1, p2 = _numbers(request, "tangential_coeffs", 2)
    s1, s2, s3, s4 = _numbers(request, "thin_prism_coeffs", 4)
    coefficients = (k1, k2, p1, p2, k3, k4, k5, k6)
    u, v = perspective(coefficients, x, y, z)
    r2 = (x * x + y * y) / (z * z)
    return u + r2 * (s1 + r2 * s2), v + r2 * (s3 + r2 * s4), radial_of(coefficients, r2) > LEAST_RADIAL


def _fisheye(request: Request, x: torch.Tensor, y: torch.Tensor, z: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """A polynomial of the angle from the axis, which ends where it folds or the image does (OpenCV's)."""
    k1, k2, k3, k4 = _numbers(request, "radial_coeffs", 4)
    beside = (x * x + y * y).clamp_min(TINY).sqrt()
    angle = torch.atan2(beside, z).minimum(_largest_angles(request))
    square = angle * angle
    ratio = angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4)))) / beside
    return ratio * x, ratio * y, ratio > 0


def _largest_angles(request: Request) -> torch.Tensor:
    """Up to which a fisheye is followed [rad], [S, C, 1, 1]: there its slope is 0, or the farthest corner lies."""
    radial, found = torch.cat(_numbers(request, "radial_coeffs", 4), -1).flatten(0, 2), []
    for k, K in zip(radial.tolist(), request.Ks.flatten(0, 1).tolist(), strict=True):
        roots = np.roots([9 * k[3], 7 * k[2], 5 * k[1], 3 * k[0], 1.0])
        folds = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
        sides = (max(size - middle, middle) for size, middle in ((request.width, K[0][2]), (request.height, K[1][2])))
        corner = math.hypot(*sides) / min(K[0][0], K[1][1])
        found.append(min(math.sqrt(min(folds, default=math.inf)), corner))
    return torch.tensor(found, dtype=torch.float64, device=radial.device).view(*request.Ks.shape[:2], 1, 1)

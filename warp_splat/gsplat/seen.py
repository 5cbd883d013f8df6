"""What cameras see of Gaussians, in torch, which gives every entry of ``viewmats`` and ``Ks`` its gradient.

The kernels' projection (``kernels/project``) knows a camera of one pose and a few numbers, not matrices of any entries.
"""

from typing import NamedTuple

import torch

from warp_splat.config import ALPHA_MIN, FRUSTUM_MARGIN
from warp_splat.gsplat.arguments import Request
from warp_splat.gsplat.helpers import spherical_harmonics
from warp_splat.gsplat.sigma_points import TINY, moved, pixels_at, rows_turned, see_points
from warp_splat.raster.beside import rotations


class Seen(NamedTuple):
    """Gaussians on the images; what follows from one that is not drawn is 0."""

    means2d: torch.Tensor  # [S, C, N, 2] px
    conics: torch.Tensor  # [S, C, N, 3] 1/px^2
    opacities: torch.Tensor  # [S, C, N] after antialiasing
    depths: torch.Tensor  # [S, C, N] z in the camera
    extents: torch.Tensor  # [S, C, N, 2] px, half sides of the box where alpha >= 1/255
    radii: torch.Tensor  # [S, C, N, 2] int32, extents rounded up
    drawn: torch.Tensor  # [S, C, N] bool


def see(request: Request) -> Seen:
    """Project: linearized at the mean (Zwicker et al. 2001), W' = J V R S, covariance W' W''; or :func:`see_points`."""
    turn, shift = request.viewmats[..., :3, :3], request.viewmats[..., :3, 3]
    points = rows_turned(request.means[:, None], turn.mT[:, :, None]) + shift[:, :, None]
    if request.rolling_shutter:
        half = torch.full_like(points[..., 0], 0.5)
        points = moved(request, request.means.double()[:, None], half.double()).to(points.dtype)
    z = points[..., 2]
    ahead = (z > request.near_plane) & (z < request.far_plane) & (request.quats != 0).any(-1)[:, None]
    if request.with_ut:
        places, xx, xy, yy, sharp, seen = see_points(request, _axes(request))
        ahead = ahead & seen
    else:
        points = torch.where(ahead[..., None], points, points.new_tensor([0.0, 0.0, 1.0]))
        u, v, *slopes = _LENSES[request.camera_model](request, *points.unbind(-1))
        places = pixels_at(request, u, v)
        focal = request.Ks[..., (0, 1), (0, 1), None, None, None]  # on the side of the matrix: it has fewer entries
        rows = [rows_turned(torch.stack(s, -1), focal[:, :, k] * turn[:, :, None]) for k, s in enumerate(slopes)]
        xx, xy, yy, sharp = _variances(request, *rows)
    wide = sharp + request.eps2d * (xx + yy) + request.eps2d**2
    xx, yy = xx + request.eps2d, yy + request.eps2d
    opacities = request.opacities[:, None].expand_as(z)
    if request.rasterize_mode == "antialiased":
        share = torch.where(ahead & (sharp > 0), sharp / wide.clamp_min(1e-30), 1.0)
        opacities = torch.where(sharp > 0, opacities * share.sqrt(), 0.0)
    with torch.no_grad():
        reach = (2 * (opacities / ALPHA_MIN).clamp_min(1.0).log()).sqrt()
        extents = reach[..., None] * torch.stack([xx, yy], -1).sqrt()
        radii = extents.ceil().clamp_max(2**30)
        size = radii.new_tensor([request.width, request.height])
        reaching = ((places + radii > 0) & (places - radii < size)).all(-1)
        drawn = ahead & reaching & (wide > 0) & (opacities >= ALPHA_MIN)
        drawn &= (radii > 0).all(-1) & (radii > request.radius_clip).any(-1)
    per_det = 1 / torch.where(drawn, wide, 1.0)
    conics = torch.stack([yy * per_det, -xy * per_det, xx * per_det], -1)
    pairs = (places, conics, extents, radii)
    places, conics, extents, radii = (torch.where(drawn[..., None], part, 0.0) for part in pairs)
    opacities, depths = (torch.where(drawn, part, 0.0) for part in (opacities, z))
    return Seen(places, conics, opacities, depths, extents, radii.int(), drawn)


def colors_of(request: Request, seen: Seen) -> torch.Tensor:
    """Colors [S, C or 1, N, D]: as given, or of the harmonics (Kerbl et al. 2023), from 0."""
    if request.sh_degree is None or request.render_mode in ("D", "ED"):
        return request.colors
    centers = torch.linalg.inv(request.viewmats)[..., :3, 3]
    if request.viewmats_rs is not None:
        centers = 0.5 * (centers + torch.linalg.inv(request.viewmats_rs)[..., :3, 3])
    rays = request.means[:, None] - centers[:, :, None]
    colors = spherical_harmonics(request.sh_degree, rays, request.colors.expand(*rays.shape[:-1], -1, 3)) + 0.5
    return torch.where(seen.drawn[..., None], colors.clamp_min(0.0), 0.0)


def _axes(request: Request) -> torch.Tensor:
    """R S, [S, N, 3, 3]."""
    return rotations(request.quats) * request.scales[:, :, None]


def _variances(request: Request, to_x: torch.Tensor, to_y: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """xx, xy, yy on the image [S, C, N] px^2 and their determinant, from the rows [S, C, N, 3] of J V."""
    if request.covars is None:
        axes = _axes(request)[:, None]
        a, b = rows_turned(to_x, axes), rows_turned(to_y, axes)
        sharp = torch.linalg.cross(a, b).square().sum(-1)  # the determinant, without cancellation
        return (a * a).sum(-1), (a * b).sum(-1), (b * b).sum(-1), sharp
    covars = (request.covars.triu() + request.covars.triu(1).mT).double()[:, None]
    to_x, to_y = to_x.double(), to_y.double()  # in which a flat Gaussian's determinant survives
    across = rows_turned(to_x, covars)
    xx, xy, yy = (across * to_x).sum(-1), (across * to_y).sum(-1), (rows_turned(to_y, covars) * to_y).sum(-1)
    return tuple(part.to(request.means.dtype) for part in (xx, xy, yy, (xx * yy - xy * xy).clamp_min(0.0)))


def _pinhole(request: Request, x: torch.Tensor, y: torch.Tensor, z: torch.Tensor):
    """Where points are seen [focal lengths], and the slopes of both; x/z in these stays near the image."""
    u, v = x / z, y / z
    held = []
    for axis, (place, size) in enumerate(((u, request.width), (v, request.height))):
        focal, middle = request.Ks[..., axis, axis, None], request.Ks[..., axis, 2, None]
        margin = FRUSTUM_MARGIN * 0.5 * size
        held.append(place.minimum((size - middle + margin) / focal).maximum(-(middle + margin) / focal))
    none, near = torch.zeros_like(z), 1 / z
    return u, v, (near, none, -held[0] * near), (none, near, -held[1] * near)


def _ortho(_request: Request, x: torch.Tensor, y: torch.Tensor, z: torch.Tensor):
    """Parallel rays; focal lengths are pixels per world unit."""
    none, one = torch.zeros_like(z), torch.ones_like(z)
    return x, y, (one, none, none), (none, one, none)


def _fisheye(_request: Request, x: torch.Tensor, y: torch.Tensor, z: torch.Tensor):
    """Equidistant: the distance from the principal point is the angle to the axis (Kannala and Brandt 2006)."""
    square = (x * x + y * y).clamp_min(TINY)
    beside, per_ray = square.sqrt(), 1 / (square + z * z)
    share = torch.atan2(beside, z) / beside
    bend = (z * per_ray - share) / square
    to_x = (share + x * x * bend, x * y * bend, -x * per_ray)
    return x * share, y * share, to_x, (to_x[1], share + y * y * bend, -y * per_ray)


_LENSES = {"pinhole": _pinhole, "ortho": _ortho, "fisheye": _fisheye}

"""Colors of Gaussians as cameras see them, in torch: differentiable in the viewing direction, hence in the camera."""

from __future__ import annotations

import torch

from warp_splat.gsplat.arguments import Request
from warp_splat.gsplat.seen import Seen


def colors_of(request: Request, seen: Seen) -> torch.Tensor:
    """Colors [S, C or 1, N, D]: as given, or of the harmonics (Kerbl et al. 2023), from 0."""
    if request.sh_degree is None or request.render_mode in ("D", "ED"):
        return request.colors
    centers = torch.linalg.inv(request.viewmats)[..., :3, 3]
    if request.viewmats_rs is not None:
        centers = 0.5 * (centers + torch.linalg.inv(request.viewmats_rs)[..., :3, 3])
    rays = torch.nn.functional.normalize(request.means[:, None] - centers[:, :, None], dim=-1)
    basis = torch.stack(_basis(*rays.unbind(-1), request.sh_degree), -1)
    colors = (basis[..., None] * request.colors[..., : basis.shape[-1], :]).sum(-2)
    return torch.where(seen.drawn[..., None], (colors + 0.5).clamp_min(0.0), 0.0)


def _basis(x: torch.Tensor, y: torch.Tensor, z: torch.Tensor, degree: int) -> list[torch.Tensor]:
    """Real spherical harmonics of unit vectors (Sloan 2008, appendix A2), with the signs of the trainers' files."""
    found = [torch.full_like(x, 0.28209479177387814)]
    if degree > 0:
        found += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    xx, yy, zz = x * x, y * y, z * z
    even, odd = xx - yy, 2 * x * y  # of twice the azimuth
    if degree > 1:
        found += [0.5462742152960396 * odd, -1.0925484305920792 * y * z, 0.31539156525252005 * (3 * zz - 1)]
        found += [-1.0925484305920792 * x * z, 0.5462742152960396 * even]
    even3, odd3 = x * even - y * odd, x * odd + y * even
    if degree > 2:
        found += [-0.5900435899266435 * odd3, 1.445305721320277 * z * odd, -0.4570457994644658 * y * (5 * zz - 1)]
        found += [0.3731763325901154 * z * (5 * zz - 3), -0.4570457994644658 * x * (5 * zz - 1)]
        found += [1.445305721320277 * z * even, -0.5900435899266435 * even3]
    if degree > 3:
        found += [0.6258357354491763 * (x * odd3 + y * even3), -1.7701307697799304 * z * odd3]
        found += [0.47308734787878004 * odd * (7 * zz - 1), -0.6690465435572892 * y * z * (7 * zz - 3)]
        found += [0.10578554691520431 * (35 * zz * zz - 30 * zz + 3), -0.6690465435572892 * x * z * (7 * zz - 3)]
        found += [0.47308734787878004 * even * (7 * zz - 1), -1.7701307697799304 * z * even3]
        found += [0.6258357354491763 * (x * even3 - y * odd3)]
    return found

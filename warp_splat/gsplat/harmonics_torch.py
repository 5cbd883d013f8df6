"""Real spherical harmonics in torch: differentiable in the viewing direction, hence in the camera."""

import math

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
    rays = request.means[:, None] - centers[:, :, None]
    colors = spherical_harmonics(request.sh_degree, rays, request.colors) + 0.5
    return torch.where(seen.drawn[..., None], colors.clamp_min(0.0), 0.0)


def spherical_harmonics(
    degrees_to_use: int, dirs: torch.Tensor, coeffs: torch.Tensor, masks: torch.Tensor | None = None
) -> torch.Tensor:
    """Sums [..., 3] of harmonics up to a degree, as gsplat's function of this name.

    Args:
        degrees_to_use: 0 or more.
        dirs: directions [..., 3], of any length.
        coeffs: [..., K, 3].
        masks: where to compute [...]; elsewhere the result is 0.
    """
    basis = _basis(*torch.nn.functional.normalize(dirs, dim=-1).unbind(-1), degrees_to_use)
    sums = (basis[..., None] * coeffs[..., : basis.shape[-1], :]).sum(-2)
    return sums if masks is None else torch.where(masks[..., None], sums, 0.0)


def _basis(x: torch.Tensor, y: torch.Tensor, z: torch.Tensor, degree: int) -> torch.Tensor:
    """At unit vectors, [..., (degree + 1)^2]: the recurrences of Sloan (2013), with the signs of the trainers' files.

    ``even`` and ``odd`` are the cosine and the sine of m times the azimuth, times the m-th power of their radius. What
    is the same in all directions is a number.
    """
    found = {}
    even, odd, first = x, y, 1.0
    for m in range(degree + 1):
        before, here = 0.0, first  # Legendre's functions of the last two degrees
        for band in range(m, degree + 1):
            norm = math.sqrt((2 * band + 1) / (4 * math.pi) * math.factorial(band - m) / math.factorial(band + m))
            if m == 0:
                found[band, 0] = norm * here
            else:
                scaled = math.sqrt(2) * norm * here
                found[band, m], found[band, -m] = scaled * even, scaled * odd
            slope, last = (2 * band + 1) / (band - m + 1), (band + m) / (band - m + 1)
            before, here = here, slope * here * z - last * before
        if m > 0:
            even, odd = x * even - y * odd, x * odd + y * even
        first *= -(2 * m + 1)
    found[0, 0] = torch.full_like(x, found[0, 0])
    return torch.stack([found[band, m] for band in range(degree + 1) for m in range(-band, band + 1)], -1)

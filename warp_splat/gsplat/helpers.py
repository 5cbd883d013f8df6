"""What gsplat's strategies call beside its ``rasterization``, in torch, with its names and arguments."""

import math

import torch

from warp_splat.color import harmonics_at
from warp_splat.errors import InputError
from warp_splat.gsplat.sigma_points import rows_turned
from warp_splat.raster.beside import rotations


def quat_scale_to_covar_preci(
    quats: torch.Tensor,
    scales: torch.Tensor,
    compute_covar: bool = True,
    compute_preci: bool = True,
    triu: bool = False,
) -> tuple[torch.Tensor | None, torch.Tensor | None]:
    """Covariances (R S)(R S)' and their inverses, [..., 3, 3] each, or None where not asked for.

    Args:
        quats: [..., 4], w first, any norm but zero.
        scales: [..., 3], world units.
        compute_covar: whether to compute the first.
        compute_preci: whether to compute the second.
        triu: only their upper triangles, row by row, [..., 6].
    """
    turns, found = rotations(quats), []
    for asked, lengths in ((compute_covar, scales), (compute_preci, 1 / scales)):
        axes = turns * lengths[..., None, :]
        matrices = rows_turned(axes, axes.mT[..., None, :, :])
        matrices = matrices[(..., *torch.triu_indices(3, 3))] if triu else matrices
        found.append(matrices if asked else None)
    return found[0], found[1]


def compute_relocation(
    opacities: torch.Tensor, scales: torch.Tensor, ratios: torch.Tensor, binoms: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Opacities [N] and scales [N, 3] of Gaussians of which several at one place look like one.

    Equation 9 of Kheradmand et al. 2024, 3D Gaussian Splatting as Markov Chain Monte Carlo.

    Args:
        opacities: of the one, [N], activated.
        scales: likewise, [N, 3].
        ratios: how many there shall be, [N]; held between 1 and the size of the table.
        binoms: binomial coefficients, [n_max, n_max], as ``MCMCStrategy`` keeps them.
    """
    ratios = ratios.clamp(1, len(binoms)).long()
    shares = 1 - (1 - opacities.double()).pow(1 / ratios)  # in float64: large terms of both signs follow
    order = torch.arange(1, len(binoms) + 1, device=binoms.device)
    signs = 1 - 2 * ((order - 1) % 2)
    terms = binoms.double().cumsum(0)[ratios - 1] * signs / order.sqrt() * shares[:, None] ** order
    return shares.to(opacities), scales * (opacities / terms.sum(1)).to(scales)[:, None]


def spherical_harmonics(
    degrees_to_use: int, dirs: torch.Tensor, coeffs: torch.Tensor, masks: torch.Tensor | None = None
) -> torch.Tensor:
    """Sums [..., 3] of harmonics up to a degree, as gsplat's function of this name.

    Args:
        degrees_to_use: 0 or more.
        dirs: directions [..., 3], of any length.
        coeffs: [..., K, 3].
        masks: where to compute [...]; elsewhere the result is 0.

    Raises:
        InputError: if these shapes or the degree do not fit together.
    """
    found = [None if tensor is None else tuple(tensor.shape) for tensor in (dirs, coeffs, masks)]
    fits = coeffs.dim() > 1 and (*dirs.shape, 3) == (*coeffs.shape[:-2], 3, coeffs.shape[-1])
    if not fits or found[2] not in (None, dirs.shape[:-1]) or degrees_to_use not in range(math.isqrt(coeffs.shape[-2])):
        wanted = "a degree D from 0, dirs [..., 3], coeffs [..., (D + 1)^2 or more, 3] and masks [...]"
        raise InputError(f"spherical_harmonics: expected {wanted}, got {degrees_to_use!r} and {found}.")
    x, y, z = torch.nn.functional.normalize(dirs, dim=-1).unbind(-1)
    basis = torch.stack(harmonics_at(x, y, z, int(degrees_to_use)), -1)
    sums = (basis[..., None] * coeffs[..., : basis.shape[-1], :]).sum(-2)
    return sums if masks is None else torch.where(masks[..., None], sums, 0.0)

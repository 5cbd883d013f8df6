"""The code in torch that gsplat's wheel has for its tests: projection, harmonics, tiles, blending, on the CPU.

Two functions that it calls need CUDA: gsplat's ``rasterize_to_indices_in_range``, which lists who is seen by which
pixel, and nerfacc's product of transmittances. They are written here anew, by what their documentation says.
"""

import sys
from types import SimpleNamespace

import torch
from gsplat.cuda import _torch_impl as theirs

from audit_targets.own import matrices_of

TILE, ALPHA_MIN, STOP = 16, 1 / 255, 1e-4


def _weights(alphas, ray_indices, n_rays):
    """As nerfacc's ``render_weight_from_alpha``: entries are sorted by ray."""
    counts = torch.bincount(ray_indices, minlength=n_rays)
    column = torch.arange(len(alphas)) - (counts.cumsum(0) - counts)[ray_indices]
    table = torch.ones(n_rays, int(counts.max()) + 1, dtype=alphas.dtype)
    through = table.index_put((ray_indices, column + 1), 1 - alphas).cumprod(1)[ray_indices, column]
    return through * alphas, through


def _sums(weights, values, ray_indices, n_rays):
    """As nerfacc's ``accumulate_along_rays``."""
    values = weights[:, None] * (1 if values is None else values)
    return torch.zeros(n_rays, values.shape[1], dtype=values.dtype).index_add(0, ray_indices, values)


def _seen(means2d, conics, opacities, offsets, ids, width, height):
    """Gaussian and pixel of each entry that is blended, front to back."""
    ends, found = [*offsets.flatten().tolist()[1:], len(ids)], []
    for tile, (start, end) in enumerate(zip(offsets.flatten().tolist(), ends, strict=True)):
        top, left = tile // offsets.shape[-1] * TILE, tile % offsets.shape[-1] * TILE
        y, x = torch.meshgrid(
            torch.arange(top, min(top + TILE, height)), torch.arange(left, min(left + TILE, width)), indexing="ij"
        )
        y, x, listed = y.flatten()[:, None], x.flatten()[:, None], ids[start:end].long()
        dx, dy = x + 0.5 - means2d[listed, 0], y + 0.5 - means2d[listed, 1]
        a, b, c = conics[listed].unbind(1)
        sigma = 0.5 * (a * dx**2 + c * dy**2) + b * dx * dy
        alpha = (opacities[listed] * torch.exp(-sigma)).clamp_max(0.999)
        alpha = torch.where((sigma >= 0) & (alpha >= ALPHA_MIN), alpha, 0.0)
        pixel, entry = ((alpha > 0) & ((1 - alpha).cumprod(1) > STOP)).nonzero(as_tuple=True)
        found.append((listed[entry], (y * width + x)[pixel, 0]))
    gaussians, pixels = (torch.cat(each) for each in zip(*found, strict=True))
    order = torch.argsort(pixels, stable=True)
    return gaussians[order], pixels[order]


def reference(means, quats, scales, opacities, sh, camera, background):
    """By the functions of ``gsplat.cuda._torch_impl``, one after the other."""
    sys.modules["nerfacc"] = SimpleNamespace(render_weight_from_alpha=_weights, accumulate_along_rays=_sums)
    viewmat, k = matrices_of(camera)
    width, height = camera.width, camera.height
    covariances, _ = theirs._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    projected = theirs._fully_fused_projection(means, covariances, viewmat[None], k[None], width, height)
    radii, means2d, depths, conics, _ = projected
    directions = means - torch.tensor(camera.center).float()
    colors = (theirs._spherical_harmonics(int(sh.shape[1] ** 0.5) - 1, directions, sh) + 0.5).clamp_min(0)
    tiles = ((width + TILE - 1) // TILE, (height + TILE - 1) // TILE)
    _, keys, ids = theirs._isect_tiles(means2d, radii, depths, TILE, *tiles)
    offsets = theirs._isect_offset_encode(keys, 1, *tiles)
    gaussians, pixels = _seen(means2d[0].detach(), conics[0].detach(), opacities.detach(), offsets, ids, width, height)
    given = (means2d, conics, opacities[None], colors[None], gaussians, pixels, torch.zeros_like(pixels), width, height)
    image, alpha = theirs.accumulate(*given)
    return (image + background * (1 - alpha))[0]

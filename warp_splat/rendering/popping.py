"""Where a picture may pop: what another order of Gaussians whose depths overlap may change in each pixel."""

import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.config import TILE, RasterOptions
from warp_splat.raster.beside import rotations
from warp_splat.raster.certificate import drawing
from warp_splat.raster.data import Gaussians
from warp_splat.raster.drivers import driver_of
from warp_splat.raster.project import project
from warp_splat.raster.seam import around, find_crossing, with_copies

AT_ONCE = 1024  # Gaussians of a list that are compared with all of it


@torch.no_grad()
def popping_of(gaussians: Gaussians, camera: Camera, options: RasterOptions) -> torch.Tensor:
    """A bound of how much a pixel changes in any channel, whatever the order of Gaussians that overlap, [H, W].

    Two overlap whose depths are less apart than their standard deviations along the axis of the camera together. No
    pixel stops early here. Exchanging neighbors i and j changes T alpha_i alpha_j |c_i - c_j| (docs/tolerance.md).
    """
    driver, options = driver_of(gaussians.means.device), drawing(options)
    splats = project(gaussians, camera, options, driver)
    crossing = find_crossing(splats, camera)
    drawn = around(splats, camera, crossing)
    bins = driver.bin(drawn, camera, options)
    extents = with_copies(_depth_extents(gaussians, camera), crossing)
    listed = wp.to_torch(bins.gaussians).long()[bins.instances.long()]
    found = gaussians.means.new_zeros(camera.height, camera.width)
    for tile, (begin, end) in enumerate(bins.ranges.tolist()):
        top, left = tile // bins.tiles_x * TILE, tile % bins.tiles_x * TILE
        part = found[top : top + TILE, left : left + TILE]
        if end - begin > 1:
            chosen = listed[begin:end]
            alphas = _alphas(drawn, chosen, top, left, part.shape, options)
            part[:] = _exchanged(alphas, drawn.colors[chosen], drawn.depths[chosen], extents[chosen]).view_as(part)
    return found


def _depth_extents(gaussians: Gaussians, camera: Camera) -> torch.Tensor:
    """Standard deviations along the axis of the camera, or of a wide lens along the ray to the mean, [N]."""
    axis = torch.tensor(camera.rotation[2], dtype=torch.float32, device=gaussians.means.device).expand(1, 3)
    if camera.lens and camera.lens.family.wide:
        away = gaussians.means - torch.from_numpy(camera.center).to(axis.device)
        axis = torch.nn.functional.normalize(away.float(), dim=1)
    return ((axis[:, None] @ rotations(gaussians.quats))[:, 0] * gaussians.scales).norm(dim=1)


def _alphas(splats, chosen: torch.Tensor, top: int, left: int, shape, options: RasterOptions) -> torch.Tensor:
    """Of the Gaussians of a list at the pixels of its tile, [P, L]."""
    rows, columns = (torch.arange(size, device=chosen.device) + 0.5 for size in shape)
    pixels = torch.cartesian_prod(rows + top, columns + left).view(-1, 2).flip(1)
    dx, dy = (pixels[:, None] - splats.means2d[chosen]).double().unbind(2)
    xx, xy, yy = splats.conics[chosen].double().unbind(1)
    raw = splats.opacities[chosen] * torch.exp(-0.5 * (xx * dx**2 + 2.0 * xy * dx * dy + yy * dy**2)).float()
    return torch.where(raw < options.alpha_min, 0.0, raw.clamp_max(options.alpha_max))


def _exchanged(alphas, colors, depths, extents) -> torch.Tensor:
    """Of pixels whose list has these alphas [P, L], colors [L, 3], depths and half widths in depth [L]; [P].

    In front of i and j lies what is before them in any order: T is at most the root of what that leaves of both.
    """
    near, far, through = depths - extents, depths + extents, torch.log1p(-alphas)
    parts = torch.arange(len(depths), device=depths.device).split(AT_ONCE)
    before = (through @ (far[:, None] < near[part]).float() for part in parts)
    shares, found = alphas * torch.exp(0.5 * torch.cat(list(before), 1)), alphas.new_zeros(len(alphas))
    for part in parts:
        overlap = (near[part, None] <= far) & (near <= far[part, None])
        changes = torch.where(overlap, torch.cdist(colors[part], colors, p=torch.inf), 0.0)
        found += ((shares[:, part] @ changes) * shares).sum(1)
    return (0.5001 * found).minimum(colors.max())

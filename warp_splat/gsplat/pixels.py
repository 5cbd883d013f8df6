"""From Gaussians on images to pixels: this package's lists and blend, view by view."""

from __future__ import annotations

import numpy as np
import torch

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.gsplat.arguments import Request
from warp_splat.gsplat.seen import Seen
from warp_splat.raster.beside import Blended, blend_channels
from warp_splat.raster.blend import blend
from warp_splat.raster.data import Bins, Dropped, Splats2D, Walk
from warp_splat.raster.drivers import driver_of

LEAST = 1e-10  # alpha that a mean depth is divided by


def draw(request: Request, seen: Seen, colors: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, list[Bins]]:
    """Images [..., C, H, W, channels], alphas [..., C, H, W, 1], and the lists of each view."""
    scenes, cameras = seen.drawn.shape[:2]
    images, alphas, lists = [], [], []
    for scene in range(scenes):
        for camera in range(cameras):
            mine = colors[scene, camera % colors.shape[1]]
            behind = None if request.backgrounds is None else request.backgrounds[scene, camera]
            image, alpha, bins = _draw_view(request, Seen(*(part[scene, camera] for part in seen)), mine, behind)
            images.append(image)
            alphas.append(alpha)
            lists.append(bins)
    shape = (*request.batch, cameras)
    return torch.stack(images).unflatten(0, shape), torch.stack(alphas).unflatten(0, shape), lists


def _draw_view(request: Request, seen: Seen, colors: torch.Tensor, behind: torch.Tensor | None):
    """An image [H, W, channels], its alpha [H, W, 1] and its lists. Three channels and the depth are the color's."""
    device, count = colors.device, len(colors)
    wanted = request.render_mode.split("+")
    colors = colors if "RGB" in wanted else colors.new_zeros(count, 0)
    behind = colors.new_zeros(colors.shape[1]) if behind is None or "RGB" not in wanted else behind
    spare = max(3 - colors.shape[1], 0)
    first = torch.cat([colors[:, :3], colors.new_zeros(count, spare)], 1)
    background = torch.cat([behind[:3], behind.new_zeros(spare)])
    radii = seen.radii.amax(1) if count else seen.radii.new_empty(0)
    splats = Splats2D(seen.means2d, seen.conics, seen.opacities, first, seen.depths, seen.extents.contiguous(), radii)
    splats = splats._replace(**{name: getattr(splats, name).contiguous() for name in splats._fields})
    frame = Camera(request.width, request.height, 1.0, 1.0, 0.0, 0.0, np.eye(3), np.zeros(3))  # its size counts
    driver, options = driver_of(device), RasterOptions(depth=wanted[-1] in ("D", "ED"))
    bins, walk, dropped = driver.bin(splats, frame, options), Walk(), Dropped()
    image, alpha, depth = blend(splats, bins, background, frame, options, "manual", driver, dropped, walk)
    alpha, parts = alpha[..., None], [image[..., : 3 - spare]]
    if colors.shape[1] > 3:
        blended = Blended(bins, walk, frame, options, "manual", driver, dropped)
        parts.append(blend_channels(splats, colors[:, 3:], blended) + (1 - alpha) * behind[3:])
    if options.depth:
        depth = depth[..., None]
        parts.append(depth / alpha.clamp_min(LEAST) if wanted[-1] == "ED" else depth)
    return torch.cat(parts, -1), alpha, bins

"""From Gaussians on images to pixels: this package's lists and blend, view by view."""

import numpy as np
import torch

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.gsplat.arguments import Request
from warp_splat.gsplat.seen import Seen
from warp_splat.raster.beside import absolute_gradients, blend_channels
from warp_splat.raster.blend import Blending, blend
from warp_splat.raster.data import Bins, Splats2D
from warp_splat.raster.drivers import driver_of
from warp_splat.runtime.timers import adjoint_of

LEAST = 1e-10  # alpha that a mean depth is divided by
ALPHA_MAX = 0.999  # to which gsplat clamps an opacity at a pixel


class _Magnitudes(torch.autograd.Function):
    """Pixels as they are; their adjoint also writes what :func:`absolute_gradients` finds into ``into`` [N or nnz, 2].

    Image and background, other channels, depth and alpha are one group: alpha is the sum of the weights times 1.
    """

    @staticmethod
    def forward(ctx, image, others, depth, alpha, channels, background, into, drawn, blending):
        ctx.save_for_backward(channels, background)
        ctx.into, ctx.drawn, ctx.blending = into, drawn, blending
        return image.clone(), others.clone(), depth.clone(), alpha.clone()

    @staticmethod
    @adjoint_of("magnitudes")
    def backward(ctx, adj_image, adj_others, adj_depth, adj_alpha):
        channels, background = ctx.saved_tensors
        adj_alpha_alone = adj_alpha - (adj_image * background).sum(-1, keepdim=True)
        parts = [adj_image, adj_others, *([adj_depth] if adj_depth.numel() else []), adj_alpha_alone]
        found = absolute_gradients(channels, torch.cat(parts, -1), ctx.blending)
        ctx.into.copy_(found if len(ctx.into) == len(found) else found[ctx.drawn])
        return adj_image, adj_others, adj_depth, adj_alpha, *[None] * 5


def draw(
    request: Request, seen: Seen, colors: torch.Tensor, magnitudes: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor, list[Bins]]:
    """Images [..., C, H, W, channels], alphas [..., C, H, W, 1], and the lists of each view.

    The adjoint fills ``magnitudes``, of the shape of meta's means2d, if asked for.
    """
    scenes, cameras, count = seen.drawn.shape
    sizes = seen.drawn.sum(2).flatten().tolist() if request.packed else [count] * (scenes * cameras)
    into = [None] * len(sizes) if magnitudes is None else magnitudes.view(-1, 2).split(sizes)
    drawn = []
    for (scene, camera), magnitudes_of_view in zip(np.ndindex(scenes, cameras), into, strict=True):
        mine = colors[scene, camera % colors.shape[1]]
        behind = None if request.backgrounds is None else request.backgrounds[scene, camera]
        view = Seen(*(part[scene, camera] for part in seen))
        drawn.append(_draw_view(request, view, mine, behind, magnitudes_of_view))
    images, alphas, lists = zip(*drawn, strict=True)
    shape = (*request.batch, cameras)
    return torch.stack(images).unflatten(0, shape), torch.stack(alphas).unflatten(0, shape), list(lists)


def _draw_view(
    request: Request, seen: Seen, colors: torch.Tensor, behind: torch.Tensor | None, into: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor, Bins]:
    """An image [H, W, channels], its alpha [H, W, 1] and its lists. Three channels and the depth are the color's."""
    device, count = colors.device, len(colors)
    wanted = request.render_mode.split("+")
    colors = colors if "RGB" in wanted else colors.new_zeros(count, 0)
    behind = colors.new_zeros(colors.shape[1]) if behind is None else behind
    spare = max(3 - colors.shape[1], 0)
    first, background = (torch.nn.functional.pad(part[..., :3], (0, spare)) for part in (colors, behind))
    parts = (seen.means2d, seen.conics, seen.opacities, first, seen.depths, seen.extents, seen.radii.amax(1))
    splats = Splats2D(*(part.contiguous() for part in parts))
    frame = Camera(request.width, request.height, 1.0, 1.0, 0.0, 0.0, np.eye(3), np.zeros(3))  # its size counts
    driver, options = driver_of(device), RasterOptions(depth=wanted[-1] in ("D", "ED"), alpha_max=ALPHA_MAX)
    bins = driver.bin(splats, frame, options)
    blending = Blending(bins, frame, options, driver)
    image, alpha, depth = blend(splats, background, blending)
    alpha, depth = alpha[..., None], depth[..., None]
    others = blend_channels(splats, colors[:, 3:], blending) if colors.shape[1] > 3 else image[..., :0]
    if into is not None:
        channels = [first, colors[:, 3:], *([seen.depths[:, None]] if options.depth else []), first.new_ones(count, 1)]
        channels = torch.cat(channels, 1)
        told = channels, background, into, seen.drawn, blending
        image, others, depth, alpha = _Magnitudes.apply(image, others, depth, alpha, *told)
    parts = [image[..., : 3 - spare], others + (1 - alpha) * behind[3:]]
    if options.depth:
        parts.append(depth / alpha.clamp_min(LEAST) if wanted[-1] == "ED" else depth)
    return torch.cat(parts, -1), alpha, bins

"""The training loss on a GPU: two kernels, and nothing that the host waits for. See :func:`.loss.image_loss`."""

from __future__ import annotations

import functools

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from warp_splat.kernels.cuda.comparison import BAND, STRIP, PicturesView, adj_compare_block, compare_block
from warp_splat.kernels.window import SLOPES
from warp_splat.runtime.launch import launch_blocks, pack_struct, view
from warp_splat.runtime.timers import stage

FAR_APART = 10.0  # in units of an image's usual range


class LossInBlocks(torch.autograd.Function):
    """See :func:`.loss.image_loss`; of dense pictures [H, W, 3]."""

    @staticmethod
    def forward(ctx, image, target, lambda_dssim, limits):
        with stage("loss"):
            height, length = image.shape[0], image.shape[1] * image.shape[2]
            image, target = (picture.detach().reshape(height, length).contiguous() for picture in (image, target))
            ctx.pictures = (image, target, centers(image, target), limits)
            shares = ((1.0 - lambda_dssim) / image.numel(), -lambda_dssim / image.numel(), lambda_dssim)
            ctx.weights = wp.vec3(*shares)
            ctx.blocks = -(-height // int(BAND)) * -(-length // int(STRIP))
            sums, ctx.slopes = image.new_empty(ctx.blocks), image.new_empty(SLOPES, height, length)
            outputs = [view(sums, wp.float32), view(ctx.slopes, wp.float32)]
            launch_blocks(compare_block, ctx.blocks, [_view(*ctx.pictures), ctx.weights], outputs, image.device)
            return sums.sum()

    @staticmethod
    @once_differentiable
    def backward(ctx, adj_loss):
        with stage("adjoint of loss"):
            adj = torch.empty_like(ctx.pictures[0])
            given = [view(ctx.slopes, wp.float32), view(adj_loss.reshape(1), wp.float32)]
            inputs = [_view(*ctx.pictures), ctx.weights, *given]
            launch_blocks(adj_compare_block, ctx.blocks, inputs, [view(adj, wp.float32)], adj.device)
            return adj.view(len(adj), -1, 3), None, None, None


def centers(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """What to subtract from the two images, [2], as on a CPU, but found where these are."""
    if target.dtype == torch.uint8:
        return _halves(image.device)
    own, other = _middle(image), _middle(target)
    return torch.stack([torch.where((own - other).abs() > FAR_APART, own, other), other])


@functools.cache
def _halves(device: torch.device) -> torch.Tensor:
    return torch.full((2,), 0.5, device=device)


def _middle(image: torch.Tensor) -> torch.Tensor:
    low, high = image.aminmax()
    middle = 0.5 * low + 0.5 * high
    return torch.where(middle.isfinite(), middle, 0.5)


def _view(image: torch.Tensor, target: torch.Tensor, middles: torch.Tensor, limits: tuple[float, float]):
    types = (torch.float32, torch.uint8)
    floats, levels = (target if target.dtype == dtype else target.new_empty(0, 0, dtype=dtype) for dtype in types)
    return pack_struct(
        PicturesView, image=image, limits=wp.vec2(*limits), target=floats, levels=levels, centers=middles
    )

"""From 2D Gaussians and their tile lists to pixels, differentiable in torch: the kernels of the device's driver."""

from __future__ import annotations

import torch
from torch.autograd.function import once_differentiable

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.errors import InputError
from warp_splat.raster.data import Bins, Dropped, Pixels, Splats2D, Walk, plus
from warp_splat.raster.drivers import Driver, driver_of
from warp_splat.runtime.timers import stage


def blend(
    splats: Splats2D,
    bins: Bins,
    background: torch.Tensor,
    camera: Camera,
    options: RasterOptions,
    adjoint: str = "manual",
    driver: Driver | None = None,
    dropped: Dropped | None = None,
    walk: Walk | None = None,
) -> Pixels:
    """The pixels of ``splats``, which ``bins`` have packed; ``dropped`` counts what the adjoint refuses to spread.

    ``walk`` is filled in, if given.
    """
    driver = driver or driver_of(background.device)
    anchors = (splats.means2d, splats.conics, splats.opacities, splats.colors, splats.depths)
    chosen = (camera, options, adjoint, driver, dropped or Dropped(), walk or Walk())
    return Pixels(*Blend.apply(*anchors, background, bins, *chosen))


class Blend(torch.autograd.Function):
    """2D Gaussians to pixels; the adjoint walks the lists back to front.

    The five tensors tie their gradients to the image. Their values are read from ``bins.splats``, packed from them.
    """

    @staticmethod
    def forward(
        ctx,
        means2d,
        conics,
        opacities,
        colors,
        depths,
        background,
        bins,
        camera,
        options,
        adjoint,
        driver,
        dropped,
        walk,
    ):
        differentiated = any(ctx.needs_input_grad)
        if adjoint == "manual" and options.falloff is not None and differentiated:
            raise InputError(
                "adjoint: 'manual' is the derivative of the Gaussian, and options.falloff is another falloff; use "
                "'stepwise', 'reversible' or 'stored'."
            )
        keep = adjoint == "stored" and differentiated
        background = background.contiguous()
        pixels, saved = driver.blend(bins, camera, background, options, keep)
        walk.final, walk.count, _ = saved
        ctx.save_for_backward(background, *saved)
        ctx.bins, ctx.options, ctx.adjoint, ctx.driver, ctx.dropped = bins, options, adjoint, driver, dropped
        return tuple(pixels)

    @staticmethod
    @once_differentiable
    def backward(ctx, *adj_pixels):
        with stage("adjoint of blend"):
            background, *saved = ctx.saved_tensors
            adj_pixels = Pixels(*(adj.contiguous() for adj in adj_pixels))
            slots, adj_background, dropped = ctx.driver.adjoint(
                ctx.adjoint, ctx.bins, ctx.options, background, saved, adj_pixels
            )
            ctx.dropped.pixel_count = plus(ctx.dropped.pixel_count, dropped.sum())
            grads = ctx.driver.gather(ctx.bins, slots)
        return *grads, adj_background, *[None] * 7

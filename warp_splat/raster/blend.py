"""From 2D Gaussians and their tile lists to pixels, differentiable in torch: the kernels of the device's driver."""

from dataclasses import dataclass, field, replace

import torch

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.errors import InputError
from warp_splat.raster.data import Bins, Dropped, Pixels, Saved, Splats2D, alphas_of, plus
from warp_splat.raster.drivers import Driver
from warp_splat.runtime.timers import adjoint_of


@dataclass
class Blending:
    """One image to blend; the color comes first, and with it what channels beside it read."""

    bins: Bins  # the splats, packed, and which of them each tile lists
    camera: Camera  # its size is the image's
    options: RasterOptions
    driver: Driver
    adjoint: str = "manual"
    dropped: Dropped = field(default_factory=Dropped)  # counts what the adjoint refuses to spread
    saved: Saved = field(init=False)  # once the color is blended, without the transmittances that its adjoint keeps

    @property
    def steps(self) -> torch.Tensor:
        """Instances of each tile that a pixel blends, [T] int32."""
        return self.saved.count.flatten(1).amax(1).int()

    def view_lists(self) -> list:
        """What each tile lists and how opacities are cut, as kernels take them."""
        return [self.bins.view(blocks=self.saved.blocks), alphas_of(self.options)]


def blend(splats: Splats2D, background: torch.Tensor, blending: Blending) -> Pixels:
    """The pixels of ``splats``, on a background [3]."""
    anchors = (splats.means2d, splats.conics, splats.opacities, splats.colors, splats.depths)
    return Pixels(*Blend.apply(*anchors, background, blending))


class Blend(torch.autograd.Function):
    """2D Gaussians to pixels; the adjoint walks the lists back to front.

    The five tensors tie their gradients to the image. Their values are read from ``bins.splats``, packed from them.
    """

    @staticmethod
    def forward(ctx, _means2d, _conics, _opacities, _colors, _depths, background, blending):
        adjoint, options, differentiated = blending.adjoint, blending.options, any(ctx.needs_input_grad)
        if adjoint == "manual" and options.falloff is not None and differentiated:
            raise InputError(
                "adjoint: 'manual' is the derivative of the Gaussian, and options.falloff is another falloff; use "
                "'stepwise', 'reversible' or 'stored'."
            )
        ctx.blending = replace(blending)  # without what it finds, which goes with the graph
        keep, background = adjoint == "stored" and differentiated, background.contiguous()
        pixels, saved = blending.driver.blend(blending.bins, blending.camera, background, options, keep)
        blending.saved = saved._replace(kept=background.new_empty(0))
        ctx.save_for_backward(background, *saved)
        ctx.set_materialize_grads(False)  # but one zero for all, where none comes
        ctx.nothing = [background.new_zeros(()).expand(tensor.shape) for tensor in pixels]
        return tuple(pixels)

    @staticmethod
    @adjoint_of("blend")
    def backward(ctx, *adj_pixels):
        (background, *saved), it = ctx.saved_tensors, ctx.blending
        given = zip(adj_pixels, ctx.nothing, strict=True)
        adj_pixels = Pixels(*(zero if adj is None else adj.contiguous().resolve_neg() for adj, zero in given))
        found = it.driver.adjoint(it.adjoint, it.bins, it.options, background, Saved(*saved), adj_pixels)
        slots, adj_background, dropped = found
        it.dropped.pixel_count = plus(it.dropped.pixel_count, dropped.sum())
        grads = it.driver.gather(it.bins, slots)
        return *grads, adj_background, None

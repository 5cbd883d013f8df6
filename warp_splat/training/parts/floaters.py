"""Fewer floaters, which hang before few cameras: opacity has a price, which what few photographs need does not earn."""

from __future__ import annotations

import torch

from warp_splat.raster.api import RenderOutput
from warp_splat.training.parts import FloatersOptions
from warp_splat.training.seams import Setting, Step


class Floaters:
    """Adds the mean opacity of all Gaussians, times a weight, to the loss of every step."""

    def __init__(self, options: FloatersOptions, setting: Setting):
        self.weight = options.opacity_reg

    def loss(self, loss: torch.Tensor, out: RenderOutput, step: Step) -> torch.Tensor:
        """Add the term; its gradient is the weight / N for each opacity."""
        opacities = out.gaussians.opacities.nan_to_num()
        # Now multiples of 2^-23: in float64 their sum is exact, and the same in any order.
        total = (opacities + 1.0 - 1.0).double().sum()
        return loss + (self.weight * (total / max(len(opacities), 1))).to(loss.dtype)

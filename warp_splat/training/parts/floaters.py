"""Fewer floaters, which hang before few cameras: opacity has a price, which what few photographs need does not earn."""

import torch

from warp_splat.raster.data import Gaussians
from warp_splat.scene.horizon import few_photographs
from warp_splat.scene.types import Scene
from warp_splat.training.parts import FloatersOptions
from warp_splat.training.seams import Setting, Verdict

FEW = 25  # photographs that show a point, from which on there is little room for floaters: not worth a trial


class Floaters:
    """Adds the mean opacity of all Gaussians, times a weight, to the loss of every step."""

    tried = True

    def __init__(self, options: FloatersOptions, setting: Setting):
        self.weight, self.processes, self.model = options.opacity_reg, setting.processes, setting.model

    @classmethod
    def needed(cls, scene: Scene) -> Verdict:
        """If few photographs show the same: what hangs before some of them is not seen by the others."""
        return Verdict(*few_photographs(scene, FEW))

    def price(self, gaussians: Gaussians) -> torch.Tensor:
        """The term; its gradient is the weight / N for each opacity."""
        # Now multiples of 2^-23: in float64 their sum is exact, and the same in any order.
        total = (gaussians.opacities.nan_to_num() + 1.0 - 1.0).double().sum()
        return self.weight * (total / max(self.processes.total(len(self.model)), 1))

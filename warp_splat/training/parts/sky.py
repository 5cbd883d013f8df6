"""The sky, and all that is too far to have a place: behind the Gaussians, and a matter of direction alone.

Without it Gaussians have to be where the sky is: huge ones, far away, or streaks before the cameras that saw it.
"""

import torch

from warp_splat.errors import InputError
from warp_splat.kernels.environment import COEFFICIENTS, make_adj_put_behind, make_put_behind
from warp_splat.raster.drivers import load_in_lanes
from warp_splat.scene.horizon import NEEDED, share_of_sky
from warp_splat.scene.types import Scene
from warp_splat.training.optimizer import power
from warp_splat.training.parts import SkyOptions
from warp_splat.training.seams import Setting, Step, Verdict

LAST_RATE = 0.01  # of the first one, at the end


class Sky:
    """Harmonics of degree 3, as a Gaussian's colors, wherever Gaussians let light through."""

    tried = True

    def __init__(self, options: SkyOptions, setting: Setting):
        self.options, self.iterations, device = options, setting.iterations, setting.model.device
        if clear := [view.name for view in setting.scene.train if view.alpha is not None and (view.alpha < 255).any()]:
            raise InputError(
                f"--parts sky: expected photographs that are nowhere transparent, found {clear[0]}: what is cut out "
                "has no sky behind it; leave the part out."
            )
        self.harmonics = torch.zeros(COEFFICIENTS, 3, device=device, requires_grad=True)  # gray

    @classmethod
    def needed(cls, scene: Scene) -> Verdict:
        """If photographs look up to where no points are."""
        if scene.random_points:
            return Verdict(False, "the scene has no points, beside which a sky would show")
        if any(view.alpha is not None and (view.alpha < 255).any() for view in scene.train):
            return Verdict(False, "photographs are transparent somewhere, and have no sky there")
        share = share_of_sky([view.camera for view in scene.train], scene.points, scene.up)
        figure = f"{100 * share:.1f} % of the photographs look up to where there are no points"
        return Verdict(share >= NEEDED, f"{figure} (limit {100 * NEEDED} %)")

    def parameters(self) -> list[dict]:
        """The coefficients; their rate falls log-linearly to LAST_RATE of it."""
        rate = lambda i: self.options.sky_lr * power(LAST_RATE, min(i, self.iterations), self.iterations)  # noqa: E731
        return [{"name": "sky", "params": [self.harmonics], "lr": rate}]

    def load(self) -> None:
        """Compile and load the kernels."""
        load_in_lanes(self.harmonics.device, make_put_behind, make_adj_put_behind)

    def background(self, color: torch.Tensor, step: Step) -> torch.Tensor:
        """The sky instead of a color."""
        return self.harmonics

    def behind(self, color: torch.Tensor) -> torch.Tensor:
        """The same, as it is by now."""
        return self.harmonics.detach()

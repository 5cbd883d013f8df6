"""Exposure: a map of colors for each photograph, through which the image goes before it is compared.

What is learned is the difference to the identity. Its mean over the photographs is 0, exactly: after each step it is
rounded to whole UNITs, whose sums are exact, and the mean is taken off. So the scene keeps its colors, and images
without a map are those of the mean photograph.
"""

from typing import Any

import numpy as np
import torch

from warp_splat.color import COLOR_MAPS, PIVOT
from warp_splat.errors import InputError
from warp_splat.formats.exposures import Exposures
from warp_splat.kernels.color_map import make_adj_map_colors, make_map_colors
from warp_splat.raster.api import RenderOutput
from warp_splat.raster.drivers import load_in_lanes
from warp_splat.raster.expose import color_matrix, expose
from warp_splat.runtime.sums import in_pairs
from warp_splat.runtime.timers import stage
from warp_splat.scene.gains import GREEN, NEEDED, gains_of
from warp_splat.scene.neighbors import guessed
from warp_splat.scene.types import Scene
from warp_splat.training.optimizer import log_linear
from warp_splat.training.parts import ExposureOptions
from warp_splat.training.seams import Setting, Step, Verdict

DEFAULT = "gain"  # as good as affine maps on known faults, and less where nothing is wrong
UNIT = 2.0**-22
SMOOTHNESS = 10.0  # weight of the squared differences between neighboring cells, beside that of the identity


class Exposure:
    """Gains, affine maps of colors, or bilateral grids of them (Chen et al. 2007; Wang et al. 2024), one a photograph.

    With ``vignetting`` also 1 + a r^2 + b r^4 for all, with the distance r to the image's middle as a share of that to
    its corner. At the middle it is 1, so no gauge is needed.
    """

    def __init__(self, options: ExposureOptions, setting: Setting):
        self.options, self.kind, self.end = options, options.exposure or DEFAULT, setting.iterations
        if options.exposure_lr_init and not options.exposure_lr_final:
            raise InputError("--exposure_lr_final: expected a positive number, since rates fall log-linearly, got 0.")
        self.pivot, self.scene = 0.0 if setting.scene.linear else PIVOT, setting.scene
        self.places = {view: place for place, view in enumerate(setting.scene.train)}
        device = setting.model.device
        self.maps = torch.zeros(len(self.places), *COLOR_MAPS[self.kind], device=device, requires_grad=True)
        self.falloff = torch.zeros(2, device=device, requires_grad=True)
        self.found: Exposures | None = None  # since the last step

    @torch.no_grad()
    def begin(self, found: Exposures) -> None:
        """Take what a training of the same kind found, and leave it so: of photographs that it did not see, nothing."""
        if found.kind == self.kind:
            maps = [found.maps.get(view.name, np.zeros(self.maps.shape[1:], np.float32)) for view in self.places]
            self.maps.copy_(torch.from_numpy(np.stack(maps)))
            self.falloff.copy_(torch.from_numpy(found.falloff))
            for table in (self.maps, self.falloff):
                table.requires_grad_(False)

    @classmethod
    def needed(cls, scene: Scene) -> Verdict:
        """If photographs differ in brightness or tint, as the colors of points in them tell."""
        if not (gains := gains_of(scene)).stops:
            return Verdict(False, "the scene does not say which points photographs saw, so exposure is not measured")
        stops = [gain[GREEN] for gain in gains.stops.values()]
        span = f"({min(stops):+.2f} to {max(stops):+.2f} in all)"
        figure = f"{gains.unlike:.3f} stops from those that show the same {span}"
        return Verdict(gains.unlike >= NEEDED, f"photographs differ by {figure}; from {NEEDED} on it is worth it")

    def parameters(self) -> list[dict]:
        """The maps, and the vignetting if it is asked for."""
        groups = [{"name": "exposure", "params": [self.maps], "lr": self._rate}]
        return groups + [{"name": "vignetting", "params": [self.falloff], "lr": self._rate}] * self.options.vignetting

    def _rate(self, iteration: int) -> float:
        """Log-linear between the rates at start and end."""
        return log_linear(self.options.exposure_lr_init, self.options.exposure_lr_final, iteration, self.end)

    def load(self) -> None:
        """Compile and load the kernels."""
        if self.kind != "bilateral":
            load_in_lanes(self.maps.device, make_map_colors, make_adj_map_colors)

    def image(self, image: torch.Tensor, out: RenderOutput, step: Step) -> torch.Tensor:
        """As the camera of this view would have shown it."""
        with stage("exposure"):
            falloff = self.falloff if self.options.vignetting else None
            return expose(image, self.kind, self.maps[self.places[step.view]], falloff, self.pivot)

    def loss(self, loss: torch.Tensor, out: RenderOutput, step: Step) -> torch.Tensor:
        """Add the squared difference of this view's map to the identity, and between neighboring cells."""
        cells = self.maps[self.places[step.view]]
        count = cells[0].numel()
        price = in_pairs((cells * cells).reshape(-1)) / count
        if self.kind == "bilateral":
            steps = [torch.diff(cells, dim=axis).reshape(-1) for axis in (1, 2, 3)]
            price = price + SMOOTHNESS / count * in_pairs(torch.cat([change * change for change in steps]))
        return loss + (self.options.exposure_reg * price).to(loss.dtype)

    @torch.no_grad()
    def files(self) -> dict[str, Any]:
        """The maps [3, 4] of gains and affine maps as the reference writes them: color @ map[:, :3] + map[:, 3]."""
        if self.kind == "bilateral":
            return {}
        maps = {view.name: color_matrix(self.kind, self.maps[place], self.pivot) for view, place in self.places.items()}
        pairs = ((name, numbers.cpu().view(4, 3)) for name, numbers in maps.items())
        return {"exposure.json": {name: torch.cat([n[:3], n[3:].T], 1).tolist() for name, n in pairs}}

    def exposures(self) -> Exposures:
        """Of all photographs; those of held-out ones are guessed from the nearest that train, once after each step."""
        if self.found:
            return self.found
        maps, scene = self.maps.detach().cpu().numpy().copy(), self.scene
        train, test = ([view.camera for view in views] for views in (scene.train, scene.test))
        found = [*maps, *guessed(maps, train, test, scene.extent).astype(np.float32)]
        names = [view.name for view in (*scene.train, *scene.test)]
        falloff = self.falloff.detach().cpu().numpy()
        self.found = Exposures(self.kind, self.pivot, falloff, dict(zip(names, found, strict=True)))
        return self.found

    @torch.no_grad()
    def after_step(self, iteration: int) -> None:
        """Take the mean over the photographs off, exactly."""
        if not self.maps.requires_grad:
            return
        units = (self.maps / UNIT).round().long()
        mean = units.sum(0).div(len(units), rounding_mode="floor")
        left = units.sum(0) - len(units) * mean  # fewer than there are photographs
        order = torch.arange(len(units), device=units.device).view(-1, *[1] * left.dim())
        self.found = None
        self.maps.copy_((units - mean - (order < left).long()) * UNIT)

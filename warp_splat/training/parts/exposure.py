"""Exposure: a map of colors for each photograph, through which the image goes before it is compared.

Of photographs as a screen shows them, light times g is (value + PIVOT) times g^(1/2.4), but for the darkest 4 %
(IEC 61966-2-1). So maps act on value + PIVOT, and need no powers. What is learned is the difference to the identity.
Its mean over the photographs is 0, exactly: after each step it is rounded to whole UNITs, whose sums are exact, and
the mean is taken off. So the scene keeps its colors, and images without a map are those of the mean photograph.
"""

from __future__ import annotations

from typing import Any

import torch
from torch.autograd.function import once_differentiable
from torch.nn import functional

from warp_splat.errors import InputError
from warp_splat.kernels.color_map import make_adj_map_colors, make_map_colors, vec12
from warp_splat.kernels.simd import Types
from warp_splat.raster.api import RenderOutput
from warp_splat.raster.drivers import driver_of
from warp_splat.runtime.launch import lanes_of, launch_in_lanes, load
from warp_splat.runtime.sums import in_pairs
from warp_splat.runtime.timers import stage
from warp_splat.scene.gains import GREEN, NEEDED, gains_of
from warp_splat.scene.types import Scene, View
from warp_splat.training.optimizer import power
from warp_splat.training.parts import ExposureOptions
from warp_splat.training.seams import Setting, Step, Verdict

DEFAULT = "gain"  # as good as affine maps on known faults, and less where nothing is wrong
UNIT = 2.0**-22
PIVOT = 0.055
#: Numbers of a photograph: a gain; 12 of an affine map; as many for each cell of brightness, height and width.
SHAPES = {"gain": (1,), "affine": (12,), "bilateral": (12, 4, 8, 8)}
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
        self.pivot = 0.0 if setting.scene.linear else PIVOT
        self.places = {view: place for place, view in enumerate(setting.scene.train)}
        device = setting.model.device
        self.maps = torch.zeros(len(self.places), *SHAPES[self.kind], device=device, requires_grad=True)
        self.falloff = torch.zeros(2, device=device, requires_grad=True)

    @classmethod
    def needed(cls, scene: Scene) -> Verdict:
        """If photographs differ in brightness or tint, as the colors of points in them tell."""
        gains = gains_of(scene)
        if not gains.stops:
            return Verdict(
                False, "the scene does not say which points its photographs saw, so exposure is not measured"
            )
        stops = [gain[GREEN] for gain in gains.stops.values()]
        figure = (
            f"{gains.unlike:.3f} stops from those that show the same ({min(stops):+.2f} to {max(stops):+.2f} in all)"
        )
        return Verdict(gains.unlike >= NEEDED, f"photographs differ by {figure}; from {NEEDED} on it is worth it")

    def parameters(self) -> list[dict]:
        """The maps, and the vignetting if it is asked for."""
        groups = [{"name": "exposure", "params": [self.maps], "lr": self._rate}]
        return groups + [{"name": "vignetting", "params": [self.falloff], "lr": self._rate}] * self.options.vignetting

    def _rate(self, iteration: int) -> float:
        """Log-linear between the rates at start and end."""
        start, final = self.options.exposure_lr_init, self.options.exposure_lr_final
        return start * power(final / start, min(iteration, self.end), self.end) if start else 0.0

    def load(self) -> None:
        """Compile and load the kernels, for many pixels at once and for those left over."""
        device = self.maps.device
        for lanes in {driver_of(device).lanes, 1} if self.kind != "bilateral" else ():
            load(make_map_colors(lanes), device)
            load(make_adj_map_colors(lanes), device)

    def image(self, image: torch.Tensor, out: RenderOutput, step: Step) -> torch.Tensor:
        """As the camera of this view would have shown it."""
        return self._mapped(image, step.view)

    def _mapped(self, image: torch.Tensor, view: View) -> torch.Tensor:
        with stage("exposure"):
            if self.options.vignetting:
                near, far = _Spread.apply(self.falloff, image.shape[:2])
                square = _squared_radius(*image.shape[:2], image.device)
                image = (image + self.pivot) * (1.0 + (near + far * square) * square)[..., None] - self.pivot
            numbers = self.maps[self.places[view]]
            if self.kind == "bilateral":
                if numbers.requires_grad:  # no pixel that is not finite may spoil the cells
                    numbers.register_hook(lambda grad: grad.nan_to_num(0.0, 0.0, 0.0))
                return self._through_grid(image, numbers)
            return _ColorMap.apply(image, self._whole(numbers))

    @torch.no_grad()
    def as_taken(self, image: torch.Tensor, view: View) -> torch.Tensor:
        """The same for a picture; of a photograph that is held out nothing is known."""
        return self._mapped(image, view) if view in self.places else image

    def _whole(self, numbers: torch.Tensor) -> torch.Tensor:
        """Columns of a matrix and a constant, [12], of what is learned."""
        none = torch.zeros_like(numbers[:1])
        n = [numbers if i % 4 == 0 else none for i in range(12)] if self.kind == "gain" else list(numbers.split(1))
        diagonal = [1.0 + n[i] if i % 4 == 0 else n[i] for i in range(9)]
        constant = [n[9 + k] + self.pivot * ((n[k] + n[3 + k]) + n[6 + k]) for k in range(3)]
        return torch.cat(diagonal + constant)

    def _through_grid(self, image: torch.Tensor, numbers: torch.Tensor) -> torch.Tensor:
        """By the affine map that is sliced for each pixel, from its place and its brightness."""
        height, width, _ = image.shape
        r, g, b = (image + self.pivot).unbind(-1)
        brightness = (r + g + b) * (2.0 / 3.0) - (1.0 + 2.0 * self.pivot)
        # not by linspace, which rounds differently by processor
        rows, columns = ((torch.arange(n, device=image.device) + 0.5) * (2.0 / n) - 1.0 for n in (height, width))
        places = [columns.expand(height, width), rows[:, None].expand(height, width), brightness]
        found = functional.grid_sample(
            numbers[None], torch.stack(places, -1)[None, None], padding_mode="border", align_corners=True
        )
        n = found[0, :, 0]
        changes = [(n[k] * r + n[3 + k] * g) + (n[6 + k] * b + n[9 + k]) for k in range(3)]
        return image + torch.stack(changes, -1)

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
        whole = {view.name: self._whole(self.maps[place]).cpu().view(4, 3) for view, place in self.places.items()}
        return {"exposure.json": {name: torch.cat([w[:3], w[3:].T], 1).tolist() for name, w in whole.items()}}

    @torch.no_grad()
    def after_step(self, iteration: int) -> None:
        """Take the mean over the photographs off, exactly."""
        units = (self.maps / UNIT).round().long()
        mean = units.sum(0).div(len(units), rounding_mode="floor")
        left = units.sum(0) - len(units) * mean  # fewer than there are photographs
        order = torch.arange(len(units), device=units.device).view(-1, *[1] * left.dim())
        self.maps.copy_((units - mean - (order < left).long()) * UNIT)


class _ColorMap(torch.autograd.Function):
    """An image [H, W, 3] by an affine map [12]."""

    @staticmethod
    def forward(ctx, image, numbers):
        image = image.detach().contiguous()
        ctx.save_for_backward(image, numbers)
        weights, mapped = lanes_of(vec12, numbers.detach())[0], torch.empty_like(image)

        def arguments(types: Types, rows: slice) -> tuple[list, list]:
            colors, made = lanes_of(types.row3, image.view(-1, 3)[rows], mapped.view(-1, 3)[rows])
            return [weights, colors], [made]

        launch_in_lanes(make_map_colors, driver_of(image.device).lanes, image.numel() // 3, arguments, image.device)
        return mapped

    @staticmethod
    @once_differentiable
    def backward(ctx, adj):
        with stage("adjoint of exposure"):
            image, numbers = ctx.saved_tensors
            adj, lanes, count = adj.contiguous(), driver_of(image.device).lanes, image.numel() // 3
            weights, adj_image = lanes_of(vec12, numbers)[0], torch.empty_like(image)
            sums = image.new_empty(count // lanes + count % lanes, 12)

            def arguments(types: Types, rows: slice) -> tuple[list, list]:
                tables = (table.view(-1, 3)[rows] for table in (image, adj, adj_image))
                colors, given, made = lanes_of(types.row3, *tables)
                return [weights, colors, given], [made, *lanes_of(vec12, sums[rows.start // lanes :])]

            launch_in_lanes(make_adj_map_colors, lanes, count, arguments, image.device)
            return adj_image, in_pairs(sums).to(numbers.dtype).nan_to_num(0.0, 0.0, 0.0)


class _Spread(torch.autograd.Function):
    """Numbers [K] at every pixel, [K, H, W]. Their gradient is summed in one order, unlike torch's by expand."""

    @staticmethod
    def forward(ctx, numbers, size):
        return numbers.detach()[:, None, None].expand(-1, *size)

    @staticmethod
    @once_differentiable
    def backward(ctx, adj):
        return in_pairs(adj.flatten(1).T).to(adj.dtype).nan_to_num(0.0, 0.0, 0.0), None


def _squared_radius(height: int, width: int, device: torch.device) -> torch.Tensor:
    """Of each pixel from the middle, 1 at the corners of the image, [H, W]."""
    y, x = (torch.arange(size, device=device) + 0.5 - 0.5 * size for size in (height, width))
    return ((y * y)[:, None] + x * x) / (0.25 * (height * height + width * width))

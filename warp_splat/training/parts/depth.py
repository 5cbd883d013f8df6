"""Depths that are known, as a weak term whose weight falls: of points that a photograph saw, and of maps.

What is compared is 1 / depth, as errors of triangulation are even there. It is measured in 1 / extent of the cameras,
so that nothing depends on the unit of the scene. The renderer's depth is the expected one of a pixel.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from warp_splat.config import RasterOptions
from warp_splat.errors import InputError
from warp_splat.raster.api import RenderOutput
from warp_splat.runtime.timers import stage
from warp_splat.scene.depth_maps import nearest_of, read_inverse_depths
from warp_splat.scene.horizon import few_photographs
from warp_splat.scene.types import Scene, View, visible
from warp_splat.training.optimizer import log_linear
from warp_splat.training.parts import DepthOptions
from warp_splat.training.seams import Setting, Step, Verdict

FEW = 12  # photographs that show a point, from which on they tell its depth themselves
LARGE = 0.1  # error in 1 / extent, from which on it costs hardly more: points that are wrong, or hidden
OPAQUE = 0.5  # alpha under which a pixel has no depth to speak of


class Target(NamedTuple):
    """Depths in an image of some size."""

    pixels: torch.Tensor | slice  # [M] int64, each once, or all
    nearness: torch.Tensor  # [M] 1 / depth, in 1 / extent; negative where it is not known


class Depth:
    """Adds the mean of error / (error + LARGE), times LARGE: as the mean error where that is small."""

    tried = True

    def __init__(self, options: DepthOptions, setting: Setting):
        self.options, self.iterations, self.extent = options, setting.iterations, setting.scene.extent
        self.device = setting.model.device
        if options.depth_l1_weight_init and not options.depth_l1_weight_final:
            raise InputError("--depth_l1_weight_final: expected a positive number, since weights fall to it, got 0.")
        self.points = {view: points_in(view, setting.scene) for view in setting.scene.train}
        self.maps = read_inverse_depths(setting.scene, options.depths) if options.depths else {}
        if not self.maps and not any(len(places) for places, _ in self.points.values()):
            raise InputError(
                "--parts depth: expected a scene that says which points its photographs saw, as COLMAP's does, found "
                "none; leave it out, or name maps with --depths."
            )
        self._found: dict[View, tuple[torch.Size, list[Target]]] = {}

    def told(self) -> list[str]:
        """Whether maps did not fit."""
        out = len(self.points) - len(self.maps) if self.maps else 0
        return [f"{out} of {len(self.points)} depth maps are left out, of scales far from the median."] * bool(out)

    @classmethod
    def needed(cls, scene: Scene) -> Verdict:
        """If few photographs show the same: then they do not tell depth well, and points do."""
        return Verdict(*few_photographs(scene, FEW))

    def asks(self, options: RasterOptions, step: Step) -> RasterOptions:
        """The expected depth."""
        return replace(options, depth=True)

    def loss(self, loss: torch.Tensor, out: RenderOutput, step: Step) -> torch.Tensor:
        """Add the term, of points and of maps; its weight falls log-linearly, as in the reference."""
        start, end = self.options.depth_l1_weight_init, self.options.depth_l1_weight_final
        weight = log_linear(start, end, step.iteration, self.iterations)
        with stage("depth"):
            for target in self._at_size(step.view, out.alpha.shape):
                loss = loss + (weight * self._error(out, target)).to(loss.dtype)
        return loss

    def _error(self, out: RenderOutput, target: Target) -> torch.Tensor:
        """The mean over the pixels of a target, float64."""
        assert out.depth is not None
        depth, alpha = (plane.reshape(-1)[target.pixels] for plane in (out.depth, out.alpha.detach()))
        seen = (alpha > OPAQUE) & (depth > 0.0) & torch.isfinite(depth) & (target.nearness >= 0.0)
        error = (self.extent / torch.where(seen, depth, 1.0) - target.nearness).abs()
        shares = torch.where(seen, error / (error + LARGE), 0.0)
        # Now multiples of 2^-23: in float64 their sum is exact, and the same in any order.
        return (shares + 1.0 - 1.0).double().sum() * (LARGE / len(target.nearness))

    def _at_size(self, view: View, size: torch.Size) -> list[Target]:
        """What is known of a view, at the size of a step."""
        if view not in self._found or self._found[view][0] != size:
            made = [make(view, *size) for make in (self._points_at, self._map_at)]
            self._found[view] = size, [target for target in made if target is not None]
        return self._found[view][1]

    def _points_at(self, view: View, height: int, width: int) -> Target | None:
        """Of two points in a pixel the nearer one."""
        places, nearness = self.points[view]
        row, column = _pixels(places, height, width)
        nearest = np.argsort(-nearness, kind="stable")
        pixels, first = np.unique((row * width + column)[nearest], return_index=True)
        nearness = torch.from_numpy(nearness[nearest][first].astype(np.float32)).to(self.device)
        return Target(torch.from_numpy(pixels).to(self.device), nearness) if len(pixels) else None

    def _map_at(self, view: View, height: int, width: int) -> Target | None:
        """The numbers nearest to the pixels."""
        if view not in self.maps:
            return None
        rows, columns = nearest_of(height, view.camera.height), nearest_of(width, view.camera.width)
        nearness = np.float32(self.extent) * self.maps[view][rows[:, None], columns]
        return Target(slice(None), torch.from_numpy(nearness.reshape(-1)).to(self.device))


def points_in(view: View, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Where a photograph shows the points that structure from motion saw in it, and how near they are.

    Returns:
        [M, 2] x and y as shares of its width and height, and [M] 1 / depth, in 1 / extent.
    """
    camera, seen = view.camera, scene.tracks.get(view.name)
    points = seen.points[visible(camera, seen.points)] if seen else np.empty((0, 3))
    inside = (camera.rotation[:, :, None] * points.T).sum(1).T + camera.translation
    x, y, z = inside.T
    depths = np.sqrt(x * x + y * y + z * z) if camera.lens and camera.lens.family.wide else z
    places = camera.pixels(inside) / (camera.width, camera.height)
    if view.mask is not None:
        counts = view.mask[_pixels(places, camera.height, camera.width)] > 0
        places, depths = places[counts], depths[counts]
    return places, scene.extent / depths


def _pixels(places: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of places [M, 2] in a picture."""
    column, row = np.minimum(np.floor(places * (width, height)), (width - 1, height - 1)).astype(np.int64).T
    return row, column

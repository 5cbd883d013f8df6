"""A truer surface: depths and normals agree, and a place has one depth in all views that see it.

A depth is where a pixel's ray meets the planes of the Gaussians, blended (PGSR, Chen et al. 2024): the expected depth
of their centers would be level across each of them. The normals of these depths are compared with the Gaussians' own,
blended (2DGS, Huang et al. 2024), and the places that they tell with the depths that other views had last.
"""

from dataclasses import replace

import numpy as np
import torch

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.errors import InputError
from warp_splat.formats.checkpoint import Checkpoint
from warp_splat.raster.api import RenderOutput
from warp_splat.raster.beside import rays
from warp_splat.runtime.timers import stage
from warp_splat.scene.neighbors import distances
from warp_splat.training.parts import SurfaceOptions
from warp_splat.training.photographs import Photograph
from warp_splat.training.seams import Setting, Step

BEGIN = 0.25  # share of the steps after which it counts
OPAQUE, GRAZING = 0.5, 0.05  # alpha, and cosine between ray and normal, under which a pixel has no depth to speak of
EVERY = 2  # of rows and columns one counts, another one in each view of a step
OTHERS = 4  # views that one is compared with, those nearest to it
SAME = 0.02  # share of a depth within which two views see the same place
SIZE = 128  # edge of the map of depths that is kept of each view


class SurfacePart:
    """Adds 1 - the cosine between both normals, and the relative difference of depths: their means, weighted."""

    mask: torch.Tensor | None = None  # of the photograph of the step

    def __init__(self, options: SurfaceOptions, setting: Setting):
        self.options, self.extent, self.begin = options, setting.scene.extent, BEGIN * setting.iterations
        self.cameras = [view.camera for view in setting.scene.train]
        if setting.processes.count > 1:
            raise InputError("--parts surface: expected one process, which sees all views; leave the part out.")
        if any(camera.lens or camera.shutter for camera in self.cameras):
            raise InputError("--parts surface: expected pinholes, found a lens or a shutter; leave the part out.")
        self.places = {view: place for place, view in enumerate(setting.scene.train)}
        self.kept = torch.zeros(len(self.cameras), SIZE, SIZE, device=setting.model.device)  # 1 / depth; 0: none

    def asks(self, options: RasterOptions, step: Step) -> RasterOptions:
        """Normals and planes, also to warm up."""
        return replace(options, normals=True) if step.iteration >= self.begin or not step.iteration else options

    def photograph(self, photograph: Photograph, step: Step) -> Photograph:
        """Note what of it counts."""
        self.mask = photograph.mask
        return photograph

    def loss(self, loss: torch.Tensor, out: RenderOutput, step: Step) -> torch.Tensor:
        """Add both terms, and keep the depths."""
        if out.normals is None or out.planes is None:
            return loss
        with stage("surface"):
            place, turn = self.places[step.view], step.iteration + step.place
            camera = self.cameras[place].resized(*out.alpha.T.shape)
            planes = out.alpha.detach(), out.normals, out.planes[..., 0], rays(camera, out.alpha.device)
            counting = np.s_[turn // EVERY % EVERY :: EVERY, turn % EVERY :: EVERY]
            alpha, normals, plane, ray = (values[counting] for values in planes)
            slope = (normals * ray).sum(-1)
            seen = (alpha > OPAQUE) & (slope < -GRAZING * alpha) & (plane < 0)
            depth = torch.where(seen, plane, -1.0) / torch.where(seen, slope, -1.0)
            points = ray * depth[..., None]
            if self.mask is not None:
                seen = seen & (self.mask[counting][..., 0] > 0)
            unlike = torch.where(seen[1:-1, 1:-1], _unlike(points, normals, alpha), 0.0)
            added = self.options.surface_normals * _mean(unlike)
            apart = distances([camera], self.cameras, self.extent)[0]
            nearest = [int(other) for other in np.argsort(apart, kind="stable") if other != place]
            for other in nearest[:OTHERS]:
                error = torch.where(seen, self._error(points, camera, other), 0.0)
                added = added + self.options.surface_views / OTHERS * _mean(error)
            nearness = torch.where(seen, 1 / depth.detach(), 0.0)[None, None]
            if nearness.numel():  # not of photographs of one row
                self.kept[place] = torch.nn.functional.interpolate(nearness, (SIZE, SIZE), mode="nearest-exact")[0, 0]
            return loss + added.to(loss.dtype)

    def _error(self, points: torch.Tensor, camera: Camera, place: int) -> torch.Tensor:
        """How far points, from the camera's center, are off the depths of another view, as shares of these, [H, W]."""
        other, (right, down, forward) = self.cameras[place], points.unbind(-1)
        offset = other.rotation @ (camera.center - other.center)
        matrix = np.concatenate([other.rotation, offset[:, None]], 1).tolist()  # numbers: a copy would make a GPU wait
        x, y, z = (right * a + down * b + forward * c + shift for a, b, c, shift in matrix)
        with torch.no_grad():
            z_there = torch.where(z > 0, z, torch.inf)
            u, v = other.fx * x / z_there + other.cx, other.fy * y / z_there + other.cy
            grid = torch.stack([2 * u / other.width - 1, 2 * v / other.height - 1], -1)[None]
            nearness = torch.nn.functional.grid_sample(self.kept[place][None, None], grid, align_corners=False)[0, 0]
        error = (1 - z * nearness).abs()
        return torch.where((nearness > 0) & (error < SAME), error, 0.0)

    def state(self) -> dict[str, torch.Tensor]:
        """The depths that are kept."""
        return {"surface.kept": self.kept}

    def restore(self, checkpoint: Checkpoint) -> None:
        """Take them back; none if the training went without this part until now."""
        if "surface.kept" in checkpoint.arrays:
            self.kept = torch.tensor(checkpoint.array("surface.kept", tuple(self.kept.shape)), device=self.kept.device)


def _unlike(points: torch.Tensor, normals: torch.Tensor, alpha: torch.Tensor) -> torch.Tensor:
    """Alpha minus the inner product of blended normals and those of points, of pixels that are not at the border."""
    across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    found = torch.nn.functional.normalize(torch.linalg.cross(down, across), dim=-1)
    return alpha[1:-1, 1:-1] - (found * normals[1:-1, 1:-1]).sum(-1)


def _mean(values: torch.Tensor) -> torch.Tensor:
    """In float64, 0 of none; values are from 0 to about 2."""
    # Now multiples of 2^-22, whose sum is exact, and the same in any order.
    return (values + 3.0 - 3.0).double().sum() / max(values.numel(), 1)

"""Where a photograph was really taken: its pose is refined, while the model stays as it is."""

from collections.abc import Callable

import numpy as np
import torch
from torch.nn.functional import avg_pool2d

from warp_splat.camera import Camera
from warp_splat.color import to_srgb
from warp_splat.config import RasterOptions
from warp_splat.raster.api import render
from warp_splat.raster.camera_parameters import CameraParameters
from warp_splat.raster.data import Gaussians
from warp_splat.scene.types import View

LEVELS = (1, 2, 4, 8, 16)  # px: boxes over which differences are averaged; fine detail sees no large displacement
FARTHEST = 0.25  # rad about an axis, shares of the extent along one: a model that shows nothing leads nowhere
Finish = Callable[[torch.Tensor, str], torch.Tensor]
STEPS = 40  # pictures and their adjoints, about: an iteration that has begun is ended


def where_taken(
    gaussians: Gaussians, background: torch.Tensor, options: RasterOptions, extent: float, finish: Finish, linear: bool
) -> Callable[[View], Camera]:
    """A function from a view to the camera that :func:`find_pose` finds for it.

    ``finish``: what makes an image [H, W, 3] as a photograph shows it, by its name. ``linear``: in linear light.
    """
    gaussians = Gaussians(*(tensor.detach() for tensor in gaussians))
    draw = lambda camera, name: finish(render(gaussians, camera, background, options).image, name)  # noqa: E731
    return lambda view: find_pose(lambda camera: draw(camera, view.name), view, extent, linear)


def find_pose(draw: Callable[[CameraParameters], torch.Tensor], view: View, extent: float, linear: bool) -> Camera:
    """The camera from which the model looks most like the photograph, on a screen, by L-BFGS near where it was given.

    Args:
        draw: the image [H, W, 3] as the photograph shows it, through a camera, with gradients for that.
        view: the photograph; where it has a mask, the rest does not count.
        extent: size of the scene, world units.
        linear: whether ``draw``'s images are in linear light.
    """
    camera = view.camera
    units = torch.tensor([1.0] * 3 + [extent] * 3, dtype=torch.float64)
    photo = torch.from_numpy(np.float32(view.picture / 255.0))
    mask = torch.ones(1) if view.mask is None else torch.from_numpy(view.mask[..., None]).float()

    def loss(numbers: np.ndarray) -> tuple[float, np.ndarray]:
        twist = torch.from_numpy(numbers).requires_grad_()
        image = draw(CameraParameters(camera, twist * units)).clamp_max(1.0)
        image = to_srgb(image.clamp_min(0.0), torch.where) if linear else image
        difference = ((image - photo.to(image.device)) * mask.to(image.device)).permute(2, 0, 1)
        levels = [level for level in LEVELS if level <= min(difference.shape[1:])]
        errors = torch.stack([avg_pool2d(difference, level).square().mean() for level in levels]).sum()
        errors.backward()
        return errors.item(), twist.grad.numpy()

    from scipy.optimize import minimize  # noqa: PLC0415 - slow to load, and most trainings do without

    near = [(-FARTHEST, FARTHEST)] * 6
    found = minimize(loss, np.zeros(6), jac=True, method="L-BFGS-B", bounds=near, options={"maxfun": STEPS})
    return CameraParameters(camera, torch.from_numpy(found.x) * units).camera

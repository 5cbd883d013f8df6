"""Where a panorama ends it begins: what crosses its left or right edge shows at the other one as well."""

import torch

from warp_splat.camera import Camera
from warp_splat.raster.data import Splats2D

Crossing = list[torch.Tensor]  # [L] int64, the Gaussians that cross the left edge, and the right one


def find_crossing(splats: Splats2D, camera: Camera) -> Crossing:
    """Which splats show at both edges; empty if the camera's lens is not one of all around."""
    if not (camera.lens and camera.lens.family.around):
        return []
    place, reach, drawn = splats.means2d[:, 0].detach(), splats.extents[:, 0], splats.radii > 0
    return [torch.nonzero(drawn & crosses)[:, 0] for crosses in (place < reach, place + reach > camera.width)]


def with_copies(tensor: torch.Tensor, crossing: Crossing) -> torch.Tensor:
    """The rows of ``tensor`` [N, ...], and behind them once more those of Gaussians that cross an edge.

    Gradients of copies are added to those of the rows, in one order.
    """
    return torch.cat([tensor, *(tensor[chosen] for chosen in crossing)]) if crossing else tensor


def around(splats: Splats2D, camera: Camera, crossing: Crossing) -> Splats2D:
    """The splats, with copies the width of the panorama to the other side.

    A pixel sees a splat and its copy only if the splat is as wide as the picture.
    """
    if not crossing:
        return splats
    copied = Splats2D(*(with_copies(tensor, crossing) for tensor in splats))
    left, right = (len(chosen) for chosen in crossing)
    shift = torch.zeros_like(copied.means2d)
    shift[len(splats.radii) :, 0] = shift.new_tensor([camera.width] * left + [-camera.width] * right)
    return copied._replace(means2d=copied.means2d + shift)

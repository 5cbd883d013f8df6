"""What lies behind the Gaussians, in place of one color: harmonics of the direction, differentiable in torch."""

import functools

import numpy as np
import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.kernels.environment import RUN, make_adj_put_behind, make_put_behind
from warp_splat.kernels.simd import vec48
from warp_splat.lenses import Lens
from warp_splat.lenses.shutter import Shutter, rotated
from warp_splat.raster.camera_parameters import CameraParameters
from warp_splat.raster.drivers import driver_of
from warp_splat.runtime.launch import launch_in_lanes, send, view
from warp_splat.runtime.sums import in_pairs
from warp_splat.runtime.timers import adjoint_of, stage

KEPT = 4  # pictures, by size and lens, whose rays are kept


def put_behind(
    image: torch.Tensor, alpha: torch.Tensor, harmonics: torch.Tensor, camera: Camera | CameraParameters
) -> torch.Tensor:
    """The image with the environment where it is transparent, differentiable in all but the camera.

    Args:
        image: [H, W, 3], of the Gaussians on black.
        alpha: [H, W].
        harmonics: coefficients as those of a Gaussian, [16, 3]; the color is max(0, 0.5 + their sum).
        camera: what each pixel sees; where its lens sees nothing, the image stays. Of one that learns, the lens is that
            of its base.
    """
    base, pose = (camera.base, camera.camera) if isinstance(camera, CameraParameters) else (camera, camera)
    rays, blind = _rays(base.width, base.height, base.fx, base.fy, base.cx, base.cy, base.lens, image.device)
    rays = _turned(rays, pose.shutter, base.height) if pose.shutter else rays
    if blind is not None:
        alpha = alpha.masked_fill(blind, 1.0)
    with stage("environment"):
        return _PutBehind.apply(image, alpha, harmonics, pose.rotation, rays)


@functools.lru_cache(maxsize=KEPT)
def _rays(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float, lens: Lens | None, device: torch.device
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """What the pixels of a camera see, [H * W, 3] float32 in its axes; and which see nothing, [H, W], if any."""
    x, y = (np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy
    places = np.stack(np.broadcast_arrays(x, y[:, None]), -1).reshape(-1, 2)
    rays = lens.undistorted(places) if lens else np.concatenate([places, np.ones((len(places), 1))], 1)
    blind = ~np.isfinite(rays).all(1)
    rays[blind] = (0.0, 0.0, 1.0)
    found = torch.from_numpy(rays.astype(np.float32)).to(device)
    return found, torch.from_numpy(blind.reshape(height, width)).to(device) if blind.any() else None


def _turned(rays: torch.Tensor, shutter: Shutter, height: int) -> torch.Tensor:
    """Rays of a rolling shutter's rows, from the axes of each into those of the middle."""
    shares, axis = 0.5 - (np.arange(height) + 0.5) / height, np.array(shutter.turn)[:, None]
    turns = np.stack([rotated(np.eye(3), share * axis, 1) for share in shares]).astype(np.float32)
    x, y, z = send(torch.from_numpy(turns), rays.device).mT[:, None].unbind(2)  # what each axis becomes, [H, 1, 3]
    right, down, forward = rays.view(height, -1, 3).split(1, 2)
    return (right * x + down * y + forward * z).view(-1, 3)


class _PutBehind(torch.autograd.Function):
    """See :func:`put_behind`; ``rays`` are [H * W, 3]."""

    @staticmethod
    def forward(ctx, image, alpha, harmonics, rotation, rays):
        image, alpha, harmonics = (tensor.detach().contiguous() for tensor in (image, alpha, harmonics))
        ctx.rotation = wp.mat33(*rotation.ravel())
        behind, made = torch.empty_like(image), torch.empty_like(image)
        ctx.save_for_backward(alpha, rays, behind)
        inputs = [ctx.rotation, view(harmonics.view(1, 48), vec48), rays, alpha.view(-1), image.view(-1, 3)]
        outputs, lanes = [behind.view(-1, 3), made.view(-1, 3)], driver_of(image.device).lanes
        launch_in_lanes(make_put_behind, lanes, inputs, outputs)
        return made

    @staticmethod
    @adjoint_of("environment")
    def backward(ctx, adj):
        alpha, rays, behind = ctx.saved_tensors
        adj, adj_alpha, lanes = adj.contiguous(), torch.empty_like(alpha), driver_of(alpha.device).lanes
        inputs = [ctx.rotation, rays, alpha.view(-1), behind.view(-1, 3), adj.view(-1, 3)]
        sums = launch_in_lanes(make_adj_put_behind, lanes, inputs, [adj_alpha.view(-1)], run=RUN, sums=48)
        return adj, adj_alpha, in_pairs(sums).to(adj).view(-1, 3).nan_to_num(0.0, 0.0, 0.0), None, None

"""This package's renderer in all the ways in which it can be called."""

from functools import partial

import torch
import warp as wp

from warp_splat import tape
from warp_splat.gsplat import rasterization
from warp_splat.raster.api import rasterize


def _in_mode(adjoint: str, *given):
    return rasterize(*given, adjoint=adjoint).image


manual, stepwise, reversible, stored = (
    partial(_in_mode, mode) for mode in ("manual", "stepwise", "reversible", "stored")
)


class _OnTape(torch.autograd.Function):
    """:func:`warp_splat.tape.rasterize` between torch tensors."""

    @staticmethod
    def forward(ctx, camera, *given):
        ctx.arrays = [wp.from_torch(tensor.detach().clone(), requires_grad=True) for tensor in given]
        with wp.Tape() as ctx.tape:
            ctx.out = tape.rasterize(*ctx.arrays[:5], camera, ctx.arrays[5])
        return wp.to_torch(ctx.out.image, requires_grad=False).clone()

    @staticmethod
    def backward(ctx, *upstream):
        ctx.tape.backward(grads={ctx.out.image: wp.from_torch(upstream[0].contiguous(), wp.vec3)})
        return None, *(wp.to_torch(array.grad).reshape(array.shape) for array in ctx.arrays)


def on_tape(*given):
    """Recorded on Warp's tape."""
    wp.init()
    *gaussians, camera, background = given
    return _OnTape.apply(camera, *gaussians, background)


def matrices_of(camera) -> tuple[torch.Tensor, torch.Tensor]:
    """World to camera [4, 4] and K [3, 3], float32, as gsplat and its relatives take them."""
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = torch.tensor(camera.rotation), torch.tensor(camera.translation)
    return viewmat, torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]).float()


def as_gsplat(means, quats, scales, opacities, sh, camera, background):
    """By gsplat's function."""
    viewmat, k = matrices_of(camera)
    degree, size = int(sh.shape[1] ** 0.5) - 1, (camera.width, camera.height)
    given = (means, quats, scales, opacities, sh, viewmat[None], k[None], *size)
    return rasterization(*given, sh_degree=degree, backgrounds=background[None])[0][0]

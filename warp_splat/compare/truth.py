"""Images and gradients of a workload in float64 and by the renderer, and how far they are apart."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp

from warp_splat import tape
from warp_splat.compare import oracle
from warp_splat.compare.workloads import Workload
from warp_splat.config import RasterOptions
from warp_splat.raster.api import render
from warp_splat.raster.data import Gaussians

ZERO = 1e-12  # norm of a gradient that is rounding only, as that of the rotation of a ball
PARAMETERS = ("means", "quats", "scales", "opacities", "sh", "background", "means2d")
TAPE = "tape"  # beside the modes of the adjoint: manual, on Warp's tape


@dataclass(frozen=True, eq=False)
class Truth:
    """What the oracle says at the workload's pixels; on the host, whatever computes what is compared with it."""

    image: torch.Tensor  # [P, 3]
    weights: torch.Tensor  # [P, 3] upstream gradient: random, 0 at pixels that hang on a rounding
    sure: torch.Tensor  # [P] bool, the other pixels
    gradients: dict[str, torch.Tensor]  # by parameter, float64


@dataclass(frozen=True)
class Error:
    """Distance of a gradient from the truth."""

    relative: float = float("nan")  # L2 of the difference over L2 of the truth
    largest: float = float("nan")  # of the entries of the difference, over the largest of the truth
    cosine: float = float("nan")
    bias: float = float("nan")  # mean difference over mean magnitude of the truth, signed


def for_oracle(options: RasterOptions) -> dict[str, Any]:
    """Those that change what is true, as keywords of the oracle."""
    names = ("sh_degree", "antialiasing", "projection", "alpha_min", "alpha_max", "t_min", "near", "blur")
    return {name: getattr(options, name) for name in names}


def draw_exactly(
    gaussians: Gaussians, camera: Any, background: torch.Tensor, options: RasterOptions, pixels=None
) -> oracle.Render:
    """The oracle's render, of float64."""
    return oracle.exact_render(*gaussians[:4], gaussians.sh, camera, background, **for_oracle(options), pixels=pixels)


def random_upstream(shape: torch.Size, fragile: torch.Tensor) -> torch.Tensor:
    """A random upstream gradient of an image, float32; 0 at the pixels that hang on a rounding."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(1)).masked_fill(fragile[..., None], 0.0)


def compute_truth(workload: Workload) -> Truth:
    """Float64 image and gradients at the workload's pixels."""
    given = (*workload.gaussians, workload.background)
    *leaves, background = (tensor.double().cpu().clone().requires_grad_() for tensor in given)
    out = draw_exactly(Gaussians(*leaves), workload.camera, background, workload.options, workload.pixels)
    weights = random_upstream(out.image.shape, out.fragile)
    found = torch.autograd.grad((out.image * weights).sum(), [*leaves, background, out.means2d])
    return Truth(out.image.detach(), weights, ~out.fragile, _by_parameter(found))


def _by_parameter(gradients: Sequence[torch.Tensor]) -> dict[str, torch.Tensor]:
    """Of a workload's Gaussians, the background and the 2D means; on the host."""
    *geometry, sh_dc, sh_rest, background, means2d = (gradient.cpu() for gradient in gradients)
    return dict(zip(PARAMETERS, (*geometry, torch.cat([sh_dc, sh_rest], 1), background, means2d), strict=True))


def gradients_of(workload: Workload, truth: Truth, adjoint: str) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """The renderer's image [P, 3] at the workload's pixels, and its gradients for the truth's upstream gradient.

    All on the host. :data:`TAPE` tells nothing of the 2D means.
    """
    rows, columns = workload.pixels.T
    upstream = workload.background.new_zeros(workload.camera.height, workload.camera.width, 3)
    upstream[rows, columns] = truth.weights.to(upstream)
    if adjoint == TAPE:
        image, found = differentiate_on_tape(workload, upstream)
        return image[rows, columns].cpu(), {name: grad.cpu() for name, grad in found.items()}
    *leaves, background = (tensor.clone().requires_grad_() for tensor in (*workload.gaussians, workload.background))
    out = render(Gaussians(*leaves), workload.camera, background, workload.options, adjoint)
    found = torch.autograd.grad(out.image, [*leaves, background, out.means2d], upstream)
    return out.image.detach()[rows, columns].cpu(), _by_parameter(found)


def run_passes(workload: Workload, adjoint: str) -> None:
    """A forward and a backward pass over the whole image, to be timed."""
    upstream = workload.background.new_ones(workload.camera.height, workload.camera.width, 3)
    if adjoint == TAPE:
        differentiate_on_tape(workload, upstream)
        return
    leaves = Gaussians(*(tensor.clone().requires_grad_() for tensor in workload.gaussians))
    render(leaves, workload.camera, workload.background, workload.options, adjoint).image.backward(upstream)


def differentiate_on_tape(workload: Workload, upstream: torch.Tensor) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """The image [H, W, 3], and the gradients by parameter for the upstream gradient [H, W, 3]."""
    given = dict(zip(PARAMETERS, (*workload.gaussians[:4], workload.gaussians.sh, workload.background), strict=False))
    arrays = {name: wp.from_torch(tensor.clone(), requires_grad=True) for name, tensor in given.items()}
    with wp.Tape() as recorded:
        out = tape.rasterize(**arrays, camera=workload.camera, options=workload.options)
    recorded.backward(grads={out.image: wp.from_torch(upstream, wp.vec3)})
    return wp.to_torch(out.image, requires_grad=False), {name: wp.to_torch(arrays[name].grad) for name in arrays}


def errors_of(found: dict[str, torch.Tensor], truth: Truth) -> dict[str, Error]:
    """The error of each gradient that was found."""
    return {name: error_of(found[name], exact) for name, exact in truth.gradients.items() if name in found}


def error_of(found: torch.Tensor, exact: torch.Tensor) -> Error:
    """How far ``found`` is from ``exact``; NaN where the truth is zero but for rounding."""
    found, exact = found.double().flatten(), exact.flatten()
    if exact.norm() < ZERO:
        return Error()
    difference = found - exact
    return Error(
        relative=float(difference.norm() / exact.norm()),
        largest=float(difference.abs().max() / exact.abs().max()),
        cosine=float(found @ exact / (found.norm() * exact.norm()).clamp_min(ZERO)),
        bias=float(difference.mean() / exact.abs().mean()),
    )

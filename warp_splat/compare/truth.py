"""Images and gradients of a workload in float64, and how far others are from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from warp_splat.compare import oracle
from warp_splat.compare.workloads import Workload
from warp_splat.config import RasterOptions
from warp_splat.raster.api import render
from warp_splat.raster.data import Gaussians

ZERO = 1e-12  # norm of a gradient that is rounding only, as that of the rotation of a ball
PARAMETERS = ("means", "quats", "scales", "opacities", "sh", "background", "means2d")


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

    relative: float  # L2 of the difference over L2 of the truth
    largest: float  # of the entries of the difference, over the largest of the truth
    cosine: float
    bias: float  # mean difference over mean magnitude of the truth, signed


def for_oracle(options: RasterOptions) -> dict[str, Any]:
    """Those that change what is true, as keywords of the oracle."""
    names = ("sh_degree", "antialiasing", "projection", "alpha_min", "alpha_max", "t_min", "near", "blur")
    return {name: getattr(options, name) for name in names}


def compute_truth(workload: Workload) -> Truth:
    """Float64 image and gradients at the workload's pixels."""
    options = workload.options
    means, quats, scales, opacities, sh_dc, sh_rest = (tensor.double().cpu() for tensor in workload.gaussians)
    leaves = [means, quats, scales, opacities, torch.cat([sh_dc, sh_rest], 1), workload.background.double().cpu()]
    leaves = [leaf.clone().requires_grad_() for leaf in leaves]
    out = oracle.exact_render(*leaves[:5], workload.camera, leaves[5], **for_oracle(options), pixels=workload.pixels)
    weights = torch.randn(out.image.shape, generator=torch.Generator().manual_seed(1))
    weights[out.fragile] = 0.0
    out.means2d.retain_grad()
    (out.image * weights).sum().backward()
    gradients = [leaf.grad for leaf in leaves] + [out.means2d.grad]
    return Truth(out.image.detach(), weights, ~out.fragile, dict(zip(PARAMETERS, gradients, strict=True)))


def gradients_of(
    workload: Workload, truth: Truth, adjoint: str, options: RasterOptions
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """The renderer's image [P, 3] at the workload's pixels, and its gradients for the truth's upstream gradient.

    All on the host.
    """
    leaves = Gaussians(*(tensor.clone().requires_grad_() for tensor in workload.gaussians))
    background = workload.background.clone().requires_grad_()
    out = render(leaves, workload.camera, background, options, adjoint)
    out.means2d.retain_grad()
    rows, columns = workload.pixels.T
    seen = out.image[rows, columns]
    (seen * truth.weights.to(seen.device)).sum().backward()
    found = Gaussians(*(leaf.grad for leaf in leaves))
    sh = torch.cat([found.sh_dc, found.sh_rest], 1)
    gradients = [found.means, found.quats, found.scales, found.opacities, sh, background.grad, out.means2d.grad]
    return seen.detach().cpu(), {name: grad.cpu() for name, grad in zip(PARAMETERS, gradients, strict=True)}


def errors_of(found: dict[str, torch.Tensor], truth: Truth) -> dict[str, Error]:
    """The error of each gradient that was found."""
    return {name: error_of(found[name], exact) for name, exact in truth.gradients.items() if name in found}


def error_of(found: torch.Tensor, exact: torch.Tensor) -> Error:
    """How far ``found`` is from ``exact``; NaN where the truth is zero but for rounding."""
    found, exact = found.double().flatten(), exact.flatten()
    if exact.norm() < ZERO:
        return Error(*[float("nan")] * 4)
    difference = found - exact
    return Error(
        relative=float(difference.norm() / exact.norm()),
        largest=float(difference.abs().max() / exact.abs().max()),
        cosine=float(found @ exact / (found.norm() * exact.norm()).clamp_min(ZERO)),
        bias=float(difference.mean() / exact.abs().mean()),
    )

"""The blend and its adjoint on a GPU; see ``lanes``, which offers the same two functions for the CPU."""

from __future__ import annotations

import torch

from warp_splat.binning import Bins
from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.errors import InputError

MISSING = "device cuda: this version has no blend for GPUs; move the tensors with .cpu(), or use --device cpu."


def blend_blocks(
    bins: Bins, camera: Camera, background: torch.Tensor, options: RasterOptions, keep: bool
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, tuple[torch.Tensor, ...]]:
    """See :func:`warp_splat.lanes.blend_lanes`."""
    raise InputError(MISSING)


def adjoint_of_blocks(
    mode: str, bins: Bins, options: RasterOptions, background, saved, adj_image, adj_alpha, adj_depth
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """See :func:`warp_splat.lanes.adjoint_of_lanes`."""
    raise InputError(MISSING)

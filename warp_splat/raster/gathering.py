"""Sums of each Gaussian's slots, the rows of gradients of its tile instances.

Always in the same order and without atomics: the same bits for any number of threads.
"""

from itertools import accumulate

import torch
import warp as wp

from warp_splat.kernels.cpu import gather as of_lanes
from warp_splat.kernels.cuda import gather as of_warps
from warp_splat.kernels.cuda.gather import GradientsView
from warp_splat.kernels.cuda.warps import WARP
from warp_splat.raster.data import Bins
from warp_splat.runtime.launch import launch, launch_blocks, pack_struct, view


def gather_by_splat(bins: Bins, slots: torch.Tensor, grads: list[torch.Tensor] | None = None) -> list[torch.Tensor]:
    """On the CPU: zero where culled, written into ``grads`` [N, width] each, column after column.

    Without, gradients of means2d, conics, opacities, colors and depths. Splats come in the order of the Gaussians.
    Tried:

    - 36 instead of 23 ms at 1M Gaussians: torch's ``embedding_bag``, some thousands at a time, their columns by numpy
    - 2 x the time: a kernel that does not ask for memory before
    """
    grads, width = grads or bins.new_gradients(slots), slots.shape[1]
    columns = [grad.data_ptr() + 4 * column for grad in grads for column in range(grad.shape[1])][:width]
    addresses, widths = torch.tensor(columns), tuple(grad.shape[1] for grad in grads)
    kernel = of_lanes.make_gather(widths if sum(widths) == width else widths[:-1])
    inputs = [bins.gaussian_count, bins.gaussians, view(bins.place_begins, wp.int32), view(bins.places, wp.int32)]
    inputs += [view(slots, wp.types.vector(length=width, dtype=float)), 0.0]
    launch(kernel, len(bins.place_begins) + 1, inputs, [view(addresses, wp.uint64)])
    return [grad.squeeze(1) for grad in grads]


def gather_by_warp(bins: Bins, slots: torch.Tensor, grads: list[torch.Tensor] | None = None) -> list[torch.Tensor]:
    """:func:`gather_by_splat` on a GPU, where splats are all Gaussians, nearest first."""
    grads = grads or bins.new_gradients(slots)
    ends = accumulate(grad.shape[1] for grad in grads)
    tables = [grad for grad, end in zip(grads, ends, strict=True) if end <= slots.shape[1]]  # no depths, maybe
    filled = [*tables, *[slots.new_empty(0, 0)] * (len(GradientsView.vars) - len(tables))]
    tables_out = pack_struct(GradientsView, **dict(zip(GradientsView.vars, filled, strict=True)))
    inputs = [bins.gaussians, view(bins.place_begins, wp.int32), view(bins.places, wp.int32), view(slots, wp.float32)]
    kernel, warps = of_warps.make_gather(tuple(table.shape[1] for table in tables)), -(-len(bins.gaussians) // WARP)
    launch_blocks(kernel, warps, inputs, [tables_out], slots.device)
    return [grad.squeeze(1) for grad in grads]

"""The adjoint of the pixel loop in one of its modes: from upstream gradients per pixel to a row per tile instance.

The modes share the forward kernel, the tile lists, the upstream gradients in blocks, the rows and their summation; they
differ in the kernel between them alone. Two exceptions: ``stored`` has a forward kernel that writes every T, and
``generated`` (for the comparison) reads a copy of the Gaussian per tile instance.
"""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from warp_splat.binning import Bins
from warp_splat.config import RasterOptions
from warp_splat.errors import InputError
from warp_splat.kernels.adjoint_lanes import make_reverse
from warp_splat.kernels.blend import LN_2, Splat2D
from warp_splat.kernels.blend_lanes import BLOCKS
from warp_splat.kernels.lanes import LANES, vec16
from warp_splat.kernels.taped_lanes import make_walk
from warp_splat.launch import available_memory, launch, view

SPLATS = 3  # place of the Gaussians in the list


def list_inputs(bins: Bins, options: RasterOptions) -> list:
    """What every blend kernel reads first."""
    ranges, instances = view(bins.ranges, wp.vec2i), view(bins.instances, wp.vec2i)
    return [bins.tiles_x, ranges, instances, bins.splats, options.alpha_min]


def memory_for_states(bins: Bins) -> torch.Tensor:
    """Room for the T of every tile instance at every pixel of its tile, [M, BLOCKS, LANES]: 1 KiB per instance.

    Raises:
        InputError: if that does not fit.
    """
    count = len(bins.instances)
    needed, available = 4 * BLOCKS * LANES * count, available_memory(bins.instances.device)
    if needed > 0.8 * available:
        raise InputError(
            f"adjoint 'stored': the transmittances of {count} tile instances take {needed / 2**30:.1f} GiB, but only "
            f"{available / 2**30:.1f} GiB are free; use 'reversible', which needs none, or a smaller image."
        )
    return torch.empty(count, BLOCKS, LANES, device=bins.instances.device)


def adjoint_of_blend(mode: str, bins: Bins, options: RasterOptions, states: list[torch.Tensor], steps, slots) -> None:
    """Fill ``slots`` [M, 9 or 10]; ``states`` are final, count, kept, up and adj_final (see ``blend_lanes``)."""
    final, count, kept, up, adj_final = (view(state, vec16) for state in states)
    steps, rows = view(steps, wp.int32), view(slots, wp.float32)
    lists, tile_count = list_inputs(bins, options), len(bins.ranges)
    variant = options.depth, options.exp_degree
    if mode in ("manual", "stepwise"):
        inputs = [*lists, final, count, steps, up, adj_final]
        launch(make_reverse(mode, *variant), tile_count, inputs, [rows], bounds=bins.slices)
        return
    walk, inputs = make_walk(mode, *variant), [final, count, kept, steps, rows]
    outputs = [up, adj_final]  # what the kernel would write; its adjoint reads their gradients and writes ``rows``
    adjoint = {"adj_inputs": [None] * (len(lists) + len(inputs)), "adj_outputs": outputs}
    if mode != "generated":
        launch(walk, tile_count, [*lists, *inputs], outputs, bounds=bins.slices, **adjoint)
        return
    lists[SPLATS] = wp.array(bins.splats.numpy()[bins.instances.numpy()[:, 0]], dtype=Splat2D, device="cpu")
    adj_splats = wp.zeros(len(bins.instances), dtype=Splat2D, device="cpu")
    adjoint["adj_inputs"][SPLATS] = adj_splats
    launch(walk, tile_count, [*lists, *inputs], outputs, bounds=bins.slices, **adjoint)
    found = _rows(adj_splats.numpy(), lists[SPLATS].numpy(), slots.shape[1])
    slots[bins.instances[:, 1].long()] = torch.from_numpy(found)


def _rows(adj: np.ndarray, splats: np.ndarray, width: int) -> np.ndarray:
    """Rows [M, width] of gradients of Splat2D: mean, conic, opacity, color, depth."""
    root, adj_root = splats["root"], adj["root"]
    yy = adj_root[:, 2] / root[:, 2]
    xy = (adj_root[:, 1] - root[:, 1] * yy) / root[:, 0]
    xx = (adj_root[:, 0] - root[:, 1] * xy) / root[:, 0]
    conic = np.stack([0.25 * xx, 0.5 * xy, 0.25 * yy], 1) / LN_2
    return np.concatenate([adj["mean"], conic, adj["opacity"][:, None], adj["color"], adj["depth"][:, None]], 1)[
        :, :width
    ]

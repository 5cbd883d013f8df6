"""The adjoint of the pixel loop in one of its modes: from upstream gradients per pixel to those of the 2D Gaussians.

The modes share the forward kernel, the tile lists, the upstream gradients in blocks, the rows and their summation; they
differ in the kernel between them alone. Two exceptions: ``stored`` has a forward kernel that writes every T, and
``generated`` (for the comparison) reads a copy of the Gaussian per tile instance.
"""

from __future__ import annotations

import numpy as np
import torch
import warp as wp
from torch.nn.functional import embedding_bag

from warp_splat.config import T_LEAST, RasterOptions
from warp_splat.errors import InputError
from warp_splat.kernels.cpu.adjoint import make_reverse
from warp_splat.kernels.cpu.blend import BLOCKS
from warp_splat.kernels.cpu.taped import make_walk, rows_of_copies
from warp_splat.kernels.lanes import LANES, vec16
from warp_splat.kernels.splat import Splat2D
from warp_splat.raster.bin import MAX_INSTANCES, Bins
from warp_splat.runtime.launch import available_memory, empty, in_slices, launch, view

SPLATS = 3  # place of the Gaussians in the list
#: Gaussians whose slots a thread sums at a time: the sums of all have no place in a heap in use, and fresh pages for
#: them cost 15 to 50 ms at 1M Gaussians.
AT_ONCE = 2**15
WIDTHS = [2, 3, 1, 3, 1]  # of a slot: means2d, conics, opacities, colors, and depths where they are asked for


def list_inputs(bins: Bins, options: RasterOptions) -> list:
    """What every blend kernel reads first."""
    ranges, instances = view(bins.ranges, wp.vec2i), view(bins.instances, wp.int32)
    return [bins.tiles_x, ranges, instances, bins.splats, options.alpha_min]


def stop_inputs(options: RasterOptions) -> list:
    """Where a pixel stops: its least transmittance, and the entries of the list that it looks at."""
    steps = MAX_INSTANCES if options.max_steps is None else min(options.max_steps, MAX_INSTANCES)
    return [max(options.t_min, T_LEAST), steps]


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
    return torch.empty(count, BLOCKS, LANES, dtype=torch.float32, device=bins.instances.device)


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
    copies, adj_copies = (empty(len(bins.instances), Splat2D, "cpu") for _ in range(2))
    copies.assign(bins.splats.numpy()[bins.instances.numpy()])
    adj_copies.zero_()
    lists[SPLATS], adjoint["adj_inputs"][SPLATS] = copies, adj_copies
    launch(walk, tile_count, [*lists, *inputs], outputs, bounds=bins.slices, **adjoint)
    launch(rows_of_copies, len(bins.instances), [copies, adj_copies], [rows])


def gather(bins: Bins, slots: torch.Tensor, gaussian_count: int) -> list[torch.Tensor]:
    """Gradients of means2d, conics, opacities, colors and depths: sums of each Gaussian's slots, zero where culled.

    Always in the same order and without atomics: the same bits for any number of threads. (Tried: a Warp kernel that
    loops over each Gaussian's slots: 11 ms instead of 6 for 540,000 slots, since torch prefetches them.)
    """
    widths = WIDTHS if slots.shape[1] == sum(WIDTHS) else WIDTHS[:-1]
    grads = [slots.new_empty(gaussian_count, width) for width in widths]
    if not bins.slices:  # lists of a GPU: all splats, nearest first
        gaussians, rows = wp.to_torch(bins.gaussians), embedding_bag(bins.places, slots, bins.place_begins, mode="sum")
        for grad, columns in zip(grads, rows.split(widths, 1), strict=True):
            grad[gaussians] = columns
    else:
        _gather_in_pieces(bins, slots, grads)
    if len(widths) < len(WIDTHS):
        grads.append(slots.new_zeros(gaussian_count, 1))
    return [grad.squeeze(1) for grad in grads]


def _gather_in_pieces(bins: Bins, slots: torch.Tensor, grads: list[torch.Tensor]) -> None:
    """Fill ``grads`` from lists of the CPU, whose splats come in the order of the Gaussians.

    Column by column and by numpy: half of the time that torch takes to copy or to scatter short rows.
    """
    gaussians, count = bins.gaussians.numpy(), len(grads[0])
    begins = np.append(bins.place_begins.numpy(), np.int32(len(slots)))
    columns = [column for grad in grads for column in grad.numpy().T]

    def run(low: int, high: int) -> None:
        first, last = np.searchsorted(gaussians, np.array([low, high], dtype=np.int32))
        if first == last:
            for column in columns:
                column[low:high] = 0.0
            return
        # those that are not drawn have no slots: theirs begin where the next one's do
        repeats = np.diff(gaussians[first:last], prepend=low - 1, append=high - 1)
        places = bins.places[begins[first] : begins[last]]
        bags = torch.from_numpy(np.repeat(begins[first : last + 1] - begins[first], repeats))
        rows = embedding_bag(places, slots, bags, mode="sum").numpy()
        for column, sums in zip(columns, rows.T, strict=True):
            column[low:high] = sums

    in_slices(run, [*range(0, count, AT_ONCE), count] if torch.get_num_threads() == 1 else [0, count])

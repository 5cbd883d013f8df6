"""The blend and its adjoint on a GPU: a block of threads per tile; as ``raster/cpu.py`` describes."""

from __future__ import annotations

from itertools import accumulate

import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.config import TILE, RasterOptions
from warp_splat.kernels.cuda.adjoint import make_reverse_block, make_upstream_block
from warp_splat.kernels.cuda.blend import make_blend_block
from warp_splat.kernels.cuda.gather import GradientsView, make_gather
from warp_splat.kernels.cuda.taped import make_walk_block
from warp_splat.kernels.cuda.warps import WARP
from warp_splat.kernels.structs import BinsView
from warp_splat.raster.bin import room_for_states
from warp_splat.raster.data import Bins, Pixels, Walk, alphas_of, limits_of, variant_of
from warp_splat.runtime.launch import launch_blocks, pack_struct, view

THREADS = TILE * TILE


def blend(
    bins: Bins, camera: Camera, background: torch.Tensor, options: RasterOptions, keep: bool
) -> tuple[Pixels, tuple[torch.Tensor, ...]]:
    """See :func:`warp_splat.raster.cpu.blend`."""
    tile_count, new = len(bins.ranges), background.new_empty
    pixels = Pixels.empty(camera, options, background)
    final, count = new(tile_count, THREADS), new(tile_count, THREADS, dtype=torch.int32)
    kept = room_for_states(bins) if keep else new(0, THREADS)
    launch_blocks(
        make_blend_block(variant_of(options, keep)),
        tile_count,
        [bins.view(), alphas_of(options), *limits_of(options), _float(background)],
        [pixels.view(), _float(final), view(count, wp.int32), _float(kept)],
        background.device,
    )
    return pixels, (final, count, kept)


def adjoint(
    mode: str, bins: Bins, options: RasterOptions, background: torch.Tensor, saved, adj_pixels: Pixels
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """See :func:`warp_splat.raster.cpu.adjoint`."""
    final, count, kept = saved
    device, tile_count, slots = background.device, len(bins.ranges), bins.new_slots(options)
    (up, adj_final), adj_background, dropped, steps = spread_upstream(
        bins, options, background, final, count, adj_pixels, slots
    )
    inputs = [bins.view(), alphas_of(options), _float(final), view(count, wp.int32)]
    upstream, steps, rows = [view(up, wp.vec4), _float(adj_final)], view(steps, wp.int32), _float(slots)
    if mode in ("manual", "stepwise"):
        kernel = make_reverse_block(mode, variant_of(options))
        launch_blocks(kernel, tile_count, [*inputs, steps, *upstream], [rows], device)
    else:
        walk, inputs = make_walk_block(mode, variant_of(options)), [*inputs, _float(kept), steps, rows]
        adjoint = {"adj_inputs": [BinsView(), *[None] * (len(inputs) - 1)], "adj_outputs": upstream}
        launch_blocks(walk, tile_count, inputs, upstream, device, **adjoint)
    return slots, adj_background.sum(0), dropped


def spread_upstream(bins: Bins, options: RasterOptions, background, final, count, adj_pixels: Pixels, slots) -> tuple:
    """(Upstream gradients by thread, dL/dT behind), dL/dbackground, dropped and steps of each tile; zeros in ``slots``.

    The zeros are for the instances that the adjoint does not walk.
    """
    tile_count, new = len(bins.ranges), background.new_empty
    up, adj_final, adj_background = new(tile_count, THREADS, 4), torch.empty_like(final), new(tile_count, 3)
    dropped, steps = (new(tile_count, dtype=torch.int32) for _ in range(2))
    outputs = [view(up, wp.vec4), _float(adj_final), _float(adj_background)]
    launch_blocks(
        make_upstream_block(variant_of(options)),
        tile_count,
        [bins.view(), _float(background), _float(final), view(count, wp.int32), adj_pixels.view()],
        [*outputs, view(dropped, wp.int32), view(steps, wp.int32), _float(slots)],
        background.device,
    )
    return (up, adj_final), adj_background, dropped, steps


def gather(bins: Bins, slots: torch.Tensor, grads: list[torch.Tensor] | None = None) -> list[torch.Tensor]:
    """See :func:`warp_splat.raster.cpu.gather`; splats are all Gaussians, nearest first."""
    grads = grads or bins.new_gradients(slots)
    ends = accumulate(grad.shape[1] for grad in grads)
    tables = [grad for grad, end in zip(grads, ends, strict=True) if end <= slots.shape[1]]  # no depths, maybe
    filled = [*tables, *[slots.new_empty(0, 0)] * (len(GradientsView.vars) - len(tables))]
    tables_out = pack_struct(GradientsView, **dict(zip(GradientsView.vars, filled, strict=True)))
    inputs = [bins.gaussians, view(bins.place_begins, wp.int32), view(bins.places, wp.int32), _float(slots)]
    kernel, warps = make_gather(tuple(table.shape[1] for table in tables)), -(-len(bins.gaussians) // WARP)
    launch_blocks(kernel, warps, inputs, [tables_out], slots.device)
    return [grad.squeeze(1) for grad in grads]


def launch_tiles(kernel: wp.Kernel, bins: Bins, inputs: list, outputs: list) -> None:
    """See :func:`warp_splat.raster.cpu.launch_tiles`; a block takes one."""
    launch_blocks(kernel, len(bins.ranges), inputs, outputs, bins.instances.device)


def view_walk(walk: Walk) -> list:
    """See :func:`warp_splat.raster.cpu.view_walk`."""
    return [_float(walk.final), view(walk.count, wp.int32)]


def _float(tensor: torch.Tensor):
    return view(tensor, wp.float32)

"""The blend and its adjoint on a GPU: a block of threads per tile; see ``lanes``, which offers the same for the CPU."""

from __future__ import annotations

import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.config import TILE, RasterOptions
from warp_splat.kernels.cuda.adjoint import make_reverse_block, make_upstream_block
from warp_splat.kernels.cuda.blend import make_blend_block
from warp_splat.kernels.cuda.taped import make_walk_block
from warp_splat.raster.adjoints import list_inputs, memory_for_states, stop_inputs
from warp_splat.raster.bin import Bins
from warp_splat.runtime.launch import launch_blocks, view

THREADS = TILE * TILE


def blend_blocks(
    bins: Bins, camera: Camera, background: torch.Tensor, options: RasterOptions, keep: bool
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, tuple[torch.Tensor, ...]]:
    """See :func:`warp_splat.raster.cpu.blend_lanes`."""
    height, width, tile_count, new = camera.height, camera.width, len(bins.ranges), background.new_empty
    image, alpha = new(height, width, 3), new(height, width)
    depth = new(height, width) if options.depth else new(0, 0)
    final, count = new(tile_count, THREADS), new(tile_count, THREADS, dtype=torch.int32)
    kept = memory_for_states(bins).view(-1, THREADS) if keep else new(0, THREADS)
    launch_blocks(
        make_blend_block(options.depth, options.exp_degree, keep),
        tile_count,
        [*list_inputs(bins, options), *stop_inputs(options), _float(background)],
        [*map(_float, (image, alpha, depth, final)), view(count, wp.int32), _float(kept)],
        background.device,
    )
    return image, alpha, depth, (final, count, kept)


def adjoint_of_blocks(
    mode: str, bins: Bins, options: RasterOptions, background: torch.Tensor, saved, adj_image, adj_alpha, adj_depth
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """See :func:`warp_splat.raster.cpu.adjoint_of_lanes`."""
    final, count, kept = saved
    device, tile_count = background.device, len(bins.ranges)
    slots = background.new_empty(len(bins.instances), 10 if options.depth else 9)
    up, adj_final, adj_background, dropped, steps = spread_upstream(
        bins, options, background, final, count, (adj_image, adj_alpha, adj_depth), slots
    )
    lists, states = list_inputs(bins, options), [_float(final), view(count, wp.int32)]
    upstream = [view(up, wp.vec4), _float(adj_final)]
    if mode in ("manual", "stepwise"):
        inputs = [*lists, *states, view(steps, wp.int32), *upstream]
        launch_blocks(
            make_reverse_block(mode, options.depth, options.exp_degree), tile_count, inputs, [_float(slots)], device
        )
    else:
        walk, inputs = make_walk_block(mode, options.depth, options.exp_degree), [*lists, *states, _float(kept)]
        inputs += [view(steps, wp.int32), _float(slots)]
        adjoint = {"adj_inputs": [None] * len(inputs), "adj_outputs": upstream}
        launch_blocks(walk, tile_count, inputs, upstream, device, **adjoint)
    return slots, adj_background.sum(0), dropped


def spread_upstream(
    bins: Bins, options: RasterOptions, background, final, count, adj_pixels, slots
) -> tuple[torch.Tensor, ...]:
    """Upstream gradients by tile and thread, what is known of a tile at once, and zeros in ``slots`` never walked."""
    tile_count, new = len(bins.ranges), background.new_empty
    up, adj_final, adj_background = new(tile_count, THREADS, 4), torch.empty_like(final), new(tile_count, 3)
    dropped, steps = (new(tile_count, dtype=torch.int32) for _ in range(2))
    inputs = [_float(background), _float(final), view(count, wp.int32), *map(_float, adj_pixels)]
    outputs = [view(up, wp.vec4), *map(_float, (adj_final, adj_background))]
    launch_blocks(
        make_upstream_block(options.depth),
        tile_count,
        [*list_inputs(bins, options)[:2], *inputs],
        [*outputs, view(dropped, wp.int32), view(steps, wp.int32), _float(slots)],
        background.device,
    )
    return up, adj_final, adj_background, dropped, steps


def _float(tensor: torch.Tensor):
    return view(tensor, wp.float32)

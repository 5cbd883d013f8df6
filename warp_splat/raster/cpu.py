"""The blend and its adjoint on the CPU: the kernels of ``blend_lanes`` and those that follow from it, and their memory.

``blocks`` offers the same two functions for a GPU.
"""

from __future__ import annotations

import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.kernels.cpu.blend import BLOCKS, make_blend, make_upstream
from warp_splat.kernels.lanes import LANES, vec16
from warp_splat.raster.adjoints import adjoint_of_blend, list_inputs, memory_for_states, stop_inputs
from warp_splat.raster.bin import Bins
from warp_splat.runtime.launch import launch, view


def blend_lanes(
    bins: Bins, camera: Camera, background: torch.Tensor, options: RasterOptions, keep: bool
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, tuple[torch.Tensor, ...]]:
    """Image [H, W, 3], alpha [H, W], depth [H, W] (or nothing, if not asked for), and what the adjoint reads.

    Args:
        bins: which Gaussians each tile lists.
        camera: its size is the image's.
        background: [3].
        options: what to compute.
        keep: store every transmittance, for the adjoint "stored".
    """
    height, width, new = camera.height, camera.width, background.new_empty
    image, alpha = new(height, width, 3), new(height, width)
    depth = new(height, width) if options.depth else new(0, 0)
    tile_count = len(bins.ranges)
    final, count = new(tile_count, BLOCKS, LANES), new(tile_count, BLOCKS, LANES)
    kept = memory_for_states(bins) if keep else new(0, 0, LANES)
    launch(
        make_blend(options.depth, options.exp_degree, keep),
        tile_count,
        [*list_inputs(bins, options), *stop_inputs(options), view(background, wp.float32)],
        [*_pixel_views(image, alpha, depth), *(view(lanes, vec16) for lanes in (final, count, kept))],
        bounds=bins.slices,
    )
    return image, alpha, depth, (final, count, kept)


def adjoint_of_lanes(
    mode: str, bins: Bins, options: RasterOptions, background, saved, adj_image, adj_alpha, adj_depth
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Gradients of the slots [M, 9 or 10] and of the background [3], and the number of pixels dropped in each tile.

    Args:
        mode: one of ADJOINTS.
        bins: as in the forward pass, like the next two.
        options: what was computed.
        background: [3].
        saved: what :func:`blend_lanes` returned last.
        adj_image: upstream gradient, like the next two; dense.
        adj_alpha: [H, W].
        adj_depth: [H, W], or nothing.
    """
    final, count, kept = saved
    slots = background.new_empty(len(bins.instances), 10 if options.depth else 9)
    adj_pixels = (adj_image, adj_alpha, adj_depth)
    up, adj_final, adj_background, bad, steps = _spread_upstream(
        bins, options, background, final, count, adj_pixels, slots
    )
    adjoint_of_blend(mode, bins, options, [final, count, kept, up, adj_final], steps, slots)
    return slots, torch.from_numpy(adj_background.numpy().sum(0)), bad


def _pixel_views(image: torch.Tensor, alpha: torch.Tensor, depth: torch.Tensor) -> list:
    return [view(tensor, wp.float32) for tensor in (image, alpha, depth)]


def _spread_upstream(
    bins: Bins, options: RasterOptions, background, final, count, adj_pixels, slots
) -> tuple[torch.Tensor, ...]:
    tile_count, new = len(bins.ranges), background.new_empty
    up = new(tile_count, BLOCKS * (4 if options.depth else 3), LANES)
    adj_final, adj_background = torch.empty_like(final), new(tile_count, 3)
    bad, steps = (new(tile_count, dtype=torch.int32) for _ in range(2))
    lists, row = [bins.tiles_x, view(bins.ranges, wp.vec2i)], wp.types.vector(length=slots.shape[1], dtype=float)
    launch(
        make_upstream(options.depth),
        tile_count,
        [*lists, view(background, wp.float32), view(final, vec16), view(count, vec16), *_pixel_views(*adj_pixels)],
        [
            *(view(up, vec16), view(adj_final, vec16), view(adj_background, wp.float32)),
            *(view(bad, wp.int32), view(steps, wp.int32), view(slots, row)),
        ],
        bounds=bins.slices,
    )
    return up, adj_final, adj_background, bad, steps

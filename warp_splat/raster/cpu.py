"""The blend and its adjoint on the CPU, in lanes of sixteen pixels; those on a GPU are in ``raster/cuda.py``.

The modes share the forward kernel, the tile lists, the upstream gradients in blocks, the rows and their summation; they
differ in the kernel between them alone. Two exceptions: ``stored`` has a forward kernel that writes every T, and
``generated`` (for the comparison) reads a copy of the Gaussian per tile instance.
"""

from __future__ import annotations

import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.kernels.cpu.adjoint import make_reverse
from warp_splat.kernels.cpu.blend import BLOCKS, make_blend, make_upstream
from warp_splat.kernels.cpu.gather import make_gather
from warp_splat.kernels.cpu.taped import make_walk, rows_of_copies
from warp_splat.kernels.simd import LANES, vec16
from warp_splat.kernels.splat import Splat2D
from warp_splat.kernels.structs import BinsView
from warp_splat.raster.bin import room_for_states
from warp_splat.raster.data import Bins, Pixels, Walk, alphas_of, limits_of, variant_of
from warp_splat.runtime.launch import empty, launch, view


def blend(
    bins: Bins, camera: Camera, background: torch.Tensor, options: RasterOptions, keep: bool
) -> tuple[Pixels, tuple[torch.Tensor, ...]]:
    """The pixels, and what the adjoint reads.

    Args:
        bins: the splats, and which of them each tile lists.
        camera: its size is the image's.
        background: [3].
        options: what to compute.
        keep: store every transmittance, for the adjoint "stored".
    """
    tile_count, new = len(bins.ranges), background.new_empty
    pixels = Pixels.empty(camera, options, background)
    final, count = new(tile_count, BLOCKS, LANES), new(tile_count, BLOCKS, LANES)
    kept = room_for_states(bins).view(-1, BLOCKS, LANES) if keep else new(0, 0, LANES)
    launch(
        make_blend(variant_of(options, keep)),
        tile_count,
        [bins.view(), alphas_of(options), *limits_of(options), view(background, wp.float32)],
        [pixels.view(), *_in_lanes(final, count, kept)],
        bounds=bins.slices,
    )
    return pixels, (final, count, kept)


def adjoint(
    mode: str, bins: Bins, options: RasterOptions, background: torch.Tensor, saved, adj_pixels: Pixels
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Gradients of the slots [M, 9 or 10] and of the background [3], and the number of pixels dropped in each tile.

    Args:
        mode: one of ADJOINTS.
        bins: as in the forward pass, like the next two.
        options: what was computed.
        background: [3].
        saved: what :func:`blend` returned last.
        adj_pixels: upstream gradients; dense.
    """
    slots, (final, count, _) = bins.new_slots(options), saved
    upstream, adj_background, dropped, steps = _spread_upstream(
        bins, options, background, final, count, adj_pixels, slots
    )
    differentiate(mode, bins, options, _in_lanes(*saved), _in_lanes(*upstream), steps, slots)
    return slots, torch.from_numpy(adj_background.numpy().sum(0)), dropped


def _spread_upstream(bins: Bins, options: RasterOptions, background, final, count, adj_pixels: Pixels, slots) -> tuple:
    """(Upstream gradients in blocks, dL/dT behind), dL/dbackground, dropped and steps of each tile; zeros in ``slots``.

    The zeros are for the instances that the adjoint does not walk.
    """
    tile_count, new = len(bins.ranges), background.new_empty
    up = new(tile_count, BLOCKS * variant_of(options).channels, LANES)
    adj_final, adj_background = torch.empty_like(final), new(tile_count, 3)
    dropped, steps = (new(tile_count, dtype=torch.int32) for _ in range(2))
    slot = wp.types.vector(length=slots.shape[1], dtype=float)
    launch(
        make_upstream(variant_of(options)),
        tile_count,
        [bins.view(), view(background, wp.float32), *_in_lanes(final, count), adj_pixels.view()],
        [
            *(*_in_lanes(up, adj_final), view(adj_background, wp.float32)),
            *(view(dropped, wp.int32), view(steps, wp.int32), view(slots, slot)),
        ],
        bounds=bins.slices,
    )
    return (up, adj_final), adj_background, dropped, steps


def differentiate(mode: str, bins: Bins, options: RasterOptions, saved, upstream, steps, slots) -> None:
    """Fill ``slots`` [M, 9 or 10]; ``saved`` and ``upstream`` as the kernels take them, ``steps`` [T]."""
    tile_count, alphas = len(bins.ranges), alphas_of(options)
    (final, count, kept), steps, rows = saved, view(steps, wp.int32), view(slots, wp.float32)
    if mode in ("manual", "stepwise"):
        inputs = [bins.view(), alphas, final, count, steps, *upstream]
        launch(make_reverse(mode, variant_of(options)), tile_count, inputs, [rows], bounds=bins.slices)
        return
    lists, inputs = bins.view(), [alphas, final, count, kept, steps, rows]
    if mode == "generated":
        copies, copies.grad = (empty(len(bins.instances), Splat2D, "cpu") for _ in range(2))
        copies.assign(bins.splats.numpy()[bins.instances.numpy()])
        copies.grad.zero_()
        lists.splats = copies
    # ``upstream`` is what the kernel would write: its adjoint reads the gradients of that and writes ``rows``
    adjoint = {"adj_inputs": [BinsView(), *[None] * len(inputs)], "adj_outputs": upstream}
    walk = make_walk(mode, variant_of(options))
    launch(walk, tile_count, [lists, *inputs], upstream, bounds=bins.slices, **adjoint)
    if mode == "generated":
        launch(rows_of_copies, len(bins.instances), [lists.splats, lists.splats.grad], [rows])


def gather(bins: Bins, slots: torch.Tensor, grads: list[torch.Tensor] | None = None) -> list[torch.Tensor]:
    """Sums of each Gaussian's slots, zero where culled, written into ``grads`` [N, width] each, column after column.

    Without, gradients of means2d, conics, opacities, colors and depths.

    Always in the same order and without atomics: the same bits for any number of threads. Splats come in the order of
    the Gaussians. Tried:

    - 36 instead of 23 ms at 1M Gaussians: torch's ``embedding_bag``, some thousands at a time, their columns by numpy
    - 2 x the time: a kernel that does not ask for memory before
    """
    grads, width = grads or bins.new_gradients(slots), slots.shape[1]
    columns = [grad.data_ptr() + 4 * column for grad in grads for column in range(grad.shape[1])][:width]
    addresses, widths = torch.tensor(columns), tuple(grad.shape[1] for grad in grads)
    kernel = make_gather(widths if sum(widths) == width else widths[:-1])
    inputs = [bins.gaussian_count, bins.gaussians, view(bins.place_begins, wp.int32), view(bins.places, wp.int32)]
    inputs += [view(slots, wp.types.vector(length=width, dtype=float)), 0.0]
    launch(kernel, len(bins.place_begins) + 1, inputs, [view(addresses, wp.uint64)])
    return [grad.squeeze(1) for grad in grads]


def launch_tiles(kernel: wp.Kernel, bins: Bins, inputs: list, outputs: list) -> None:
    """Launch a kernel that takes a tile."""
    launch(kernel, len(bins.ranges), inputs, outputs, bounds=bins.slices)


def view_walk(walk: Walk) -> list:
    """Final transmittances and counts, as kernels take them."""
    return _in_lanes(walk.final, walk.count)


def _in_lanes(*tensors: torch.Tensor) -> list:
    return [view(tensor, vec16) for tensor in tensors]

"""How a device renders: a driver for each, chosen once per render. The only place that asks which device it is.

On a CPU, kernels take sixteen pixels of a tile at once (lanes), on a GPU a block of threads has one each. What is
launched, and in which order, is the same. The modes share the forward kernel, the tile lists, the upstream gradients,
the rows and their summation; they differ in the kernel between them alone. Two exceptions: ``stored`` has a forward
kernel that writes every T, and ``generated`` (for the comparison) reads a copy of the Gaussian per tile instance.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import accumulate
from types import ModuleType

import numpy as np
import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.config import TILE, RasterOptions
from warp_splat.kernels import cpu, cuda
from warp_splat.kernels.cuda.warps import WARP
from warp_splat.kernels.simd import LANES
from warp_splat.kernels.splat import Splat2D
from warp_splat.kernels.structs import BinsView
from warp_splat.kernels.tiles import count_in_front
from warp_splat.raster import bin
from warp_splat.raster.data import Bins, Pixels, Saved, alphas_of, limits_of, variant_of
from warp_splat.runtime.launch import bind, check_memory, empty, launch, launch_blocks, load, pack_struct
from warp_splat.runtime.pool import falling_slices, slice_by_slice

THREADS = TILE * TILE


@dataclass(eq=False)
class Driver:
    """What one device does otherwise than another, and what all do alike with it."""

    lanes: int  # Gaussians, or pixels, that a kernel takes at once
    peeks: bool  # whether to look at a result between two kernels: on a GPU the host would have to wait for it
    bin: Callable[..., Bins]
    gather: Callable[..., list[torch.Tensor]]
    launch_tiles: Callable[..., None]  # of bins: (kernel, inputs, outputs, maybe its adjoint's), then the next
    kernels: ModuleType  # the package of those that take a tile: modules and makers have the same names in both
    shape: tuple[int, ...]  # of a number for each pixel of a tile, as its kernels have it
    counts: torch.dtype  # of a number of instances there
    upstream: Callable[[int], tuple[int, ...]]  # shape of the upstream gradients there, by the number of channels

    def blend(
        self, bins: Bins, camera: Camera, background: torch.Tensor, options: RasterOptions, keep: bool
    ) -> tuple[Pixels, Saved]:
        """The pixels, and what the adjoint reads.

        Args:
            bins: the splats, and which of them each tile lists.
            camera: its size is the image's.
            background: [3].
            options: what to compute.
            keep: store every transmittance, for the adjoint "stored".
        """
        tile_count, new, shape = len(bins.ranges), background.new_empty, self.shape
        size = camera.height, camera.width
        pixels = Pixels(new(*size, 3), new(*size), new(*size) if options.depth else new(0, 0))
        final, count = new(tile_count, *shape), new(tile_count, *shape, dtype=self.counts)
        blocks = new(len(bins.instances) if self.lanes > 1 else 0, dtype=torch.int32)
        saved = Saved(final, count, blocks, _room_for_states(bins).view(-1, *shape) if keep else new(0, *shape))
        limits = new(0 if options.hidden_from is None else tile_count, *shape)
        if options.hidden_from is not None:
            inputs, outputs = [bins.view(), options.hidden_from.resolve_neg(), self.lanes], [limits.view(-1, THREADS)]
            launch(count_in_front, tile_count, inputs, outputs, bounds=bins.slices, device=background.device)
        variant = variant_of(options, keep, options.bound, options.hidden_from is not None)
        inputs = [bins.view(blocks=blocks), alphas_of(options), *limits_of(options), background, bins.bound, limits]
        outputs = [pixels.view(), final, count, saved.kept]
        self.launch_tiles(bins, (self.kernels.blend.make_blend(variant), inputs, outputs))
        return pixels, saved

    def adjoint(
        self, mode: str, bins: Bins, options: RasterOptions, background: torch.Tensor, saved: Saved, adj_pixels: Pixels
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Gradients of the slots [M, 9 or 10] and of the background [3], and the number of pixels dropped in each tile.

        Args:
            mode: one of ADJOINTS.
            bins: as in the forward pass, like the next two.
            options: what was computed.
            background: [3].
            saved: what :meth:`blend` returned last.
            adj_pixels: upstream gradients; dense.
        """
        slots = background.new_empty(len(bins.instances), variant_of(options).columns)  # a row per tile instance
        up, behind, dropped, steps, before = self.spread_upstream(bins, options, background, saved, adj_pixels, slots)
        self.differentiate(mode, bins, options, saved, up, steps, slots, before)
        if self.peeks:  # numpy's sum is one after another, whatever the number of torch's threads
            return slots, torch.from_numpy(behind.numpy().sum(0)), dropped
        return slots, behind.sum(0), dropped

    def spread_upstream(
        self, bins: Bins, options: RasterOptions, background, saved: Saved, adj_pixels: Pixels, slots: torch.Tensor
    ) -> tuple:
        """(Upstream gradients by pixel, dL/dT behind), dL/dbackground, dropped and steps of each tile; what finds them.

        That writes zeros into ``slots`` as well, for the instances that the adjoint does not walk.
        """
        tile_count, new = len(bins.ranges), background.new_empty
        variant = variant_of(options)
        up = new(tile_count, *self.upstream(variant.channels))
        adj_final, adj_background = torch.empty_like(saved.final), new(tile_count, 3)
        dropped, steps = (new(tile_count, dtype=torch.int32) for _ in range(2))
        inputs = [bins.view(), background, saved.final, saved.count, adj_pixels.view()]
        outputs = [up, adj_final, adj_background, dropped, steps, slots]
        before = self.kernels.adjoint.make_upstream(variant), inputs, outputs
        return (up, adj_final), adj_background, dropped, steps, before

    def differentiate(
        self, mode: str, bins: Bins, options: RasterOptions, saved: Saved, upstream, steps, slots: torch.Tensor, before
    ) -> None:
        """Fill ``slots`` [M, 9 or 10]; ``upstream`` and ``steps`` [T] are those that ``before`` finds."""
        lists, variant = bins.view(blocks=saved.blocks), variant_of(options)
        if mode in ("manual", "stepwise"):
            inputs = [lists, alphas_of(options), saved.final, saved.count, steps, *upstream]
            self.launch_tiles(bins, before, (self.kernels.adjoint.make_reverse(mode, variant), inputs, [slots]))
            return
        inputs = [alphas_of(options), saved.final, saved.count, saved.kept, steps, slots]
        if mode == "generated":
            copies, copies.grad = (empty(len(bins.instances), Splat2D, "cpu") for _ in range(2))
            copies.assign(bins.splats.numpy()[bins.instances.numpy()])
            copies.grad.zero_()
            lists.splats = copies
        # ``upstream`` is what the kernel would write: its adjoint reads the gradients of that and writes ``slots``
        adjoint = {"adj_inputs": [BinsView(), *[None] * len(inputs)], "adj_outputs": upstream}
        walk = self.kernels.taped.make_walk(mode, variant)
        self.launch_tiles(bins, before, (walk, [lists, *inputs], upstream, adjoint))
        if mode == "generated":
            launch(cpu.taped.rows_of_copies, len(bins.instances), [lists.splats, lists.splats.grad], [slots])


def _room_for_states(bins: Bins) -> torch.Tensor:
    """Room for the T of every tile instance at every pixel of its tile, [M, TILE TILE]: 1 KiB per instance.

    Raises:
        InputError: if that does not fit.
    """
    count, device = len(bins.instances), bins.instances.device
    what = f"adjoint 'stored': the transmittances of {count} tile instances take"
    check_memory(what, 4 * TILE * TILE * count, device, "use 'reversible', which needs none, or a smaller image", 0.8)
    return torch.empty(count, TILE * TILE, dtype=torch.float32, device=device)


def _launch_slices(bins: Bins, *launches: tuple) -> None:
    """Each kernel on a slice of the tiles, then on the next: threads wait for each other once."""
    passes = [bind(kernel, inputs, outputs, "cpu", **dict(*more)) for kernel, inputs, outputs, *more in launches]
    slice_by_slice(passes, bins.slices)


def _launch_blocks(bins: Bins, *launches: tuple) -> None:
    for kernel, inputs, outputs, *more in launches:
        launch_blocks(kernel, len(bins.ranges), inputs, outputs, bins.instances.device, **dict(*more))


def gather_by_splat(bins: Bins, slots: torch.Tensor, grads: list[torch.Tensor] | None = None) -> list[torch.Tensor]:
    """Sums of each Gaussian's slots, the rows of gradients of its tile instances, on the CPU; zero where culled.

    Always in the same order and without atomics: the same bits for any number of threads. Written into ``grads``
    [N, width] each, column after column. Without, gradients of means2d, conics, opacities, colors and depths. Splats
    come in the order of the Gaussians. Tried:

    - 36 instead of 23 ms at 1M Gaussians: torch's ``embedding_bag``, some thousands at a time, their columns by numpy
    - 2 x the time: a kernel that does not ask for memory before
    """
    grads, width = grads or bins.new_gradients(slots), slots.shape[1]
    columns = [grad.data_ptr() + 4 * column for grad in grads for column in range(grad.shape[1])][:width]
    addresses, widths = np.array(columns, np.int64), tuple(grad.shape[1] for grad in grads)
    kernel = cpu.gather.make_gather(widths if sum(widths) == width else widths[:-1])
    inputs = [bins.gaussian_count, bins.gaussians, bins.place_begins, bins.places, slots, 0.0]
    count = len(bins.place_begins) + 1
    launch(kernel, count, inputs, [addresses], bounds=falling_slices(count))
    return [grad.squeeze(1) for grad in grads]


def gather_by_warp(bins: Bins, slots: torch.Tensor, grads: list[torch.Tensor] | None = None) -> list[torch.Tensor]:
    """:func:`gather_by_splat` on a GPU, where splats are all Gaussians, nearest first."""
    grads, views = grads or bins.new_gradients(slots), cuda.gather.GradientsView
    ends = accumulate(grad.shape[1] for grad in grads)
    tables = [grad for grad, end in zip(grads, ends, strict=True) if end <= slots.shape[1]]  # no depths, maybe
    filled = [*tables, *[slots.new_empty(0, 0)] * (len(views.vars) - len(tables))]
    tables_out = pack_struct(views, **dict(zip(views.vars, filled, strict=True)))
    inputs = [bins.gaussians, bins.place_begins, bins.places, slots]
    kernel = cuda.gather.make_gather(tuple(table.shape[1] for table in tables))
    launch_blocks(kernel, -(-len(bins.gaussians) // WARP), inputs, [tables_out], slots.device)
    return [grad.squeeze(1) for grad in grads]


CPU = Driver(
    *(LANES, True, bin.bin_by_counting, gather_by_splat, _launch_slices, cpu),
    *((cpu.blend.BLOCKS, LANES), torch.float32, lambda channels: (cpu.blend.BLOCKS * channels, LANES)),
)
CUDA = Driver(
    *(1, False, bin.bin_by_sorting, gather_by_warp, _launch_blocks, cuda),
    *((THREADS,), torch.int32, lambda _channels: (THREADS, 4)),
)
#: By torch's name of the device.
DRIVERS = {"cpu": CPU, "cuda": CUDA}


def driver_of(device: torch.device) -> Driver:
    """The driver of ``device``."""
    return DRIVERS[device.type]


def load_in_lanes(device: torch.device, *makes: Callable[[int], wp.Kernel]) -> None:
    """Compile and load what :func:`.launch_in_lanes` launches, for many rows at once and for those left over."""
    load(device, *(make(lanes) for make in makes for lanes in {driver_of(device).lanes, 1}))

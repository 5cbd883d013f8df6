"""How a device renders: a driver for each, chosen once per render. The only place that asks which device it is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.kernels.cpu import channels as lanes
from warp_splat.kernels.cpu import strongest as lanes_strongest
from warp_splat.kernels.cuda import channels as blocks
from warp_splat.kernels.cuda import strongest as blocks_strongest
from warp_splat.kernels.simd import LANES
from warp_splat.kernels.splat import BlendVariant
from warp_splat.raster import bin, cpu, cuda
from warp_splat.raster.data import Bins, Pixels, Walk


class ChannelKernels(NamedTuple):
    """What blends any number of channels, beside the color."""

    at_once: int  # channels of a group
    blend: Callable[[BlendVariant], wp.Kernel]
    adjoint: Callable[..., wp.Kernel]
    strongest: Callable[[BlendVariant, int], wp.Kernel]


Saved = tuple[torch.Tensor, ...]  # what a driver's blend leaves for its adjoint


@dataclass(frozen=True)
class Driver:
    """What one device does otherwise than another; the functions are described where the CPU's are."""

    lanes: int  # Gaussians, or pixels, that a kernel takes at once
    peeks: bool  # whether to look at a result between two kernels: on a GPU the host would have to wait for it
    bin: Callable[..., Bins]
    blend: Callable[[Bins, Camera, torch.Tensor, RasterOptions, bool], tuple[Pixels, Saved]]
    adjoint: Callable[[str, Bins, RasterOptions, torch.Tensor, Saved, Pixels], tuple[torch.Tensor, ...]]
    gather: Callable[..., list[torch.Tensor]]
    channels: ChannelKernels
    launch_tiles: Callable[[wp.Kernel, Bins, list, list], None]
    view_walk: Callable[[Walk], list]


CPU = Driver(
    *(LANES, True, bin.bin_by_counting, cpu.blend, cpu.adjoint, cpu.gather),
    ChannelKernels(lanes.AT_ONCE, lanes.make_blend_channels, lanes.make_adj_channels, lanes_strongest.make_strongest),
    *(cpu.launch_tiles, cpu.view_walk),
)
CUDA = Driver(
    *(1, False, bin.bin_by_sorting, cuda.blend, cuda.adjoint, cuda.gather),
    ChannelKernels(
        blocks.AT_ONCE, blocks.make_blend_channels, blocks.make_adj_channels, blocks_strongest.make_strongest
    ),
    *(cuda.launch_tiles, cuda.view_walk),
)
#: By torch's name of the device.
DRIVERS = {"cpu": CPU, "cuda": CUDA}


def driver_of(device: torch.device) -> Driver:
    """The driver of ``device``."""
    return DRIVERS[device.type]


@contextmanager
def using(driver: Driver) -> Iterator[None]:
    """Render on the CPU by ``driver``, for tests and dry runs; a GPU's kernels then run in slow fibers."""
    before = DRIVERS["cpu"], wp.config.enable_cpu_blocks
    DRIVERS["cpu"], wp.config.enable_cpu_blocks = driver, True
    try:
        yield
    finally:
        DRIVERS["cpu"], wp.config.enable_cpu_blocks = before

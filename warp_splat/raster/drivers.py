"""How a device renders: a driver for each, chosen once per render. The only place that asks which device it is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.kernels.simd import LANES
from warp_splat.raster import bin, cpu, cuda
from warp_splat.raster.data import Bins, Pixels, Splats2D

Saved = tuple[torch.Tensor, ...]  # what a driver's blend leaves for its adjoint


@dataclass(frozen=True)
class Driver:
    """What one device does otherwise than another; the functions are described where the CPU's are."""

    lanes: int  # Gaussians, or pixels, that a kernel takes at once
    peeks: bool  # whether to look at a result between two kernels: on a GPU the host would have to wait for it
    bin: Callable[[Splats2D, Camera, RasterOptions], Bins]
    blend: Callable[[Bins, Camera, torch.Tensor, RasterOptions, bool], tuple[Pixels, Saved]]
    adjoint: Callable[[str, Bins, RasterOptions, torch.Tensor, Saved, Pixels], tuple[torch.Tensor, ...]]
    gather: Callable[[Bins, torch.Tensor], list[torch.Tensor]]


CPU = Driver(LANES, True, bin.bin_by_counting, cpu.blend, cpu.adjoint, cpu.gather)
CUDA = Driver(1, False, bin.bin_by_sorting, cuda.blend, cuda.adjoint, cuda.gather)
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

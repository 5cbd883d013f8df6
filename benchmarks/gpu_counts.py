"""For ``gpu_model.py``: what there is to do in a training step on a GPU, counted without one.

Of a step: launches of Warp, operations of torch, and how often the host waits for a number. The real trainer takes it
by the driver of a GPU, in fibers. Of a scene: what the blends walk, by the CPU's lists.
"""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from unittest import mock

import numpy as np
import torch
import warp as wp
from common import using
from made_up import VIEWS, make_trainer, steps_of
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from work import count

from warp_splat import runtime
from warp_splat.camera import Camera
from warp_splat.config import ALPHA_MIN, TILE, RasterOptions
from warp_splat.gaussians import GaussianModel
from warp_splat.kernels.compiler import FORWARD_ONLY
from warp_splat.kernels.cuda.blend import EACH
from warp_splat.kernels.cuda.warps import PIXELS, blocks_of
from warp_splat.kernels.falloff import LOG2_E, reach_of
from warp_splat.kernels.splat import exponent
from warp_splat.kernels.structs import BinsView
from warp_splat.raster.data import Gaussians
from warp_splat.raster.drivers import CPU, CUDA
from warp_splat.raster.project import project
from warp_splat.runtime import timers
from warp_splat.runtime.launch import launch, view
from warp_splat.runtime.pool import get_threads, set_threads

LAUNCHES, OPERATIONS, WAITS = range(3)  # of an array of counts
REST = "between stages"
COUNTED = (300, 64, 48)  # Gaussians, width, height: the counts do not depend on them
WARPS = 8  # of a tile, two lines of sixteen pixels each, where a thread has one

#: Operations that look at memory in another way, or name it: no launch.
NO_LAUNCH = re.compile(
    r"aten\.(view|slice|select|unsqueeze|permute|transpose|detach|alias|split|unbind|as_strided|squeeze|expand|empty"
    r"|new_empty|_unsafe_view|t|lift|resize_|reshape|_reshape_alias|is_pinned|set_)(_|\.)"
)
#: Operations that need a number on the host; so does an index by a mask.
WAIT = re.compile(r"aten\.(_local_scalar_dense|item|nonzero|masked_select|equal|_?unique)(_|\.|\d)")


class Operations(TorchDispatchMode):
    """Adds every operation of torch to ``counts``."""

    def __init__(self, counts: np.ndarray):
        super().__init__()
        self.counts = counts

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        found, name = func(*args, **(kwargs or {})), str(func)
        indices = args[1] if name.startswith("aten.index") and len(args) > 1 else ()
        masked = any(isinstance(index, torch.Tensor) and index.dtype == torch.bool for index in tree_leaves(indices))
        empty = isinstance(found, torch.Tensor) and found.numel() == 0
        if WAIT.match(name) or masked:
            self.counts[WAITS] += 1
        elif not NO_LAUNCH.match(name) and not empty:  # on no numbers torch launches nothing
            self.counts[OPERATIONS] += 1
        return found


def count_step(**options) -> dict[str, np.ndarray]:
    """By stage, a step of training in which the set does not change, with these options of the trainer.

    The stages' clock tells of what was counted instead of the time.
    """
    threads, counts = get_threads(), np.zeros(3)
    try:
        set_threads(1)
        with using(CUDA), counted_launches(counts), mock.patch.object(timers, "_now", counts.copy):
            step = steps_of(make_trainer(*COUNTED, "cpu", **options))
            for _ in range(VIEWS):  # whose photographs are then at hand
                step()
            counts[:] = 0
            with timers.profile() as stages, Operations(counts):
                step()
    finally:
        set_threads(threads)
    found = {name: np.asarray(value) for name, value in stages.items()}
    return {**found, REST: counts - sum(found.values())}


@contextmanager
def counted_launches(counts: np.ndarray) -> Iterator[None]:
    def counting(function: Callable) -> Callable:
        def run(*args, **kwargs):
            counts[LAUNCHES] += 1
            return function(*args, **kwargs)

        return run

    with (
        mock.patch.object(runtime.launch, "_bound", counting(runtime.launch._bound)),
        mock.patch.object(wp, "launch_tiled", counting(wp.launch_tiled)),
    ):
        yield


@wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
def count_walked(
    first: int,
    bins: BinsView,
    stops: wp.array2d[float],  # [T, TILE TILE] instances walked before a pixel stopped, line by line
    alpha_min: float,
    # out
    found_out: wp.array2d[wp.int64],  # [T, 4] instances walked, blocks of 8 x 4 and halves touched, warps that blend
):
    tile = first + wp.tid()
    start = bins.ranges[tile][0]
    left = float((tile % bins.tiles_x) * TILE) + 0.5
    top = float((tile // bins.tiles_x) * TILE) + 0.5
    steps = float(0.0)
    for pixel in range(TILE * TILE):
        steps = wp.max(steps, stops[tile, pixel])
    touched = int(0)
    halves = int(0)
    blending = int(0)
    for step in range(int(steps)):
        splat = bins.splats[bins.instances[start + step]]
        reach = reach_of(splat.opacity, alpha_min)
        blocks = blocks_of(splat, 0.5 * LOG2_E * reach, left, top)
        for block in range(PIXELS):
            touched += (blocks >> block) & 1
        for half in range(PIXELS // EACH):
            if ((blocks >> (half * EACH)) & ((1 << EACH) - 1)) != 0:
                halves += 1
        for warp in range(WARPS):
            hit = int(0)
            for pixel in range(32):
                place = warp * 32 + pixel
                dx = splat.mean[0] - left - float(place % TILE)
                dy = splat.mean[1] - top - float(place // TILE)
                z = exponent(dx, dy, splat.root[0], splat.root[1], splat.root[2])
                if z <= 0.5 * LOG2_E * reach and float(step) < stops[tile, place]:
                    hit = 1
            blending += hit
    found_out[tile, 0] = wp.int64(steps)
    found_out[tile, 1] = wp.int64(touched)
    found_out[tile, 2] = wp.int64(halves)
    found_out[tile, 3] = wp.int64(blending)


@dataclass(frozen=True)
class Scene:
    """A view of a scene."""

    gaussians: int
    drawn: int  # Gaussians
    pixels: int
    tiles: int
    instances: int  # Gaussians in tiles
    walked: int  # of them, before every pixel of the tile has stopped
    blocks: int  # of 8 x 4 pixels that these touch, eight in a tile
    halves: int  # of a tile that they touch
    warps: int  # of 16 x 2 pixels in which one blends it, eight in a tile
    pairs: int  # Gaussians in pixels, blended
    by_tile: np.ndarray  # [T, 3] of the above: walked, blocks, halves


def count_scene(model: GaussianModel, camera: Camera) -> Scene:
    """By the CPU's kernels."""
    options = RasterOptions()
    with torch.no_grad():
        gaussians = Gaussians(*(tensor.detach() for tensor in model.activated()))
        bins = CPU.bin(project(gaussians, camera, options), camera, options)
        _, (_, stopped, *_) = CPU.blend(bins, camera, torch.zeros(3), options, False)
        stops = in_lines(stopped)
        found = torch.empty(len(bins.ranges), 4, dtype=torch.int64)
        launch(count_walked, len(found), [bins.view(), view(stops, wp.float32), ALPHA_MIN], [view(found, wp.int64)])
    work, (walked, blocks, halves, warps) = count(gaussians, camera, options), found.sum(0).tolist()
    return Scene(
        *(len(gaussians.means), len(bins.gaussians), camera.width * camera.height, len(bins.ranges)),
        *(len(bins.instances), walked, blocks, halves, warps, int(work.pairs), found[:, :3].numpy()),
    )


def in_lines(blocks: torch.Tensor) -> torch.Tensor:
    """[T, 256] of pixels line by line, from the CPU's blocks of 4 x 4."""
    count = len(blocks)
    return blocks.view(count, 4, 4, 4, 4).permute(0, 1, 3, 2, 4).reshape(count, TILE * TILE).contiguous()

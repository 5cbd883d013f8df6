"""How much pictures change with their Gaussians: measured, and with a bound that holds in real arithmetic."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from warp_splat.camera import Camera
from warp_splat.config import ConvertConfig, RasterOptions
from warp_splat.formats.convert import convert
from warp_splat.formats.exchange import load_gaussians
from warp_splat.gaussians import GaussianModel
from warp_splat.raster.api import render
from warp_splat.raster.data import Gaussians
from warp_splat.rendering.camera_paths import ORBIT_LENS, orbit_cameras
from warp_splat.rendering.finished import Finished
from warp_splat.runtime import launch

AROUND, DISTANCE = 4, 2.5  # cameras around a model; from its middle, times what holds three quarters of its Gaussians


@torch.no_grad()
def largest_change(
    before: Gaussians, after: Gaussians, cameras: Sequence[Camera], background: torch.Tensor, options: RasterOptions
) -> tuple[float, float]:
    """The largest difference of any channel of any pixel, as measured, and a bound of it without rounding or stop.

    Raises:
        InputError: if the background is of harmonics.
    """
    options, measured, bound = replace(options, bound=True, of="trained"), 0.0, 0.0
    for camera in cameras:
        old, new = (render(gaussians, camera, background, options) for gaussians in (before, after))
        assert old.bound is not None and new.bound is not None
        change = (old.image - new.image).abs().amax(2)
        measured, bound = max(measured, float(change.max())), max(bound, float((change + old.bound + new.bound).max()))
    return measured, bound


def convert_and_compare(config: ConvertConfig) -> int:
    """Convert as ``config`` says, and with ``--bound`` compare pictures; returns the process's exit code.

    Raises:
        InputError: as :func:`convert`.
    """
    code = convert(config)
    if config.bound:
        launch.prepare("cpu", 0)
        finished = Finished(config.source, crop=config.crop)
        splats = (finished.file.splats, load_gaussians(config.target).splats)
        means = np.asarray(splats[0].means if len(splats[0].means) else [[0, 0, 0]], np.float64)
        middle = np.median(means, axis=0)
        reach = np.quantile(np.linalg.norm(means - middle, axis=1), 0.75)
        radius = DISTANCE * reach + 1e-6 * (1 + np.abs(middle).max())
        start, up = middle - [0.0, 0.0, radius], np.array([0.0, -1.0, 0.0])
        cameras = orbit_cameras(
            middle, up, start, AROUND, ORBIT_LENS.resized(ORBIT_LENS.width // 3, ORBIT_LENS.height // 3)
        )
        with torch.no_grad():
            before, after = (GaussianModel.from_splats(some).arranged().activated() for some in splats)
        measured, bound = largest_change(before, after, cameras, torch.zeros(3), finished.options)
        print(f"  largest change of a pixel, {AROUND} places around: {measured:.2g} measured, {bound:.2g} its bound")
    return code

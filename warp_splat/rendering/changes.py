"""From one format of Gaussians to another, and what that cost: in numbers, and how much pictures change.

Both are measured by reading the new file again; of pictures there is a bound, too, that holds in real arithmetic.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from warp_splat.camera import Camera
from warp_splat.config import ConvertConfig, RasterOptions
from warp_splat.formats.exchange import format_of, load_gaussians, save_gaussians
from warp_splat.formats.model_folder import check_output
from warp_splat.formats.splats import COEFFICIENTS, SplatArrays
from warp_splat.formats.stored import LOG_SCALES, SH_C0, sigmoid, unit_quats
from warp_splat.gaussians import GaussianModel
from warp_splat.raster.api import render
from warp_splat.raster.data import Gaussians
from warp_splat.rendering.camera_paths import ORBIT_LENS, orbit_cameras
from warp_splat.rendering.finished import Finished
from warp_splat.runtime import launch
from warp_splat.text import upward

ROUNDING = 1e-6  # smaller changes, as a share of a Gaussian's own size, are those of float32
AROUND, DISTANCE = 4, 2.5  # cameras around a model; from its middle, times what holds three quarters of its Gaussians


def convert(config: ConvertConfig) -> int:
    """Convert as ``config`` says, with ``--bound`` compare pictures; returns the process's exit code.

    Raises:
        InputError: if a name has an unknown ending, the source cannot be read, or the target cannot be written.
    """
    format_of(config.target)  # before anything is read
    finished = Finished(config.source, crop=config.crop)
    check_output(Path(config.target), config.source)
    notes: list[str] = []
    before = save_gaussians(config.target, finished.placed(), notes.append).splats
    after = load_gaussians(config.target).splats
    print(f"{config.target}: {len(after.means)} Gaussians, SH degree {COEFFICIENTS.index(after.sh.shape[1])}")
    notes = losses(before, after) + notes + finished.beyond_files
    print(f"  lost: {'; '.join(notes)}" if notes else "  nothing lost but rounding of float32")
    if config.bound and len(before.means):
        _compare(before, after, finished.options)
    return 0


def _compare(before: SplatArrays, after: SplatArrays, options: RasterOptions) -> None:
    """Tell how much pictures of two sets of Gaussians differ, of which the first has some."""
    launch.prepare("cpu", 0)
    means = before.means.astype(np.float64)
    middle = np.median(means, axis=0)
    size = np.exp(np.median(np.clip(before.scales.max(1), *LOG_SCALES)))  # if all are at one place
    reach = max(np.quantile(np.linalg.norm(means - middle, axis=1), 0.75), size)
    radius = DISTANCE * reach + 1e-6 * (1 + np.abs(middle).max())
    options = replace(options, near=min(options.near, 0.1 * radius))  # or small models would not show
    start, up = middle - [0.0, 0.0, radius], np.array([0.0, -1.0, 0.0])
    lens = ORBIT_LENS.resized(ORBIT_LENS.width // 3, ORBIT_LENS.height // 3)
    cameras = orbit_cameras(middle, up, start, AROUND, lens)
    with torch.no_grad():
        models = [GaussianModel.from_splats(some).arranged().activated() for some in (before, after)]
    measured, bound = largest_change(*models, cameras, torch.zeros(3), options)
    print(f"  largest change of a pixel, {AROUND} places around: {measured:.2g} measured, {upward(bound)} its bound")


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


def losses(old: SplatArrays, new: SplatArrays) -> list[str]:
    """What differs, in phrases with numbers: the largest change of any Gaussian and the root mean square."""
    notes = []
    degrees = [COEFFICIENTS.index(splats.sh.shape[1]) for splats in (old, new)]
    if degrees[0] != degrees[1]:
        notes.append(f"SH degree {degrees[0]} became {degrees[1]}")
    if len(old.means) != len(new.means):
        return [*notes, f"{len(old.means) - len(new.means)} of {len(old.means)} Gaussians"]
    for name, unit, size, change in _changes(old, new):
        if (change > ROUNDING * size).any():
            notes.append(f"{name} up to {change.max():.2g}{unit} (RMS {np.sqrt(np.mean(change**2)):.2g})")
    return notes


def _changes(old: SplatArrays, new: SplatArrays) -> list[tuple[str, str, float | np.ndarray, np.ndarray]]:
    """By quantity: its name, its unit, its size (of each Gaussian, [N, 1]), and by how much each number changed."""
    shared = min(old.sh.shape[1], new.sh.shape[1])
    size = lambda array: np.abs(array).max(axis=1, keepdims=True)  # noqa: E731
    sh, others_sh = (splats.sh[:, :shared].astype(np.float64) for splats in (old, new))
    scales = [np.exp(np.clip(splats.scales.astype(np.float64), *LOG_SCALES)) for splats in (old, new)]
    quats, others = unit_quats(old.quats).astype(np.float64), unit_quats(new.quats).astype(np.float64)
    others = np.where((quats * others).sum(axis=1, keepdims=True) < 0, -others, others)
    halves = np.linalg.norm(quats - others, axis=1), np.linalg.norm(quats + others, axis=1)
    return [
        ("position", "", size(old.means), np.abs(old.means.astype(np.float64) - new.means)),
        ("scale", "", size(scales[0]), np.abs(scales[0] - scales[1])),
        ("opacity", "", 1.0, np.abs(sigmoid(old.opacities) - sigmoid(new.opacities))),
        ("color", "", 1.0, SH_C0 * np.abs(sh[:, 0] - others_sh[:, 0])),
        ("harmonics", "", 1.0, np.abs(sh[:, 1:] - others_sh[:, 1:])),
        ("rotation", " degrees", 360.0, np.degrees(4 * np.arctan2(*halves))),
    ]

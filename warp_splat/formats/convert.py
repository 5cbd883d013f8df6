"""From one format of Gaussians to another, and what that cost, measured by reading the new file again."""

import os

import numpy as np

from warp_splat.config import ConvertConfig
from warp_splat.errors import InputError
from warp_splat.formats.coordinates import read_coordinates
from warp_splat.formats.exchange import format_of, load_gaussians, save_gaussians
from warp_splat.formats.model_folder import is_file_of_gaussians, open_model, ply_path, read_environment
from warp_splat.formats.splats import COEFFICIENTS, SplatArrays, SplatFile
from warp_splat.formats.stored import LOG_SCALES, SH_C0, sigmoid, unit_quats

ROUNDING = 1e-6  # smaller changes, as a share of a Gaussian's own size, are those of float32


def convert(config: ConvertConfig) -> int:
    """Convert as ``config`` says; returns the process's exit code.

    Raises:
        InputError: if a name has an unknown ending, the source cannot be read, or the target cannot be written.
    """
    format_of(config.target)  # before anything is read
    iteration, before, trained = open_model(config.source, crop=config.crop)
    source = config.source if is_file_of_gaussians(config.source) else ply_path(config.source, iteration)
    if os.path.exists(config.target) and os.path.samefile(source, config.target):
        raise InputError(f"{config.target}: expected another file than the source; name a new one.")
    where = before.coordinates if is_file_of_gaussians(config.source) else read_coordinates(config.source)
    before = before._replace(antialiased=bool(trained["antialiasing"]), coordinates=where)
    notes: list[str] = []
    before = save_gaussians(config.target, before, notes.append)
    after = load_gaussians(config.target)
    degree = COEFFICIENTS.index(after.splats.sh.shape[1])
    print(f"{config.target}: {len(after.splats.means)} Gaussians, SH degree {degree}")
    notes = losses(before, after) + notes
    if read_environment(config.source, iteration) is not None:
        notes.append("what was learned behind the Gaussians (--parts sky), which no format has")
    print(f"  lost: {'; '.join(notes)}" if notes else "  nothing lost but rounding of float32")
    return 0


def losses(before: SplatFile, after: SplatFile) -> list[str]:
    """What differs, in phrases with numbers: the largest change of any Gaussian and the root mean square."""
    notes = []
    old, new = before.splats, after.splats
    degrees = [COEFFICIENTS.index(splats.sh.shape[1]) for splats in (old, new)]
    if degrees[0] != degrees[1]:
        notes.append(f"SH degree {degrees[0]} became {degrees[1]}")
    if before.antialiased != after.antialiased:
        notes.append("the mark that the Gaussians are antialiased")
    if before.coordinates and not after.coordinates:
        notes.append("where they are in the world (coordinates.json)")
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

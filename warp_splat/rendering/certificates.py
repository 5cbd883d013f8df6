"""Pictures of how wrong each pixel of a view may be: colors on a logarithmic scale, and floats."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import torch
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from warp_splat.camera import Camera
from warp_splat.errors import InputError
from warp_splat.formats.files import atomic_write
from warp_splat.scene.types import View

SCALE = (1e-6, 1.0)  # of the colors
DPI = 100


def write_maps(name: str, find: Callable[[Camera], torch.Tensor], views: list[View], folder: Path) -> float:
    """Write ``NAME/00000.png`` and ``NAME/00000.exr`` in ``folder`` for each of ``views``, of which ``find`` finds one.

    Returns:
        The largest number of all.

    Raises:
        InputError: if a file cannot be written.
    """
    largest = 0.0
    for index, view in enumerate(views):
        values = find(view.camera).cpu().numpy()
        (folder / name).mkdir(parents=True, exist_ok=True)
        largest = max(largest, float(values.max()))
        save_scaled(folder / name / f"{index:05d}.png", values)
        save_exr(folder / name / f"{index:05d}.exr", values)
    return largest


def save_scaled(path: Path, values: np.ndarray) -> None:
    """Positive ``values`` [H, W] as colors, with the scale beside them."""
    height, width = values.shape
    figure = Figure(figsize=(width / DPI + 1.0, height / DPI), dpi=DPI)
    axes = figure.add_axes((0.0, 0.0, width / (width + DPI), 1.0))
    axes.set_axis_off()
    shown = axes.imshow(values.clip(*SCALE), norm=LogNorm(*SCALE), cmap="turbo", aspect="auto")
    figure.colorbar(shown, cax=figure.add_axes(((width + 0.1 * DPI) / (width + DPI), 0.05, 0.2 * DPI / width, 0.9)))
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png")


def save_exr(path: Path, values: np.ndarray) -> None:
    """``values`` [H, W] as floats of 32 bits.

    Raises:
        InputError: if the file cannot be written.
    """
    spec = oiio.ImageSpec(values.shape[1], values.shape[0], 1, "float")
    output = oiio.ImageOutput.create(str(path))
    if not (output and output.open(str(path), spec) and output.write_image(values[..., None]) and output.close()):
        raise InputError(f"{path}: it cannot be written: {oiio.geterror() or output.geterror()}; name another folder.")

"""What simplify and clean begin and end with: a model and its scene opened, a file written, in numbers."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from warp_splat.errors import InputError
from warp_splat.evaluation.metrics import psnr
from warp_splat.formats.exchange import format_of, save_gaussians
from warp_splat.formats.exposures import Exposures, read_exposures
from warp_splat.formats.model_folder import is_file_of_gaussians, open_model, read_environment
from warp_splat.formats.splats import SplatArrays, SplatFile
from warp_splat.gaussians import GaussianModel
from warp_splat.pruning.score import ViewSetting
from warp_splat.raster.selftest import settle_device
from warp_splat.rendering.command import backdrop, load_trained_scene, make_picture, options_of, with_refined_cameras
from warp_splat.runtime import launch
from warp_splat.scene.types import Scene, View


class Opened(NamedTuple):
    """A model, and the scene it was trained on."""

    file: SplatFile
    trained: dict  # options of its training
    scene: Scene
    setting: ViewSetting  # of the training views
    harmonics: np.ndarray | None  # behind the Gaussians, [16, 3]
    exposures: Exposures | None  # of its photographs

    def picture(self, splats: SplatArrays) -> Callable[..., np.ndarray]:
        """A function from a camera, and whose photograph's exposure it has, to what ``splats`` look like: uint8."""
        model = GaussianModel.from_splats(splats).to(self.setting.background.device)
        options, linear = self.setting.options, self.scene.linear
        white = bool(self.trained.get("white_background"))
        return make_picture(model, white, options, linear, self.harmonics, self.exposures)

    def psnr(self, splats: SplatArrays, views: list[View]) -> float:
        """Mean PSNR [dB] of 8-bit renders."""
        picture = self.picture(splats)
        return float(np.mean([psnr(picture(view.camera, view.name), view.picture, view.mask) for view in views]))

    def quality(self, splats: SplatArrays) -> dict[str, float]:
        """PSNR [dB] of the training views and, if there are any, of those held out."""
        views = {"train": self.scene.train, "test": self.scene.test}
        return {name: self.psnr(splats, some) for name, some in views.items() if some}


def open_file(model: str, iteration: int) -> tuple[int, SplatFile, dict]:
    """As :func:`open_model`. Raises InputError if there are no Gaussians in it."""
    iteration, file, trained = open_model(model, iteration)
    if not len(file.splats.means):
        raise InputError(f"{model}: expected Gaussians to choose from, found none.")
    return iteration, file, trained


def open_finished(model: str, source_path: str, iteration: int, device: str, threads: int) -> Opened:
    """The model with its scene.

    Raises:
        InputError: if either cannot be read, or the device cannot be used.
    """
    used = settle_device(launch.prepare(device, threads), device)
    iteration, file, trained = open_file(model, iteration)
    scene = load_trained_scene(model, source_path, trained, print)
    scene = with_refined_cameras(scene, model, iteration)
    harmonics = read_environment(model, iteration)
    if harmonics is not None:
        print(f"What {model} has learned behind its Gaussians stays as it is; a file of Gaussians does not have it.")
    background = backdrop(bool(trained.get("white_background")), harmonics, used)
    setting = ViewSetting(scene.train, options_of(trained), background)
    return Opened(file, trained, scene, setting, harmonics, read_exposures(model, iteration))


def output_of(model: str, output: str, name: str) -> Path:
    """The file to write: ``output``, or one called ``name`` in the model's folder.

    Raises:
        InputError: if its ending is unknown, or it is the model itself.
    """
    source = Path(model)
    path = Path(output) if output else (source.parent if is_file_of_gaussians(source) else source) / name
    format_of(path)
    if path.exists() and source.exists() and path.samefile(source):
        raise InputError(f"{path}: expected another file than the model; name a new one with -o.")
    return path


def written_bytes(name: Path, file: SplatFile) -> int:
    """Of a file of this name, written elsewhere and removed."""
    with tempfile.TemporaryDirectory() as folder:
        save_gaussians(Path(folder) / name.name, file, lambda _: None)
        return sum(path.stat().st_size for path in Path(folder).iterdir())


def write(path: Path, before: SplatFile, splats: SplatArrays) -> None:
    """Write ``splats`` in place of those of ``before``, and print what that saved."""
    notes: list[str] = []
    after = before._replace(splats=splats)
    save_gaussians(path, after, notes.append)
    old, new = written_bytes(path, before), written_bytes(path, after)
    print(f"{path}: {len(splats.means)} of {len(before.splats.means)} Gaussians, {new / 1e6:.2f} of {old / 1e6:.2f} MB")
    if notes:
        print(f"  the format lost: {'; '.join(notes)}")


def print_quality(before: dict[str, float], after: dict[str, float]) -> None:
    """A line for each set of views."""
    for name, value in before.items():
        print(f"  {name} PSNR {value:.2f} -> {after[name]:.2f} dB ({after[name] - value:+.2f})")

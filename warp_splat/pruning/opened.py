"""What simplify and clean begin and end with: a model opened with its scene, a file written, in numbers."""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from warp_splat.camera import Camera
from warp_splat.config import CleanConfig, FinishedModel, RasterOptions, SimplifyConfig
from warp_splat.errors import InputError
from warp_splat.evaluation.metrics import psnr
from warp_splat.formats.exchange import format_of, load_gaussians, save_gaussians
from warp_splat.formats.files import save_somewhere
from warp_splat.formats.model_folder import check_output, is_file_of_gaussians
from warp_splat.formats.splats import SplatArrays, SplatFile, cropped, within
from warp_splat.formats.stored import SH_C0
from warp_splat.gaussians import GaussianModel
from warp_splat.pruning.score import ViewSetting
from warp_splat.raster.selftest import settle_device
from warp_splat.rendering.finished import Finished, make_renderer
from warp_splat.scene.types import Stored, View

COVERED = 0.9  # of a pixel's light, from which on Gaussians of a crop are what one sees there


class Opened(Finished):
    """A model with the scene it was trained on.

    Attributes:
        scene: its own.
        setting: its training views, and how they are rendered.
        shows: a function from a camera to where it sees what a crop left, [H, W] bool; None without one.

    Raises:
        InputError: if either cannot be read, or the device cannot be used.
    """

    def __init__(self, config: FinishedModel):
        used = settle_device(config.device, config.threads)
        super().__init__(config.model, config.iteration)
        require_some(self)
        self.scene = self.refined(self.load_scene(config.source_path, print))
        if (linear := self.scene.linear) != self.is_linear(self.scene):
            raise InputError(f"{self.path}: expected a scene {'not ' * linear}in linear light, as its own is (-s).")
        if found := self.scene.trained_among(self.path):
            print(f"{len(found)} photographs that are held out now, such as {found[0]}, were trained on: not used.")
            self.scene = replace(self.scene, test=[view for view in self.scene.test if view.name not in found])
        self.shows = self._crop(config.crop, used) if config.crop else None
        if self.shows:
            train, test = (list(within_sight(views, self.shows)) for views in (self.scene.train, self.scene.test))
            if not train:
                raise InputError("--crop: expected Gaussians that cover pixels of photographs, found none; enlarge it.")
            print(f"Only what the Gaussians in the box cover counts, in {len(train)} of {len(self.scene.train)} views.")
            self.scene = replace(self.scene, train=train, test=test)
        self.setting = ViewSetting(self.scene.train, self.options, self.background(used))

    def _crop(self, box: Sequence[float], device: torch.device) -> Callable[[Camera], torch.Tensor]:
        """Leave out what is not in a box; returns ``shows``. What is left may stand before the rest, or behind."""
        whole = self.file.splats
        self.file = self.file._replace(splats=cropped(whole, box))
        light = np.where(within(whole.means, box), 0.5, -0.5) / SH_C0  # 1 and 0, as coefficients
        marked = whole._replace(sh=np.repeat(light[:, None, None], 3, axis=2).astype(np.float32))
        draw = make_renderer(GaussianModel.from_splats(marked).to(device), None, self.options)
        return lambda camera: draw(camera).image[..., 0] > COVERED

    def picture_of(self, splats: SplatArrays, options: RasterOptions | None = None) -> Callable[..., np.ndarray]:
        """A function from a camera, and whose photograph's exposure it has, to what ``splats`` look like: uint8."""
        return self.picture(GaussianModel.from_splats(splats).to(self.setting.background.device), self.scene, options)

    def psnr(self, splats: SplatArrays, views: list[View], options: RasterOptions | None = None) -> float:
        """Mean PSNR [dB] of 8-bit renders, with the model's options or others; of one that is its photograph, 99 dB."""
        picture = self.picture_of(splats, options)
        return float(np.mean([min(psnr(picture(v.camera, v.name), v.picture, v.mask), 99.0) for v in views]))

    def print_quality(self, before: SplatArrays, path: Path) -> float:
        """A line for the training views and, if there are any, for those held out, of a file; the former's PSNR."""
        after, found = load_gaussians(path), []
        as_told = replace(self.options, antialiasing=after.antialiased)  # as those draw it who know the file alone
        for name, views in {"train": self.scene.train, "test": self.scene.test}.items():
            if views:
                old, new = self.psnr(before, views), self.psnr(after.splats, views, as_told)
                print(f"  {name} PSNR {old:.2f} -> {new:.2f} dB ({new - old:+.2f})")
                found.append(new)
        return found[0]


def within_sight(views: list[View], shows: Callable[[Camera], torch.Tensor]) -> Iterator[View]:
    """The views, of which only counts what Gaussians cover: photographs show what a crop left out, too."""
    for view in views:
        counts = shows(view.camera).cpu().numpy()
        if view.mask is not None:
            counts &= view.mask > 0
        if counts.any():
            read = partial(lambda view, mask: view.pixels._replace(mask=mask), view, counts.astype(np.uint8))
            yield replace(view, photograph=Stored(read, view.linear, alpha=True, mask=True))


def require_some(finished: Finished) -> None:
    """Raise InputError if there are no Gaussians in a model."""
    if not len(finished.file.splats.means):
        raise InputError(f"{finished.path}: expected Gaussians to choose from, found none.")


def output_of(config: SimplifyConfig | CleanConfig, name: str) -> Path:
    """The file to write: as ``config`` says, or one called ``name`` in the model's folder.

    Raises:
        InputError: if its ending is unknown, it is the model itself, or it could not be written.
    """
    source = Path(config.model)
    path = Path(config.output) if config.output else (source.parent if is_file_of_gaussians(source) else source) / name
    format_of(path)
    check_output(path, source, config.iteration)
    return path


def as_held(path: Path, file: SplatFile) -> SplatFile:
    """The Gaussians without harmonics, if files of this name have no room for them."""
    sh = file.splats.sh if format_of(path).harmonics else file.splats.sh[:, :1]
    return file._replace(splats=file.splats._replace(sh=sh))


def written_bytes(name: Path, file: SplatFile) -> int:
    """Of a file of this name, written elsewhere and removed."""
    with tempfile.TemporaryDirectory() as folder:
        save_gaussians(Path(folder) / name.name, file, lambda _: None)
        return sum(path.stat().st_size for path in Path(folder).iterdir())


def write(path: Path, finished: Finished, splats: SplatArrays) -> Path:
    """Write ``splats`` in place of those of a model, and print what that saved, and lost; returns where they are."""
    before, notes = finished.placed(), finished.beyond_files
    after, size = before._replace(splats=splats), ""
    saved = save_somewhere(path, lambda place: save_gaussians(place, after, notes.append))
    with suppress(InputError, OSError):  # of the folder for temporary files
        size = f", {written_bytes(path, after) / 1e6:.2f} of {written_bytes(path, before) / 1e6:.2f} MB"
    if before.splats.sh[:, splats.sh.shape[1] :].any():
        notes.append("all harmonics, for which such a file has no room")
    print(f"{saved}: {len(splats.means)} of {len(before.splats.means)} Gaussians{size}")
    if notes:
        print(f"  lost: {'; '.join(dict.fromkeys(notes))}")
    return saved

"""A finished model and how its pictures are made: what render, view, simplify and clean have in common."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from warp_splat.camera import Camera
from warp_splat.color import to_bytes
from warp_splat.config import RasterOptions
from warp_splat.errors import InputError
from warp_splat.formats.coordinates import read_coordinates
from warp_splat.formats.exposures import Exposures, read_exposures
from warp_splat.formats.model_folder import folder_of, open_model, read_environment, read_refined
from warp_splat.formats.splats import SplatFile
from warp_splat.gaussians import GaussianModel
from warp_splat.raster.api import RenderOutput, render
from warp_splat.raster.expose import expose
from warp_splat.scene import load_scene
from warp_splat.scene.decoding import photo_memory
from warp_splat.scene.types import Scene, View


class Finished:
    """A trained model, or a file of Gaussians, as far as it lies beside each other.

    Args:
        path: the folder, or the file.
        iteration: which saved model; -1: the last.
        crop: a box, to leave out what is not in it; see :func:`warp_splat.formats.splats.cropped`.

    Attributes:
        iteration: that was found; of a file, 0.
        file: the Gaussians.
        trained: options of the training; of a file alone, that every 8th view was held out.
        harmonics: what lies behind the Gaussians, [16, 3], or None.
        exposures: of the photographs, or None.

    Raises:
        InputError: if there is no such model, or it cannot be read.
    """

    def __init__(self, path: str | Path, iteration: int = -1, crop: Sequence[float] = ()):
        self.path = str(path)
        self.iteration, self.file, self.trained = open_model(path, iteration, crop)
        self.harmonics = read_environment(path, self.iteration)
        self.exposures = read_exposures(path, self.iteration)

    @property
    def options(self) -> RasterOptions:
        """How it is rendered."""
        projection = str(self.trained.get("projection", RasterOptions.projection))
        return RasterOptions(antialiasing=bool(self.trained.get("antialiasing")), projection=projection)

    def placed(self) -> SplatFile:
        """Its Gaussians, and where they are in the world. Raises InputError if ``coordinates.json`` is damaged."""
        return self.file._replace(coordinates=read_coordinates(folder_of(self.path)) or self.file.coordinates)

    @property
    def beyond_files(self) -> list[str]:
        """What its pictures owe to the training, and no file of Gaussians says."""
        owed = {
            "how photographs were exposed (--parts exposure)": bool(self.exposures),
            "what was learned behind the Gaussians (--parts sky)": self.harmonics is not None,
            "that a white background was behind them": bool(self.trained.get("white_background")),
            f"their projection ({self.options.projection})": self.options.projection != RasterOptions.projection,
        }
        return [f"{what}, which no format has" for what, owes in owed.items() if owes]

    def is_linear(self, scene: Scene | None) -> bool:
        """Whether its colors are in linear light: as its training or its file says, else as its scene's are."""
        told = self.trained.get("linear_light")
        return bool(told) if told is not None else scene is not None and scene.linear

    def background(self, device: torch.device) -> torch.Tensor:
        """What lies behind the Gaussians: a color [3]; or the harmonics [16, 3] in its place, if there are any."""
        if self.harmonics is not None:
            return torch.from_numpy(self.harmonics).to(device)
        return torch.full((3,), float(bool(self.trained.get("white_background"))), device=device)

    def renderer(self, model: GaussianModel, options: RasterOptions | None = None) -> Callable[..., RenderOutput]:
        """:func:`make_renderer` of its Gaussians, or some of them."""
        return make_renderer(model, self.background(model.device), options or self.options)

    def picture(
        self, model: GaussianModel, scene: Scene | None, options: RasterOptions | None = None
    ) -> Callable[..., np.ndarray]:
        """A function from a camera, and whose photograph's exposure it has, to the image [H, W, 3] uint8.

        ``scene``: that of the model, if it is known.
        """
        draw, linear = self.renderer(model, options), self.is_linear(scene)
        return lambda camera, name="": to_bytes(as_photographed(self.exposures, draw(camera).image, name), linear)

    def load_scene(self, source_path: str, say: Callable[[str], object]) -> Scene:
        """The scene that it was trained on, as it was loaded then.

        Args:
            source_path: where the scene is now; empty: where it was.
            say: receives what there is to say.

        Raises:
            InputError: as :func:`warp_splat.load_scene`, or if it is not known which scene that is.
        """
        trained, trained_on = self.trained, str(self.trained.get("source_path") or "")
        if not (source := source_path or trained_on):
            raise InputError(f"{self.path}: it does not say what it was trained on; name the scene with -s.")
        if trained_on and os.path.abspath(source) != os.path.abspath(trained_on):
            say(f"The scene is {source}; the model was trained on {trained_on}.")
        if not isinstance((resolution := trained.get("resolution", -1)), int):
            raise InputError(f"{self.path}: expected a whole number as resolution in cfg_args, found {resolution!r}.")
        flags = {name: bool(trained.get(name)) for name in ("white_background", "eval", "invert_masks")}
        names = {"images": str(trained.get("images", "images")), "lens": str(trained.get("lens", "undistort"))}
        names["block"], start = str(trained.get("block") or ""), str(trained.get("start_ply") or "")
        if names["block"] and start:  # its cells are those of what it started from
            names["start"] = start if os.path.exists(start) else ""
            if not names["start"]:
                say(f"Warning: {start}, which the block started from, has gone; it may have had other photographs.")
        scene = load_scene(source, **names, resolution=resolution, **flags, memory=photo_memory(), report=say)
        scene.refuse_other_frame(self.path, self.placed().coordinates)
        return scene

    def refined(self, scene: Scene) -> Scene:
        """The scene with the cameras that were learned with the Gaussians; itself, if they were not.

        Raises:
            InputError: if the scene has changed since the training.
        """
        if not (cameras := read_refined(self.path, self.iteration)):
            return scene
        train, test = ([self._refined(view, cameras) for view in views] for views in (scene.train, scene.test))
        return replace(scene, train=train, test=test)

    def _refined(self, view: View, cameras: Mapping[str, Camera]) -> View:
        """The view with its camera of ``cameras``. Raises InputError if it has none of its size."""
        camera, given = cameras.get(view.name), view.original
        if camera is None or (camera.width, camera.height) != (given.width, given.height):
            found = "none" if camera is None else f"one for {camera.width}x{camera.height} px"
            raise InputError(
                f"{self.path}: expected a refined camera for {view.name}, {given.width}x{given.height} px, found "
                f"{found}; the scene has changed since the training, name the one of then with -s."
            )
        return replace(view, camera=camera.resized(view.camera.width, view.camera.height), original=camera)


def make_renderer(
    model: GaussianModel, background: torch.Tensor | None = None, options: RasterOptions | None = None
) -> Callable[..., RenderOutput]:
    """A function from a camera, and which depths are wanted, to what the model looks like, without gradients.

    ``background``: a color [3], black unless given; or harmonics [16, 3].

    Raises:
        InputError: if a bound is asked for, and there are harmonics.
    """
    behind = torch.zeros(3, device=model.device) if background is None else background
    options = options or RasterOptions()
    if behind.ndim > 1 and (options.bound or options.tolerance is not None):
        raise InputError("--tolerance, --bound: expected one color behind the Gaussians, found a sky; leave them out.")
    with torch.no_grad():
        gaussians = model.activated()

    @torch.no_grad()
    def draw(camera: Camera, depth: bool = False, median: bool = False) -> RenderOutput:
        return render(gaussians, camera, behind, replace(options, depth=depth, median_depth=median))

    return draw


def as_photographed(exposures: Exposures | None, image: torch.Tensor, name: str) -> torch.Tensor:
    """The image [H, W, 3] as the photograph of this name shows it; as it is, if that one is not known."""
    if exposures is None or name not in exposures.maps:
        return image
    numbers, falloff = (torch.from_numpy(n).to(image.device) for n in (exposures.maps[name], exposures.falloff))
    return expose(image, exposures.kind, numbers, falloff if falloff.any() else None, exposures.pivot)

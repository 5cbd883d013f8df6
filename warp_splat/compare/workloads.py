"""What adjoints and knobs are measured on: layered scenes of known depth complexity, and scenes in training."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warp_splat.camera import Camera
from warp_splat.compare.scenes import at_pixels, distinct_depths, make_camera
from warp_splat.config import RasterOptions
from warp_splat.presets import EMBEDDED_DEFAULTS
from warp_splat.raster.data import Gaussians
from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene
from warp_splat.scene.types import Scene
from warp_splat.text import Report
from warp_splat.training.options import TrainConfig
from warp_splat.training.trainer import Trainer

#: The schedule of the embedded scene, shrunk.
SHORT: dict[str, Any] = {
    **EMBEDDED_DEFAULTS[""],
    "iterations": 300,
    "position_lr_max_steps": 300,
    "densify_from_iter": 50,
    "densify_until_iter": 200,
    "densification_interval": 50,
    "sh_interval": 100,
}
CANDIDATES = (10, 100, 1000, 10_000)  # per pixel of the layered scenes
LAYERED_SIZE = 96  # px
STAGES = (0, 100, 300)  # steps of the short schedule after which a scene in training is measured
CAPS = (2048, 512, 128)  # on the entries of a list that a pixel looks at: the thesis's first; the last is pictured
SAMPLES = 192  # pixels at which float64 is computed


@dataclass(frozen=True, eq=False)
class Workload:
    """Activated Gaussians, as :func:`warp_splat.raster.api.render` takes them, a camera, and pixels to look at."""

    name: str
    gaussians: Gaussians
    camera: Camera
    background: torch.Tensor  # [3]
    options: RasterOptions
    pixels: torch.Tensor  # [P, 2] (row, column), int64; always on the host

    @property
    def device(self) -> torch.device:
        """Where it is rendered."""
        return self.background.device

    def to(self, device: torch.device) -> "Workload":
        """The same on ``device``."""
        gaussians = Gaussians(*(tensor.to(device) for tensor in self.gaussians))
        return replace(self, gaussians=gaussians, background=self.background.to(device))


def layered(candidates: int) -> Workload:
    """Gaussians that all cover the whole image, so that each is a candidate at every pixel.

    Opacities fall with their number, but not below what the cut at 1/255 leaves: at 10,000 most pixels stop early.
    """
    rng = np.random.default_rng(candidates)
    camera = make_camera(LAYERED_SIZE, LAYERED_SIZE, LAYERED_SIZE, seed=None)
    depth = distinct_depths(rng, candidates, 2.0, 8.0)
    means = at_pixels(rng.uniform(0.3, 0.7, (candidates, 2)) * LAYERED_SIZE, depth, camera)
    scales = rng.uniform(0.4, 0.9, (candidates, 3)) * depth[:, None]
    opacities = rng.uniform(0.0045, max(0.008, min(0.9, 15 / candidates)), candidates)
    arrays = (means, rng.normal(size=(candidates, 4)), scales, opacities, rng.uniform(-1.5, 1.5, (candidates, 1, 3)))
    tensors = [torch.tensor(array, dtype=torch.float32) for array in arrays]
    gaussians = Gaussians(*tensors, sh_rest=torch.zeros(candidates, 0, 3))
    background = torch.tensor([0.2, 0.4, 0.7])
    return Workload(f"{candidates} layers", gaussians, camera, background, RasterOptions(), sample_pixels(camera))


def in_training(name: str, scene: Scene, device: torch.device, say: Report) -> list[Workload]:
    """The first held-out view of a scene after each of :data:`STAGES` of the short schedule."""
    trainer = Trainer(scene, TrainConfig(**SHORT, device=device.type))
    camera = scene.evaluated[1][0].camera
    found = []
    for iteration in range(max(STAGES) + 1):
        if iteration:
            trainer.advance(iteration)
        if iteration in STAGES:
            gaussians = Gaussians(*(tensor.detach().clone() for tensor in trainer.model.activated()))
            stage = f"{name}, step {iteration}"
            say(f"{stage}: {len(trainer.model)} Gaussians, {camera.width} x {camera.height} px")
            options = RasterOptions(sh_degree=trainer.degree)
            found.append(Workload(stage, gaussians, camera, trainer.background, options, sample_pixels(camera)))
    return found


def named_scenes(scene: str, say: Report) -> dict[str, Scene]:
    """The embedded scene, and the one in the folder ``scene`` if that is not empty, by names that differ.

    Raises:
        InputError: if the folder holds no scene.
    """
    yours = load_scene(scene, eval=True, report=say) if scene else None  # first, since it may be refused
    found = {"embedded": load_scene(embedded_scene(), eval=True, report=say)}
    if yours:
        name = Path(scene).resolve().name.replace(",", " ")
        found[name if name not in found else f"{name} (2)"] = yours
    return found


def sample_pixels(camera: Camera) -> torch.Tensor:
    """:data:`SAMPLES` pixels of the image at random, or all if it has no more, [P, 2] (row, column)."""
    chosen = np.random.default_rng(0).permutation(camera.width * camera.height)[:SAMPLES]
    return torch.from_numpy(np.stack([chosen // camera.width, chosen % camera.width], 1))

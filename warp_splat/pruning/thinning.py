"""A set of Gaussians in fewer: which to leave out, and training that makes up for it."""

import math
import os
from dataclasses import replace

import numpy as np
import torch

from warp_splat.flags import fits, flags_of
from warp_splat.formats.exposures import Exposures
from warp_splat.formats.splats import COEFFICIENTS, SplatArrays, SplatFile
from warp_splat.gaussians import GaussianModel
from warp_splat.presets import TRIPLED
from warp_splat.pruning.score import ViewSetting, costs
from warp_splat.scene.types import Scene
from warp_splat.training.options import TrainConfig
from warp_splat.training.parts import PARTS
from warp_splat.training.seams import having
from warp_splat.training.trainer import Trainer

AT_ONCE = 0.8  # of the Gaussians stay, at least, before the rest is judged again: of two that are alike one is needed
STAGES, THINNED = 5, 1 / 3  # of training: how often Gaussians are left out, and over which share of the steps
#: Rates of that training, three times the default ones. Tried, fox at half size, half (a third) of the Gaussians kept,
#: 300 steps, held-out PSNR, 31.57 dB before:
#: - 31.03 (29.40) dB: default rates, all left out at once
#: - 31.37 (30.37) dB: twice
#: - 31.46 (30.72) dB: three times
#: - 31.51 (30.99) dB: three times, left out in stages
RATES = TRIPLED | {"position_lr_init": 1.6e-4, "position_lr_final": 1.6e-5}
#: Options of the model's training that hold here; what was learned of cameras and background is so already.
SAME = {"white_background", "projection", "lambda_dssim", "loss_space", "parts", "opacity_reg", "depths"}
SAME |= {"exposure", "vignetting", "random_background"}
LEARNED = {"pose", "sky"}  # parts of which the model has what they found
NEVER = 2**31  # a step that does not come


class Thinning:
    """The Gaussians of a model in the order in which it can do without them.

    Args:
        splats: the model.
        setting: the training views, and how they are rendered.
    """

    def __init__(self, splats: SplatArrays, setting: ViewSetting):
        self.splats, self.setting = splats, setting
        self._kept = {len(splats.means): np.arange(len(splats.means))}

    def to(self, count: int) -> SplatArrays:
        """The ``count`` that are needed most, in their order."""
        rows = self._kept[min(known for known in self._kept if known >= count)]
        while len(rows) > count:
            model = model_of(self.splats.take(rows), self.setting)
            kept = max(count, min(len(rows) - 1, math.ceil(AT_ONCE * len(rows))))
            rows = rows[_costliest(model, self.setting, kept).cpu().numpy()]
            self._kept[len(rows)] = rows
        return self.splats.take(rows)


def model_of(splats: SplatArrays, setting: ViewSetting) -> GaussianModel:
    """On the device of the setting."""
    return GaussianModel.from_splats(splats).to(setting.background.device)


def _costliest(model: GaussianModel, setting: ViewSetting, count: int) -> torch.Tensor:
    """Indices of the Gaussians, ascending, without which the images would change most."""
    order = torch.sort(costs(model, setting).gaussians, descending=True, stable=True).indices
    return torch.sort(order[:count]).values


def tuned(
    scene: Scene, file: SplatFile, setting: ViewSetting, count: int, steps: int, trained: dict, found: Exposures | None
) -> SplatArrays:
    """The model in ``count`` Gaussians, which ``steps`` of training adapt; they are left out by and by.

    Args:
        scene: to train on.
        file: the whole model.
        setting: the training views.
        count: of Gaussians to keep.
        steps: of training.
        trained: options of the model's training.
        found: exposures that it found.
    """
    degree = COEFFICIENTS.index(file.splats.sh.shape[1])
    config = _config(scene, file, steps, degree, trained, setting.background.device)
    trainer = Trainer(replace(scene, start=file), config)
    trainer.background = setting.background
    for begin in having(trainer.parts, "begin") if found else ():
        begin(found)
    total = len(trainer.model)
    for number in range(1, steps + 1):
        stage = math.ceil(STAGES * number / max(1, THINNED * steps))
        wanted = max(count, round(total * (count / total) ** (min(stage, STAGES) / STAGES)))
        if wanted < len(trainer.model):
            nothing = {name: rows.detach()[:0] for name, rows in trainer.model.parameters.items()}
            trainer.optimizer.replace(_costliest(trainer.model, setting, wanted), nothing)
            trainer.growth.clear()
        trainer.differentiate(degree + number)
        trainer.update(degree + number)
    return trainer.model.splats()


def _config(scene: Scene, file: SplatFile, steps: int, degree: int, trained: dict, device: torch.device) -> TrainConfig:
    """Options of a training that neither grows nor resets, at all degrees from its first step on."""
    known = {item.name: item for item in flags_of(TrainConfig) if item.name in SAME}
    same = {name: trained[name] for name, item in known.items() if name in trained and fits(trained[name], item)}
    if not os.path.isdir(os.path.join(scene.source or "", str(same.get("depths", "")))):
        same["depths"] = ""
    same["parts"] = ",".join(name for name in same.get("parts", "").split(",") if name in {*PARTS} - LEARNED)
    return TrainConfig(
        **RATES,
        **same,
        antialiasing=file.antialiased,
        device=device.type,
        sh_degree=degree,
        sh_interval=1,
        iterations=degree + steps,
        position_lr_max_steps=degree + steps,
        cooldown=round(0.8 * steps),
        densify_until_iter=0,
        densify_from_iter=NEVER,
        opacity_reset_interval=NEVER,
    )

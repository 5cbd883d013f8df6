"""What a part and a growth are, and what they are given: the seams of training. Loads neither torch nor Warp.

A part (training/parts/) is something that is learned or done besides the Gaussians. A growth (training/growth/) is the
rules by which their set grows and shrinks. Each is a file there and a line in that folder's table. Trainer and command
line know neither by name: flags are the fields of its options; what :meth:`state` returns is in the checkpoint.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import torch

    from warp_splat.camera import Camera
    from warp_splat.config import RasterOptions
    from warp_splat.formats.checkpoint import Checkpoint
    from warp_splat.gaussians import GaussianModel
    from warp_splat.raster.api import RenderOutput
    from warp_splat.runtime.distributed import Processes
    from warp_splat.scene.types import Scene, View
    from warp_splat.training.optimizer import Optimizer
    from warp_splat.training.trainer import Photograph


class Entry(NamedTuple):
    """A line of the table of parts, or of that of growths."""

    options: type  # a frozen dataclass of flags; where a part's has `asked` and it is true, --parts need not name it
    place: str  # of the class, as module.Class

    def load(self) -> Any:
        """The class."""
        module, name = self.place.rsplit(".", 1)
        return getattr(importlib.import_module(module), name)


class Setting(NamedTuple):
    """What a part or a growth works on."""

    scene: Scene
    model: GaussianModel
    background: torch.Tensor  # [3], on which the photographs were composited, on the model's device
    processes: Processes
    seed: int
    max_gaussians: int  # 0: no limit


class Step(NamedTuple):
    """One view in one step."""

    iteration: int  # the last of this step
    view: View


class Change(NamedTuple):
    """What a growth did to the set, in Gaussians."""

    cloned: int = 0
    split: int = 0
    pruned: int = 0
    refused: bool = False  # pruning would have left nothing, so nothing was pruned


class Verdict(NamedTuple):
    """Whether a scene needs a part, the figure that says so, and a sentence with that figure."""

    needed: bool
    figure: float
    sentence: str


class Plugin:
    """What parts and growths have in common. Any method may be left out."""

    def __init__(self, options: Any, setting: Setting):
        self.options, self.setting = options, setting

    def asks(self, options: RasterOptions, step: Step) -> RasterOptions:
        """What it needs of the renderer in this step: depth, ..."""
        return options

    def state(self) -> Mapping[str, torch.Tensor]:
        """What a checkpoint keeps besides :meth:`Part.parameters`, by names that no other has; see DTYPES there."""
        return {}

    def restore(self, checkpoint: Checkpoint) -> None:
        """Take back what :meth:`state` gave; raises InputError if it does not fit."""


class Growth(Plugin):
    """How the set grows and shrinks: the same in all processes."""

    def __init__(self, options: Any, setting: Setting, optimizer: Optimizer):
        super().__init__(options, setting)
        self.optimizer = optimizer  # whose `replace`, `arrange` and `reset_opacities` change the set

    def observe(self, out: RenderOutput, step: Step) -> None:
        """Look at what was rendered, after the gradients: ``out.means2d.grad`` [N, 2] is that of the 2D means."""

    def update(self, iteration: int) -> Change | None:
        """Change the set if it is time; None if nothing changed."""

    def grows(self, iterations: int) -> bool:
        """Whether a training of this length gains Gaussians, for the forecast of its memory."""
        return True


class Part(Plugin):
    """Something that is learned or done besides the Gaussians. In each step its methods run in this order."""

    reads_alpha = False  # whether it asks for the transparency of the photographs

    @classmethod
    def needed(cls, scene: Scene) -> Verdict:
        """Whether ``--parts auto`` takes it, measured on the scene."""
        return Verdict(False, 0.0, "nothing is measured")

    def parameters(self) -> Sequence[dict]:
        """Groups for Adam: a ``name`` that no other has, ``params`` (one leaf) and ``lr``. Asked for once."""
        return ()

    def camera(self, camera: Camera, step: Step) -> Camera:
        """The camera to render with."""
        return camera

    def background(self, color: torch.Tensor, step: Step) -> torch.Tensor:
        """The color [3] to render on."""
        return color

    def photograph(self, photograph: Photograph, step: Step) -> Photograph:
        """What the image is compared with."""
        return photograph

    def image(self, image: torch.Tensor, out: RenderOutput, step: Step) -> torch.Tensor:
        """The image [H, W, 3] that is compared; ``out`` is what was rendered."""
        return image

    def loss(self, loss: torch.Tensor, out: RenderOutput, step: Step) -> torch.Tensor:
        """What is differentiated, a scalar."""
        return loss

    def after_step(self, iteration: int) -> None:
        """After Adam."""

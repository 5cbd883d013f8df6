"""A random background in every step, so that what is transparent in photographs has to become so in the model."""

import torch

from warp_splat.formats.checkpoint import Checkpoint
from warp_splat.runtime.launch import send
from warp_splat.scene.types import Scene
from warp_splat.training.parts import BackgroundOptions
from warp_splat.training.photographs import Photograph
from warp_splat.training.seams import Setting, Step, Verdict

GENERATOR = "random.background"  # in a checkpoint


class RandomBackground:
    """Renders on a new color in each step and puts it behind the photograph, too."""

    reads_alpha = True

    def __init__(self, options: BackgroundOptions, setting: Setting):
        self.setting = setting
        self.random = torch.Generator().manual_seed(setting.seed)
        self.color = setting.background
        self.drawn = -1, torch.empty(0, 3)  # the step, and a color for each of its views

    @classmethod
    def needed(cls, scene: Scene) -> Verdict:
        """If photographs are transparent somewhere."""
        clear = sum(view.alpha is not None and bool((view.alpha < 255).any()) for view in scene.train)
        return Verdict(clear > 0, f"{clear} of {len(scene.train)} photographs are transparent somewhere")

    def background(self, color: torch.Tensor, step: Step) -> torch.Tensor:
        """Draw one for each view of a step; this one's."""
        if step.iteration != self.drawn[0]:
            self.drawn = step.iteration, torch.rand(self.setting.processes.images, 3, generator=self.random)
        self.color = send(self.drawn[1][step.place], color.device)
        return self.color

    def photograph(self, photograph: Photograph, step: Step) -> Photograph:
        """Put the color where the photograph was composited on the scene's background."""
        image, alpha, _ = photograph
        if alpha is None:
            return photograph
        values = image / 255.0 if image.dtype == torch.uint8 else image
        return photograph._replace(image=values + (1.0 - alpha / 255.0) * (self.color - self.setting.background))

    def state(self) -> dict[str, torch.Tensor]:
        """The state of the generator."""
        return {GENERATOR: self.random.get_state()}

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on drawing."""
        if GENERATOR in checkpoint.arrays:  # not, if training went without this part so far
            self.random.set_state(torch.from_numpy(checkpoint.generator(GENERATOR)))

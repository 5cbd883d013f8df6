"""What parts and growths are, and what they are given: the seams of training. Loads neither torch nor Warp.

A part (``training/parts/``) is something that is learned or done besides the Gaussians. A growth (``training/growth/``)
is the rules by which their set grows and shrinks. Each is a class in a file there, and a line in that folder's table
with its options, whose fields are flags. No two types of options may share a name; growths may share a type. Trainer
and command line know none by name.

A growth is made of (options, setting, optimizer); the optimizer's ``replace`` and ``arrange`` change the set:

    update(iteration) -> Change | None      change the set if it is time; None: nothing changed
    grows(iterations) -> bool               whether a training of this length gains Gaussians

It may look at every step, without a gradient:

    compare(image, target, mask, out, step) at what the loss compares, before it is differentiated
    observe(out, step)                      at what was rendered; ``out.means2d.grad`` [N, 2] is there

A part is made of (options, setting). It has any of these methods; ``tests/test_seams.py`` has an example. In each step
they run in this order:

    needed(scene) -> Verdict                of the class: whether ``--parts auto`` takes it; without, it never does
    tried                                   of the class, true: where ``needed`` says yes, trial.py has to confirm it
    parameters() -> [{name, params, lr}]    groups for Adam, each of one leaf, dense float32, with a name that no other
                                            has; lr is a number, or a function of the iteration
    camera(camera, step) -> camera          to render with
    background(color, step) -> color        [3], to render on; or harmonics [16, 3] of the direction
    image(image, out, step) -> image        [H, W, 3], of what was rendered, which is compared
    photograph(photograph, step)            what it is compared with; with ``reads_alpha``, it has its transparency

For what is shown and saved, a part may have:

    behind(color) -> color                  as ``background``, of pictures, without gradients
    refined(camera, view) -> camera         of a photograph, held out or not, as it is learned by now
    exposures() -> Exposures                of photographs, held out or not, as they are learned by now
    files() -> {name: value}                JSON files of the model's folder

Both may have, the growth after the parts:

    told() -> sentences                     what is said before the first step
    load()                                  compile and load the kernels that they launch, before the first step
    asks(options, step) -> options          what they need of the renderer in this step: depth, ...
    loss(loss, out, step) -> loss           a scalar, which is differentiated
    price(gaussians) -> price               a scalar that is added to it: what Gaussians cost by themselves
    after_step(iteration)                   after Adam
    state() -> {name: tensor}               what a checkpoint keeps besides ``parameters``, by names that no other has
    restore(checkpoint)                     take that back; raise InputError if it does not fit
"""

from __future__ import annotations

import pkgutil
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import torch

    from warp_splat.gaussians import GaussianModel
    from warp_splat.runtime.distributed import Processes
    from warp_splat.scene.types import Scene, View


class Entry(NamedTuple):
    """A line of the table of parts, or of that of growths."""

    options: type  # a frozen dataclass of flags
    place: str  # of the class, as module.Class

    def load(self) -> Any:
        """The class."""
        return pkgutil.resolve_name(self.place)


class Setting(NamedTuple):
    """What a part or a growth works on."""

    scene: Scene
    model: GaussianModel
    background: torch.Tensor  # [3], on which the photographs were composited, on the model's device
    processes: Processes
    seed: int
    max_gaussians: int  # 0: no limit
    iterations: int  # of the whole training


class Step(NamedTuple):
    """One view in one step."""

    iteration: int  # the last of this step
    view: View
    place: int = 0  # among the views of this step


class Change(NamedTuple):
    """What a growth did to the set, in Gaussians."""

    cloned: int
    split: int
    pruned: int
    refused: bool = False  # pruning would have left nothing, so nothing was pruned


class Verdict(NamedTuple):
    """Whether a scene needs a part, and a sentence with the figure that says so."""

    needed: bool
    sentence: str


def having(plugins: Iterable[Any], method: str) -> list[Any]:
    """This method of those that have it."""
    return [getattr(plugin, method) for plugin in plugins if hasattr(plugin, method)]

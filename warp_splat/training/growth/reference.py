"""Growing and pruning the set (Kerbl et al. 2023, section 5.2), as the reference does it. Index logic, no kernels."""

import functools
import math
from statistics import NormalDist

import numpy as np
import torch
import warp as wp

from warp_splat.formats.checkpoint import Checkpoint
from warp_splat.gaussians import CHUNK, activate
from warp_splat.kernels.statistics import make_observe
from warp_splat.raster.api import RenderOutput
from warp_splat.raster.drivers import driver_of, load_in_lanes
from warp_splat.runtime.launch import launch_in_lanes
from warp_splat.training.growth import ReferenceOptions
from warp_splat.training.optimizer import Optimizer
from warp_splat.training.seams import Change, Setting, Step

PRUNE_OPACITY = 0.005
RESET_OPACITY = 0.01
PRUNE_EXTENT = 0.1  # share of the scene's extent above which a Gaussian is pruned, once opacities have been reset
LEVELS = 2**14  # of the normal distribution from which children are drawn
SPLIT_SHRINK = 1.6  # the children's scales are the parent's divided by this


class Reference:
    """Statistics of the gradients of the 2D means, and what follows from them."""

    def __init__(self, options: ReferenceOptions, setting: Setting, optimizer: Optimizer):
        self.options, self.setting, self.optimizer = options, setting, optimizer
        self.model, self.processes, self.extent = setting.model, setting.processes, setting.scene.extent
        self.random = torch.Generator().manual_seed(setting.seed)
        self.clear()

    def told(self) -> list[str]:
        """What may surprise about the limit, as sentences."""
        limit, start = self.setting.max_gaussians, self.processes.total(len(self.model))
        if not 0 < limit < start:
            return []
        return [f"Warning: --max_gaussians {limit} bounds growth alone; training starts with all {start} Gaussians."]

    def clear(self) -> None:
        """Begin to observe the present set."""
        new = self.model.parameters["means"].new_zeros
        self.gradient = new(len(self.model))  # sum over views of |dL/dmean2d|, NDC units
        self.views = new(len(self.model))  # in which the Gaussian was drawn
        self.radius = new(len(self.model), dtype=torch.int32)  # px, largest in any view

    def statistics(self) -> dict[str, torch.Tensor]:
        """What was observed since the last change, by name [N]."""
        return {"gradient": self.gradient, "views": self.views, "radius": self.radius}

    def observe(self, out: RenderOutput, step: Step) -> None:
        """Take in the gradient of one view's 2D means."""
        grad, (height, width) = out.means2d.grad, out.image.shape[:2]
        if grad is None or step.iteration >= self.options.densify_until_iter:
            return
        inputs = [wp.vec2(0.5 * width, 0.5 * height), grad, out.radii]
        launch_in_lanes(make_observe, driver_of(grad.device).lanes, inputs, [self.gradient, self.views])
        if self.options.prune_screen_size:
            self.radius = torch.maximum(self.radius, out.radii)

    def load(self) -> None:
        """Compile and load the kernel of :meth:`observe`."""
        load_in_lanes(self.model.device, make_observe)

    def update(self, iteration: int) -> Change | None:
        """Densify, prune and reset opacities if it is time; None if the set did not change."""
        options, change, step = self.options, None, self.processes.images  # iterations in a step
        if iteration >= options.densify_until_iter:
            return None
        if iteration > options.densify_from_iter and iteration % options.densification_interval < step:
            change = self._densify(prune_large=iteration > options.opacity_reset_interval)
        at_start = self.processes.reaches(iteration, [options.densify_from_iter]) and self.setting.background.all()
        if iteration % options.opacity_reset_interval < step or at_start:
            self.optimizer.reset_opacities(RESET_OPACITY)
        return change

    def grows(self, iterations: int) -> bool:
        """Whether a training of this length densifies."""
        last, interval = min(iterations, self.options.densify_until_iter) - 1, self.options.densification_interval
        return last // interval * interval > max(self.options.densify_from_iter, 0)

    def state(self) -> dict[str, torch.Tensor]:
        """Statistics since the last densification, [R, N] with a row for each process, and the random state."""
        found = {f"statistics.{name}": self.processes.observed(rows) for name, rows in self.statistics().items()}
        return {**found, "random.densification": self.random.get_state()}

    def restore(self, checkpoint: Checkpoint) -> None:
        """Take what :meth:`state` gave from a checkpoint, for the present set; of any number of processes."""
        self.clear()
        for name, own in self.statistics().items():
            dtype = np.int32 if name == "radius" else np.float32
            rows = torch.tensor(checkpoint.array(f"statistics.{name}", (-1, len(self.model)), dtype))
            own.copy_(self.processes.restored(rows, largest=name == "radius"))
        self.random.set_state(torch.from_numpy(checkpoint.generator("random.densification")))

    def _densify(self, prune_large: bool) -> Change:
        for name, rows in self.statistics().items():
            self.processes.merge(rows, largest=name == "radius")
        raw = {name: tensor.detach() for name, tensor in self.model.parameters.items()}
        chosen = self._choose()
        splits = raw["scales"].amax(1) > _log(self.options.percent_dense * self.extent)
        clone, split = chosen[~splits[chosen]], chosen[splits[chosen]]
        added = self._children(raw, split)
        added = {name: torch.cat([raw[name][clone], added[name]]) for name in raw}
        widest = _log(PRUNE_EXTENT * self.extent) if prune_large else math.inf
        keep, keep_added = (survivors(some, widest) for some in (raw, added))
        if self.options.prune_screen_size and prune_large:
            keep &= self.radius <= self.options.prune_screen_size
        keep[split] = False
        pruned = len(keep) + len(keep_added) - int(keep.sum()) - int(keep_added.sum()) - len(split)
        if not self.processes.total(int(keep.sum()) + int(keep_added.sum())):  # an empty scene could never recover
            self.clear()
            return Change(0, 0, 0, refused=True)
        self.optimizer.replace(keep.nonzero()[:, 0], {name: rows[keep_added] for name, rows in added.items()})
        pieces = [keep, *keep_added.split([len(clone), len(split), len(split)])]
        self.optimizer.arrange(self.model.arranging(self.processes, [int(piece.sum()) for piece in pieces]))
        self.clear()
        return Change(len(clone), len(split), pruned)

    def _choose(self) -> torch.Tensor:
        """Gaussians whose mean gradient is over the threshold, ascending; the largest first where room is short."""
        mean = self.gradient / self.views.clamp_min(1.0)
        over = mean >= self.options.densify_grad_threshold
        room = max(self.setting.max_gaussians - self.processes.total(len(self.model)), 0)
        if self.setting.max_gaussians and self.processes.total(int(over.sum())) > room:
            over &= self.processes.lowest(torch.where(over, -mean, torch.inf), room)
        return over.nonzero()[:, 0]

    def _children(self, raw: dict[str, torch.Tensor], split: torch.Tensor) -> dict[str, torch.Tensor]:
        """Two samples of each Gaussian in ``split``, smaller than it."""
        twice = split.repeat(2)
        rows = {name: tensor[twice] for name, tensor in raw.items()}
        drawn = self.processes.draw(self.random, LEVELS, [len(split)] * 2)
        offsets = activate(rows["scales"], rows["opacities"])[0] * normals()[drawn].to(twice.device)
        rows["means"] = rows["means"] + rotate(rows["quats"], offsets)
        rows["scales"] = rows["scales"] - math.log(SPLIT_SHRINK)
        return rows


def survivors(raw: dict[str, torch.Tensor], widest: float = math.inf) -> torch.Tensor:
    """Which Gaussians are finite, not too faint to be seen, and no wider than the logarithm ``widest`` [N]."""
    keep = raw["opacities"] >= math.log(PRUNE_OPACITY / (1.0 - PRUNE_OPACITY))
    keep &= raw["scales"].amax(1) <= widest
    for tensor in raw.values():  # one that is not finite is left out of every image, so nothing else would prune it
        keep &= torch.cat([torch.isfinite(part)[..., None].flatten(1).all(1) for part in tensor.split(CHUNK)])
    return keep


@functools.cache
def normals() -> torch.Tensor:
    """Standard normal numbers, each as likely as the others [LEVELS]; torch's own differ by processor."""
    return torch.tensor([NormalDist().inv_cdf((level + 0.5) / LEVELS) for level in range(LEVELS)])


def _log(x: float) -> float:
    return math.log(x) if x > 0.0 else -math.inf


def rotate(quats: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Rotate vectors [N, 3] by quaternions [N, 4] (w, x, y, z) of any norm but 0."""
    w, x, y, z = (quats * quats).unbind(1)  # one operation after another: torch's functions of rows differ by processor
    axis, square = quats[:, 1:], (w + x + y + z)[:, None].clamp_min(1e-24)  # and no root: that one, too
    twist = 2.0 * _cross(axis, vectors)
    return vectors + (quats[:, :1] * twist + _cross(axis, twist)) / square


def _cross(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return a.roll(-1, 1) * b.roll(1, 1) - a.roll(1, 1) * b.roll(-1, 1)

"""Growing to a budget: what pulls most at its place is split, until there are as many as asked for."""

import math

import numpy as np
import torch

from warp_splat.formats.checkpoint import Checkpoint
from warp_splat.gaussians import activate, logarithm
from warp_splat.training.growth import ReferenceOptions, check_budget
from warp_splat.training.growth.reference import Reference, rotate, survivors
from warp_splat.training.optimizer import Optimizer
from warp_splat.training.seams import Change, Setting

SPLIT = 0.03  # share of the Gaussians, at least, of each densification; the faintest make room for it
APART = 0.7  # standard deviations from the middle of a Gaussian to those of its halves, along its longest axis
NARROW = math.log(0.714)  # of that axis: 0.7^2 + 0.714^2 = 1, so the halves together were as wide as the whole,
SMALLER = math.log(0.9)  # but for this of every axis: a seventh fewer pairs of Gaussians and pixels
CLEAREST = 1e-12  # floor of opacities and transmittances, whose logarithms are taken


class Budget(Reference):
    """Exactly ``--max_gaussians`` by the end of densification, along a square root of the steps; of more, at once."""

    shrinks = True  # to that number, where there are more at the start

    def __init__(self, options: ReferenceOptions, setting: Setting, optimizer: Optimizer):
        super().__init__(options, setting, optimizer)
        self.start = self.processes.total(len(self.model))
        self.end = min(options.densify_until_iter, setting.iterations)
        check_budget("budget", setting.max_gaussians)

    def told(self) -> list[str]:
        """What may surprise about the budget, as sentences."""
        budget, interval = self.setting.max_gaussians, self.options.densification_interval
        doublings = max((self.end - 1) // interval - self.options.densify_from_iter // interval, 0)
        if not doublings and budget != self.start:
            more = "more --iterations" if self.end == self.setting.iterations else "a later --densify_until_iter"
            return [f"Warning: no densification before step {self.end}, so {self.start} Gaussians stay; take {more}."]
        if budget < self.start:
            return [f"Of {self.start} Gaussians, --max_gaussians {budget} are left at the first densification."]
        if budget > self.start * 2 ** min(doublings, 99):
            most = f"{doublings} densifications double {self.start} to {self.start * 2**doublings}"
            return [f"Warning: --max_gaussians {budget} will not be reached, since {most} at most."]
        return []

    def update(self, iteration: int) -> Change | None:
        """Split and prune if it is time; None if the set did not change."""
        options, step = self.options, self.processes.images
        if not options.densify_from_iter < iteration < self.end or iteration % options.densification_interval >= step:
            return None
        return self._grow(self._due(iteration))

    def _due(self, iteration: int) -> int:
        """Gaussians that there are to be after the densification of this step."""
        options, step, most = self.options, self.processes.images, self.setting.max_gaussians
        following = (iteration // options.densification_interval + 1) * options.densification_interval
        # at once, where there are too many: those that stay have the time to move to where they are lacking
        if most < self.start or -(-following // step) * step >= self.end:
            return most
        share = math.sqrt((iteration - options.densify_from_iter) / (self.end - options.densify_from_iter))
        now = self.processes.total(len(self.model))  # no fewer, where a later end was given since
        return max(self.start + round((most - self.start) * share), min(now, most))

    def _grow(self, due: int) -> Change | None:
        self.processes.merge(self.gradient)
        self.processes.merge(self.views)
        raw = {name: tensor.detach() for name, tensor in self.model.parameters.items()}
        keep, total = survivors(raw), self.processes.total
        kept = total(int(keep.sum()))
        leaving = max(min(round(SPLIT * min(kept, due)), due // 2) - (due - kept), 0)
        keep &= ~self.processes.lowest(torch.where(keep, raw["opacities"], torch.inf), leaving)  # the faintest
        kept -= leaving
        pruned, room = total(len(keep)) - kept, min(max(due - kept, 0), kept)
        if not pruned + room or not kept:  # an empty scene could never recover
            self.clear()
            return None if kept else Change(0, 0, 0, refused=True)
        gradient = self.gradient / self.views.clamp_min(1.0)
        score = torch.where(keep, gradient.nan_to_num(0.0, 0.0, 0.0), -1.0)
        split = self.processes.lowest(-score, room).nonzero()[:, 0]
        keep[split] = False
        self.optimizer.replace(keep.nonzero()[:, 0], halves(raw, split))
        self.optimizer.arrange(self.model.arranging(self.processes, [int(keep.sum()), len(split), len(split)]))
        self.clear()
        return Change(0, len(split), pruned)

    def state(self) -> dict[str, torch.Tensor]:
        """As the reference's, and how many Gaussians there were at the start."""
        return {**super().state(), "budget.start": torch.tensor([self.start], dtype=torch.int32)}

    def restore(self, checkpoint: Checkpoint) -> None:
        """Take what :meth:`state` gave from a checkpoint."""
        super().restore(checkpoint)
        self.start = int(checkpoint.array("budget.start", (1,), np.int32)[0])


def halves(raw: dict[str, torch.Tensor], split: torch.Tensor) -> dict[str, torch.Tensor]:
    """Two Gaussians for each in ``split``, side by side along its longest axis, which together look about like it.

    Their opacity b is such that both, one behind the other, are as opaque as the whole: (1 - b)^2 = 1 - a.

    Args:
        raw: parameters before activation, by name, as :class:`warp_splat.gaussians.GaussianModel` has them.
        split: indices [S].

    Returns:
        Rows [2 S] by name: first those on one side, then those on the other.
    """
    rows = {name: tensor[split] for name, tensor in raw.items()}
    scales, opacities = activate(rows["scales"].contiguous(), rows["opacities"].contiguous())
    axis = torch.zeros_like(scales).scatter_(1, rows["scales"].argmax(1, keepdim=True), 1.0)  # the longest
    offset = rotate(rows["quats"], APART * scales * axis)
    clear = np.sqrt(np.maximum(1.0 - opacities.cpu().double().numpy(), CLEAREST))
    logits = logarithm(np.maximum(1.0 - clear, CLEAREST)) - logarithm(clear)
    rows["opacities"] = torch.from_numpy(logits).to(opacities)
    rows["scales"] = rows["scales"] + NARROW * axis + SMALLER
    both = {name: torch.cat([tensor, tensor]) for name, tensor in rows.items()}
    both["means"] = torch.cat([rows["means"] - offset, rows["means"] + offset])
    return both

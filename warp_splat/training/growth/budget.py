"""Growing to a budget: what carries error and pulls at its place is split, until there are as many as asked for.

The score of a Gaussian is (error that it carries) x (mean gradient of its 2D mean). The error that it carries is the
sum over pixels of weight times |image - photograph|. Both come from adjoints of the blend: the gradient from that of
the step, the sums from one more in every tenth step.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from warp_splat.formats.checkpoint import Checkpoint
from warp_splat.formats.curve import along_curve
from warp_splat.gaussians import activate, logarithm
from warp_splat.raster.api import RenderOutput
from warp_splat.runtime.timers import stage
from warp_splat.training.growth import ReferenceOptions, check_budget
from warp_splat.training.growth.reference import Reference, rotate, survivors
from warp_splat.training.optimizer import Optimizer
from warp_splat.training.seams import Change, Setting, Step

EVERY = 10  # steps from one look at the error to the next: a look costs about half a step, an adjoint of the blend
MOVED = 0.02  # share of the Gaussians that move, where there are as many as planned
APART = 0.7  # standard deviations from the middle of a Gaussian to those of its halves, along its longest axis
NARROW = math.log(0.714)  # of that axis: 0.7^2 + 0.714^2 = 1, so the halves together are as wide as the whole
CLEAREST = 1e-12  # floor of opacities and transmittances, whose logarithms are taken


class Budget(Reference):
    """Exactly ``--max_gaussians`` by the end of densification, along a square root of the steps."""

    def __init__(self, options: ReferenceOptions, setting: Setting, optimizer: Optimizer):
        super().__init__(options, setting, optimizer)
        self.start = len(self.model)
        self.end = min(options.densify_until_iter, setting.iterations)
        check_budget("budget", setting.max_gaussians)

    def told(self) -> list[str]:
        """What may surprise about the budget, as sentences."""
        budget, interval = self.setting.max_gaussians, self.options.densification_interval
        doublings = max((self.end - 1) // interval - self.options.densify_from_iter // interval, 0)
        if not doublings and budget != self.start:
            return [f"Warning: no densification before step {self.end}: there will be {self.start} Gaussians as now."]
        if budget < self.start:
            return [f"The weakest of {self.start} Gaussians go, until there are --max_gaussians {budget}."]
        if budget > self.start * 2.0**doublings:
            most = f"{doublings} densifications double {self.start} to {self.start * 2**doublings}"
            return [f"Warning: --max_gaussians {budget} will not be reached, since {most} at most."]
        return []

    def clear(self) -> None:
        """Begin to observe the present set."""
        super().clear()
        new = self.model.parameters["means"].new_zeros
        self.error = new(len(self.model))  # sum over looks of weight x error, mean over the pixels
        self.weight = new(len(self.model))  # likewise of weight
        self.looks = new(len(self.model))  # in which the Gaussian was drawn

    def statistics(self) -> dict[str, torch.Tensor]:
        """What was observed since the last change, by name."""
        return {**super().statistics(), "error": self.error, "weight": self.weight, "looks": self.looks}

    def compare(self, image, target: torch.Tensor, mask: torch.Tensor | None, out: RenderOutput, step: Step) -> None:
        """Share the error of a view out among the Gaussians that made it."""
        if step.iteration >= self.end or step.iteration // self.processes.count % EVERY:
            return
        with stage("densify"):
            target = target / 255.0 if target.dtype == torch.uint8 else target
            r, g, b = (image.detach() - target).abs().unbind(2)
            counts = torch.ones_like(r) if mask is None else (mask[..., 0] != 0).to(r)
            error = torch.where(counts > 0, r + g + b, torch.zeros_like(r))
            upstream = torch.stack([error, counts, torch.zeros_like(r)], 2) / r.numel()
            (sums,) = torch.autograd.grad(out.image, out.colors, upstream, retain_graph=True)
            self.error += sums[:, 0]
            self.weight += sums[:, 1]
            self.looks += out.radii > 0

    def update(self, iteration: int) -> Change | None:
        """Split and prune if it is time; None if the set did not change."""
        options, step = self.options, self.processes.count
        if not options.densify_from_iter < iteration < self.end or iteration % options.densification_interval >= step:
            return None
        return self._grow(self._due(iteration))

    def _due(self, iteration: int) -> int:
        """Gaussians that there are to be after the densification of this step."""
        options, step = self.options, self.processes.count
        following = (iteration // options.densification_interval + 1) * options.densification_interval
        if -(-following // step) * step >= self.end:  # this is the last one
            return self.setting.max_gaussians
        share = math.sqrt((iteration - options.densify_from_iter) / (self.end - options.densify_from_iter))
        return self.start + round((self.setting.max_gaussians - self.start) * share)

    def _grow(self, due: int) -> Change | None:
        for rows in (self.gradient, self.views, self.error, self.weight, self.looks):
            self.processes.sum(rows)
        raw = {name: tensor.detach() for name, tensor in self.model.parameters.items()}
        keep = survivors(raw)
        if (kept := int(keep.sum())) >= due:
            keep &= ~self._weakest(keep, kept - due)
        kept = int(keep.sum())
        pruned, room = len(keep) - kept, min(max(due - kept, 0), kept)
        if not pruned + room or not kept:  # an empty scene could never recover
            self.clear()
            return None if kept else Change(0, 0, 0, refused=True)
        score = torch.where(keep, self._score().nan_to_num(0.0, 0.0, 0.0), -1.0)
        split = torch.sort(torch.sort(score, descending=True, stable=True).indices[:room]).values
        keep[split] = False
        self.optimizer.replace(keep.nonzero()[:, 0], halves(raw, split))
        self.optimizer.arrange(along_curve(self.model.parameters["means"]))
        self.clear()
        return Change(0, len(split), pruned)

    def _weakest(self, keep: torch.Tensor, excess: int) -> torch.Tensor:
        """Those with the least weight in the pixels [N]: a share of what was looked at, or the ``excess`` if more."""
        seen = keep & (self.looks > 0)
        weight = torch.where(seen, self.weight / self.looks.clamp_min(1.0), torch.inf)
        order = torch.sort(torch.where(keep, weight, torch.nan), stable=True).indices  # the unknown, then the left out
        count = max(min(round(MOVED * int(keep.sum())), int(seen.sum())), excess)
        return torch.zeros_like(keep).index_fill_(0, order[:count], True)

    def _score(self) -> torch.Tensor:
        gradient = self.gradient / self.views.clamp_min(1.0)
        return gradient * (self.error / self.looks.clamp_min(1.0))

    def state(self) -> dict[str, torch.Tensor]:
        """As the reference's, and how many Gaussians there were at the start."""
        return {**super().state(), "budget.start": torch.tensor([self.start], dtype=torch.int32)}

    def restore(self, checkpoint: Checkpoint) -> None:
        """Take what :meth:`state` gave from a checkpoint."""
        super().restore(checkpoint)
        self.start = int(checkpoint.array("budget.start", (1,), np.int32)[0])


def halves(raw: dict[str, torch.Tensor], split: torch.Tensor) -> dict[str, torch.Tensor]:
    """Two Gaussians for each in ``split``, side by side along its longest axis, which together look like it.

    Their opacity b is such that both, one behind the other, are as opaque as the whole: (1 - b)^2 = 1 - a.

    Args:
        raw: parameters before activation, by name, as :class:`warp_splat.gaussians.GaussianModel` has them.
        split: indices [S].

    Returns:
        Rows [2 S] by name: first those on one side, then those on the other.
    """
    rows = {name: tensor[split] for name, tensor in raw.items()}
    scales, opacities = activate(rows["scales"].contiguous(), rows["opacities"].contiguous())
    longest = rows["scales"].argmax(1, keepdim=True)
    axis = torch.zeros_like(scales).scatter_(1, longest, 1.0)
    offset = rotate(rows["quats"], APART * scales * axis)
    clear = np.sqrt(np.maximum(1.0 - opacities.cpu().double().numpy(), CLEAREST))
    logits = logarithm(np.maximum(1.0 - clear, CLEAREST)) - logarithm(clear)
    rows["opacities"] = torch.from_numpy(logits).to(opacities)
    rows["scales"] = rows["scales"] + NARROW * axis
    both = {name: torch.cat([tensor, tensor]) for name, tensor in rows.items()}
    both["means"] = torch.cat([rows["means"] - offset, rows["means"] + offset])
    return both

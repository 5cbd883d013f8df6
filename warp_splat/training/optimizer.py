"""Adam over the Gaussians' parameters, and its moments through every change of the set."""

from __future__ import annotations

import functools
import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from decimal import Decimal

import numpy as np
import torch

from warp_splat.errors import InputError
from warp_splat.formats.checkpoint import Checkpoint
from warp_splat.gaussians import GaussianModel
from warp_splat.training.adam_step import HALF, load_adam, move
from warp_splat.training.options import LearnOptions

BETAS = (0.9, 0.999)
EPS = 1e-15  # the reference's: gradients of single Gaussians are tiny
MOMENTS = ("exp_avg", "exp_avg_sq")


def power(base: float, steps: float, of: int = 1) -> float:
    """``base ** (steps / of)``; the C library's differs by processor."""
    return float(_root(base, of) ** Decimal(steps))


@functools.cache
def _root(base: float, degree: int) -> Decimal:
    return Decimal(base) ** (Decimal(1) / degree)


class Tables:
    """Groups of parameters and their moments, by the names of torch's Adam, which loads torch's compiler: 5 s.

    Args:
        groups: each with ``name`` and ``params``, a list of one leaf.
        settings: of all groups: ``lr``, ``betas``, ``eps``.
    """

    def __init__(self, groups: Sequence[dict], **settings):
        self.param_groups = [settings | group for group in groups]
        self.state: defaultdict[torch.Tensor, dict] = defaultdict(dict)

    def zero_grad(self) -> None:
        """Forget all gradients."""
        for group in self.param_groups:
            group["params"][0].grad = None


class Optimizer:
    """Adam with one group per parameter, or its sparse variant.

    Args:
        model: whose parameters are updated in place.
        options: rates and ``optimizer_type``.
        extent: size of the scene, world units; the means' rate is relative to it.
        batch: images whose mean gradient makes a step. Rates are multiplied by its square root, epsilon is divided by
            that, and the betas are raised to its power (Zhao et al. 2024, "On Scaling Up 3D Gaussian Splatting
            Training"): if gradients of different images are independent, a step then moves the parameters as far,
            and forgets as much, as ``batch`` steps of one image.
        parts: groups of what parts learn, each with ``name``, ``params`` (one leaf of at least one axis) and ``lr``, a
            number or a function of the iteration; they learn in every step.

    Raises:
        InputError: if a leaf of a part is not dense float32.
    """

    def __init__(
        self, model: GaussianModel, options: LearnOptions, extent: float, batch: int = 1, parts: Sequence[dict] = ()
    ):
        self.model, self.options, self.extent, self.scale = model, options, extent, math.sqrt(batch)
        self.batch, self.parts = batch, {group["name"]: group["params"][0] for group in parts}
        for name, leaf in self.parts.items():
            if leaf.dtype != torch.float32 or not leaf.is_contiguous():
                raise InputError(f"parameters of a part: expected dense float32, got {name} of {leaf.dtype}.")
        self._part_rates = {group["name"]: group["lr"] for group in parts}
        groups = [{"name": name, "params": [leaf]} for name, leaf in model.parameters.items()]
        betas = tuple(power(beta, batch) for beta in BETAS)
        self.adam = Tables([*groups, *parts], lr=0.0, betas=betas, eps=EPS / self.scale)
        self._groups = {group["name"]: group for group in self.adam.param_groups}
        self.set_iteration(0)

    def set_iteration(self, iteration: int) -> None:
        """Set the rates for this step: the means' fall log-linearly from init to final over position_lr_max_steps.

        In the last ``cooldown`` steps all fall to a tenth as well, which settles what constant rates keep in motion.
        """
        self.iteration, options = iteration, self.options
        steps, fall = options.position_lr_max_steps, options.position_lr_final / options.position_lr_init
        rate = options.position_lr_init * power(fall, min(iteration, steps), steps)
        rates = {
            "means": rate * self.extent,
            "sh_dc": options.feature_lr,
            "sh_rest": options.feature_lr / 20.0,
            "opacities": options.opacity_lr,
            "scales": options.scaling_lr,
            "quats": options.rotation_lr,
            **{name: rate(iteration) if callable(rate) else rate for name, rate in self._part_rates.items()},
        }
        cooldown = int(min(options.cooldown, options.end))
        late = power(0.1, max(iteration - options.falls_from, 0), max(cooldown, 1))
        for name, rate in rates.items():
            self._groups[name]["lr"] = rate * self.scale * late

    def step(self, radii: torch.Tensor | None) -> None:
        """Update from the gradients and clear them.

        Args:
            radii: [N] int32, what the image showed (0: not); None if the set has just changed, and has no gradients.
        """
        sparse, parts = self.options.optimizer_type == "sparse_adam", [self._groups[name] for name in self.parts]
        if radii is not None:
            gaussians = [group for group in self.adam.param_groups if group["name"] not in self.parts]
            self._step(gaussians, len(radii), radii if sparse else None)
        for group in parts:
            self._step([group], group["params"][0].numel(), None)
        self.adam.zero_grad()

    def load(self) -> None:
        """Compile and load what :meth:`step` launches."""
        sparse, halves = self.options.optimizer_type == "sparse_adam", self.options.half_moments
        for kind in [(sparse, halves)] + [(False, False)] * bool(self.parts):
            load_adam(self.model.device, *kind)

    def _step(self, groups: list[dict], rows: int, radii: torch.Tensor | None) -> None:
        """Adam on tables of ``rows`` rows.

        With ``radii`` only on rows that are drawn, and without bias correction, as the reference's sparse_adam.
        """
        tables, numbers = [], []
        for group in groups:
            parameter, (beta1, beta2), biases = group["params"][0], group["betas"], (1.0, 1.0)
            state, grad = self._state(parameter), parameter.grad
            if radii is None:
                state["step"] += 1
            if grad is not None and parameter.numel() > 0:  # degree 0: zeros would change nothing but the count
                if radii is None:
                    biases = [1.0 - power(beta, state["step"]) for beta in (beta1, beta2)]
                tables.append([parameter.detach(), grad.contiguous(), *(state[name] for name in MOMENTS)])
                rates = [group["lr"] / biases[0], group["eps"], 1.0 / math.sqrt(biases[1])]
                numbers.append([*rates, beta1, 1 - beta1, beta2, 1 - beta2])
        if tables:
            move(tables, numbers, rows, radii, self.iteration)

    def _state(self, parameter: torch.Tensor) -> dict:
        """Moments and number of steps, as torch's Adam keeps them, but for the latter, which is a plain number."""
        state = self.adam.state[parameter]
        if not state:
            zeros = {name: torch.zeros_like(parameter, dtype=self._kept_as(parameter)) for name in MOMENTS}
            state.update(zeros, step=0.0)
        return state

    def _kept_as(self, parameter: torch.Tensor) -> torch.dtype:
        """The type of a parameter's moments."""
        of_part = any(parameter is leaf for leaf in self.parts.values())
        return HALF if self.options.half_moments and not of_part else parameter.dtype

    def replace(self, kept: torch.Tensor, added: dict[str, torch.Tensor]) -> None:
        """Keep the rows ``kept`` (indices), then append ``added`` (name -> rows) with zero moments."""
        for name in self.model.NAMES:
            rows, nothing = added[name], torch.zeros_like(added[name])
            self._swap(name, torch.cat([self.model.parameters[name].detach()[kept], rows]))
            self._change_moments(name, lambda moment, nothing=nothing: torch.cat([moment[kept], nothing.to(moment)]))

    def arrange(self, order: torch.Tensor) -> None:
        """Put the rows in ``order`` (indices), moments and all."""
        for name in self.model.NAMES:
            self._swap(name, self.model.parameters[name].detach()[order])
            self._change_moments(name, lambda moment: moment[order])

    def reset_opacities(self, ceiling: float) -> None:
        """Lower every opacity to at most ``ceiling`` and forget its moments."""
        logits = self.model.parameters["opacities"].detach()
        self._swap("opacities", logits.clamp_max(math.log(ceiling / (1.0 - ceiling))))
        self._change_moments("opacities", torch.zeros_like)

    def _change_moments(self, name: str, change: Callable[[torch.Tensor], torch.Tensor]) -> None:
        state = self.adam.state.get(self.model.parameters[name], {})
        state.update({moment: change(state[moment]) for moment in MOMENTS if moment in state})

    def state(self) -> dict[str, torch.Tensor]:
        """The parameters and all that belongs to them, as ``kind.name``: gradients, moments, and images learned from.

        Those are steps times ``batch``: bias correction then goes on as it should for any other ``batch``.
        """
        found: dict[str, torch.Tensor] = {}
        for name, leaf in (self.model.parameters | self.parts).items():
            found[f"parameters.{name}"] = leaf.detach()
            if leaf.grad is not None:
                found[f"gradients.{name}"] = leaf.grad
            if state := self.adam.state.get(leaf):
                found |= {f"{moment}.{name}": state[moment].to(leaf) for moment in MOMENTS}
                found[f"images.{name}"] = torch.tensor(state["step"] * self.batch, dtype=torch.float64)
        return found

    def restore(self, checkpoint: Checkpoint) -> None:
        """Take what :meth:`state` gave from a checkpoint. Raises InputError if something does not fit."""
        arrays, count = checkpoint.arrays, len(checkpoint.array("parameters.means", (-1, 3)))
        for name, old in (self.model.parameters | self.parts).items():
            if name in self.parts and f"parameters.{name}" not in arrays:  # training went without this part so far
                continue
            shape = old.shape if name in self.parts else (count, *old.shape[1:])
            moments = MOMENTS if any(f"{moment}.{name}" in arrays for moment in MOMENTS) else ()
            gradients = ("gradients",) if f"gradients.{name}" in arrays else ()
            tables = {
                kind: torch.empty(shape, device=old.device).copy_(
                    torch.from_numpy(checkpoint.array(f"{kind}.{name}", shape))
                )
                for kind in ("parameters", *gradients, *moments)
            }
            if name in self.parts:
                old.detach().copy_(tables["parameters"])  # the part knows this leaf
            else:
                self._swap(name, tables["parameters"])
            leaf = self._groups[name]["params"][0]
            leaf.grad = tables.get("gradients")
            if moments:
                images = np.nan_to_num(checkpoint.array(f"images.{name}", (), np.float64)).clip(0)
                self.adam.state[leaf] = {
                    "step": float(np.float32(images / self.batch)),
                    **{moment: tables[moment].to(self._kept_as(leaf)) for moment in MOMENTS},
                }

    def part_gradients(self) -> list[torch.Tensor]:
        """The gradients of what parts learn, zeros where there are none."""
        for leaf in self.parts.values():
            leaf.grad = torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
        return [leaf.grad for leaf in self.parts.values()]

    def _swap(self, name: str, values: torch.Tensor) -> None:
        """Put a new leaf, without a gradient, in the place of a parameter; its state moves along."""
        old, new = self.model.parameters[name], values.requires_grad_()
        self.model.parameters[name] = new
        self._groups[name]["params"][0] = new
        if old in self.adam.state:
            self.adam.state[new] = self.adam.state.pop(old)

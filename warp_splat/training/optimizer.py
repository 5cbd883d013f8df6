"""Adam over the Gaussians' parameters, and its moments through every change of the set."""

import functools
import math
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path

import numpy as np
import torch

from warp_splat.errors import InputError, refusing
from warp_splat.formats.checkpoint import Checkpoint
from warp_splat.gaussians import CHUNK, GaussianModel
from warp_splat.training.adam_step import HALF, load_adam, move
from warp_splat.training.options import LearnOptions

BETAS = (0.9, 0.999)
EPS = 1e-15  # the reference's: gradients of single Gaussians are tiny
MOMENTS = ("exp_avg", "exp_avg_sq")


def power(base: float, steps: float, of: int = 1) -> float:
    """``base ** (steps / of)``; the C library's differs by processor."""
    return float(_root(base, of) ** Decimal(steps))


def log_linear(start: float, end: float, iteration: int, last: int) -> float:
    """From ``start`` to ``end``, which it has from step ``last`` on, evenly in the logarithm; 0 if ``start`` is."""
    return start * power(end / start, min(iteration, last), last) if start else 0.0


@functools.cache
def _root(base: float, degree: int) -> Decimal:
    return Decimal(base) ** (Decimal(1) / degree)


def zeros_in_file(folder: Path, shape: Sequence[int], dtype: torch.dtype) -> torch.Tensor:
    """Zeros of ``shape`` on the CPU, in a file without a name in ``folder`` that goes when the tensor does.

    The system keeps in memory what of it is in use, and writes the rest back.

    Raises:
        InputError: if there is no room for it.
    """
    size = dtype.itemsize * math.prod(shape)
    problem = f"{folder}: expected {math.ceil(size / 2**20)} MiB more on its disk for --out_of_core"
    advice = "; free some, or choose another folder with -m."
    with refusing(OSError, problem, advice), tempfile.TemporaryFile(dir=folder) as file:
        if hasattr(os, "posix_fallocate"):  # a page without room on the disk would end the process
            os.posix_fallocate(file.fileno(), 0, max(size, 1))
        content = np.memmap(file, np.uint8, "r+" if os.fstat(file.fileno()).st_size else "w+", shape=max(size, 1))
    return torch.from_numpy(content)[:size].view(dtype).view(*shape)


@dataclass
class Table:
    """A leaf, and what Adam knows of it."""

    leaf: torch.Tensor
    part_rate: float | Callable[[int], float] = 0.0  # of a part: a number, or a function of the iteration
    rate: float = 0.0  # in this step
    steps: float = 0.0
    moments: list[torch.Tensor] = field(default_factory=list)  # as in MOMENTS; none before the first step


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
        folder: where the Gaussians' parameters and moments live, in files; without it, in memory.

    Raises:
        InputError: if a leaf of a part is not dense float32, or a scalar.
    """

    def __init__(
        self,
        model: GaussianModel,
        options: LearnOptions,
        extent: float,
        batch: int = 1,
        parts: Sequence[dict] = (),
        folder: Path | None = None,
    ):
        self.folder = folder
        self.torn = False  # whether some tables have other rows than others, since memory or disk ran out
        self.model, self.options, self.extent, self.scale = model, options, extent, math.sqrt(batch)
        self.batch, self.parts = batch, {group["name"]: group["params"][0] for group in parts}
        for name, leaf in self.parts.items():
            if leaf.dtype != torch.float32 or not leaf.is_contiguous() or leaf.dim() == 0:
                raise InputError(f"parameters of a part: expected dense float32 [N, ...], got {name} of {leaf.dtype}.")
        self.tables = {name: Table(leaf) for name, leaf in model.parameters.items()}
        if folder:
            self.arrange(lambda rows: rows)  # into files
        self.tables |= {group["name"]: Table(group["params"][0], group["lr"]) for group in parts}
        self.betas, self.eps = tuple(power(beta, batch) for beta in BETAS), EPS / self.scale
        self.set_iteration(0)

    def set_iteration(self, iteration: int) -> None:
        """Set the rates for this step: the means' fall log-linearly from init to final over position_lr_max_steps.

        In the last ``cooldown`` steps all fall to a tenth as well, which settles what constant rates keep in motion.
        """
        self.iteration, options = iteration, self.options
        start, end, last = options.position_lr_init, options.position_lr_final, options.position_lr_max_steps
        rates = {
            "means": log_linear(start, end, iteration, last) * self.extent,
            "sh_dc": options.feature_lr,
            "sh_rest": options.feature_lr / 20.0,
            "opacities": options.opacity_lr,
            "scales": options.scaling_lr,
            "quats": options.rotation_lr,
        }
        begin = max(options.end - options.cooldown, 0)
        late = power(0.1, max(iteration - begin, 0), max(int(min(options.cooldown, options.end)), 1))
        for name, table in self.tables.items():
            rate = rates.get(name, table.part_rate)
            table.rate = (rate(iteration) if callable(rate) else rate) * self.scale * late

    def step(self, radii: torch.Tensor | None) -> None:
        """Update from the gradients and clear them.

        Args:
            radii: [N] int32, what the image showed (0: not); None if the set has just changed, and has no gradients.
        """
        sparse = self.options.optimizer_type == "sparse_adam"
        if radii is not None:
            self._step(self.model.NAMES, len(radii), radii if sparse else None)
        for name, leaf in self.parts.items():
            self._step([name], leaf.numel(), None)
        self.zero_grad()

    def zero_grad(self) -> None:
        """Forget all gradients."""
        for table in self.tables.values():
            table.leaf.grad = None

    def load(self) -> None:
        """Compile and load what :meth:`step` launches."""
        sparse, halves = self.options.optimizer_type == "sparse_adam", self.options.half_moments
        for kind in [(sparse, halves)] + [(False, False)] * bool(self.parts):
            load_adam(self.model.device, *kind)

    def _step(self, names: Sequence[str], rows: int, radii: torch.Tensor | None) -> None:
        """Adam on tables of ``rows`` rows.

        With ``radii`` only on rows that are drawn, and without bias correction, as the reference's sparse_adam.
        """
        moved, numbers, homes, shown, (beta1, beta2) = [], [], [], None, self.betas
        for name in names:
            table, grad, biases = self.tables[name], self.tables[name].leaf.grad, (1.0, 1.0)
            table.moments = table.moments or [self._zeros(table.leaf.shape, self._kept_as(name)) for _ in MOMENTS]
            if radii is None:
                table.steps += 1
                biases = [1.0 - power(beta, table.steps) for beta in self.betas]
            if grad is not None and grad.numel() > 0:  # degree 0: zeros would change nothing but the count
                tensors = [table.leaf.detach(), *table.moments]
                if grad.is_sparse:  # only rows that the view shows are taken out of their file, and put back
                    homes.append(tensors)
                    shown, grad = grad._indices()[0], grad._values()
                    tensors = [tensor[shown] for tensor in tensors]
                moved.append([tensors[0], grad.contiguous(), *tensors[1:]])
                rates = [table.rate / biases[0], self.eps, 1.0 / math.sqrt(biases[1])]
                numbers.append([*rates, beta1, 1 - beta1, beta2, 1 - beta2])
        if shown is not None and radii is not None:
            rows, radii = len(shown), radii[shown]
        if moved and rows:
            move(moved, numbers, rows, radii, self.iteration)
        for tensors, (values, _, *moments) in zip(homes, moved, strict=False):
            for tensor, found in zip(tensors, (values, *moments), strict=True):
                tensor.index_copy_(0, shown, found)

    def _kept_as(self, name: str) -> torch.dtype:
        """The type of a parameter's moments."""
        return HALF if self.options.half_moments and name not in self.parts else torch.float32

    def _zeros(self, shape: Sequence[int], dtype: torch.dtype = torch.float32) -> torch.Tensor:
        if self.folder:
            return zeros_in_file(self.folder, shape, dtype)
        return torch.zeros(*shape, dtype=dtype, device=self.model.device)

    def _copied(self, rows: np.ndarray) -> torch.Tensor:
        """A table of ``rows``, which may lie in a file: a part after another, since memory may be short."""
        found = self._zeros(rows.shape)
        for start in range(0, len(rows), CHUNK):
            found[start : start + CHUNK] = torch.tensor(rows[start : start + CHUNK])
        return found

    def _taken(self, tensor: torch.Tensor, rows: torch.Tensor, more: int = 0) -> torch.Tensor:
        """The ``rows`` of a table, and zeros for some more."""
        found = self._zeros((len(rows) + more, *tensor.shape[1:]), tensor.dtype)
        torch.index_select(tensor, 0, rows, out=found[: len(rows)])
        return found

    def replace(self, kept: torch.Tensor, added: dict[str, torch.Tensor]) -> None:
        """Keep the rows ``kept`` (indices), then append ``added`` (name -> rows) with zero moments."""
        for name in self.model.NAMES:
            table, rows = self.tables[name], added[name]
            values, *moments = (self._taken(old, kept, len(rows)) for old in (table.leaf.detach(), *table.moments))
            values[len(kept) :] = rows
            self._put(name, values, moments)
            self.torn = name != self.model.NAMES[-1]

    def arrange(self, moved: Callable[[torch.Tensor], torch.Tensor]) -> None:
        """Put the rows, moments and all, into the order that ``moved`` gives them."""
        if self.folder:
            order = moved(torch.arange(len(self.model)))
            moved = lambda rows: self._taken(rows, order)  # noqa: E731
        for name in self.model.NAMES:
            table = self.tables[name]
            self._put(name, moved(table.leaf.detach()), [moved(moment) for moment in table.moments])
            self.torn = name != self.model.NAMES[-1]

    def reset_opacities(self, ceiling: float) -> None:
        """Lower every opacity to at most ``ceiling`` and forget its moments."""
        table, most = self.tables["opacities"], math.log(ceiling / (1.0 - ceiling))
        self._put("opacities", table.leaf.detach().clamp_max(most), [torch.zeros_like(m) for m in table.moments])

    def _put(self, name: str, values: torch.Tensor, moments: list[torch.Tensor]) -> None:
        """Put a new leaf, without a gradient, in the place of a parameter of the Gaussians."""
        self.tables[name].leaf = self.model.parameters[name] = values.requires_grad_()
        self.tables[name].moments = moments

    def state(self) -> dict[str, torch.Tensor]:
        """The parameters and all that belongs to them, as ``kind.name``: gradients, moments, and images learned from.

        Those are steps times ``batch``: bias correction then goes on as it should for any other ``batch``.
        """
        found: dict[str, torch.Tensor] = {}
        for name, table in self.tables.items():
            found[f"parameters.{name}"] = table.leaf.detach()
            if (grad := table.leaf.grad) is not None:
                if grad.is_sparse:
                    grad = self._zeros(grad.shape).index_copy_(0, grad._indices()[0], grad._values())
                found[f"gradients.{name}"] = grad
            if table.moments:
                found |= {f"{kind}.{name}": m.to(table.leaf) for kind, m in zip(MOMENTS, table.moments, strict=True)}
                found[f"images.{name}"] = torch.tensor(table.steps * self.batch, dtype=torch.float64)
        return found

    def restore(self, checkpoint: Checkpoint) -> None:
        """Take what :meth:`state` gave from a checkpoint. Raises InputError if something does not fit."""
        arrays, count = checkpoint.arrays, len(checkpoint.array("parameters.means", (-1, 3)))
        for name, table in self.tables.items():
            if name in self.parts and f"parameters.{name}" not in arrays:  # training went without this part so far
                continue
            shape = table.leaf.shape if name in self.parts else (count, *table.leaf.shape[1:])
            moments = MOMENTS if any(f"{moment}.{name}" in arrays for moment in MOMENTS) else ()
            gradients = ("gradients",) if f"gradients.{name}" in arrays else ()
            kinds = ("parameters", *gradients, *moments)
            found = {kind: self._copied(checkpoint.array(f"{kind}.{name}", shape)) for kind in kinds}
            if name in self.parts:
                table.leaf.detach().copy_(found["parameters"])  # the part knows this leaf
            else:
                self._put(name, found["parameters"], [])
            table.leaf.grad = found.get("gradients")
            if moments:
                images = np.nan_to_num(checkpoint.array(f"images.{name}", (), np.float64)).clip(0)
                table.steps = float(np.float32(images / self.batch))
                table.moments = [found[moment].to(self._kept_as(name)) for moment in moments]

    def part_gradients(self) -> list[torch.Tensor]:
        """The gradients of what parts learn, zeros where there are none."""
        for leaf in self.parts.values():
            leaf.grad = torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
        return [leaf.grad for leaf in self.parts.values()]

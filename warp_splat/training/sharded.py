"""Views of Gaussians that lie in blocks on several processes (Zhao et al. 2024, "On Scaling Up 3D Gaussian Splatting").

Each process projects its own Gaussians for every view of a step. The splats that a view shows travel to the process
that draws it, and their gradients travel back. All sums go by view, in the order of the step: the number of processes
changes no bit. Splats are projected again for their gradients, one view after another, rather than kept for all views.
"""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import torch

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.errors import InputError
from warp_splat.formats.ply import save_ply_parts
from warp_splat.formats.splats import SplatArrays
from warp_splat.gaussians import CHUNK, GaussianModel
from warp_splat.raster.api import RenderOutput
from warp_splat.raster.data import Dropped, Splats2D
from warp_splat.raster.project import project
from warp_splat.runtime.shards import Shards
from warp_splat.training.seams import Step, having

if TYPE_CHECKING:
    from warp_splat.training.trainer import Trainer

T = TypeVar("T")
WIDTHS = (2, 3, 1, 3, 1, 2, 1)  # columns of a splat that travels: 52 bytes
LEARNED = 5  # of these tensors: their gradients travel back, 40 bytes


class Observed(NamedTuple):
    """What a growth may look at of one view: own Gaussians."""

    means2d: torch.Tensor  # [n, 2], with a gradient
    radii: torch.Tensor  # [n]
    image: torch.Tensor  # [H, W, 3], of which there is but the shape

    @classmethod
    def of_all(cls, out: RenderOutput, rows: torch.Tensor, count: int) -> "Observed":
        """What ``out`` shows of ``rows`` alone, among ``count`` Gaussians."""
        means2d, radii = out.means2d.new_empty(count, 2), out.radii.new_zeros(count)
        means2d.grad = means2d.new_zeros(count, 2).index_copy_(0, rows, out.means2d.grad)
        return cls(means2d, radii.index_copy_(0, rows, out.radii), out.image)


class Blocks:
    """What the processes of a training do together, where each holds a block of the Gaussians.

    Args:
        trainer: of this process.
        processes: that hold the blocks.

    Raises:
        InputError: if an option needs all Gaussians in one process.
    """

    def __init__(self, trainer: "Trainer", processes: Shards):
        self.trainer, self.processes = trainer, processes
        learn = trainer.config.learn
        refused = {
            "--half_moments": learn.half_moments,  # are rounded by the number of a row
            "--minutes": learn.minutes,
            "--parts pose": having(trainer.parts, "camera"),
        }
        for name in filter(refused.get, refused):
            raise InputError(f"--shard: expected a training without {name}, which needs whole models; leave it out.")

    def differentiate(self, steps: list[Step]) -> list[torch.Tensor]:
        """Add the gradients of own Gaussians in all views of a step; returns their losses, and all prices together."""
        optimizer, rows = self.trainer.optimizer, []
        price = torch.zeros((), dtype=torch.float64, device=self.trainer.device)
        for begin in range(0, len(steps), self.processes.count):
            loss, more = self._differentiate(steps[begin : begin + self.processes.count])
            rows.append(torch.cat([loss.view(1), *(grad.reshape(-1) for grad in optimizer.part_gradients())]))
            price += more
            for leaf in optimizer.parts.values():
                leaf.grad = None
        views = self.processes.gather(torch.stack(rows)).transpose(0, 1).flatten(0, 1)[: len(steps)]
        losses, *learned = views.split([1, *(leaf.numel() for leaf in optimizer.parts.values())], 1)
        for leaf, (first, *others) in zip(optimizer.parts.values(), learned, strict=True):
            leaf.grad = sum(others, first).view_as(leaf)
        self.processes.sum(price)
        return [*losses[:, 0], price.float()]

    def _differentiate(self, steps: list[Step]) -> tuple[torch.Tensor, torch.Tensor]:
        """One view of each process; returns the loss of the own one, and the prices of own Gaussians in all."""
        trainer, rank, count = self.trainer, self.processes.rank, self.processes.count
        cameras = [trainer.photographs.camera_at(step.view, step.iteration) for step in steps]
        options = [trainer.options_at(step) for step in steps]
        with torch.no_grad():
            gaussians = trainer.model.activated(trainer.degree)
            shown = [_packed(project(gaussians, *one)) for one in zip(cameras, options, strict=True)]
        arrived = self.processes.exchange(shown + [shown[0][:0]] * (count - len(steps)))
        del shown, gaussians
        loss, grads = arrived[0].new_zeros(()), [part[:, : sum(WIDTHS[:LEARNED])] for part in arrived]
        if rank < len(steps):
            splats = _unpacked(torch.cat(arrived))
            loss = trainer.differentiate_view(steps[rank], splats)
            columns = [tensor.grad.reshape(-1, width) for tensor, width in zip(splats, WIDTHS[:LEARNED], strict=False)]
            grads = torch.cat(columns, 1).split([len(part) for part in arrived])
            del splats
        returned, price = self.processes.exchange(grads), torch.zeros((), dtype=torch.float64, device=trainer.device)
        for one in zip(steps, cameras, options, returned, strict=False):
            price += self._return(*one)
        return loss, price

    def _return(self, step: Step, camera: Camera, options: RasterOptions, rows: torch.Tensor) -> torch.Tensor:
        """Add own gradients in a view; ``rows``: of the splats that it shows. Returns what own Gaussians cost in it."""
        trainer, dropped = self.trainer, Dropped()
        gaussians = trainer.model.activated(trainer.degree)
        splats = project(gaussians, camera, options, dropped=dropped)
        splats.means2d.retain_grad()
        drawn, roots, grads = (splats.radii > 0).nonzero()[:, 0], list(splats[:LEARNED]), []
        for tensor, columns in zip(roots, rows.split(WIDTHS[:LEARNED], 1), strict=True):
            grads.append(torch.zeros_like(tensor).index_copy_(0, drawn, columns.reshape(-1, *tensor.shape[1:])))
        prices = trainer.prices(gaussians)
        torch.autograd.backward([*roots, *prices], [*grads, *map(torch.ones_like, prices)])
        image = torch.empty(camera.height, camera.width, 3, device="meta")
        trainer.see(Observed(splats.means2d, splats.radii.clamp_min(0), image), step)
        trainer.dropped.update(gradients=dropped.gaussian_count, gaussians=torch.count_nonzero(splats.radii < 0))
        return sum((price.detach() for price in prices), rows.new_zeros((), dtype=torch.float64))

    def lead(self, do: Callable[[], T]) -> T | None:
        """What process 0 does; the others do meanwhile what it asks for."""
        if self.processes.rank > 0:
            while request := self.processes.first(None):
                name, arguments = request
                getattr(self, name)(*arguments)
            return None
        try:
            return do()
        finally:
            self.processes.first(None)

    def ask(self, name: str, *arguments: Any) -> Any:
        """What a method gives in process 0, after all have called it; for what process 0 does in :meth:`lead`."""
        self.processes.first((name, arguments))
        return getattr(self, name)(*arguments)

    def show(self, camera: Camera, options: RasterOptions) -> Splats2D:
        """The splats of a view, in process 0; in others none."""
        with torch.no_grad():
            rows = _packed(project(self.trainer.model.activated(self.trainer.degree), camera, options))
        return _unpacked(self._to_first(rows))

    def save(self, path: Path, antialiased: bool) -> None:
        """Write a PLY file; process 0 never has more than CHUNK Gaussians of others. For :meth:`lead`."""
        total = self.ask("arrange")
        save_ply_parts(path, total, (self.ask("part", first) for first in range(0, total, CHUNK)), antialiased)

    def arrange(self) -> int:
        """Put a copy of the Gaussians in the order of files; returns how many there are."""
        self.arranged = self.trainer.model.arranged(self.processes)
        return self.processes.total(len(self.arranged))

    def part(self, first: int) -> SplatArrays:
        """Some of them, in process 0."""
        begin = self.processes.own(self.processes.total(len(self.arranged))).start
        rows = slice(max(first - begin, 0), max(first + CHUNK - begin, 0))
        tensors = {name: self._to_first(tensor.detach()[rows]) for name, tensor in self.arranged.parameters.items()}
        return GaussianModel(tensors).splats()

    def _to_first(self, rows: torch.Tensor) -> torch.Tensor:
        """The rows of all, in process 0."""
        return torch.cat(self.processes.exchange([rows] + [rows[:0]] * (self.processes.count - 1)))


def _packed(splats: Splats2D) -> torch.Tensor:
    """Those that are drawn, a row each."""
    drawn = (splats.radii > 0).nonzero()[:, 0]
    columns = [*splats[:-1], splats.radii.view(torch.float32)]
    return torch.cat([table[drawn].reshape(-1, width) for table, width in zip(columns, WIDTHS, strict=True)], 1)


def _unpacked(rows: torch.Tensor) -> Splats2D:
    """Splats that take gradients."""
    columns = (part.squeeze(1) if part.shape[1] == 1 else part for part in rows.split(WIDTHS, 1))
    *tensors, radii = (part.clone(memory_format=torch.contiguous_format) for part in columns)
    learned = [tensor.requires_grad_() for tensor in tensors[:LEARNED]]
    return Splats2D(*learned, *tensors[LEARNED:], radii.view(torch.int32))

"""Processes that train one model together, as ``torchrun`` starts them: what they exchange, and how they end.

Data parallelism: each process holds the whole model and differentiates other views. The mean of the gradients makes
the same step everywhere. Nothing else is sent. The models stay the same bytes, because every decision is made from
numbers that are the same. :meth:`Processes.check_identical` proves it.
"""

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import Any, TypeVar

import numpy as np
import torch
import torch.distributed as dist

from warp_splat.errors import InputError, refusing
from warp_splat.runtime.devices import is_out_of_memory
from warp_splat.runtime.timers import stage
from warp_splat.runtime.watch import Watch, watching

T = TypeVar("T")
PATIENCE = timedelta(minutes=5)  # with a process that is silent: it may be evaluating, or compiling kernels


class GroupError(InputError):
    """The processes cannot go on together: one has ended, or their models differ."""


class Processes:
    """One of several processes, all of which call the same methods in the same order; or one that trains alone.

    About the rows of all Gaussians, in their order, each answers by itself, since it holds them all;
    :class:`.shards.Shards` has to ask the others.

    Attributes:
        rank: number of this process; 0 prints, evaluates and saves.
        count: of all processes. Of one, nothing is exchanged.
        images: in a step, by which an iteration number grows.
        local_count: of those on this machine.
        lost: whether another process went away. Then this one saves the model, even if its rank is not 0.

    Raises:
        GroupError: from every method, if another process has ended or is silent for longer than PATIENCE.
    """

    lost = False
    sharded = False
    watch: Watch | None = None

    def __init__(self, rank: int = 0, count: int = 1, local_count: int = 1, images: int = 0):
        self.rank, self.count, self.local_count, self.images = rank, count, local_count, images or count

    def reaches(self, iteration: int, marks: Iterable[int]) -> bool:
        """Whether one of ``marks`` is among the iterations of the step that ends with ``iteration``."""
        return any(0 <= iteration - mark < self.images for mark in marks)

    def average(self, tensors: Sequence[torch.Tensor]) -> None:
        """Replace the tensors, sums over this process's images, by their means over all images of the step."""
        if self.count == 1 or self.sharded:  # of own Gaussians, it has the sums over all images
            for tensor in tensors if self.images > 1 else ():
                tensor.div_(self.images)
            return
        with stage("all-reduce"):
            flat = torch.cat([tensor.reshape(-1) for tensor in tensors])  # one exchange: each waits for all processes
            self.sum(flat)
            flat /= self.images
            for tensor, mean in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
                tensor.copy_(mean.view(tensor.shape))

    def sum(self, tensor: torch.Tensor) -> None:
        """Replace ``tensor`` by its sum over the processes."""
        self._exchange(dist.all_reduce, tensor, dist.ReduceOp.SUM)

    def merge(self, tensor: torch.Tensor, largest: bool = False) -> None:
        """Sums (or the largest values) of what each process saw of the Gaussians that it holds, in their place."""
        self._exchange(dist.all_reduce, tensor, dist.ReduceOp.MAX if largest else dist.ReduceOp.SUM)

    def observed(self, rows: torch.Tensor) -> torch.Tensor:
        """What each process saw of the Gaussians that it holds [n], as a checkpoint keeps it: [count, n]."""
        return self.gather(rows)

    def restored(self, rows: torch.Tensor, largest: bool = False) -> torch.Tensor:
        """What :meth:`observed` gave, of this process; the first takes all, if there were more or fewer."""
        if len(rows) == self.count:
            return rows[self.rank]
        return (rows.amax(0) if largest else rows.sum(0)) * (self.rank == 0)

    def largest(self, value: int) -> int:
        """The largest ``value`` of all processes."""
        return int(self.gather(torch.tensor([value])).max())

    def gather(self, tensor: torch.Tensor) -> torch.Tensor:
        """The tensors of all processes, stacked: [count, ...]."""
        found = [torch.empty_like(tensor) if self.count > 1 else tensor for _ in range(self.count)]
        self._exchange(dist.all_gather, found, tensor)
        return torch.stack(found)

    def first(self, value: T) -> T:
        """What process 0 calls ``value``."""
        box = [value]
        self._exchange(dist.broadcast_object_list, box, 0)
        return box[0]

    def check_identical(self, tensors: Iterable[torch.Tensor], iteration: int) -> None:
        """Compare the bytes of ``tensors`` over the processes. Raises GroupError if they differ."""
        if self.count == 1:
            return
        digest = hashlib.sha256()
        for tensor in tensors:
            digest.update(tensor.detach().cpu().contiguous().numpy().data)
        own = torch.tensor(list(digest.digest()), dtype=torch.uint8)
        names = [bytes(other.tolist()).hex()[:8] for other in self.gather(own)]
        if len(set(names)) > 1:
            raise GroupError(
                f"Process {self.rank}: expected the same model in all {self.count} processes after {iteration} "
                f"iterations, found SHA-256 {', '.join(names)} (rank 0, 1, ...); give all the same scene, processors "
                "or GPUs of one kind, and the same versions of torch and Warp."
            )

    def check_alike(self, facts: dict[str, Any]) -> None:
        """Compare what holds for this process with what does for the first. Raises GroupError if that differs."""
        theirs = self.first(facts)
        for name in filter(lambda name: facts[name] != theirs[name], facts):
            expected = f"expected the same {name} as of process 0, {theirs[name]!r:.80}, got {facts[name]!r:.80}"
            raise GroupError(f"Process {self.rank}: {expected}; start all with the same options and scene.")

    def own(self, count: int) -> slice:
        """Which of ``count`` rows belong to this process."""
        return slice(0, count)

    def total(self, count: int) -> int:
        """Rows in all, of which this process has ``count``."""
        return count

    def lowest(self, values: torch.Tensor, count: int) -> torch.Tensor:
        """Which own rows are among the ``count`` of the lowest values of all, ties by their order: [n] bool."""
        chosen = torch.sort(values, stable=True).indices[:count]
        return torch.zeros_like(values, dtype=torch.bool).index_fill_(0, chosen, True)

    def between(self, values: torch.Tensor, spare: int) -> tuple[torch.Tensor, torch.Tensor]:
        """In each column of all ``values`` [n, 3], what is left between the ``spare`` lowest and highest: two [3]."""
        low, high = (values.kthvalue(place, dim=0).values for place in (1 + spare, len(values) - spare))
        return low, high

    def sorting(self, keys: torch.Tensor, sizes: Sequence[int]) -> Callable[[torch.Tensor], torch.Tensor]:
        """A function that puts rows in the order of their ``keys`` [n] int64, ties by their order.

        ``sizes``: of the pieces in which own rows come; all first pieces come before all second ones.
        """
        order = torch.sort(keys, stable=True).indices
        return lambda rows: rows[order]

    def draw(self, random: torch.Generator, levels: int, sizes: Sequence[int]) -> torch.Tensor:
        """Three random numbers below ``levels`` for each own row [n, 3], on the host; all draw those of all."""
        return torch.randint(levels, (sum(sizes), 3), generator=random)

    def running_sums(self, values: np.ndarray) -> tuple[float, np.ndarray, float]:
        """The sum of what is before the own ``values``; the sums up to each of them; the sum of all."""
        sums = np.cumsum(values)
        return 0.0, sums, sums[-1]

    def _exchange(self, collective: Callable, *arguments) -> None:
        if self.count == 1:
            return
        try:
            collective(*arguments)
        except RuntimeError as error:
            if is_out_of_memory(error):
                raise
            self.lost = True
            silent = any(words in str(error).lower() for words in ("timed out", "timeout"))
            what = f"was silent for {PATIENCE.seconds // 60} minutes" if silent else "has ended"
            gone = self.watch.silent() if self.watch else []
            which = f" (no sign of process {', '.join(map(str, gone))})" * bool(gone)
            raise GroupError(
                f"Process {self.rank}: expected an answer from all {self.count} processes, but one {what}{which}; see "
                "which one, and why, in its own message or in torchrun's report."
            ) from error


ALONE = Processes()


@contextmanager
def join(device: str, images: int = 0, kind: type[Processes] = Processes) -> Iterator[Processes]:
    """The processes that ``torchrun`` started, for as long as the block runs; without it, this one alone.

    Args:
        device: "auto", "cpu" or "cuda"; on GPUs, each process of a machine takes another one.
        images: of a step; 0: one for each process.
        kind: what several processes are.

    Raises:
        InputError: if a machine has fewer GPUs than processes, or the processes do not find each other, or cannot
            take equally many images.
    """
    if os.environ.get("WORLD_SIZE", "1") == "1":
        yield Processes(images=images) if images > 1 else ALONE
        return
    names = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
    problem = "WORLD_SIZE: expected RANK, LOCAL_RANK and LOCAL_WORLD_SIZE beside it, all numbers, found otherwise"
    with refusing((KeyError, ValueError), problem, "; start several processes with torchrun, or unset it."):
        rank, count, local_rank, local_count = (int(os.environ[name]) for name in names)
    # torch loads this later anyhow. Its functions would then keep the group of that moment as a default argument.
    # Nothing would end that group or its gloo threads, which abort a process that shuts down around them.
    import torch.distributed.nn  # noqa: PLC0415 - only of use here

    backend = "gloo"
    if device != "cpu" and torch.cuda.is_available():
        if local_count > torch.cuda.device_count():
            raise InputError(
                f"--nproc-per-node {local_count}: expected at most as many processes as GPUs, found "
                f"{torch.cuda.device_count()}; start fewer, or use --device cpu."
            )
        torch.cuda.set_device(local_rank)
        backend = "cpu:gloo,cuda:nccl" if dist.is_nccl_available() else backend
        # Else a thread of NCCL's ends the process when an exchange fails, and the model is lost. So the host waits for
        # each exchange, which raises: nothing is learned from a sum that never came, and who is left can save.
        os.environ.setdefault("TORCH_NCCL_BLOCKING_WAIT", "1")
    problem = f"Process {rank}: expected to meet {count - 1} others, as torchrun arranges"
    with refusing((RuntimeError, ValueError), problem):
        dist.init_process_group(backend, timeout=PATIENCE)
    try:
        with watching(rank, count, ends=kind.sharded) as watch:
            if images % count and not kind.sharded:
                raise InputError(f"--views {images}: expected a multiple of {count} processes; give each as many.")
            processes = kind(rank, count, local_count, images)
            processes.watch = watch
            yield processes
    finally:
        dist.destroy_process_group()

"""Processes of which each holds a block of the Gaussians: all that travels between them.

Whatever the number of blocks, every answer is that of :class:`.distributed.Processes` about the whole, to the bit.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch
import torch.distributed as dist

from warp_splat.runtime.distributed import Processes
from warp_splat.runtime.timers import stage

LEAST, MOST = -(2**61), 2**61  # of what is sorted
WAYS = 64  # into which a search divides what is left: each takes an exchange, which far away costs more than numbers
AT_ONCE = 2**20  # random numbers that are drawn for others


class Shards(Processes):
    """Blocks in the order of the processes, as large as each other after :meth:`sorting`."""

    sharded = True

    def own(self, count: int) -> slice:
        """An equal share."""
        return slice(count * self.rank // self.count, count * (self.rank + 1) // self.count)

    def exchange(self, rows: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """Rows of one kind [n, ...] for each process; returns those from each."""
        counts, shape = torch.tensor([len(part) for part in rows]), rows[0].shape[1:]
        with stage("exchange"):
            theirs = torch.empty_like(counts)
            self._exchange(dist.all_to_all_single, theirs, counts)
            found = rows[0].new_empty(int(theirs.sum()), *shape)
            if shape.numel():
                self._exchange(dist.all_to_all_single, found, torch.cat(list(rows)), theirs.tolist(), counts.tolist())
        return list(found.split(theirs.tolist()))

    def total(self, count: int) -> int:
        """The sum over the processes."""
        return int(self.gather(torch.tensor([count])).sum())

    def merge(self, tensor: torch.Tensor, largest: bool = False) -> None:
        """Nothing: of its own Gaussians, a process has seen all views."""

    def observed(self, rows: torch.Tensor) -> torch.Tensor:
        """One row, of all views."""
        return rows[None]

    def restored(self, rows: torch.Tensor, largest: bool = False) -> torch.Tensor:
        """Of own Gaussians, what all saw."""
        return rows.amax(0) if largest else rows.sum(0)

    def lowest(self, values: torch.Tensor, count: int) -> torch.Tensor:
        """As of the whole."""
        (start,), _ = self._starts([len(values)])
        return self._parts(_ordered(values), torch.arange(start, start + len(values)), [count]).to(values.device) == 0

    def between(self, values: torch.Tensor, spare: int) -> tuple[torch.Tensor, torch.Tensor]:
        """As of the whole."""
        columns, last = torch.sort(_ordered(values), dim=0).values.T, self.total(len(values)) - 1
        low, high = (self._at([*columns.contiguous()], [place] * 3) for place in (spare, last - spare))
        return _unordered(low).to(values), _unordered(high).to(values)

    def sorting(self, keys: torch.Tensor, sizes: Sequence[int]) -> Callable[[torch.Tensor], torch.Tensor]:
        """As of the whole, of which each process gets an equal share."""
        starts, total = self._starts(sizes)
        pieces = [torch.arange(start, start + size) for start, size in zip(starts, sizes, strict=True)]
        keys, places = keys.cpu(), torch.cat(pieces)
        target = self._parts(keys, places, [total * rank // self.count for rank in range(1, self.count)])
        order, counts = torch.argsort(target, stable=True), torch.bincount(target, minlength=self.count).tolist()

        def moved(rows: torch.Tensor) -> torch.Tensor:
            return torch.cat(self.exchange(rows[order.to(rows.device)].split(counts)))

        within = torch.from_numpy(np.lexsort((moved(places).numpy(), moved(keys).numpy())))
        return lambda rows: moved(rows)[within.to(rows.device)]

    def draw(self, random: torch.Generator, levels: int, sizes: Sequence[int]) -> torch.Tensor:
        """As of the whole, of which the own ones are kept."""
        (starts, total), at, own = self._starts(sizes), 0, []
        for start, size in zip([*starts, total], [*sizes, 0], strict=True):
            for skipped in range(at, start, AT_ONCE):
                torch.randint(levels, (min(AT_ONCE, start - skipped), 3), generator=random)
            own.append(torch.randint(levels, (size, 3), generator=random))
            at = start + size
        return torch.cat(own)

    def running_sums(self, values: np.ndarray) -> tuple[float, np.ndarray, float]:
        """As of the whole: one process after another goes on from where the one before came to."""
        before, sums, end = 0.0, values, 0.0
        for rank in range(self.count):
            box = torch.zeros(1, dtype=torch.float64)
            if rank == self.rank:
                before, sums = end, np.cumsum(np.concatenate([[end], values]))
                box[0] = sums[-1]
            self.sum(box)
            end = float(box)
        return before, sums[1:], end

    def _starts(self, sizes: Sequence[int]) -> tuple[list[int], int]:
        """Where own pieces of rows begin, if all first pieces come before all second ones; and the rows in all."""
        counts = self.gather(torch.tensor(sizes))
        ends = counts.T.reshape(-1).cumsum(0).view(counts.T.shape)
        return (ends - counts.T)[:, self.rank].tolist(), int(ends[-1, -1])

    def _parts(self, keys: torch.Tensor, places: torch.Tensor, ranks: Sequence[int]) -> torch.Tensor:
        """How many of ``ranks``, in the order of the keys and then the places of all rows, each own row has reached."""
        inside, found = torch.sort(keys).values, torch.zeros_like(places)
        edges = self._at([inside] * len(ranks), ranks)
        below = torch.searchsorted(inside, edges)
        self.sum(below)
        alike = [torch.sort(places[keys == edge]).values for edge in edges]
        firsts = self._at(alike, [rank - before for rank, before in zip(ranks, below.tolist(), strict=True)])
        for edge, first in zip(edges, firsts, strict=True):
            found += (keys > edge) | ((keys == edge) & (places >= first))
        return found

    def _at(self, columns: Sequence[torch.Tensor], ranks: Sequence[int]) -> torch.Tensor:
        """The numbers at these places of sorted columns [k], of which each process has a part; MOST beyond the last."""
        low, high = (torch.full((len(ranks), 1), end) for end in (LEAST, MOST))
        while bool((low < high).any()):
            steps = torch.arange(WAYS) * ((high - low) // WAYS).clamp(1)
            tried = torch.minimum(low + steps, high - 1)
            counts = [torch.searchsorted(part, at, right=True) for part, at in zip(columns, tried, strict=True)]
            reached = torch.stack(counts)
            self.sum(reached)
            short = (reached <= torch.tensor(ranks)[:, None]).sum(1, keepdim=True)
            ends = torch.cat([low - 1, tried, high], 1)
            low, high = ends.gather(1, short) + 1, ends.gather(1, short + 1)
        return low[:, 0]


def _ordered(values: torch.Tensor) -> torch.Tensor:
    """Integers in the order of ``values`` (float32, not NaN), on the host."""
    bits = (values.cpu() + 0.0).view(torch.int32).long()  # of -0, those of 0
    return torch.where(bits < 0, -(2**31) - bits, bits)


def _unordered(numbers: torch.Tensor) -> torch.Tensor:
    """What :func:`_ordered` took."""
    return torch.where(numbers < 0, -(2**31) - numbers, numbers).int().view(torch.float32)

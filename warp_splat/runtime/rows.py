"""Questions about the rows of all Gaussians, in their order: here, each process holds them all."""

from collections.abc import Callable, Sequence

import numpy as np
import torch


class Rows:
    """What processes that hold everything answer by themselves; :class:`.shards.Shards` has to ask the others."""

    sharded = False

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

"""What a run kept from spreading because it was not finite."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch

from warp_splat.formats.checkpoint import Checkpoint
from warp_splat.runtime.distributed import ALONE, Processes


@dataclass
class Quarantine:
    """What was kept from spreading, counted over the run on the device."""

    pixels: int | torch.Tensor = 0  # with an upstream gradient that was not finite
    gradients: int | torch.Tensor = 0  # of Gaussians, not finite: no update in that step
    gaussians: int | torch.Tensor = 0  # left out of an image because a parameter was not finite (once per image)
    prunings: int = 0  # refused, because they would have emptied the scene

    @classmethod
    def restored(cls, checkpoint: Checkpoint, processes: Processes) -> Quarantine:
        """What :meth:`state` gave to a checkpoint; the first process goes on with what is summed over all."""
        counts = {item.name: checkpoint.count(f"dropped.{item.name}") for item in fields(cls)}
        return cls(**counts) if processes.rank == 0 else cls(prunings=counts["prunings"])

    def state(self, processes: Processes) -> dict[str, int]:
        """For a checkpoint."""
        return {f"dropped.{name}": count for name, count in self.read(processes).items()}

    def read(self, processes: Processes = ALONE) -> dict[str, int]:
        """The counts by name, over all processes."""
        counts = torch.tensor([int(self.pixels), int(self.gradients), int(self.gaussians)])
        processes.sum(counts)  # but a refused pruning is the same one everywhere
        names = (item.name for item in fields(self))
        return dict(zip(names, [*counts.tolist(), self.prunings], strict=True))

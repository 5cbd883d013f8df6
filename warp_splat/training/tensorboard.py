"""Event files for TensorBoard, written by the package tensorboardX, which needs neither TensorFlow nor TensorBoard."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from warp_splat.errors import InputError

if TYPE_CHECKING:
    from tensorboardX import SummaryWriter


class EventLog:
    """Curves of a training in its folder; without a writer, nowhere."""

    def __init__(self, writer: SummaryWriter | None = None):
        self.writer = writer

    @classmethod
    def open(cls, folder: Path, begun: int) -> EventLog:
        """A log in ``folder``; what an earlier run logged after iteration ``begun`` is no longer shown."""
        return cls(writer_class()(str(folder), purge_step=begun + 1, flush_secs=10))

    def write_losses(self, iteration: int, losses: Sequence[float], stride: int) -> None:
        """The losses of the steps up to ``iteration``, ``stride`` iterations apart."""
        if self.writer:
            first = iteration - (len(losses) - 1) * stride
            for number, loss in enumerate(losses):
                self.writer.add_scalar("train/loss", loss, first + number * stride)

    def write_record(self, record: Mapping[str, float], split: str) -> None:
        """What an evaluation before the end found, as in ``history.json``."""
        if self.writer:
            step = int(record["iteration"])
            self.writer.add_scalar(f"{split}/psnr_on_the_way", record["psnr"], step)
            self.writer.add_scalar("gaussians", record["gaussians"], step)
            self.writer.add_scalar("seconds", record["seconds"], step)
            self.writer.flush()

    def write_means(self, iteration: int, split: str, means: Mapping[str, float]) -> None:
        """The mean of each metric of the last evaluation; nothing follows."""
        if self.writer:
            for name, value in means.items():
                self.writer.add_scalar(f"{split}/{name}", value, iteration)
            self.writer.close()


def writer_class() -> type[SummaryWriter]:
    """What writes event files.

    Raises:
        InputError: if tensorboardX is not installed.
    """
    try:
        from tensorboardX import SummaryWriter  # noqa: PLC0415 - optional
    except ImportError as error:
        raise InputError("--tensorboard: expected the package tensorboardX; `pip install tensorboardX`.") from error
    return SummaryWriter

"""Event files for TensorBoard, written by the package tensorboardX, which needs neither TensorFlow nor TensorBoard."""

from collections.abc import Iterable
from pathlib import Path

from warp_splat.errors import imported


class EventLog:
    """Curves of a training in its folder; without a folder, nowhere.

    Args:
        folder: where.
        begun: what an earlier run logged after this iteration is no longer shown.
    """

    def __init__(self, folder: Path | None = None, begun: int = 0):
        self.writer = writer_class()(str(folder), purge_step=begun + 1, flush_secs=10) if folder else None

    def write(self, points: Iterable[tuple[int, str, float]]) -> None:
        """Points of curves: iteration, name of the curve, value."""
        if self.writer:
            for iteration, name, value in points:
                self.writer.add_scalar(name, value, iteration)
            self.writer.flush()

    def close(self) -> None:
        """Nothing follows."""
        if self.writer:
            self.writer.close()


def writer_class() -> type:
    """What writes event files, tensorboardX's ``SummaryWriter``.

    Raises:
        InputError: if tensorboardX is not installed.
    """
    problem = "--tensorboard: expected the package tensorboardX; `pip install tensorboardX`."
    return imported("tensorboardX", problem).SummaryWriter

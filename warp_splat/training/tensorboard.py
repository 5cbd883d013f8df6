"""Event files for TensorBoard, written by the package tensorboardX, which needs neither TensorFlow nor TensorBoard."""

import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tqdm import tqdm

from warp_splat.errors import imported, reason_of


class EventLog:
    """Curves of a training in its folder; without a folder, nowhere.

    Args:
        folder: where.
        begun: what an earlier run logged after this iteration is no longer shown.
    """

    def __init__(self, folder: Path | None = None, begun: int = 0):
        self.file = None
        if folder:
            self.library = tensorboard_library()
            self.file = self.library.event_file_writer.EventsWriter(str(folder / "events"))
            self._add(begun + 1, session_log={"status": "START"})

    def write(self, points: Iterable[tuple[int, str, float]]) -> None:
        """Points of curves: iteration, name of the curve, value. They end with a warning where the disk is full."""
        try:
            for iteration, name, value in points if self.file else ():
                self._add(iteration, summary=self.library.summary.scalar(name, value))
            if self.file:
                self.file.flush()
        except OSError as error:
            tqdm.write(f"warning: --tensorboard: no more curves are written ({reason_of(error)}).", file=sys.stderr)
            self.file = None

    def _add(self, step: int, **what) -> None:
        self.file.write_event(self.library.proto.event_pb2.Event(wall_time=time.time(), step=step, **what))


def tensorboard_library() -> Any:
    """tensorboardX, whose ``SummaryWriter`` has a thread that dies where the disk is full, and is waited for.

    Raises:
        InputError: if tensorboardX is not installed.
    """
    problem = "--tensorboard: expected the package tensorboardX; `pip install tensorboardX`."
    return imported("tensorboardX", problem)

"""Which processes have gone: each leaves a sign every second in the store where torchrun lets them meet."""

import math
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch.distributed as dist

GONE = 3.0  # seconds without a sign, of a process of which nothing is heard
HUNG = 20.0  # of one for which others wait in vain
LEFT = "left"


class Watch:
    """The signs of all processes, looked at by a thread of its own."""

    def __init__(self, rank: int, count: int, store: Any, patience: float):
        self.rank, self.store, self.patience, self.stopped = rank, store, patience, threading.Event()
        self.names = [f"sign/{other}" for other in range(count)]
        self.signs, self.changed = [b""] * count, [time.monotonic()] * count

    def gone(self, seconds: float) -> list[int]:
        """Processes that have left no sign for so long."""
        now = time.monotonic()
        return [rank for rank, then in enumerate(self.changed) if now - then > seconds and rank != self.rank]

    def silent(self) -> list[int]:
        """Those that have gone by now, which takes a moment to tell."""
        time.sleep(GONE + 2.0)  # a second until their last sign is seen, another until it is looked at again
        return self.gone(GONE)

    def look(self) -> None:
        """Leave a sign and look at those of others, until one of them hangs: then this process can only end."""
        beat = 0
        while not self.stopped.wait(1.0):
            beat += 1
            self.store.set(self.names[self.rank], str(beat))
            signs, now = self.store.multi_get(self.names), time.monotonic()
            for rank, sign in enumerate(signs):
                if sign != self.signs[rank] or sign == LEFT.encode():
                    self.changed[rank] = now
            self.signs = signs
            if hung := self.gone(self.patience):
                ranks = ", ".join(map(str, hung))
                words = (
                    f"Process {self.rank}: no sign of process {ranks} for {HUNG:.0f} s; the last checkpoint is whole."
                )
                os.write(2, f"warp-splat: error: {words}\n".encode())
                os._exit(1)


@contextmanager
def watching(rank: int, count: int, ends: bool) -> Iterator[Watch]:
    """A watch while the block runs; where one hangs, it ``ends`` this process, which has nothing whole to save."""
    store = dist.distributed_c10d._get_default_store()
    store.set(f"sign/{rank}", "0")
    watch = Watch(rank, count, store, HUNG if ends else math.inf)
    thread = threading.Thread(target=_until_the_store_ends, args=(watch,), daemon=True)
    thread.start()
    try:
        yield watch
    finally:
        watch.stopped.set()
        thread.join(2.0)
        try:
            store.set(f"sign/{rank}", LEFT)
        except RuntimeError:  # the process that kept the store has gone before
            pass


def _until_the_store_ends(watch: Watch) -> None:
    try:
        watch.look()
    except RuntimeError:
        return

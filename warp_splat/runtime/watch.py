"""Which processes have gone: each leaves a sign every second in the store where torchrun lets them meet."""

import math
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import psutil
import torch.distributed as dist

from warp_splat.errors import InputError, tell

GONE = 3.0  # seconds without a sign, of a process of which nothing is heard
HUNG = 20.0  # of one for which others wait in vain
LEFT = "left"


class Watch:
    """The signs of all processes. A thread of its own reads them: of a network that is cut, it waits for ever."""

    def __init__(self, rank: int, count: int, store: Any, patience: float):
        self.rank, self.store, self.patience, self.stopped = rank, store, patience, threading.Event()
        self.names = [f"sign/{other}" for other in range(count)]
        self.signs, self.changed = [b""] * count, [0] * count
        self.seconds = 0  # in which this process ran: one that was stopped for a while (Ctrl-Z) blames nobody

    def gone(self, seconds: float) -> list[int]:
        """Other processes that have left no sign for so long."""
        silent = [rank for rank, then in enumerate(self.changed) if self.seconds - then > seconds]
        return [rank for rank in silent if rank != self.rank and self.signs[rank] != LEFT.encode()]

    def silent(self) -> list[int]:
        """Those that have gone by now, which takes a moment to tell."""
        time.sleep(GONE + 2.0)  # a second until their last sign is seen, another until it is looked at again
        return self.gone(GONE)

    def look(self) -> None:
        """Leave a sign and look at those of others, until the process that keeps them has gone."""
        while not self.stopped.wait(1.0):
            try:
                self.store.set(self.names[self.rank], f"{os.getpid()} {self.seconds}")
                signs = self.store.multi_get(self.names)
            except RuntimeError:
                return
            for rank, sign in enumerate(signs):
                if sign != self.signs[rank]:
                    self.changed[rank] = self.seconds
            self.signs = signs

    def judge(self) -> None:
        """Wait until one of the others hangs: then this process can only end."""
        while not self.stopped.wait(1.0):
            self.seconds += 1
            if self.gone(self.patience):
                hung = self.gone(self.patience / 2)  # two that are cut off have not left their last signs at once
                words = f"Process {self.rank}: no sign of process {', '.join(map(str, hung))} for {HUNG / 2:.0f} s"
                os.write(2, f"warp-splat: error: {words}; the last checkpoint is whole.\n".encode())
                for rank in hung:
                    self.kill(rank)
                os._exit(1)

    def kill(self, rank: int) -> None:
        """End a process that hangs beside this one: torchrun waits 30 s for an answer to its SIGTERM."""
        with suppress(psutil.Error, LookupError):
            process = psutil.Process(int(self.signs[rank].split()[0]))
            if process.ppid() == os.getppid():  # else it has its number on another machine
                process.kill()


@contextmanager
def watching(rank: int, count: int, ends: bool) -> Iterator[Watch]:
    """A watch while the block runs; where one hangs, it ``ends`` this process, which has nothing whole to save.

    An error that all processes of a machine have, of the scene for instance, is told by the first of them.

    Raises:
        SystemExit: instead of the error.
    """
    store = dist.distributed_c10d._get_default_store()
    store.set(f"sign/{rank}", f"{os.getpid()} 0")
    watch = Watch(rank, count, store, HUNG if ends else math.inf)
    threads = [threading.Thread(target=run, daemon=True) for run in (watch.look, watch.judge)]
    for thread in threads:
        thread.start()
    try:
        yield watch
    except (InputError, OSError) as error:
        first = True
        with suppress(RuntimeError):  # the process that kept the store has gone before
            first = store.add(f"told/{os.environ.get('GROUP_RANK')}/{error}", 1) == 1
        if first:  # now: torchrun ends this process as soon as another one has ended
            tell(error)
        raise SystemExit(1) from error
    finally:
        watch.stopped.set()
        threads[0].join(2.0)
        with suppress(RuntimeError):
            store.set(f"sign/{rank}", LEFT)

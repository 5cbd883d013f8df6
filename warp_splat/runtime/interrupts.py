"""Ctrl-C that waits until what is at hand is whole, or that waits for nothing."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def interruptible() -> Iterator[list[int]]:
    """Yield a list that Ctrl-C (and SIGTERM) adds to, instead of raising: the block looks at it when it can stop."""
    interrupted: list[int] = []
    if threading.current_thread() is not threading.main_thread():  # only the main thread may handle signals
        yield interrupted
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    previous = [signal.signal(number, lambda number, frame: interrupted.append(number)) for number in numbers]
    try:
        yield interrupted
    finally:
        for number, handler in zip(numbers, previous, strict=True):
            signal.signal(number, handler)


@contextmanager
def leaving_at_once() -> Iterator[None]:
    """Let Ctrl-C end the process instead of raising: in libraries that are half loaded, exceptions become others."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = signal.signal(signal.SIGINT, _leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


def _leave(*_: object) -> None:
    os.write(2, b"warp-splat: interrupted before it began.\n")  # print may be what was interrupted
    os._exit(130)

"""Ctrl-C that waits until what is at hand is whole."""

from __future__ import annotations

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

"""Ctrl-C that waits until what is at hand is whole, or that waits for nothing."""

import os
import signal
import stat
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import Any, NoReturn

HANGUP = getattr(signal, "SIGHUP", None)  # not on Windows


@contextmanager
def _handling(numbers: Sequence[int], handler: Callable) -> Iterator[None]:
    """Let ``handler`` take these signals; elsewhere than in the main thread, which alone may, nothing happens."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, frame: Any) -> None:
        if number == HANGUP:  # what is said from here on goes nowhere: a terminal that is closed refuses it
            nowhere = os.open(os.devnull, os.O_WRONLY)
            for stream in (1, 2):
                with suppress(OSError):  # it is closed
                    if stat.S_ISCHR(os.fstat(stream).st_mode):
                        os.dup2(nowhere, stream)
        handler(number, frame)

    previous = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield
    finally:
        for number, before in previous.items():
            signal.signal(number, before)


def _ending() -> list[int]:
    """What ends a process by default: SIGTERM, and SIGHUP of a terminal that is closed, unless nohup has it ignored."""
    return [number for number in (signal.SIGTERM, HANGUP) if number and signal.getsignal(number) != signal.SIG_IGN]


@contextmanager
def interruptible() -> Iterator[list[int]]:
    """Yield a list that Ctrl-C (and what ends a process) adds to, instead of raising, for the block to look at."""
    interrupted: list[int] = []
    with _handling((signal.SIGINT, *_ending()), lambda number, frame: interrupted.append(number)):
        yield interrupted


@contextmanager
def later() -> Iterator[None]:
    """Let Ctrl-C and its like come after the block: in libraries that are half loaded, exceptions become others."""
    with interruptible() as interrupted:
        yield
    for number in interrupted:  # for the handler of whoever loads them
        signal.raise_signal(number)


def ending_as_by_ctrl_c() -> AbstractContextManager[None]:
    """Let SIGTERM and SIGHUP raise as Ctrl-C does, so that what is half written goes, and what is measured is kept.

    Not torchrun's: it would wait for a process that waits for another.
    """
    return _handling(_ending() * ("LOCAL_RANK" not in os.environ), signal.default_int_handler)


def leaving_at_once() -> AbstractContextManager[None]:
    """Let Ctrl-C end the process instead of raising: in libraries that are half loaded, exceptions become others."""
    return _handling((signal.SIGINT,), lambda number, frame: leave("warp-splat: interrupted before it began."))


def leave(words: str) -> NoReturn:
    """End the process at once, as Ctrl-C does."""
    os.write(2, f"{words}\n".encode())  # print may be what was interrupted
    os._exit(130)

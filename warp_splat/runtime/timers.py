"""Where the time of a step goes, stage by stage."""

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

import torch

_seconds: dict[str, float] | None = None


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Name the block for whoever reads its errors; add its time to stage ``name``, if :func:`profile` is on."""
    start, table = _now(), _seconds
    try:
        yield
    except (MemoryError, RuntimeError) as error:  # of what ran out of memory, one wants to know where
        error.add_note(f"in stage '{name}'")
        raise
    finally:
        if table is not None:
            table[name] += _now() - start


def _now() -> float:
    """Seconds on the clock of :func:`profile`; while that is on, once the GPU has done what it was given."""
    if _seconds is not None and torch.cuda.is_initialized():
        torch.cuda.synchronize()
    return time.perf_counter()


@contextmanager
def profile(active: bool = True) -> Iterator[dict[str, float]]:
    """Collect the seconds spent in each :func:`stage` while the block runs (unless not ``active``)."""
    global _seconds
    before, collected = _seconds, defaultdict(float)
    _seconds = collected if active else None
    try:
        yield collected
    finally:
        _seconds = before

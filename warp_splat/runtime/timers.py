"""Where the time of a step goes, stage by stage."""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

from warp_splat.errors import InputError

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


def adjoint_of(what: str) -> Callable[[Callable], Callable]:
    """A stage of its own for a ``backward`` of torch's, and an InputError where a graph of its gradients is wanted.

    Torch's ``once_differentiable`` lets them pass for constants where the loss is linear in the image.
    """

    def decorate(backward: Callable) -> Callable:
        def run(ctx, *upstream):
            if torch.is_grad_enabled():
                raise InputError("create_graph=True: expected False: no gradients of gradients here; take differences.")
            with stage(f"adjoint of {what}"):
                return backward(ctx, *upstream)

        return run

    return decorate


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

"""The threads of the CPU: who is free takes the next slice of the work. Results do not depend on their number."""

import atexit
import itertools
import os
import queue
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from numbers import Integral
from typing import Any

import numpy as np
import torch
import warp as wp

from warp_splat.config import CORES
from warp_splat.errors import InputError

MOST_THREADS = 1024
SMALLEST_SLICE = 4096  # indices, or tile instances; below, starting a thread costs more than it saves
SMALLEST_OF_TORCH = 2**16  # likewise, of rows for torch, which takes less time and more of the interpreter's lock
PER_THREAD = 8  # slices of work that is uneven
WIDTH = 64  # numbers: a multiple of what torch computes at once on any processor

_threads = CORES
_helpers: list[threading.Thread] = []
_jobs: "queue.SimpleQueue[_Job | None]" = queue.SimpleQueue()


class _Job:
    """Slices of one launch, or of other work, shared by the threads: whoever is free takes the next one.

    A launch takes tenths of a millisecond, so what a thread costs counts. The caller waits for helpers that are at
    work, but not for those that have not woken yet. Tried:

    - 0.1 ms more per launch, 2 ms a step: an executor's futures
    - no difference, though waking one takes 0.1 ms: helpers, or the caller, that spin, in Python or in native code; two
      or four equal slices for each thread
    """

    def __init__(self, slices: list[Callable[[], None]]):
        self.slices = slices[::-1]
        self.lock, self.ended = threading.Lock(), queue.SimpleQueue()  # a Ctrl-C in an Event's code leaves it locked
        self.helping = 0
        self.error: BaseException | None = None

    def share(self, helpers: int) -> None:
        """The caller's part: call ``helpers``, run slices until there are no more, wait for those that are at work.

        An error or Ctrl-C is raised only then: nobody may still write into tensors that the caller is about to free.
        """
        error = None
        while True:
            try:
                for _ in range(helpers):
                    _jobs.put(self)
                self._run_slices()
                while self.helping:
                    self.ended.get()
                break
            except BaseException as raised:  # Ctrl-C comes at any of these lines, mostly while waiting
                error, helpers = raised, 0
                self.slices.clear()
        if error or self.error:
            try:
                raise error or self.error
            finally:  # or its traceback, which knows this frame, would keep the callers' tensors in a cycle
                error = self.error = None

    def _run_slices(self) -> None:
        while True:
            try:
                run = self.slices.pop()  # one step, hence safe without the lock
            except IndexError:
                return
            run()

    def help(self) -> None:
        """A helper's part."""
        with self.lock:
            if not self.slices:
                return
            self.helping += 1
        try:
            self._run_slices()
        except BaseException as error:
            self.error = error
        finally:
            with self.lock:
                self.helping -= 1
            self.ended.put(None)


@torch.no_grad()
def _help() -> None:
    """What a helper thread does: job after job."""
    while (job := _jobs.get()) is not None:
        job.help()


@atexit.register
def _end_helpers() -> None:
    """Before the interpreter ends: a thread that wakes in its last moments aborts the process."""
    for _ in _helpers:
        _jobs.put(None)
    for helper in _helpers:
        helper.join(1.0)


def _forget_helpers() -> None:
    """A forked child inherits the list but not the threads."""
    global _jobs
    _helpers.clear()
    _jobs = queue.SimpleQueue()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_helpers)


def get_threads() -> int:
    """Number of threads that work on the CPU may use."""
    return _threads


def set_threads(count: int) -> None:
    """Use ``count`` threads (1 to 1024) on the CPU. Results do not depend on it.

    Raises:
        InputError: if ``count`` is not a whole number, or out of that range.
    """
    global _threads
    if isinstance(count, bool) or not isinstance(count, Integral) or not 1 <= count <= MOST_THREADS:
        raise InputError(f"threads: expected a whole number, 1 to {MOST_THREADS}, got {count!r}.")
    _threads = int(count)


def slice_count(work: int, shares: int = 1, smallest: int = 0) -> int:
    """In how many slices to cut ``work`` indices: ``shares`` for each thread, none much below ``smallest``."""
    return max(1, min(shares * _threads if _threads > 1 else 1, work // (smallest or SMALLEST_SLICE)))


def even_slices(dim: int, smallest: int = 0, each: int = 1, device: torch.device | str = "cpu") -> list[int]:
    """Bounds of a slice per thread of ``dim`` pieces of work, of ``each`` indices; of one slice on a GPU."""
    parts = 1 if torch.device(device).type == "cuda" else slice_count(dim * each, smallest=smallest)
    return [dim * part // parts for part in range(parts + 1)]


def falling_shares(work: int) -> np.ndarray:
    """Bounds, from 0 to 1, of slices of ``work`` indices whose cost is not known well: if many, the last are small.

    So all threads end at about the same time. With equal slices, eight to a thread for the blends and one for Adam, a
    step of 200,000 Gaussians took 3 % longer on two threads. The projection, whose slices take Python, gains nothing.
    """
    parts = slice_count(work, PER_THREAD if work >= 2 * _threads * SMALLEST_SLICE else 1)
    power = max(3.0 * parts / (PER_THREAD * _threads), 1.0)  # the first is 0.4 of a thread's share, or all are equal
    return 1.0 - (np.arange(parts, -1, -1) / parts) ** power


def falling_slices(dim: int, each: int = 1) -> list[int]:
    """Bounds of :func:`falling_shares` of ``dim`` pieces of work, of ``each`` indices."""
    return [int(dim * share) for share in falling_shares(dim * each)]


def torch_slices(dim: int, device: torch.device | str = "cpu") -> list[int]:
    """:func:`even_slices` of work that torch does; a single one where it has threads of its own, or works on a GPU.

    In multiples of WIDTH: what is left over at the end of a slice, torch may round in another way.
    """
    if torch.get_num_threads() > 1 or torch.device(device).type == "cuda":
        return [0, dim]
    return [min(WIDTH * bound, dim) for bound in even_slices(-(-dim // WIDTH), SMALLEST_OF_TORCH // WIDTH)]


def in_slices(run: Callable[[int, int], object], bounds: list[int]) -> None:
    """Call ``run`` with the bounds of every slice that is not empty, on the threads of the CPU.

    Slices must write different elements. Helpers record no gradients.
    """
    if torch.is_inference_mode_enabled():  # which is each thread's own
        run = torch.inference_mode()(run)
    # each with its function: a helper that sleeps or comes late knows its job, which must not keep tensors alive
    slices = [partial(run, low, high) for low, high in itertools.pairwise(bounds) if high > low]
    # in its debug mode, Warp keeps what it knows of a running kernel in one place for all threads
    if (helpers := min(_threads, len(slices)) - 1) <= 0 or wp.config.mode == "debug":
        for call in slices:
            call()
        return
    for _ in range(helpers - len(_helpers)):
        helper = threading.Thread(target=_help, name="warp_splat", daemon=True)
        with suppress(RuntimeError):  # the system may give no more threads; then there are fewer
            helper.start()
            _helpers.append(helper)
    _Job(slices).share(min(helpers, len(_helpers)))


def with_slices(alone: Callable[[], Any], run: Callable[[int, int], object], bounds: list[int]) -> Any:
    """What ``alone`` returns, which one thread calls first; slices of ``run`` from 0 on are shared meanwhile."""
    found = []
    in_slices(lambda low, high: run(low, high) if low >= 0 else found.append(alone()), [-1, *bounds])
    return found[0]


def slice_by_slice(passes: Sequence[Callable[[int, int], object]], bounds: list[int]) -> None:
    """Call each of ``passes`` with the bounds of a slice, one after the other, slice by slice."""
    in_slices(lambda low, high: [each(low, high) for each in passes], bounds)

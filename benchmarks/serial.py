"""What keeps a training step from being faster on more cores: work of one thread only, and bytes that must move.

Serial is the time in which fewer than two threads are at work on slices of a launch. On P cores, a stage is predicted
to take

    serial + max((time on one thread - serial) / P, bytes / bandwidth)

with the bytes of ``work.py`` and half of one thread's bandwidth per core: 16 cores have 8 times as much. With more
threads than cores, serial time must not grow: that checks the bookkeeping. What starting slices takes of the
interpreter, which is one thread's at a time, does not show on few cores. So steps are timed as well whose slices are
those of 16 threads, all run by one. Sizes are those of ``step.py``; times are the least of several rounds.

    python benchmarks/serial.py [-s path/to/fox --models output/fox] [--out docs/benchmarks]
"""

import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from unittest import mock

from common import parse, write_table
from gpu_steps import STAGES
from limits import measure_limits
from made_up import VIEWS, steps_of
from step import GIVEN, trainers
from work import Counts, count, mean, work_of

from warp_splat.config import CORES, RasterOptions
from warp_splat.raster.data import Gaussians
from warp_splat.runtime import launch, pool, timers
from warp_splat.training.trainer import Trainer

CORES_PREDICTED = (4, 8, 16, 32)
SHARED, MORE = max(CORES, 2), 4 * max(CORES, 2)  # threads that share the work
MANY = 16  # threads for which a step on one is cut
HOST, WHOLE = "host", "whole step"

Spans = list[tuple[float, float, int]]  # beginning, end and thread


class Clock(defaultdict):
    """Seconds of each stage, as ``timers.stage`` adds them, and of those the seconds in which threads shared work."""

    def __init__(self):
        super().__init__(float)
        self.spans: Spans = []  # of slices, in any order
        self.busy: dict[str, float] = defaultdict(float)
        self.lock = threading.Lock()

    def __setitem__(self, stage: str, total: float) -> None:
        end = time.perf_counter()
        self.busy[stage] += shared(self.spans, end - (total - self.get(stage, 0.0)), end)
        super().__setitem__(stage, total)


def shared(spans: Spans, start: float, end: float) -> float:
    """Seconds between ``start`` and ``end`` in which at least two threads have a span; one's may lie in another."""
    within = [(max(begin, start), min(stop, end), who) for begin, stop, who in spans if begin < end and stop > start]
    events = sorted([(begin, 1, who) for begin, _, who in within] + [(stop, -1, who) for _, stop, who in within])
    found, running, before = 0.0, Counter(), start
    for moment, change, who in events:
        found += moment - before if len(+running) > 1 else 0.0
        running[who] += change
        before = moment
    return found


def timed(clock: Clock, run: Callable[[], None]) -> Callable[[], None]:
    """A slice that notes when it ran."""

    def call() -> None:
        begin = time.perf_counter()
        try:
            run()
        finally:
            with clock.lock:
                clock.spans.append((begin, time.perf_counter(), threading.get_ident()))

    return call


def measure(step: Callable[[], None], threads: int) -> tuple[dict[str, float], dict[str, float]]:
    """Seconds of each stage and of the whole step, and of those in which no work was shared; means over VIEWS steps."""
    clock, job = Clock(), pool._Job
    pool.set_threads(threads)
    timers._seconds, pool._Job = clock, lambda slices: job([timed(clock, run) for run in slices])
    whole = busy = 0.0
    try:
        for _ in range(VIEWS):
            clock.spans.clear()
            start = time.perf_counter()
            step()
            end = time.perf_counter()
            whole, busy = whole + end - start, busy + shared(clock.spans, start, end)
    finally:
        timers._seconds, pool._Job = None, job
    seconds = {stage: clock.get(stage, 0.0) / VIEWS for stage in STAGES}
    serial = {stage: seconds[stage] - clock.busy[stage] / VIEWS for stage in STAGES}
    for table, total in ((seconds, whole / VIEWS), (serial, (whole - busy) / VIEWS)):
        table |= {HOST: total - sum(table.values()), WHOLE: total}
    return seconds, serial


def least(records: list[dict[str, float]]) -> dict[str, float]:
    return {stage: min(record[stage] for record in records) for stage in records[0]}


def measure_trainer(trainer: Trainer, rounds: int) -> tuple[dict, dict, dict]:
    """By stage: seconds on one thread, and serial ones with SHARED and with MORE threads. They take turns."""
    step, found = steps_of(trainer), defaultdict(list)
    for number in range(-1, rounds):
        for threads in (1, SHARED, MORE):
            measured = measure(step, threads)
            if number >= 0:
                found[threads].append(measured)
    (alone, _), (_, serial), (_, check) = (
        (least([seconds for seconds, _ in found[threads]]), least([serial for _, serial in found[threads]]))
        for threads in (1, SHARED, MORE)
    )
    return alone, serial, check


def measure_slices(step: Callable[[], None], rounds: int) -> float:
    """Seconds that a step on one thread takes longer when it is cut into slices for MANY; the least of each."""
    found = defaultdict(list)
    with mock.patch.object(pool._Job, "share", lambda job, helpers: job._run_slices()):
        for _ in range(rounds + 1):
            for threads in (1, MANY):
                pool.set_threads(threads)
                start = time.perf_counter()
                for _ in range(VIEWS):
                    step()
                found[threads].append((time.perf_counter() - start) / VIEWS)
    return min(found[MANY][1:]) - min(found[1][1:])


def predict(alone: dict, serial: dict, counts: Counts, bandwidth: float, cores: int) -> dict[str, float]:
    """Seconds of each stage on so many cores."""
    work, found = work_of(counts), {}
    for stage in [*STAGES, HOST]:
        least = work[stage][0] / (0.5 * cores * bandwidth)
        found[stage] = serial[stage] + max((alone[stage] - serial[stage]) / cores, least)
    return {**found, WHOLE: sum(found.values())}


def main() -> None:
    arguments = parse(__doc__, *GIVEN)
    launch.prepare("cpu", 0)
    bandwidth = measure_limits(1).bandwidth
    rows, notes, data = [], [], {"bandwidth": bandwidth}
    for name, trainer, rounds in trainers(arguments):
        gaussians = Gaussians(*(tensor.detach() for tensor in trainer.model.activated()))
        counts = mean([count(gaussians, view.camera, RasterOptions()) for view in trainer.scene.train])
        alone, serial, check = measure_trainer(trainer, rounds)
        predicted = {cores: predict(alone, serial, counts, bandwidth, cores) for cores in CORES_PREDICTED}
        work = work_of(counts)
        for stage in alone:
            moved = sum(size for size, _ in work.values()) if stage == WHOLE else work[stage][0]
            times = [alone[stage], serial[stage], check[stage], *(predicted[cores][stage] for cores in CORES_PREDICTED)]
            milliseconds = [f"{1e3 * seconds:.2f}" for seconds in times]
            rows.append([name, stage, *milliseconds[:3], f"{1e-6 * moved:.1f}", *milliseconds[3:]])
        gains = ", ".join(f"{alone[WHOLE] / predicted[cores][WHOLE]:.1f} on {cores}" for cores in CORES_PREDICTED)
        slices = measure_slices(steps_of(trainer), rounds)
        notes.append(
            f"{name}: {100 * serial[WHOLE] / alone[WHOLE]:.1f} % of a step is serial; predicted gain {gains}; in "
            f"slices for {MANY}, one thread takes {1e3 * slices:.1f} ms longer."
        )
        print(notes[-1])
        found = {"seconds": alone, "serial": serial, f"serial, {MORE} threads": check, "predicted": predicted}
        data[name] = {**found, "slices": {WHOLE: slices}}
    headers = ("size", "stage", "1 thread: ms", f"serial, {SHARED} threads: ms", f"serial, {MORE} threads: ms", "MB")
    headers += tuple(f"{cores} cores: ms" for cores in CORES_PREDICTED)
    write_table("serial", arguments.out, headers, rows, f"{' '.join(notes)} {1e-9 * bandwidth:.1f} GB/s.", data)


if __name__ == "__main__":
    main()

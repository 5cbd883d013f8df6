"""Every stage of a training step as other processors compute it: AVX-512, AVX2, and vectors of 128 bits.

The kernels are built for each of them, in a process of its own; all run on this machine, by turns. So only the
instructions differ. A processor of that kind has other caches and another clock, and not all of it is emulated: torch
and NumPy keep the width that they were built for, but where an environment variable says otherwise.

The sizes are random Gaussians on 980 x 545 pixels. Times are medians over the rounds, of a round's mean of eight views.

    python benchmarks/processors.py [--count 200000 1000000] [--rounds 5] [--out docs/benchmarks]
"""

import argparse
import json
import os
import statistics
import subprocess
import sys

from common import machine, option, parse, write_table

#: Of each processor, the environment that makes it; the first is what others are compared with.
NO_AVX512 = {"ATEN_CPU_CAPABILITY": "avx2"}
PROCESSORS = {
    "this one": {},
    "this one, portable": {"WARP_SPLAT_PORTABLE": "1"},
    "AVX2": {"WARP_SPLAT_TARGET": "-target-cpu x86-64-v3", **NO_AVX512},
    "128 bits": {"WARP_SPLAT_TARGET": "-target-cpu x86-64", "WARP_SPLAT_PORTABLE": "1", **NO_AVX512},
}
THREADS = (1, 2)
SIZE = (980, 545)


def work(count: int) -> None:
    """The process of a processor: for each line, the seconds of every stage of a round by its number of threads."""
    from made_up import VIEWS, steps_of  # noqa: PLC0415 - the environment comes first
    from step import STAGES, synthetic  # noqa: PLC0415

    from warp_splat.runtime import launch, pool, timers  # noqa: PLC0415

    launch.prepare("cpu", 0)
    step = steps_of(synthetic(count, *SIZE))
    for line in sys.stdin:
        pool.set_threads(int(line))
        with timers.profile() as stages, timers.stage("whole step"):
            for _ in range(VIEWS):
                step()
        seconds = {stage: stages.get(stage, 0.0) / VIEWS for stage in (*STAGES, "whole step")}
        print(json.dumps(seconds), flush=True)


def measure(count: int, rounds: int) -> dict[str, dict[int, dict[str, float]]]:
    """Seconds of each stage, by processor and number of threads."""
    command = [sys.executable, __file__, "--work", str(count)]
    workers = {
        name: subprocess.Popen(
            command, env={**os.environ, **flags}, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        for name, flags in PROCESSORS.items()
    }
    found: dict[str, dict[int, list[dict[str, float]]]] = {name: {t: [] for t in THREADS} for name in PROCESSORS}
    for number in range(-1, rounds):
        for threads in THREADS:
            for name, worker in workers.items():
                assert worker.stdin and worker.stdout
                print(threads, file=worker.stdin, flush=True)
                seconds = json.loads(worker.stdout.readline())
                if number >= 0:
                    found[name][threads].append(seconds)
    for worker in workers.values():
        worker.communicate()
    return {
        name: {
            threads: {stage: statistics.median(record[stage] for record in records) for stage in records[0]}
            for threads, records in by_threads.items()
        }
        for name, by_threads in found.items()
    }


def main() -> None:
    arguments = parse(
        __doc__,
        option("--count", type=int, nargs="+", default=[200_000, 1_000_000], help="Gaussians of each size"),
        option("--rounds", type=int, default=5),
        option("--work", type=int, help=argparse.SUPPRESS),
    )
    if arguments.work:
        work(arguments.work)
        return
    rows, data = [], {"machine": machine()}
    first = next(iter(PROCESSORS))
    for count in arguments.count:
        times = data[str(count)] = measure(count, arguments.rounds)
        for threads in THREADS:
            for stage, base in times[first][threads].items():
                others = [f"{times[name][threads][stage] / base:.2f}" for name in list(PROCESSORS)[1:]] if base else []
                if others:
                    rows.append([f"{count:,}", threads, stage, f"{1e3 * base:.1f}", *others])
    headers = ("Gaussians", "threads", "stage", f"{first}, ms", *list(PROCESSORS)[1:])
    write_table("processors", arguments.out, headers, rows, "Times of the others are multiples of the first.", data)


if __name__ == "__main__":
    main()

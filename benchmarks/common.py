"""What the benchmarks share: timing, the machine's name, and tables."""

import json
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch

from warp_splat.evaluation.report import machine
from warp_splat.text import format_table


def interleaved_medians(runs: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median seconds of each run; rounds over all runs, so that a change of the machine's pace hits them alike."""
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for run in runs.values():
        run()
    for _ in range(repeats):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - start)
    return {name: statistics.median(values) for name, values in seconds.items()}


def write_table(
    name: str, out: Path | None, headers: Sequence, rows: Sequence[Sequence], note: str, data: dict
) -> None:
    """Print a table, and write it to ``<out>/<name>.md`` and ``.json`` if a folder is given."""
    table = format_table(headers, rows)
    print(f"\n{table}\n\n{note}\n{machine()}")
    if out:
        out.mkdir(parents=True, exist_ok=True)
        (out / f"{name}.md").write_text(f"{table}\n\n{note} Measured by `benchmarks/{name}.py` on {machine()}.\n")
        (out / f"{name}.json").write_text(json.dumps(data, indent=1) + "\n")


def milliseconds(run: Callable[[], object], device: str, repeats: int) -> float:
    """Median after a warm-up, by CUDA events (by the clock on a CPU)."""
    times = []
    for repeat in range(-2, repeats):
        if device == "cuda":
            start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            start.record()
            run()
            end.record()
            torch.cuda.synchronize()
            elapsed = start.elapsed_time(end)
        else:
            begun = time.perf_counter()
            run()
            elapsed = 1e3 * (time.perf_counter() - begun)
        if repeat >= 0:
            times.append(elapsed)
    return statistics.median(times)


def synchronize(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()

"""Processor seconds from `python train.py` to the end of its first step, once kernels have been compiled.

Each run is a process of its own; checkouts take turns. The first of each only compiles.

    python benchmarks/first_step.py -s path/to/scene [--before path/to/checkout] [--out docs/benchmarks]
"""

import itertools
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from common import ROOT, SCENE, option, parse, write_table

PARTS = ("torch", "our imports", "scene, options", "kernels", "first step")
RUN = """
import json, os, sys, time
marks = [time.process_time()]
mark = lambda: marks.append(time.process_time())
import torch
mark()
import warp_splat.training.command
mark()
from warp_splat.cli import main
from warp_splat.training.trainer import Trainer
warm_up, differentiate = Trainer.warm_up, Trainer.differentiate
def warm(self):
    mark()
    warm_up(self)
    mark()
def step(self, iteration):
    differentiate(self, iteration)
    mark()
    print(json.dumps(marks), flush=True)
    os._exit(0)
Trainer.warm_up, Trainer.differentiate = warm, step
main(sys.argv[1:])
"""


def seconds_of(checkout: Path, scene: Path) -> list[float]:
    """Of each of PARTS."""
    with tempfile.TemporaryDirectory() as folder:
        flags = ["--eval", "--preset", "fast", "--quiet", "--threads", "1", "-m", folder]
        environment = {**os.environ, "PYTHONPATH": str(checkout)}
        command = [sys.executable, "-c", RUN, "train", "-s", str(scene.resolve()), *flags]
        out = subprocess.run(command, check=True, cwd=checkout, env=environment, capture_output=True, text=True).stdout
    marks = json.loads(out.splitlines()[-1])
    return [late - early for early, late in itertools.pairwise(marks)]


def main() -> None:
    arguments = parse(
        __doc__,
        SCENE,
        option("--before", type=Path, help="another checkout, to compare with"),
        option("--repeats", type=int, default=3),
    )
    checkouts = {"before": arguments.before, "now": ROOT} if arguments.before else {"now": ROOT}
    found: dict[str, list] = {name: [] for name in checkouts}
    for _ in range(1 + arguments.repeats):
        for name, checkout in checkouts.items():
            found[name].append(seconds_of(checkout, arguments.scene))
    rows = []
    for name, runs in found.items():
        parts = [statistics.median(part) for part in zip(*runs[1:], strict=True)]
        rows.append((name, *(f"{part:.2f}" for part in parts), f"{sum(parts):.2f}"))
    note = f"The median of {arguments.repeats} processes, one thread; {arguments.scene.name}, --preset fast."
    write_table("first_step", arguments.out, ("", *PARTS, "all"), rows, note)


if __name__ == "__main__":
    main()

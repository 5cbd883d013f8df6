"""What ``gpu.py`` found: tables that are written after every row, and attempts of which none ends another."""

import json
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from common import versions
from gpu_blends import ATOMIC_HEADERS, LONGEST_HEADERS, SHARE_HEADERS
from gpu_steps import STEP_HEADERS
from gpu_training import GSPLAT_HEADERS, NCU_HEADERS, TRAINING_HEADERS

from warp_splat.errors import InputError
from warp_splat.evaluation.report import machine
from warp_splat.formats.files import atomic_write, write_json
from warp_splat.runtime.devices import is_out_of_memory
from warp_splat.text import format_table

ROWS = "rows: "  # begins a line that a process prints for its parent
HEADERS = {
    "Checks": ("check", "found"),
    "Training step": STEP_HEADERS,
    "Kernels of a step": ("kernel", "ms per step"),
    "Longest tile": LONGEST_HEADERS,
    "Share of the card": SHARE_HEADERS,
    "Slots against atomics": ATOMIC_HEADERS,
    "Orbit": ("size", "Gaussians", "loop cap", "frames per second"),
    "Adjoints: error against time": ("scene", "variant", "error", "of", "forward ms", "backward ms"),
    "Adjoints: time and memory": ("size", "Gaussians", "mode", "forward ms", "forward + backward ms", "peak MiB"),
    "Training": TRAINING_HEADERS,
    "Beside gsplat": GSPLAT_HEADERS,
    "Kernels by ncu": NCU_HEADERS,
    "Left out": ("what", "why"),
}


class Results:
    """Tables by heading, written anew whenever a row comes in; what the time does not suffice for is noted."""

    def __init__(self, out: Path | None, device: str, seconds: float, only: str = "", apart: Sequence[str] = ()):
        """Attempt ``only`` one thing; or each in a process of its own, by the command line ``apart``."""
        self.out, self.end, self.only, self.apart = out, time.monotonic() + seconds, only, apart
        self.tables: dict[str, list[Sequence]] = {}
        self.wrong: list[str] = []
        card = torch.cuda.get_device_name() if device == "cuda" else "Dry run on the CPU, which says nothing of a GPU"
        self.where = f"{card}; {machine()}; {versions()}"

    @property
    def left(self) -> float:
        """Seconds."""
        return self.end - time.monotonic()

    def add(self, heading: str, rows: Sequence[Sequence]) -> None:
        self.tables.setdefault(heading, []).extend(rows)
        if heading == "Checks":
            self.wrong += [what for what, found in rows if found.startswith("WRONG")]
        if self.only:
            print(ROWS + json.dumps([heading, rows]), flush=True)
            return
        for row in rows:
            print(f"{heading}: {' | '.join(map(str, row))}", flush=True)
        if self.out:
            tables = [f"## {name}\n\n{format_table(HEADERS[name], found)}\n" for name, found in self.tables.items()]
            with atomic_write(self.out / "gpu.md") as path:
                path.write_text("\n".join([*tables, f"Measured by `benchmarks/gpu.py` on {self.where}.\n"]))
            named = {name: [dict(zip(HEADERS[name], row, strict=True)) for row in found]
                     for name, found in self.tables.items()}  # fmt: skip
            write_json(self.out / "gpu.json", {"tables": named, "where": self.where})

    def judge(self, what: str, found: str, right: bool) -> None:
        """A row of the checks; one that fails stops nothing, for a card may be at hand only now, but ends in code 1."""
        self.add("Checks", [(what, found if right else f"WRONG: {found}")])

    def attempt(self, what: str, run: Callable[[], None], needs: float, starts: bool = False) -> None:
        """Run, if ``needs`` seconds are left; what runs out of memory is a row, too.

        What ``starts`` a process itself needs no other around it, which takes nine seconds to begin on a GPU machine.
        """
        if self.only and what != self.only:
            return
        if self.left < needs:
            self.add("Left out", [(what, "no time left")])
            return
        if self.apart and not starts:
            self._start(what)
            return
        start = time.monotonic()
        try:
            run()
        except (MemoryError, RuntimeError, InputError) as error:
            if not (is_out_of_memory(error) or isinstance(error, InputError)):
                raise
            self.add("Left out", [(what, str(error).splitlines()[0])])
        if torch.cuda.is_initialized():
            torch.cuda.empty_cache()
        print(f"{what}: {time.monotonic() - start:.0f} s, {self.left:.0f} s left", flush=True)

    def _start(self, what: str) -> None:
        """A process that attempts ``what``; its rows are added here, and how it ended if that was not well."""
        try:
            done = subprocess.run(
                [*self.apart, "--only", what], capture_output=True, text=True, check=False, timeout=self.left
            )
        except subprocess.TimeoutExpired:
            self.add("Left out", [(what, "not finished")])
            return
        for line in done.stdout.splitlines():
            if line.startswith(ROWS):
                self.add(*json.loads(line.removeprefix(ROWS)))
            else:
                print(line)
        if done.returncode:
            self.judge(what, (done.stderr.strip().splitlines() or ["no word"])[-1], False)

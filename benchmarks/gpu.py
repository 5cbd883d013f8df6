"""On an NVIDIA GPU: check first, then measure, what matters most first. Needs no network and at most 8 minutes.

    python benchmarks/gpu.py [--out docs/benchmarks]     # writes gpu.md and gpu.json after every row
    python benchmarks/gpu.py --device cpu                # a dry run of this program at small sizes
    python benchmarks/gpu.py --save-expected cpu.npz     # anywhere: what the CPU's kernels say, for --expected cpu.npz
                                                         # on a machine whose Warp was built without them; of the
                                                         # small case, if the file is called gpu_expected.npz

Checks: the self-test, every mode against the CPU's results (of a small case they lie in gpu_expected.npz), two runs bit
for bit, a small case under compute-sanitizer's memcheck, racecheck and synccheck, pytest. On a card each check and each
measurement has a process of its own: one that ends by an illegal address ends no other.
Measures: training steps by stage and as a whole against the sum of stages and of kernels; the two blends' share of the
card's bandwidth and arithmetic; slots against atomics; an orbit with and without the thesis's loop cap; all adjoints,
error against time; what the host needs for a step. Times are medians. What the time does not suffice for is listed.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import torch
import warp as wp
from gpu_blends import ATOMIC_HEADERS, SHARE_HEADERS, measure_blends
from gpu_steps import STEP_HEADERS, measure_errors, measure_modes, measure_orbit, measure_step
from made_up import cameras, make_crowd, make_gaussians

from warp_splat import rasterize
from warp_splat.config import ADJOINTS
from warp_splat.errors import InputError
from warp_splat.evaluation.report import machine
from warp_splat.formats.atomic import atomic_write, write_json
from warp_splat.raster.drivers import CUDA, using
from warp_splat.raster.selftest import check_device
from warp_splat.runtime.devices import is_out_of_memory
from warp_splat.runtime.launch import prepare
from warp_splat.text import format_table

SMALL, LARGE = (980, 545), (1920, 1080)
COUNT = 1_000_000
CHECKED, STORED = (20_000, 320, 200), (500, 64, 40)  # cases; what the CPU says of the second lies in a file
EXPECTED = Path(__file__).with_name("gpu_expected.npz")
TOOLS = ("memcheck", "racecheck", "synccheck")
ROWS = "rows: "  # begins a line that a process prints for its parent
LIMIT, DECISION, RARE = 1e-4, 2e-2, 1e-3  # of errors; of those where rounding decides; share of pixels where it may
NAMES = ("image", "means", "quats", "scales", "opacities", "sh")
HEADERS = {
    "Checks": ("check", "found"),
    "Training step": STEP_HEADERS,
    "Kernels of a step": ("kernel", "ms per step"),
    "Share of the card": SHARE_HEADERS,
    "Slots against atomics": ATOMIC_HEADERS,
    "Orbit": ("size", "Gaussians", "loop cap", "frames per second"),
    "Adjoints: error against time": ("scene", "variant", "error", "of", "forward ms", "backward ms"),
    "Adjoints: time and memory": ("size", "Gaussians", "mode", "forward ms", "forward + backward ms", "peak MiB"),
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
        self.where = f"{card}; {machine()}; torch {torch.__version__}, Warp {wp.__version__}"

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

    def attempt(self, what: str, run: Callable[[], None], needs: float) -> None:
        """Run, if ``needs`` seconds are left; what runs out of memory is a row, too."""
        if self.only and what != self.only:
            return
        if self.left < needs:
            self.add("Left out", [(what, "no time left")])
            return
        if self.apart:
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
        if done.returncode:
            self.judge(what, (done.stderr.strip().splitlines() or ["no word"])[-1], False)


def differentiate(count: int, width: int, height: int, device: str, mode: str) -> list[torch.Tensor]:
    """Image and gradients of a weighted sum of it, in the order of NAMES; the scene is the same on every device."""
    means, quats, scales, opacities, *sh = make_gaussians(count, "cpu").activated()
    scene = [tensor.detach().to(device) for tensor in (means, quats, scales, opacities, torch.cat(sh, 1))]
    leaves = [tensor.requires_grad_() for tensor in scene]
    out = rasterize(*leaves, cameras(width, height, 1)[0], adjoint=mode)
    weights = torch.linspace(-1, 1, out.image.numel(), device=device).view_as(out.image)
    (out.image * weights).sum().backward()
    return [out.image.detach().cpu(), *(leaf.grad.cpu() for leaf in leaves)]


def check(results: Results, device: str, case: tuple[int, int, int], expected: dict[str, torch.Tensor]) -> None:
    """Every mode against itself and against the CPU's manual one."""
    for mode in ADJOINTS:
        what = f"{mode}, {case[0]} Gaussians"
        results.attempt(what, lambda mode=mode: check_mode(results, device, mode, case, expected), 10)


def check_mode(results: Results, device: str, mode: str, case: tuple[int, int, int], expected: dict) -> None:
    first, second = (differentiate(*case, device, mode) for _ in range(2))
    same = all(map(torch.equal, first, second))
    results.judge(f"{mode}: two runs", "the same bits" if same else "differ", same)
    found = dict(zip(NAMES, first, strict=True))
    for name, truth in expected.items():
        difference = found[name] - truth
        error = float(difference.norm() / truth.norm())
        right = error < LIMIT
        if name == "image":
            size = difference.abs().amax(2)
            error, share = float(size.max()), float((size > LIMIT).float().mean())
            right = error < DECISION and share < RARE
        results.judge(f"{mode}: {name} against the CPU", f"{error:.1e}", right)


def expectation(file: Path | None, case: tuple[int, int, int]) -> dict[str, torch.Tensor]:
    """What the CPU's kernels say, from a file or by themselves; empty if Warp has none here."""
    if file:
        return {name: torch.from_numpy(array) for name, array in np.load(file).items()}
    if not wp.is_cpu_available():
        return {}
    return dict(zip(NAMES, differentiate(*case, "cpu", "manual"), strict=True))


def test_itself(results: Results, device: str) -> None:
    for mode in ADJOINTS:
        check_device(torch.device(device), mode)
    results.judge("self-test", "right", True)


def run_checked(results: Results, what: str, command: Sequence) -> None:
    """A program that says by its exit code whether all is well."""
    if shutil.which(command[0]) is None:
        results.add("Left out", [(what, "not installed")])
        return
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=max(results.left, 1))
    except subprocess.TimeoutExpired:
        results.add("Left out", [(what, "not finished")])
        return
    results.judge(
        what, f"{done.stdout[-1500:]}{done.stderr[-500:]}" if done.returncode else "no errors", not done.returncode
    )


def check_by_programs(results: Results) -> None:
    """A small case under compute-sanitizer, and the tests that run for CUDA."""
    for tool in TOOLS:
        command = ["compute-sanitizer", "--tool", tool, "--error-exitcode", "9", sys.executable, __file__, "--small"]
        results.attempt(tool, lambda tool=tool, command=command: run_checked(results, tool, command), 30)
    tests = [sys.executable, "-m", "pytest", "-q", "-k", "cuda", Path(__file__).parents[1] / "tests/test_rasterize.py"]
    results.attempt("pytest", lambda: run_checked(results, "pytest", tests), 60)


def measure(results: Results, device: str) -> None:
    """What matters most first: one million Gaussians, then small, large and huge ones."""
    real = device == "cuda"
    count, size, large = (COUNT, SMALL, LARGE) if real else (1000, (98, 54), (192, 108))

    def step(count: int, size: tuple[int, int]) -> None:
        row, kernels = measure_step(count, *size, device, 60 if real else 6)
        results.add("Training step", [row])
        if kernels and (count, size) == (COUNT, SMALL):
            results.add("Kernels of a step", [(name[:90], f"{spent:.4f}") for name, spent in kernels])

    def blends(make: Callable, size: tuple[int, int], scene: str) -> None:
        shares, ways, error = measure_blends(make(count, device), *size, device, 20 if real else 1)
        results.judge(f"atomics against slots, {scene}", f"{error:.1e}", error < LIMIT)
        results.add("Share of the card", [[f"{name}, {scene}", *rest] for name, *rest in shares])
        results.add("Slots against atomics", ways)

    def modes(count: int, size: tuple[int, int]) -> None:
        results.add("Adjoints: time and memory", measure_modes(count, *size, device, 10 if real else 2))

    def errors() -> None:
        rows = measure_errors((100, 1000, 10_000) if real else (10,), device, print)
        results.add("Adjoints: error against time", rows)

    attempt = results.attempt
    attempt("step", lambda: step(count, size), 20)
    attempt("blends, ball", lambda: blends(make_gaussians, size, "ball"), 20)
    attempt("blends, crowd", lambda: blends(make_crowd, large, "crowd"), 20)
    attempt("orbit", lambda: results.add("Orbit", measure_orbit(count, device, 100 if real else 3)), 20)
    attempt("modes", lambda: modes(count, size), 20)
    attempt("errors", errors, 60)
    attempt("host", lambda: step(100, (64, 64)), 10)  # hardly any arithmetic: what the host does, at most
    others = [(count // 10, size), (count, large), (5 * count, size), (count // 10, large), (5 * count, large)]
    for place in others:
        attempt(f"step, {place}", lambda place=place: step(*place), 40 * place[0] / (5 * count))
    for place in others[::2]:
        attempt(f"modes, {place}", lambda place=place: modes(*place), 40 * place[0] / (5 * count))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="folder for gpu.md and gpu.json")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--seconds", type=float, default=450, help="after which nothing new is begun (default: 450)")
    parser.add_argument("--save-expected", type=Path, help="write the CPU's results to this file, and stop")
    parser.add_argument("--expected", type=Path, help="compare with the results in this file")
    parser.add_argument("--only", default="", help="one check or measurement, by its name; prints rows for its parent")
    parser.add_argument("--small", action="store_true", help="one small case and nothing else, for the sanitizer")
    arguments = parser.parse_args()
    os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # or torch's profiler tells when it starts and stops
    device, case = arguments.device, CHECKED
    try:
        # one thread in a dry run: its smallest step tells how long the host is busy at most
        prepare("cpu" if arguments.save_expected else device, int(device == "cpu"))
    except InputError as error:
        raise SystemExit(str(error)) from None
    if arguments.save_expected:
        found = differentiate(*(STORED if arguments.save_expected.name == EXPECTED.name else case), "cpu", "manual")
        arrays = {name: tensor.numpy() for name, tensor in zip(NAMES, found, strict=True)}
        np.savez_compressed(arguments.save_expected, **arrays)
        return
    if arguments.small:
        for mode in ADJOINTS:
            differentiate(2000, 100, 70, device, mode)
        return
    apart = ()
    if device == "cuda" and not arguments.only:
        apart = [sys.executable, __file__, "--device", device]
        apart += ["--expected", arguments.expected] if arguments.expected else []
    results, driver = Results(arguments.out, device, arguments.seconds, arguments.only, apart), nullcontext()
    if device == "cpu":  # the kernels of a GPU, in fibers
        driver, wp.config.enable_cpu_blocks = using(CUDA), True
    with driver:
        results.attempt("self-test", lambda: test_itself(results, device), 10)
        check(results, device, STORED, expectation(EXPECTED, STORED))
        if device == "cuda":
            check_by_programs(results)
            check(results, device, case, {} if apart else expectation(arguments.expected, case))
    measure(results, device)
    if results.wrong and not results.only:  # else its parent says so
        raise SystemExit(f"Wrong: {', '.join(results.wrong)}.")


if __name__ == "__main__":
    main()

"""On an NVIDIA GPU: check first, then measure, what matters most first. Needs no network and at most 8 minutes.

    python benchmarks/gpu.py [--out docs/benchmarks]     # writes gpu.md and gpu.json after every row
    python benchmarks/gpu.py --device cpu                # a dry run of this program at small sizes
    python benchmarks/gpu.py --save-expected cpu.npz     # anywhere: what the CPU's kernels say, for --expected cpu.npz
                                                         # on a machine whose Warp was built without them

Checks: CUDA agrees with the CPU, two runs give the same bits, a small case is clean under compute-sanitizer.
Measures: training steps by stage and as a whole against the sum of stages and of kernels; the two blends' share of the
card's bandwidth and arithmetic; slots against atomics; an orbit with and without the thesis's loop cap; all adjoints,
error against time; what the host needs for a step. Times are medians. What the time does not suffice for is listed.
"""

import argparse
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
from made_up import cameras, make_gaussians

from warp_splat import rasterize
from warp_splat.config import ADJOINTS
from warp_splat.errors import InputError
from warp_splat.evaluation.report import machine
from warp_splat.formats.atomic import atomic_write, write_json
from warp_splat.raster.drivers import CUDA, using
from warp_splat.runtime.devices import is_out_of_memory
from warp_splat.runtime.launch import prepare
from warp_splat.text import format_table

SMALL, LARGE = (980, 545), (1920, 1080)
COUNT, CHECKED = 1_000_000, 20_000
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

    def __init__(self, out: Path | None, device: str, seconds: float):
        self.out, self.end = out, time.monotonic() + seconds
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
        if not right:
            self.wrong.append(what)

    def attempt(self, what: str, run: Callable[[], None], needs: float) -> None:
        """Run, if ``needs`` seconds are left; what runs out of memory is a row, too."""
        if self.left < needs:
            self.add("Left out", [(what, "no time left")])
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


def sanitize(results: Results) -> None:
    """A small case under compute-sanitizer."""
    program, found = shutil.which("compute-sanitizer"), "not installed"
    if program:
        command = [program, "--error-exitcode", "9", sys.executable, __file__, "--small"]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=results.left)
            found = "no errors" if done.returncode == 0 else f"{done.stdout[-1500:]}{done.stderr[-500:]}"
        except subprocess.TimeoutExpired:
            found = "not finished"
    results.judge("compute-sanitizer", found, found in ("no errors", "not installed", "not finished"))


def measure(results: Results, device: str) -> None:
    """What matters most first: one million Gaussians, then small, large and huge ones."""
    real = device == "cuda"
    count, size, large = (COUNT, SMALL, LARGE) if real else (1000, (98, 54), (192, 108))

    def step(count: int, size: tuple[int, int]) -> None:
        row, kernels = measure_step(count, *size, device, 60 if real else 6)
        results.add("Training step", [row])
        if "Kernels of a step" not in results.tables and kernels:
            results.add("Kernels of a step", [(name[:90], f"{spent:.4f}") for name, spent in kernels])

    def blends() -> None:
        shares, ways, error = measure_blends(count, *size, device, 20 if real else 1)
        results.judge("atomics against slots", f"{error:.1e}", error < LIMIT)
        results.add("Share of the card", shares)
        results.add("Slots against atomics", ways)

    def modes(count: int, size: tuple[int, int]) -> None:
        results.add("Adjoints: time and memory", measure_modes(count, *size, device, 10 if real else 2))

    def errors() -> None:
        rows = measure_errors((100, 1000, 10_000) if real else (10,), device, print)
        results.add("Adjoints: error against time", rows)

    attempt = results.attempt
    attempt("step", lambda: step(count, size), 20)
    attempt("blends", blends, 20)
    attempt("orbit", lambda: results.add("Orbit", measure_orbit(count, device, 100 if real else 3)), 20)
    attempt("modes", lambda: modes(count, size), 20)
    attempt("errors", errors, 60)
    attempt("host", lambda: step(100, (64, 64)), 10)  # hardly any arithmetic: what the host does, at most
    others = [(count // 10, size), (count, large), (5 * count, size), (count // 10, large), (5 * count, large)]
    for place in others:
        attempt(f"step, {place}", lambda place=place: step(*place), 40 * place[0] / (5 * count))
    for place in others[::2]:
        attempt(f"modes, {place}", lambda place=place: modes(*place), 40 * place[0] / (5 * count))
    if real:
        attempt("compute-sanitizer", lambda: sanitize(results), 30)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="folder for gpu.md and gpu.json")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--seconds", type=float, default=450, help="after which nothing new is begun (default: 450)")
    parser.add_argument("--save-expected", type=Path, help="write the CPU's results to this file, and stop")
    parser.add_argument("--expected", type=Path, help="compare with the results in this file")
    parser.add_argument("--small", action="store_true", help="one small case and nothing else, for the sanitizer")
    arguments = parser.parse_args()
    os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # or torch's profiler tells when it starts and stops
    device, case = arguments.device, (CHECKED, 320, 200)
    try:
        # one thread in a dry run: its smallest step tells how long the host is busy at most
        prepare("cpu" if arguments.save_expected else device, int(device == "cpu"))
    except InputError as error:
        raise SystemExit(str(error)) from None
    if arguments.save_expected:
        found = differentiate(*case, "cpu", "manual")
        np.savez(arguments.save_expected, **{name: tensor.numpy() for name, tensor in zip(NAMES, found, strict=True)})
        return
    if arguments.small:
        for mode in ADJOINTS:
            differentiate(2000, 100, 70, device, mode)
        return
    results, driver = Results(arguments.out, device, arguments.seconds), nullcontext()
    if device == "cpu":  # the kernels of a GPU, in fibers
        case, driver, wp.config.enable_cpu_blocks = (500, 64, 40), using(CUDA), True
    expected = expectation(arguments.expected, case)
    with driver:
        check(results, device, case, expected)
    measure(results, device)
    if results.wrong:
        raise SystemExit(f"Wrong: {', '.join(results.wrong)}.")


if __name__ == "__main__":
    main()

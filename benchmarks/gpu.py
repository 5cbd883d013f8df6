"""On an NVIDIA GPU: check first, then measure, what matters most first. Needs no network and at most 8 minutes.

    python benchmarks/gpu.py [--out docs/benchmarks]     # writes gpu.md and gpu.json after every row
    python benchmarks/gpu.py --device cpu                # a dry run of this program at small sizes
    python benchmarks/gpu.py --save-expected cpu.npz     # anywhere: what the CPU's kernels say, for --expected cpu.npz
                                                         # on a machine whose Warp was built without them; of the
                                                         # small case, if the file is called gpu_expected.npz

In this order. Checks: ``rasterize`` as a process's first call; the self-test; a small case under compute-sanitizer's
memcheck, racecheck and synccheck; every mode's two runs bit for bit, and against the CPU's results (of a small case
they lie in gpu_expected.npz). On a card each check and each measurement has a process of its own: one that ends by an
illegal address ends no other.
Measures: training steps by stage and as a whole against the sum of stages and of kernels; the longest tile's share of
the adjoint. Then pytest, a larger case against the CPU, and the other tables: the two blends' share of the card's
bandwidth and arithmetic; slots against atomics; an orbit with and without the thesis's loop cap; all adjoints,
error against time; what the host needs for a step; whole training against the CPU's; gsplat beside ours, if it can be
imported; kernels by ncu, if it is installed. Times are medians. What the time does not suffice for is listed.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import numpy as np
import torch
import warp as wp
from common import option, parse, using
from gpu_blends import blends_of, measure_blends, measure_longest
from gpu_results import Results
from gpu_steps import measure_errors, measure_modes, measure_orbit, measure_step
from gpu_training import NOISE, measure_gsplat, measure_training, profile_by_ncu, psnr_on_cpu
from made_up import cameras, make_crowd, make_gaussians

from warp_splat import rasterize
from warp_splat.config import ADJOINTS
from warp_splat.errors import InputError
from warp_splat.raster.drivers import CUDA
from warp_splat.raster.selftest import check_device
from warp_splat.runtime.launch import prepare

SMALL, LARGE = (980, 545), (1920, 1080)
COUNT = 1_000_000
CHECKED, STORED = (20_000, 320, 200), (500, 64, 40)  # cases; what the CPU says of the second lies in a file
EXPECTED = Path(__file__).with_name("gpu_expected.npz")
TOOLS = ("memcheck", "racecheck", "synccheck")
#: Warp's kernels alone, as it names them; and what Warp asks of a driver that does not know it is no error.
WARPS = ("--kernel-name", "kernel_substring=_cuda_kernel_", "--ignore-getprocaddress-notfound")
PATIENCE = 90  # s, for one of these tools
LIMIT, DECISION, RARE = 1e-4, 2e-2, 1e-3  # of errors; of those where rounding decides; share of pixels where it may
NAMES = ("image", "means", "quats", "scales", "opacities", "sh")


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
    results.judge(f"{mode}: two runs, {case[0]} Gaussians", "the same bits" if same else "differ", same)
    found = dict(zip(NAMES, first, strict=True))
    for name, truth in expected.items():
        difference = found[name] - truth
        error = float(difference.norm() / truth.norm())
        right = error < LIMIT
        if name == "image":
            size = difference.abs().amax(2)
            error, share = float(size.max()), float((size > LIMIT).float().mean())
            right = error < DECISION and share < RARE
        results.judge(f"{mode}: {name} against the CPU, {case[0]} Gaussians", f"{error:.1e}", right)


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


FIRST_CALL = """
import numpy, torch
from warp_splat import Camera, rasterize
means, scales, sh = torch.zeros(1, 3), torch.full((1, 3), 0.5), torch.ones(1, 1, 3)
given = [tensor.to("DEVICE") for tensor in (means, torch.eye(4)[:1], scales, torch.full((1,), 0.9), sh)]
camera = Camera(32, 24, 30.0, 30.0, 16.0, 12.0, numpy.eye(3), numpy.array([0.0, 0.0, 3.0]))
middle = rasterize(*given, camera).image[12, 16].cpu()
assert 0.6 < middle.min() < 0.8, middle  # 0.9 (0.5 + 0.282), and a little beside the middle
"""


def run_checked(results: Results, what: str, command: Sequence, limit: float = np.inf) -> None:
    """A program that says by its exit code whether all is well, within so many seconds."""
    if shutil.which(command[0]) is None:
        results.add("Left out", [(what, "not installed")])
        return
    try:
        left = max(min(results.left, limit), 1)
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=left)
    except subprocess.TimeoutExpired:
        results.add("Left out", [(what, "not finished")])
        return
    if done.returncode:
        print(done.stdout[-3000:], done.stderr[-1000:])
    said = (done.stdout.strip() or done.stderr.strip() or f"exit code {done.returncode}").splitlines()[-1]
    results.judge(what, said if done.returncode else "no errors", not done.returncode)


def check_by_sanitizer(results: Results) -> None:
    """A small case under each of compute-sanitizer's tools."""
    for tool in TOOLS:
        command = ["compute-sanitizer", "--tool", tool, "--error-exitcode", "9", *WARPS, sys.executable]
        command += [__file__, "--small"]
        run = partial(run_checked, results, tool, command, PATIENCE)
        results.attempt(tool, run, 30, starts=True)


def measure(results: Results, device: str, real: bool, check_more: Callable[[], None]) -> None:
    """What matters most first: one million Gaussians, then small, large and huge ones; few if it is not ``real``."""
    count, size, large = (COUNT, SMALL, LARGE) if real else (1000, (98, 54), (192, 108))

    def step(count: int, size: tuple[int, int]) -> None:
        row, kernels = measure_step(count, *size, device, 60 if real else 6)
        results.add("Training step", [row])
        if kernels and (count, size) == (COUNT, SMALL):
            results.add("Kernels of a step", [(name[:90], f"{spent:.4f}") for name, spent in kernels])

    def longest(make: Callable, size: tuple[int, int], scene: str) -> None:
        row = measure_longest(blends_of(make(count, device), *size), device, 20 if real else 1)
        results.add("Longest tile", [[scene, *row]])

    def blends(make: Callable, size: tuple[int, int], scene: str) -> None:
        made = blends_of(make(count, device), *size)
        shares, ways, error = measure_blends(made, "{} x {}".format(*size), device, 20 if real else 1)
        results.judge(f"atomics against slots, {scene}", f"{error:.1e}", error < LIMIT)
        results.add("Share of the card", [[f"{name}, {scene}", *rest] for name, *rest in shares])
        results.add("Slots against atomics", ways)

    def modes(count: int, size: tuple[int, int]) -> None:
        results.add("Adjoints: time and memory", measure_modes(count, *size, device, 10 if real else 2))

    def errors() -> None:
        rows = measure_errors((100, 1000, 10_000) if real else (10,), device, print)
        results.add("Adjoints: error against time", rows)

    def training() -> None:
        found = []
        for row, quality in measure_training(device, None if real else 2):
            results.add("Training", [row])
            found.append(quality)
        if real:
            behind = psnr_on_cpu() - np.mean(found[1:])
            results.judge("training, four seeds", f"{behind:.2f} dB behind the CPU", behind < NOISE)

    def profiled() -> None:
        found = profile_by_ncu(results.left)
        results.add(*(("Kernels by ncu", found) if found else ("Left out", [("ncu", "not installed, or not allowed")])))

    attempt = results.attempt
    attempt("step", lambda: step(count, size), 20)
    attempt("longest tile, ball", lambda: longest(make_gaussians, size, "ball"), 20)
    attempt("longest tile, crowd", lambda: longest(make_crowd, large, "crowd"), 20)
    check_more()
    attempt("blends, ball", lambda: blends(make_gaussians, size, "ball"), 20)
    attempt("blends, crowd", lambda: blends(make_crowd, large, "crowd"), 20)
    attempt("orbit", lambda: results.add("Orbit", measure_orbit(count, device, 100 if real else 3, real)), 20)
    attempt("modes", lambda: modes(count, size), 20)
    attempt("errors", errors, 60)
    attempt("host", lambda: step(100, (64, 64)), 10)  # hardly any arithmetic: what the host does, at most
    attempt("training", training, 60)
    attempt("gsplat", lambda: results.add("Beside gsplat", measure_gsplat(count, *size, device, 20 if real else 1)), 20)
    if real:
        attempt("ncu", profiled, 60)
    others = [(count // 10, size), (count, large), (5 * count, size), (count // 10, large), (5 * count, large)]
    for place in others:
        attempt(f"step, {place}", lambda place=place: step(*place), 40 * place[0] / (5 * count))
    for place in others[::2]:
        attempt(f"modes, {place}", lambda place=place: modes(*place), 40 * place[0] / (5 * count))


def main() -> None:
    arguments = parse(
        __doc__,
        option("--device", choices=("cuda", "cpu"), default="cuda"),
        option("--seconds", type=float, default=450, help="after which nothing new is begun (default: 450)"),
        option("--save-expected", type=Path, help="write the CPU's results to this file, and stop"),
        option("--expected", type=Path, help="compare with the results in this file"),
        option("--only", default="", help="one check or measurement, by its name; prints rows for its parent"),
        option("--small", action="store_true", help="one small case and nothing else, for the sanitizer"),
        option("--dry", action="store_true", help="the sizes of a dry run, in one process, on any device"),
    )
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
    apart, real = (), device == "cuda" and not arguments.dry
    if real and not arguments.only:
        apart = [sys.executable, __file__, "--device", device]
        apart += ["--expected", arguments.expected] if arguments.expected else []
    results, driver = Results(arguments.out, device, arguments.seconds, arguments.only, apart), nullcontext()
    if device == "cpu":  # the kernels of a GPU, in fibers
        driver, wp.config.enable_cpu_blocks = using(CUDA), True
    first = [sys.executable, "-c", FIRST_CALL.replace("DEVICE", device)]
    tests = [sys.executable, "-m", "pytest", "-q", "-k", "cuda", Path(__file__).parents[1] / "tests/test_rasterize.py"]

    def check_more() -> None:
        if real:
            results.attempt("pytest", lambda: run_checked(results, "pytest", tests), 60, starts=True)
            check(results, device, case, {} if apart else expectation(arguments.expected, case))

    results.attempt("first call", lambda: run_checked(results, "first call", first), 10, starts=True)
    with driver:
        results.attempt("self-test", lambda: test_itself(results, device), 10)
        if device == "cuda":
            check_by_sanitizer(results)
        check(results, device, STORED, expectation(EXPECTED, STORED))
    measure(results, device, real, check_more)
    if results.wrong and not results.only:  # else its parent says so
        raise SystemExit(f"Wrong: {', '.join(results.wrong)}.")


if __name__ == "__main__":
    main()

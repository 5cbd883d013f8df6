"""On an NVIDIA GPU: check first, then measure. Needs no network, writes gpu.md and gpu.json.

    python benchmarks/gpu.py --save-expected cpu.npz     # anywhere: what the CPU's kernels say
    python benchmarks/gpu.py --expected cpu.npz [--out docs/benchmarks]
    python benchmarks/gpu.py --device cpu                # a dry run of this program at small sizes

Checks: CUDA agrees with the CPU (image 1e-4, gradients 1e-4 relative; a Warp built for a GPU machine may have no CPU
kernels, hence the file), two runs give the same bits, a small case is clean under compute-sanitizer, if there is one.
Measures, by events and medians: forward, forward with the loop cap, forward and backward, and peak memory, for every
adjoint at 100k, 1M and 5M Gaussians.
"""

import argparse
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from common import write_table

from warp_splat import Camera, RasterOptions, rasterize
from warp_splat.config import ADJOINTS
from warp_splat.errors import InputError
from warp_splat.launch import prepare
from warp_splat.report import machine

SIZES, COUNTS = ((980, 545), (1920, 1080)), (100_000, 1_000_000, 5_000_000)
DRY_SIZES, DRY_COUNTS = ((98, 54),), (1000,)
LIMIT = 1e-4
NAMES = ("image", "means", "quats", "scales", "opacities", "sh")


def make_scene(count: int, width: int, height: int, device: str) -> tuple[list[torch.Tensor], Camera]:
    """Random Gaussians of about 2 px in front of a camera, SH degree 3."""
    rng = np.random.default_rng(0)
    focal = 0.9 * width
    camera = Camera(width, height, focal, focal, width / 2, height / 2, np.eye(3), np.zeros(3))
    depth = rng.uniform(1, 10, count)
    pixels = rng.uniform(0, 1, (count, 2)) * [width, height]
    means = np.concatenate([(pixels - [width / 2, height / 2]) / focal * depth[:, None], depth[:, None]], 1)
    scales = np.exp(rng.normal(0.3, 0.8, (count, 3))) * depth[:, None] / focal
    opacities = 1 / (1 + np.exp(-rng.normal(0, 2, count)))
    arrays = (means, rng.normal(size=(count, 4)), scales, opacities, rng.normal(size=(count, 16, 3)) * 0.3)
    return [torch.tensor(array, dtype=torch.float32, device=device) for array in arrays], camera


def differentiate(scene: list[torch.Tensor], camera: Camera, mode: str) -> list[torch.Tensor]:
    """Image and gradients of a weighted sum of it, in the order of NAMES."""
    leaves = [tensor.clone().requires_grad_() for tensor in scene]
    out = rasterize(*leaves, camera, adjoint=mode)
    weights = torch.linspace(-1, 1, out.image.numel(), device=out.image.device).view_as(out.image)
    (out.image * weights).sum().backward()
    return [out.image.detach(), *(leaf.grad for leaf in leaves)]


def check(device: str, expected: dict[str, np.ndarray]) -> list[tuple[str, str]]:
    """What was checked and found; raises SystemExit at the first that is wrong."""
    rows = []
    scene, camera = make_scene(20_000 if device == "cuda" else 500, 320, 200, device)
    for mode in ADJOINTS:
        first, second = (differentiate(scene, camera, mode) for _ in range(2))
        if not all(map(torch.equal, first, second)):
            raise SystemExit(f"{mode}: two runs differ")
        rows.append((f"{mode}: two runs", "the same bits"))
        for name, found in zip(NAMES, first, strict=True):
            if name in expected:
                truth = torch.from_numpy(expected[name])
                error = (
                    (found.cpu() - truth).abs().max()
                    if name == "image"
                    else (found.cpu() - truth).norm() / truth.norm()
                )
                rows.append((f"{mode}: {name} against the CPU", f"{float(error):.1e}"))
                if not error < LIMIT:
                    raise SystemExit(f"{mode}: {name} is off by {float(error):.1e}, allowed {LIMIT:g}")
    return rows


def sanitize() -> tuple[str, str]:
    """A small case under compute-sanitizer."""
    program = shutil.which("compute-sanitizer")
    if program is None:
        return "compute-sanitizer", "not installed"
    command = [program, "--error-exitcode", "9", sys.executable, __file__, "--small"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"compute-sanitizer: {done.stdout[-2000:]}{done.stderr[-500:]}")
    return "compute-sanitizer", "no errors"


def milliseconds(run: Callable[[], object], device: str, repeats: int) -> float:
    """Median after a warm-up, by CUDA events (by the clock in a dry run)."""
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


def measure(count: int, width: int, height: int, device: str) -> list[tuple]:
    """A row per adjoint."""
    scene, camera = make_scene(count, width, height, device)
    capped = RasterOptions(max_steps=2048)
    with torch.no_grad():
        forward = milliseconds(lambda: rasterize(*scene, camera), device, 20)
        with_cap = milliseconds(lambda: rasterize(*scene, camera, options=capped), device, 20)
    rows = []
    for mode in ADJOINTS:
        if device == "cuda":
            torch.cuda.reset_peak_memory_stats()
        try:
            both = f"{milliseconds(lambda: differentiate(scene, camera, mode), device, 7):.2f}"  # noqa: B023
        except InputError:  # stored refuses what does not fit
            both = "-"
        peak = torch.cuda.max_memory_allocated() / 2**20 if device == "cuda" else 0
        rows.append((f"{width} x {height}", count, mode, f"{forward:.2f}", f"{with_cap:.2f}", both, f"{peak:.0f}"))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="folder for gpu.md and gpu.json")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--save-expected", type=Path, help="write the CPU's results to this file, and stop")
    parser.add_argument("--expected", type=Path, help="compare with the results in this file")
    parser.add_argument("--small", action="store_true", help="one small case and nothing else, for the sanitizer")
    arguments = parser.parse_args()
    if arguments.save_expected:
        found = differentiate(*make_scene(20_000, 320, 200, "cpu"), "manual")
        np.savez(arguments.save_expected, **{name: tensor.numpy() for name, tensor in zip(NAMES, found, strict=True)})
        return
    device = arguments.device
    try:
        prepare(device, 0)
    except InputError as error:
        raise SystemExit(str(error)) from None
    if arguments.small:
        for mode in ADJOINTS:
            differentiate(*make_scene(2000, 100, 70, device), mode)
        return
    expected = dict(np.load(arguments.expected)) if arguments.expected else {}
    checks = [*check(device, expected), *([sanitize()] if device == "cuda" else [])]
    for what, found in checks:
        print(f"{what:40s} {found}")
    sizes, counts = (SIZES, COUNTS) if device == "cuda" else (DRY_SIZES, DRY_COUNTS)
    rows = [row for width, height in sizes for count in counts for row in measure(count, width, height, device)]
    headers = ("size", "Gaussians", "mode", "forward ms", "forward, cap 2048, ms", "forward + backward ms", "peak MiB")
    card = torch.cuda.get_device_name() if device == "cuda" else "Dry run on the CPU"
    data = {"checks": checks, "rows": rows, "card": card, "machine": machine()}
    write_table("gpu", arguments.out, headers, rows, f"{card}.", data)


if __name__ == "__main__":
    main()

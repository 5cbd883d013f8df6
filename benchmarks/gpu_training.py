"""For ``gpu.py``: whole training against the CPU's, gsplat beside ours, and what NVIDIA's profiler says of kernels."""

import csv
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import torch
from audit_targets.own import matrices_of
from common import ROOT, milliseconds
from made_up import cameras, make_gaussians, make_trainer, steps_of
from preset import run

from warp_splat.config import RasterOptions
from warp_splat.raster.api import render
from warp_splat.raster.data import Gaussians

STORED = ROOT / "docs/benchmarks/preset.json"
TRAINING_HEADERS = ("photographs", "seed", "iterations", "s of steps", "PSNR dB", "SSIM", "Gaussians")
GSPLAT_HEADERS = ("size", "Gaussians", "renderer", "forward ms", "forward + backward ms")
NCU_HEADERS = ("kernel", "ms", "% of bandwidth", "% of arithmetic", "% of warps resident")
#: NVIDIA's names for those: nanoseconds, and percent of what the card can do.
METRICS = (
    "gpu__time_duration.sum",
    *(f"{unit}__throughput.avg.pct_of_peak_sustained_elapsed" for unit in ("dram", "sm")),
    "sm__warps_active.avg.pct_of_peak_sustained_active",
)
SEEDS = range(1, 4)
NOISE = 0.2  # dB, of the mean of four seeds; a seed differs from another, and from itself after rounding, by as much


def measure_training(device: str, iterations: int | None) -> Iterator[tuple[list, float]]:
    """The embedded scene, densification and all: rows, and their PSNR in dB.

    With photographs on the device, and in page-locked memory of the host; then other seeds, all at once. In a dry run
    of so many ``iterations`` only one of these, of small photographs.
    """
    more = ["--iterations", f"{iterations}", "-r", "8"] if iterations else []

    def train(where: str, seed: int) -> tuple[list, float]:
        with tempfile.TemporaryDirectory() as folder:
            flags = ["--device", device, "--data_device", where, "--seed", f"{seed}", *more]
            results, history = run(Path(folder), flags)
        took = f"{history[-1]['seconds']:.0f}" if history else "-"
        quality = [f"{results['PSNR']:.2f}", f"{results['SSIM']:.4f}", results["gaussians"]]
        return [where, seed, results["iterations"], took, *quality], results["PSNR"]

    if not iterations:
        yield from (train(where, 0) for where in (device, "cpu"))
    with ThreadPoolExecutor() as pool:
        yield from pool.map(partial(train, device), SEEDS[:1] if iterations else SEEDS)


def psnr_on_cpu() -> float:
    """Of the same training, seed 0."""
    stored = json.loads(STORED.read_text())
    return float(dict(zip(stored["headers"], stored["rows"][0], strict=True))["PSNR dB"])


def measure_gsplat(count: int, width: int, height: int, device: str, repeats: int) -> list[list]:
    """Both passes from Gaussians to an image, by ours and, on a GPU where it can be imported, by gsplat's function."""
    gaussians = Gaussians(*(tensor.detach().requires_grad_() for tensor in make_gaussians(count, device).activated()))
    (camera,), background = cameras(width, height, 1), torch.zeros(3, device=device)
    renderers = {"ours": lambda: render(gaussians, camera, background, RasterOptions()).image}
    if rasterization := _gsplat(device):
        means, quats, scales, opacities, *sh = gaussians
        given = (means, quats, scales, opacities)
        more = (*(matrix[None].to(device) for matrix in matrices_of(camera)), width, height)
        renderers["gsplat"] = lambda: rasterization(*given, torch.cat(sh, 1), *more, sh_degree=3)[0]
    rows = []
    for name, forward in renderers.items():

        def both(forward=forward) -> None:
            image = forward()
            torch.autograd.grad(image, gaussians, torch.ones_like(image))

        times = (f"{milliseconds(work, device, repeats):.2f}" for work in (forward, both))
        rows.append([f"{width} x {height}", count, name, *times])
    return rows


def _gsplat(device: str):
    """Its function; None on a CPU, where it has no kernels, and where it cannot be imported."""
    if device == "cpu":
        return None
    try:
        from gsplat import rasterization  # noqa: PLC0415 - may be missing
        from gsplat.cuda._backend import _C  # noqa: PLC0415 - None where its kernels are not compiled
    except ImportError:
        return None
    return rasterization if _C else None


def profile_by_ncu(seconds: float) -> list[list] | None:
    """The kernels of a step of a million Gaussians by NVIDIA's profiler; None where it is missing or not allowed."""
    if shutil.which("ncu") is None:
        return None
    command = ["ncu", "--clock-control", "none", "--csv", "--page", "raw", "--metrics", ",".join(METRICS)]
    command += ["--profile-from-start", "off", sys.executable, __file__]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=seconds)
    return rows_of_ncu(done.stdout) if not done.returncode else None


def rows_of_ncu(said: str) -> list[list]:
    """Those that take longest, from ncu's lines; the second of them are units."""
    lines = said.splitlines()
    begin = next((i for i, line in enumerate(lines) if line.startswith('"ID"')), len(lines))
    _units, *found = [*csv.DictReader(lines[begin:])] or [None]
    rows = [[row["Kernel Name"][:60], *(float(row[metric].replace(",", "")) for metric in METRICS)] for row in found]
    longest = sorted(rows, key=lambda row: -row[1])[:15]
    return [
        [name, f"{1e-6 * nanoseconds:.3f}", *(f"{share:.0f}" for share in rest)] for name, nanoseconds, *rest in longest
    ]


def main() -> None:
    """What ncu runs: steps to warm up, and one that it looks at."""
    step = steps_of(make_trainer(1_000_000, 980, 545, "cuda"))
    for _ in range(10):
        step()
    torch.cuda.synchronize()
    with torch.cuda.profiler.profile():
        step()


if __name__ == "__main__":
    main()

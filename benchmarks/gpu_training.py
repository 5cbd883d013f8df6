"""For ``gpu.py``: whole training against the CPU's, gsplat beside ours, and what NVIDIA's profiler says of kernels."""

import csv
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import torch
from common import ROOT, milliseconds
from made_up import cameras, make_gaussians, make_trainer, steps_of
from preset import run

from warp_splat.config import RasterOptions
from warp_splat.raster.api import render
from warp_splat.raster.data import Gaussians

STORED = ROOT / "docs/benchmarks/preset.json"
TRAINING_HEADERS = ("photographs", "iterations", "s of steps", "PSNR dB", "SSIM", "Gaussians", "PSNR dB on a CPU")
GSPLAT_HEADERS = ("size", "Gaussians", "renderer", "forward ms", "forward + backward ms")
NCU_HEADERS = ("kernel", "ms", "% of bandwidth", "% of arithmetic", "% of warps resident")
#: NVIDIA's names for those: nanoseconds, and percent of what the card can do.
METRICS = (
    "gpu__time_duration.sum",
    *(f"{unit}__throughput.avg.pct_of_peak_sustained_elapsed" for unit in ("dram", "sm")),
    "sm__warps_active.avg.pct_of_peak_sustained_active",
)
NOISE = 0.2  # dB, between trainings that differ by rounding alone; seeds differ by 0.03


def measure_training(device: str, iterations: int | None) -> Iterator[tuple[list, float]]:
    """The embedded scene, densification and all: rows, and by how many dB the CPU was better.

    With photographs on the device, and in page-locked memory of the host.
    """
    stored = json.loads(STORED.read_text())
    expected = dict(zip(stored["headers"], stored["rows"][0], strict=True))
    for where in dict.fromkeys((device, "cpu")):
        flags = ["--device", device, "--data_device", where]
        flags += ["--iterations", f"{iterations}"] if iterations else []
        with tempfile.TemporaryDirectory() as folder:
            results, history = run(Path(folder), flags)
        took = f"{history[-1]['seconds']:.0f}" if history else "-"
        quality = [f"{results['PSNR']:.2f}", f"{results['SSIM']:.4f}", results["gaussians"]]
        row = [where, results["iterations"], took, *quality, expected["PSNR dB"]]
        yield row, float(expected["PSNR dB"]) - results["PSNR"]


def measure_gsplat(count: int, width: int, height: int, device: str, repeats: int) -> list[list]:
    """Both passes from Gaussians to an image, by ours and, on a GPU where it can be imported, by gsplat's function."""
    gaussians = Gaussians(*(tensor.detach().requires_grad_() for tensor in make_gaussians(count, device).activated()))
    (camera,), background = cameras(width, height, 1), torch.zeros(3, device=device)
    renderers = {"ours": lambda: render(gaussians, camera, background, RasterOptions()).image}
    if rasterization := _gsplat(device):
        means, quats, scales, opacities, *sh = gaussians
        view = torch.eye(4, device=device)
        view[:3, :3], view[:3, 3] = (torch.tensor(part).to(view) for part in (camera.rotation, camera.translation))
        lens = torch.tensor([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]], device=device)
        given = (means, quats, scales, opacities)
        more = (view[None], lens[None], width, height)
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

"""For ``gpu.py``: training steps by stage and as a whole, the orbit, and the four adjoints."""

import statistics
import time

import torch
from common import milliseconds, picture_of, synchronize
from made_up import cameras, make_gaussians, make_trainer, steps_of

from warp_splat.compare import adjoints
from warp_splat.compare.workloads import layered
from warp_splat.config import ADJOINTS, RasterOptions
from warp_splat.errors import InputError
from warp_splat.raster.api import render
from warp_splat.raster.data import Gaussians
from warp_splat.rendering.camera_paths import ORBIT_SIZE
from warp_splat.runtime import timers

STAGES = (
    *("project", "bin", "blend", "loss", "adjoint of loss", "adjoint of blend", "adjoint of project"),
    *("densify", "Adam"),
)
STEP_HEADERS = (
    *("size", "Gaussians", "it/s", "step ms", "/ stages", "/ kernels", "stages ms", "kernels ms", "peak MiB"),
    *(f"{stage} ms" for stage in STAGES),
)
CAP = 2048  # the thesis's


def measure_step(count: int, width: int, height: int, device: str, steps: int) -> tuple[list, list[tuple[str, float]]]:
    """A row of STEP_HEADERS, and the kernels that take longest (none on a CPU) with their milliseconds per step.

    The whole step is timed without a stop between its stages, the stages with one after each; kernels by CUPTI.
    """
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    step = steps_of(make_trainer(count, width, height, device))
    for _ in range(5):
        step()
    whole = _whole_step(step, device, steps)
    records = []
    for _ in range(max(steps // 3, 3)):
        with timers.profile() as stages:
            step()
        records.append(dict(stages))
    medians = [1e3 * statistics.median(record.get(stage, 0.0) for record in records) for stage in STAGES]
    kernels = kernel_times(step, 5) if device == "cuda" else {}
    peak = torch.cuda.max_memory_allocated() / 2**20 if device == "cuda" else 0.0
    total, busy = sum(medians), sum(kernels.values())
    share = f"{whole / busy:.2f}" if busy else "-"
    row = [f"{width} x {height}", count, f"{1e3 / whole:.1f}", f"{whole:.2f}", f"{whole / total:.2f}", share]
    row += [f"{total:.2f}", f"{busy:.2f}" if busy else "-", f"{peak:.0f}", *(f"{median:.3f}" for median in medians)]
    return row, sorted(kernels.items(), key=lambda item: -item[1])[:15]


def _whole_step(step, device: str, steps: int) -> float:
    """Milliseconds, median of five rounds."""
    rounds = []
    for _ in range(5):
        synchronize(device)
        start = time.perf_counter()
        for _ in range(max(steps // 5, 1)):
            step()
        synchronize(device)
        rounds.append(1e3 * (time.perf_counter() - start) / max(steps // 5, 1))
    return statistics.median(rounds)


def kernel_times(step, steps: int) -> dict[str, float]:
    """Milliseconds per step of each kernel and copy on the GPU, Warp's and torch's, by name; empty without CUPTI."""
    if torch.profiler.ProfilerActivity.CUDA not in torch.profiler.supported_activities():
        return {}
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        for _ in range(steps):
            step()
        torch.cuda.synchronize()
    found: dict[str, float] = {}
    for event in profile.profiler.kineto_results.events():
        if event.device_type() == torch.autograd.DeviceType.CUDA and not event.is_user_annotation():
            found[event.name()] = found.get(event.name(), 0.0) + 1e-6 * event.duration_ns() / steps
    return found


def measure_orbit(count: int, device: str, frames: int, real: bool) -> list[list]:
    """Frames per second, without and with the cap, of pictures on the host, as ``warp-splat render --orbit`` counts."""
    rows, model, path = [], make_gaussians(count, device), cameras(*ORBIT_SIZE, frames)
    if not real:
        path = [camera.resized(98, 54) for camera in path]
    for cap in (None, CAP):
        picture = picture_of(model, None, RasterOptions(max_steps=cap))
        for camera in path[:10]:
            picture(camera)
        start = time.perf_counter()
        for camera in path:
            picture(camera)
        size = f"{path[0].width} x {path[0].height}"
        rows.append([size, count, cap or "none", f"{frames / (time.perf_counter() - start):.1f}"])
    return rows


def measure_modes(count: int, width: int, height: int, device: str, repeats: int) -> list[list]:
    """Forward and backward pass in every mode: time, and memory beyond the Gaussians."""
    gaussians = Gaussians(*(tensor.detach().requires_grad_() for tensor in make_gaussians(count, device).activated()))
    (camera,), background = cameras(width, height, 1), torch.zeros(3, device=device)
    rows = []
    for mode in ADJOINTS:

        def forward(mode=mode) -> torch.Tensor:
            return render(gaussians, camera, background, RasterOptions(), mode).image

        def both(forward=forward) -> None:
            image = forward()
            torch.autograd.grad(image, gaussians, torch.ones_like(image))

        try:
            times = [f"{milliseconds(run, device, repeats):.2f}" for run in (forward, both)]
            memory = f"{adjoints.peak_of(both, torch.device(device)) / 2**20:.0f}"
        except InputError:  # stored refuses what does not fit
            times, memory = ["-", "-"], "-"
        rows.append([f"{width} x {height}", count, mode, *times, memory])
    return rows


def measure_errors(layers: tuple[int, ...], device: str, say) -> list[list]:
    """Error of the worst gradient against float64 and time of the pixel loop, as ``warp-splat compare`` measures."""
    found = adjoints.run_adjoints([layered(count).to(torch.device(device)) for count in layers], ADJOINTS, say)
    return [
        [item.scene, item.variant, f"{item.worst[1]:.1e}", item.worst[0], *_milliseconds(item)]
        for item in found
        if item.errors and item.forward
    ]


def _milliseconds(item: adjoints.Measurement) -> list[str]:
    return [f"{1e3 * statistics.median(seconds):.3f}" for seconds in (item.forward, item.backward)]

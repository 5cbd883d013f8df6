"""``warp-splat compare``: which comparison to run, and where its results go."""

from dataclasses import asdict
from pathlib import Path

import torch

from warp_splat.compare import adjoints
from warp_splat.compare.plots import plot_errors
from warp_splat.compare.stability import cases
from warp_splat.compare.workloads import CANDIDATES, Workload, in_training, layered, named_scenes
from warp_splat.config import ADJOINTS, CompareConfig
from warp_splat.errors import InputError
from warp_splat.evaluation.report import machine
from warp_splat.formats.files import write_csv, write_json, write_text
from warp_splat.formats.model_folder import prepare_folder
from warp_splat.raster.gradcheck import check_gradients
from warp_splat.raster.selftest import settle_device
from warp_splat.runtime import pool
from warp_splat.text import Report

DIRECTIONS = 4  # per parameter


def run(config: CompareConfig) -> int:
    """Run the comparison that ``config`` asks for; returns the process's exit code (1 if a stability verdict failed).

    Raises:
        InputError: for an unknown mode, an unusable scene or output folder.
    """
    unknown = [mode for mode in config.modes if mode not in ADJOINTS]
    if unknown or not config.modes:
        raise InputError(f"--modes: expected some of {', '.join(ADJOINTS)}, got {', '.join(unknown) or 'none'}.")
    if config.stability and config.scene:
        raise InputError("--scene: expected none with --stability, whose cases are made up.")
    if config.stability and config.device == "cuda":
        raise InputError("--device cuda: --stability computes on the CPU only; use --device cpu.")
    scenes = {} if config.stability else named_scenes(config.scene, print)
    device = settle_device("cpu" if config.stability else config.device, config.threads, config.modes)
    out, log = prepare_folder(config.out), []  # to fail before all measuring, not after

    def say(text: str = "") -> None:
        print(text)
        log.append(text)

    failed = cases.run_cases(out, config.modes, say) if config.stability else 0
    if not config.stability:
        workloads = [layered(candidates).to(device) for candidates in CANDIDATES]
        for name, scene in scenes.items():
            workloads += in_training(name, scene, device, say)
        _compare_modes(workloads, config.modes, out, say)
    card = f"{torch.cuda.get_device_name(device)}, " if device.type == "cuda" else ""
    say(f"\nMeasured on {card}{machine()}, {pool.get_threads()} threads.")
    write_text(out / ("stability.txt" if config.stability else "compare.txt"), "\n".join([*log, ""]))
    print(f"Tables and plots: {out}")
    return int(failed > 0)


def _compare_modes(workloads: list[Workload], modes: list[str], out: Path, say: Report) -> None:
    """Adjoints on every workload; for the scenes in training, the whole image's gradients by finite differences."""
    print("Kernels of every variant are compiled once on a machine, about a minute in all.")  # not a result
    measured, checks = adjoints.run_adjoints(workloads, modes, say), {}
    say(f"\n{adjoints.adjoint_table(measured)}\n")
    write_csv(out / "adjoints.csv", adjoints.records(measured))
    write_json(out / "adjoints.json", [asdict(item) for item in measured])
    plot_errors(out / "adjoints.png", measured)
    for workload in workloads:
        if "," in workload.name:
            scene = (*workload.gaussians[:4], workload.gaussians[4:], workload.camera, workload.background)
            check = check_gradients(*scene, options=workload.options, directions=DIRECTIONS)
            say(f"{workload.name}: along random directions, against finite differences\n\n{check}\n")
            checks[workload.name] = [asdict(row) for row in check.rows]
    write_json(out / "directions.json", checks)

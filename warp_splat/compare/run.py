"""``warp-splat compare``: which comparison to run, and where its results go."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from warp_splat import launch
from warp_splat.compare import adjoints, knobs, report, stability, training, volume_report
from warp_splat.compare.workloads import Workload, all_workloads
from warp_splat.config import ADJOINTS, CompareConfig
from warp_splat.errors import InputError
from warp_splat.formats.atomic import write_csv, write_json


def compare(config: CompareConfig) -> int:
    """Run the comparison that ``config`` asks for; returns the process's exit code (1 if a stability verdict failed).

    Raises:
        InputError: for an unknown mode, an unusable scene or output folder.
    """
    unknown = [mode for mode in config.modes if mode not in ADJOINTS]
    if unknown or not config.modes:
        raise InputError(f"--modes: expected some of {', '.join(ADJOINTS)}, got {', '.join(unknown) or 'none'}.")
    launch.prepare(config.device, config.threads)
    out = Path(config.out)
    if config.stability:
        print("Kernels of a mode are compiled once on a machine, about 10 s each.")
        return 1 if stability.run(out, config.modes) else 0
    if config.volume:
        volume_report.run(out)
        return 0
    _compare_pixel_loops(config, out)
    training.run(out, config.modes, config.scene, config.full)
    print(f"\nTables and plots: {out}")
    return 0


def _compare_pixel_loops(config: CompareConfig, out: Path) -> None:
    """Adjoints on every workload; knobs on the layered scene and those trained longest."""
    print("Kernels of every variant are compiled once on a machine, about a minute in all.")
    workloads = all_workloads(config.scene, print)
    measured = adjoints.measure(workloads, config.modes, print)
    print(f"\n{report.adjoint_table(measured)}\n")
    _write(out, "adjoints", measured)
    report.plot_errors(out / "adjoints.png", measured)
    report.plot_memory(out / "memory.png", measured)
    report.plot_stages(out / "stages.png", measured, config.modes)
    turned = knobs.measure(_for_knobs(workloads), print)
    print(f"\n{report.knob_table(turned)}\n")
    _write(out, "knobs", turned)
    report.plot_knobs(out / "knobs.png", turned)


def _for_knobs(workloads: list[Workload]) -> list[Workload]:
    last = {workload.name.split(",")[0]: workload for workload in workloads if "," in workload.name}
    return [workload for workload in workloads if workload.name == "1000 layers"] + list(last.values())


def _write(out: Path, name: str, measured: list[adjoints.Measurement]) -> None:
    write_csv(out / f"{name}.csv", adjoints.records(measured))
    write_json(out / f"{name}.json", [asdict(item) for item in measured])

"""How do time and memory of a training step grow with Gaussians, pixels and depth complexity?

Each size is a process of its own, which reports its peak. About 5 minutes on two cores.

    python benchmarks/scaling.py [--sweeps gaussians pixels depth training] [--out docs/benchmarks]
"""

import argparse
import json
import math
import re
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from common import ROOT, in_process, option, parse, write_table
from made_up import make_trainer
from panels import Panel, draw_panels

from warp_splat.config import TILE, RasterOptions
from warp_splat.evaluation.report import BLUE, INK, ORANGE
from warp_splat.raster.drivers import CPU
from warp_splat.raster.project import project
from warp_splat.runtime import launch, timers
from warp_splat.runtime.devices import peak_memory
from warp_splat.text import format_table
from warp_splat.training.memory import pixel_floats, step_memory
from warp_splat.training.trainer import Trainer

MIB = 2**20
FAINT = -4.5  # logit of the opacities in the sweep of the depth, so low that no pixel saturates
#: sweep: what varies, and its points (Gaussians, width, height, factor of the Gaussians' size)
SWEEPS = {
    "gaussians": ("Gaussians", [(n, 980, 545, 1.0) for n in (10_000, 30_000, 100_000, 300_000, 1_000_000, 2_000_000)]),
    "pixels": ("pixels", [(100_000, side, side, 1.0) for side in (256, 512, 1024, 2048, 4096)]),
    "depth": ("depth", [(100_000, 980, 545, size) for size in (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)]),
}
#: What the time of a stage should follow, at most linearly.
FOLLOWS = {
    "project": "gaussians",
    "bin": "instances",
    "blend": "instances",
    "loss": "pixels",
    "adjoint of loss": "pixels",
    "adjoint of blend": "instances",
    "adjoint of project": "gaussians",
    "densify": "gaussians",
    "Adam": "gaussians",
}
VARIES = {"gaussians": "gaussians", "pixels": "pixels", "instances": "depth"}  # in which sweep that alone varies
SECONDS = 5.0  # of the steps at one point, after three to warm up, but
REPEATS = (3, 15)  # so many at least, at most
HEADERS = (
    *("sweep", "Gaussians", "width", "height", "tile instances", "listed per px", "ms per step", "ns per instance"),
    *("peak MiB", "forecast MiB", "forecast / peak"),
)
#: Runs of train.py on the embedded scene that grow quickly: the forecast is the line that train.py prints.
RUNS = (20_000, 50_000)
GROWTH = (
    *("--iterations", "400", "--densify_from_iter", "40", "--densification_interval", "20"),
    *("--densify_grad_threshold", "0.00005", "--device", "cpu"),
)


def measure(
    count: int, width: int, height: int, size: float, faint: bool, repeats: tuple = REPEATS, kinds: tuple = ()
) -> dict:
    """One point, in this process: milliseconds of a step and of its stages, peak and forecast in MiB.

    ``kinds`` of photographs: "masked", "composited", "linear".
    """
    launch.prepare("cpu", 0)
    small = make_trainer(64, 2 * TILE, TILE, "cpu", kinds)  # loads every kernel
    take_step(small, 10)
    loaded = peak_memory()
    trainer = make_trainer(count, width, height, "cpu", kinds)
    planes = [plane for view in trainer.scene.train for plane in (view.image, view.alpha, view.mask)]
    photographs = sum(plane.nbytes for plane in planes if plane is not None)
    with torch.no_grad():
        trainer.model.parameters["scales"] += math.log(size)
        if faint:
            trainer.model.parameters["opacities"].fill_(FAINT)
    steps, stages = [], []
    for iteration in range(10, 13):
        take_step(trainer, iteration)
    change_set(trainer)
    while len(steps) < repeats[0] or (len(steps) < repeats[1] and sum(steps) < SECONDS):
        with timers.profile() as profile:
            start = time.perf_counter()
            take_step(trainer, 13 + len(steps))
            steps.append(time.perf_counter() - start)
        stages.append(dict(profile))
    peak, instances = peak_memory(), count_instances(trainer)
    per_pixel = pixel_floats("masked" in kinds, "composited" in kinds, "linear" in kinds)
    needed = step_memory(count, instances, width * height, trainer.config, per_pixel)
    return {
        "gaussians": count,
        "width": width,
        "height": height,
        "pixels": width * height,
        "instances": instances,
        "depth": instances * TILE**2 / (width * height),
        "ms": 1e3 * min(steps),  # what else runs on the machine only adds to it
        "stages": {name: 1e3 * min(stage[name] for stage in stages) for name in FOLLOWS},
        "peak": peak,
        "added": peak - loaded,
        "forecast": loaded + (needed + photographs) / MIB,
    }


def take_step(trainer: Trainer, iteration: int) -> None:
    trainer.differentiate(iteration)
    trainer.update(iteration)


def change_set(trainer: Trainer) -> None:
    """What a densification that keeps every Gaussian and adds none does to the memory."""
    every = torch.arange(len(trainer.model))
    trainer.optimizer.replace(every, {name: rows.detach()[:0] for name, rows in trainer.model.parameters.items()})


def count_instances(trainer: Trainer) -> int:
    """Tile instances, mean over the views."""
    options, gaussians = RasterOptions(), trainer.model.activated()
    counts = []
    with torch.no_grad():
        for camera in (view.camera for view in trainer.scene.train):
            bins = CPU.bin(project(gaussians, camera, options), camera, options)
            counts.append(len(bins.instances))
    return round(statistics.mean(counts))


def measure_apart(arguments: list) -> dict:
    """:func:`measure` in a process of its own."""
    return in_process(__file__, "--point", json.dumps(arguments))


def train(limit: int) -> dict:
    """A run of train.py on the embedded scene: the forecast that it prints, and its peak [MiB]."""
    with tempfile.TemporaryDirectory() as folder:
        scene = ["-s", ROOT / "assets" / "still_life", "-m", folder]
        command = [sys.executable, ROOT / "train.py", *scene, *GROWTH, "--max_gaussians", str(limit)]
        found = subprocess.run(command, check=True, capture_output=True, text=True)
        (entry,) = json.loads((Path(folder) / "results.json").read_text()).values()
    said = re.search(r"About ([\d.]+) GiB", found.stdout + found.stderr)
    assert said, found.stdout
    return {"gaussians": entry["gaussians"], "peak": entry["peak_memory_mb"], "forecast": 1024 * float(said[1])}


def exponent(points: list[dict], along: str, key: str) -> float:
    """Slope of the straight line through the points on logarithmic axes."""
    x, y = np.log([point[along] for point in points]), np.log([point[key] for point in points])
    return float(np.polyfit(x, y, 1)[0])


def row_of(sweep: str, point: dict) -> tuple:
    forecast = (point["peak"], f"{point['forecast']:.0f}", f"{point['forecast'] / point['peak']:.2f}")
    if sweep == "training":
        return (sweep, point["gaussians"], *[""] * 6, *forecast)
    size = (point["gaussians"], point["width"], point["height"], point["instances"], f"{point['depth']:.0f}")
    return (sweep, *size, f"{point['ms']:.1f}", f"{1e6 * point['ms'] / point['instances']:.0f}", *forecast)


def exponents(found: dict[str, list[dict]]) -> list[tuple]:
    """Of time and of memory beyond the loaded process, against what the sweep varies and against instances."""
    rows = []
    for sweep, (title, _) in SWEEPS.items():
        points, cells = found[sweep], []
        for key in ("ms", "added"):
            for part, along in ((points, sweep), (points[-2:], sweep), (points, "instances")):
                cells.append(f"{exponent(part, along, key):.2f}")
        rows.append((title, *cells))
    return rows


def stage_exponents(found: dict[str, list[dict]]) -> list[tuple]:
    """Of each stage against what it follows: over the sweep, and between its last two points."""
    rows = []
    for stage, along in FOLLOWS.items():
        points = [{**point, **point["stages"]} for point in found[VARIES[along]]]
        over = [exponent(part, along, stage) for part in (points, points[-2:])]
        rows.append((stage, along, f"{points[-1][stage]:.1f}", *(f"{slope:.2f}" for slope in over)))
    return rows


def plot(path: Path, found: dict[str, list[dict]]) -> None:
    """Time above, memory below, over what each sweep varies; the forecast as open circles."""
    panels = []
    for key, name, color in (("ms", "ms per step", BLUE), ("added", "MiB per step", ORANGE)):
        for sweep, (title, _) in SWEEPS.items():
            points = found[sweep]
            x = [point[sweep] for point in points]
            panels.append(panel := Panel(f"{name}: exponent {exponent(points, sweep, key):.2f}", title))
            panel.marks("", x, [point[key] for point in points], (color, "o"), ls="-")
            if key == "added":
                told = [point["added"] + point["forecast"] - point["peak"] for point in points]
                panel.marks("forecast", x, told, (INK, "o"), markerfacecolor="none", markersize=8)
    draw_panels(path, panels, len(SWEEPS), 2.3)


def main() -> None:
    choices = (*SWEEPS, "training")
    arguments = parse(
        __doc__,
        option("--sweeps", nargs="+", choices=choices, default=choices, help="others are read from --out"),
        option("--point", type=json.loads, help=argparse.SUPPRESS),
    )
    if arguments.point:
        print(json.dumps(measure(*arguments.point)))
        return
    before = arguments.out / "scaling.json" if arguments.out else None
    found = json.loads(before.read_text())["points"] if before and before.exists() else {}
    for sweep in arguments.sweeps:
        if sweep == "training":
            found[sweep] = [train(limit) for limit in RUNS]
        else:
            found[sweep] = [measure_apart([*point, sweep == "depth"]) for point in SWEEPS[sweep][1]]
        print(format_table(HEADERS, [row_of(sweep, point) for point in found[sweep]]), flush=True)
        if before:
            before.parent.mkdir(parents=True, exist_ok=True)
            before.write_text(json.dumps({"points": found}) + "\n")
    if not set(choices) <= set(found):
        print(f"Not measured yet: {', '.join(sorted(set(choices) - set(found)))}")
        return
    report(arguments.out, {sweep: found[sweep] for sweep in choices})


def report(out: Path | None, found: dict[str, list[dict]]) -> None:
    """Tables, and the plot if there is a folder for it."""
    rows = [row_of(sweep, point) for sweep, points in found.items() for point in points]
    over = ("time", "its end", "in instances", "memory", "its end", "in instances")
    note = "\n\n".join(
        (
            "Exponents of time and of memory beyond the loaded process: against what the sweep varies, over all of it "
            "and between its last two points, and against tile instances. These fall behind the Gaussians, because "
            "those shrink, and behind the pixels; in the sweep of the depth, where Gaussians grow, they change, and so "
            "does how much of its tile each covers:",
            format_table(("sweep", *over), exponents(found)),
            "Exponents of the stages, each over the sweep in which only that varies which the stage follows:",
            format_table(("stage", "follows", "ms at its end", "exponent", "its end"), stage_exponents(found)),
            "The quickest of 3 to 15 steps on random Gaussians of degree 3, the smaller the more there are; faint in "
            "the sweep of the depth, so that no pixel saturates. Memory: training steps and a change of the set; "
            "`training`: runs of train.py on the embedded scene, with the forecast that they print.",
        )
    )
    write_table("scaling", out, HEADERS, rows, note, {"points": found})
    if out:
        plot(out / "scaling.png", found)


if __name__ == "__main__":
    main()

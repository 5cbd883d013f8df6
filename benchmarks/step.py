"""Every stage of a training step against its floor, on one thread and on two.

The floor of a stage is the larger of two times: that of a copy of the bytes that it must move, and that of
multiply-adds as many as the vector operations that it must do (``work.py`` has both formulas, ``limits.py`` measures
the machine's rates in the same run). A ratio of 1 cannot be reached, below 1 it tells of data that stay in the caches.

Sizes: with -s, a COLMAP scene at half and full size and the models that `benchmarks/training.py` leaves
(DIR/half/point_cloud/iteration_1000, DIR/full/point_cloud/iteration_3000); always, 1,000,000 random Gaussians.
Kernels are warm. Eight views make a round; all rates are zero, so that every round does the same work; one and two
threads take turns. Times are medians over the rounds, of a round's mean.

    python benchmarks/step.py [-s path/to/fox --models output/fox] [--out docs/benchmarks]
"""

import statistics
import time
from argparse import Namespace
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

from common import load_model, option, parse, write_table
from gpu_steps import STAGES
from limits import Limits, measure_limits
from made_up import VIEWS, make_gaussians, make_scene, steps_of, trainer_on
from work import Counts, count, mean, work_of

from warp_splat.config import RasterOptions
from warp_splat.formats.model_folder import ply_path
from warp_splat.raster.data import Gaussians
from warp_splat.runtime import launch, pool, timers
from warp_splat.scene import load_scene
from warp_splat.training.trainer import Trainer

THREADS = (1, 2)
GIVEN = (
    option("-s", "--scene", type=Path, help="COLMAP scene of the models"),
    option("--models", type=Path, help="folder with half/ and full/, as benchmarks/training.py leaves it"),
)
TRAINED = {"half": (2, 1000), "full": (1, 3000)}  # name of the model: -r, iteration
SYNTHETIC = (1_000_000, 980, 545)
#: Adam does all of its work, and moves nothing. The rate of the means decays exponentially: almost zero.
AT_REST = {
    **dict.fromkeys(("feature_lr", "opacity_lr", "scaling_lr", "rotation_lr"), 0.0),
    **{"position_lr_init": 1e-37, "position_lr_final": 1e-37},
}


def trained(source: Path, models: Path, name: str) -> Trainer:
    """On VIEWS of the scene's training views."""
    resolution, iteration = TRAINED[name]
    scene = load_scene(source, resolution=resolution, eval=True, report=lambda *_: None)
    scene = replace(scene, train=scene.train[:: len(scene.train) // VIEWS][:VIEWS])
    return trainer_on(scene, load_model(ply_path(models / name, iteration)), "cpu", **AT_REST)


def synthetic(count: int, width: int, height: int) -> Trainer:
    return trainer_on(make_scene(width, height), make_gaussians(count, "cpu"), "cpu", **AT_REST)


def trainers(arguments: Namespace) -> Iterator[tuple[str, Trainer, int]]:
    """What to measure, one at a time, and for how many rounds."""
    if arguments.scene:
        for name, rounds in zip(TRAINED, (15, 7), strict=True):
            yield name, trained(arguments.scene, arguments.models, name), rounds
    yield "synthetic", synthetic(*SYNTHETIC), 3


def time_steps(trainer: Trainer, rounds: int) -> dict[int, dict[str, float]]:
    """Seconds of each stage, ``host`` (the rest) and the ``whole step``, by number of threads."""
    step = steps_of(trainer)
    found: dict[int, list[dict[str, float]]] = {threads: [] for threads in THREADS}
    for number in range(-1, rounds):
        for threads in THREADS:
            pool.set_threads(threads)
            with timers.profile() as stages:
                start = time.perf_counter()
                for _ in range(VIEWS):
                    step()
                whole = time.perf_counter() - start
            if number >= 0:
                parts = {stage: stages.get(stage, 0.0) / VIEWS for stage in STAGES}
                rest = whole / VIEWS - sum(parts.values())
                found[threads].append({**parts, "host": rest, "whole step": whole / VIEWS})
    return {
        threads: {stage: statistics.median(record[stage] for record in records) for stage in records[0]}
        for threads, records in found.items()
    }


def rows_of(
    name: str, times: dict[int, dict[str, float]], counts: Counts, limits: dict[int, Limits]
) -> tuple[list[list], dict]:
    """A row for each stage, and the same as numbers, by threads and stage."""
    work = work_of(counts)
    floors = {}
    for threads in THREADS:
        floors[threads] = {stage: limits[threads].floor(*work[stage]) for stage in work}
        floors[threads]["whole step"] = sum(floors[threads].values())
    rows = []
    for stage in times[1]:
        row: list[str] = [name, stage]
        for threads in THREADS:
            seconds, floor = times[threads][stage], floors[threads][stage]
            ratio = f"{seconds / floor:.1f}" if floor else "-"
            row += [f"{1e3 * seconds:.2f}", f"{1e3 * floor:.2f}" if floor else "-", ratio]
        rows.append([*row, f"{times[1][stage] / times[2][stage]:.2f}"])
    return rows, {"seconds": times, "floors": floors, "counts": asdict(counts)}


def describe(name: str, trainer: Trainer, counts: Counts, times: dict[int, dict[str, float]]) -> str:
    """The size and its ratios, in a sentence."""
    camera = trainer.scene.train[0].camera
    over_blends = [step["whole step"] / (step["blend"] + step["adjoint of blend"]) for step in times.values()]
    return (
        f"{name}: {len(trainer.model)} Gaussians, {camera.width} x {camera.height} px; in a view {counts.drawn:.0f} "
        f"drawn, {counts.instances:.0f} tile instances, {counts.pairs / 1e6:.1f}M pairs blended of "
        f"{counts.looked_at / 1e6:.1f}M looked at, {counts.by_adjoint / 1e6:.1f}M by the adjoint; the whole step takes "
        f"{over_blends[0]:.2f} times as long as the two blends together (2 threads: {over_blends[1]:.2f}), two threads "
        f"are {times[1]['whole step'] / times[2]['whole step']:.2f} times as fast as one."
    )


def main() -> None:
    arguments = parse(__doc__, *GIVEN)
    launch.prepare("cpu", 0)
    limits = {threads: measure_limits(threads) for threads in THREADS}
    rows, notes, data = [], [], {"limits": {k: v._asdict() for k, v in limits.items()}}
    for name, trainer, rounds in trainers(arguments):
        gaussians = Gaussians(*(tensor.detach() for tensor in trainer.model.activated()))
        counts = mean([count(gaussians, view.camera, RasterOptions()) for view in trainer.scene.train])
        times = time_steps(trainer, rounds)
        added, data[name] = rows_of(name, times, counts, limits)
        rows += added
        notes.append(describe(name, trainer, counts, times))
        print(notes[-1])
    each = ("ms", "floor ms", "ratio")
    headers = ("size", "stage", *(f"{threads}: {column}" for threads in THREADS for column in each), "1 : 2 threads")
    rates = ", ".join(
        f"{limit.bandwidth / 1e9:.1f} GB/s and {limit.rate / 1e9:.2f}e9 vector operations per second on {threads}"
        for threads, limit in limits.items()
    )
    write_table("step", arguments.out, headers, rows, f"{' '.join(notes)} Limits: {rates}.", data)


if __name__ == "__main__":
    main()

"""Seconds of a step with all photographs in memory, with none and a file of them, and with none that is kept.

    python benchmarks/photo_memory.py --work output/large [--threads 2] [--out docs/benchmarks]

Photographs are those of `captures_train.py`: some of 12 megapixels, trained at a width of 1600 px, and some that have
this size. Three trainings take steps by turns, after one with each photograph.
"""

import statistics
import tempfile
import time
from pathlib import Path

from captures_train import POINTS, make_scene
from common import option, parse, write_table

from warp_splat.runtime import launch
from warp_splat.scene import load_scene
from warp_splat.training.options import TrainConfig
from warp_splat.training.trainer import Trainer

COUNT, WIDTH, TURNS, STEPS = 24, 1600, 6, 12
SIZES = {"4000 x 3000": (4000, 3000), "1600 x 1200": (1600, 1200)}
HEADERS = {
    "photographs": lambda row: row["size"],
    "all in memory, ms": lambda row: f"{1e3 * row['memory']:.0f}",
    "in a file, ms": lambda row: f"{1e3 * row['file']:.0f}",
    "decoded each time, ms": lambda row: f"{1e3 * row['decoded']:.0f}",
    "file / memory": lambda row: f"{row['file'] / row['memory']:.2f}",
    "decoded / memory": lambda row: f"{row['decoded'] / row['memory']:.2f}",
}


def trainer_of(scene: Path, memory: float | None, folder: str) -> Trainer:
    loaded = load_scene(scene, resolution=WIDTH, memory=memory)
    trainer = Trainer(loaded, TrainConfig(source_path=str(scene), device="cpu", model_path=folder))
    trainer.warm_up()
    return trainer


def step(trainer: Trainer, iteration: int) -> float:
    begun = time.perf_counter()
    trainer.advance(iteration)
    return time.perf_counter() - begun


def measure(scene: Path) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        trainers = {
            "memory": trainer_of(scene, None, ""),
            "file": trainer_of(scene, 1.0, folder),
            "decoded": trainer_of(scene, 1.0, ""),
        }
        seconds = {name: list[float]() for name in trainers}
        for turn in range(1 + TURNS):
            first = COUNT + 1 + (turn - 1) * STEPS if turn else 1
            for name, trainer in trainers.items():
                taken = [step(trainer, first + k) for k in range(STEPS if turn else COUNT)]
                seconds[name] += taken if turn else []
    return {name: statistics.median(each) for name, each in seconds.items()}


def main() -> None:
    options = parse(
        __doc__,
        option("--work", type=Path, required=True, help="folder for scenes"),
        option("--threads", type=int, default=2),
    )
    launch.prepare("cpu", options.threads)
    rows = []
    for name, size in SIZES.items():
        if not (scene := options.work / f"few{size[0]}").is_dir():
            make_scene(scene, COUNT, COUNT, size, False)
        rows.append({"size": name, **measure(scene)})
    note = (
        f"Trained at a width of {WIDTH} px, {COUNT} photographs, {POINTS} Gaussians, {options.threads} threads; the "
        f"median of {TURNS * STEPS} steps, by turns of {STEPS}."
    )
    write_table("photo_memory", options.out, HEADERS, rows, note)


if __name__ == "__main__":
    main()

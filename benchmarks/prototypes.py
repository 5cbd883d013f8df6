"""Ingredients that are not in the package, each beside `--preset fast` at equal processor seconds.

Each is a prototype (``benchmarks/ingredients.py``). It trains by turns with the preset in one process on one thread,
so that both meet the same machine; the ratio of their processor seconds (starts included) is what it costs. What the
preset reaches in as many seconds lies between its trainings of half as many steps and of as many. Runs are kept in a
folder and not repeated; several of these programs may run at once.

    python benchmarks/prototypes.py --runs output/prototypes --fox path/to/fox --church path/to/church [--out folder]
"""

import json
import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from common import RUNS, claimed, option, parse, write_table
from ingredients import INGREDIENTS, Ingredient

from warp_splat.evaluation.metrics import ssim
from warp_splat.kernels.patches import search
from warp_splat.presets import EMBEDDED_DEFAULTS, PRESETS
from warp_splat.runtime import launch
from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene
from warp_splat.scene.types import Scene
from warp_splat.training.options import TrainConfig
from warp_splat.training.plan import of_length, task_of
from warp_splat.training.trainer import Trainer

#: Divisor of edges, budget; the points of small ones are thinned as the preset's budget is.
SIZES = {"fox": (8, 8000), "church": (8, 8000), "embedded": (2, 12_000)}
SIZES |= {"fox, half": (2, 100_000), "church, half": (2, 100_000), "embedded, whole": (1, 50_000)}
SMALL = ("fox", "church", "embedded")
LARGE = ("embedded, whole", "fox, half", "church, half")
GROUPS = {"small": (SMALL, 0.25), "large": (LARGE, 0.25), "short": (LARGE, 0.0625)}  # scenes, share of the steps
GROUPS |= {"few points": (("embedded, whole",), 0.25), "short, few points": (("embedded, whole",), 0.0625)}
COST = "fox, half", 0.0625  # the scene and the share of the steps in which an ingredient's seconds are measured
TURNS_EACH = 50  # in which two trainings run by turns
PRESET = "--preset fast"


def train(scene: Scene, name: str, share: float, seed: int, ingredient: Ingredient | None) -> list[dict]:
    """What the preset, or an ingredient, reaches in ``share`` of the steps; of larger scenes, by turns with the preset.

    With the processor's seconds, times those of the preset where that ran by turns. That is the second then.
    """
    ours, limit = name.startswith("embedded"), SIZES[name][1]
    preset = PRESETS["fast"] | (EMBEDDED_DEFAULTS["fast"] if ours else {})
    fewer = preset["max_gaussians"] // limit
    scene = replace(scene, points=scene.points[::fewer], colors=scene.colors[::fewer])
    whole = TrainConfig(**preset | {"max_gaussians": limit, "seed": seed, "device": "cpu"})
    task = task_of(whole, scene, Trainer(scene, whole).photographs.shares)
    plain, trainers, seconds = Ingredient({}), [], []
    for it in [ingredient, plain] if ingredient and name not in SMALL else [ingredient or plain]:
        config = of_length(whole, share * it.more, task)
        config = config.changed(**{"densification_interval": 100} | it.options(config, len(scene.points)))
        begun = time.process_time()
        trainers.append(Trainer(it.start(scene, config.grow.max_gaussians), config))
        it.put(trainers[-1])
        seconds.append(time.process_time() - begun)
        trainers[-1].warm_up()
    for turn in range(TURNS_EACH):
        for place, trainer in enumerate(trainers):
            last, begun = trainer.config.learn.iterations, time.process_time()
            for iteration in range(1 + last * turn // TURNS_EACH, 1 + last * (turn + 1) // TURNS_EACH):
                trainer.advance(iteration)
            seconds[place] += time.process_time() - begun
    made = zip(trainers, seconds, strict=True)
    return [measured(it, scene) | {"seconds": time, "cost": time / seconds[-1]} for it, time in made]


def measured(trainer: Trainer, scene: Scene) -> dict:
    """Of a training that has ended."""
    similar = [ssim(trainer.picture(view.camera), view.picture) for view in scene.test]
    reached = {"psnr": trainer.evaluate(scene.test), "train": trainer.evaluate(scene.train[::4])}
    return reached | {"ssim": float(np.mean(similar)), "gaussians": len(trainer.model)}


class Runs:
    """What has been trained, in a folder; trains what is not there."""

    def __init__(self, folder: Path, places: dict[str, Path | None], only_table: bool):
        self.folder, self.places, self.only_table = folder, places, only_table
        self.scenes: dict[str, Scene] = {}

    def get(self, what: str, name: str, share: float, seeds: int) -> dict[int, dict]:
        """By seed; without what another program is at, or is not to be trained."""
        found, place = {}, self.places[name.partition(",")[0]]
        for seed in range(seeds):
            path = self._path(what, name, share, seed)
            if not path.exists() and place and not self.only_table:
                with claimed(path):
                    if name not in self.scenes:
                        self.scenes[name] = load_scene(place, eval=True, resolution=SIZES[name][0], report=str)
                    made, *beside = train(self.scenes[name], name, share, seed, INGREDIENTS.get(what))
                    path.write_text(json.dumps(made))
                    if beside:
                        self._path(PRESET, name, share, seed).write_text(json.dumps(beside[0]))
                    print(name, share, what, seed, {key: round(value, 3) for key, value in made.items()}, flush=True)
            if path.exists() and path.stat().st_size:
                found[seed] = json.loads(path.read_text())
        return found

    def _path(self, what: str, name: str, share: float, seed: int) -> Path:
        word = "".join(letter if letter.isalnum() else "_" for letter in what)
        return self.folder / f"{name}_{share:g}_{word}_{seed}.json"


def row_of(runs: Runs, what: str, size: str) -> tuple | None:
    """Of each scene the gain over the preset in as many steps, and over what it reaches in as many seconds."""
    it, cells, costs = INGREDIENTS[what], dict.fromkeys(SMALL, ""), []
    names, share = GROUPS[size]
    for name in names:
        news, olds = (runs.get(which, name, share, it.seeds[size]) for which in (what, PRESET))
        half, beside = runs.get(PRESET, name, share / 2, 1), runs.get(what, *COST, 1) if size == "small" else news
        both = [seed for seed in news if seed in olds]
        if not both or not half or not beside:
            continue
        costs.append(float(np.mean([run["cost"] for run in beside.values()])))
        same = np.array([news[seed]["psnr"] - olds[seed]["psnr"] for seed in both])
        gain = same - max(olds[0]["psnr"] - half[0]["psnr"], 0.0) * math.log2(costs[-1])
        cells[name.partition(",")[0]] = f"{same.mean():+.2f}, {gain.mean():+.2f}{_span(gain, '+.2f')}"
    if not costs:
        return None
    return what, it.after, size, it.seeds[size], f"{np.mean(costs):.2f}", *cells.values(), it.kept


def row_of_preset(runs: Runs, size: str) -> tuple:
    """What it reaches itself, and how that scatters."""
    cells, (names, share) = dict.fromkeys(SMALL, ""), GROUPS[size]
    for name in names:
        reached = np.array([run["psnr"] for run in runs.get(PRESET, name, share, 3).values()])
        if len(reached):
            cells[name.partition(",")[0]] = f"{reached.mean():.2f}{_span(reached, '.2f')}"
    return PRESET, "", size, 3, "1", *cells.values(), ""


def _span(values: np.ndarray, how: str) -> str:
    return f" ({values.min():{how}} to {values.max():{how}})" if len(values) > 1 else ""


HEADERS = ("ingredient", "after", "size", "seeds", "seconds", *SMALL, "kept")
NOTE = (
    "First row: held-out PSNR of --preset fast, densifying every 100 steps. Others: gains over it [dB] with the same "
    "seeds, in as many steps, and in as many seconds; in brackets, from seed to seed. All in a quarter of the "
    "preset's steps (short: a sixteenth), with rates and budgets as --minutes takes them. seconds: the processor's, "
    "times the preset's, by turns in one process on one thread; for small ones those of fox at half size in a "
    "sixteenth of the steps. What the preset reaches in other seconds lies on a line through half as many steps, in "
    "their logarithm. small: photographs of an eighth of their edges, budgets of 8,000 (embedded: half, 12,000); "
    "large and short: half of their edges, 100,000 (embedded: whole, 50,000); times the root of the share of steps, "
    "like the points of small ones."
)


def main() -> None:
    arguments = parse(
        __doc__,
        *RUNS,
        option("--only", default="", help="ingredients whose names begin so, between commas"),
    )
    launch.prepare("cpu", 1)
    launch.load(torch.device("cpu"), search)
    arguments.runs.mkdir(parents=True, exist_ok=True)
    places = {"fox": arguments.fox, "church": arguments.church, "embedded": embedded_scene()}
    runs = Runs(arguments.runs, places, arguments.only_table)
    chosen = {what: it for what, it in INGREDIENTS.items() if what.startswith(tuple(arguments.only.split(",")))}
    rows = [row for what, it in chosen.items() for size in it.seeds if (row := row_of(runs, what, size))]
    rows.insert(0, row_of_preset(runs, "small"))
    write_table("prototypes", arguments.out, HEADERS, rows, NOTE)


if __name__ == "__main__":
    main()

"""Ingredients of recipes beside `--preset fast`, at one budget: quality, processor time, Gaussians in pixels.

A run trains in this process, on one thread. Its seconds are the processor's, of its steps alone. What has been run is
kept in a folder and not repeated; several of these programs may run at once, and share the work.

    python benchmarks/recipes.py --runs output/recipes --fox path/to/fox --church path/to/church [--out docs/benchmarks]
"""

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import torch
import work
from common import RUNS, claimed, parse, write_table

from warp_splat.evaluation.metrics import psnr, ssim
from warp_splat.evaluation.perceptual import flip
from warp_splat.presets import EMBEDDED_DEFAULTS, PRESETS
from warp_splat.runtime import launch
from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene
from warp_splat.scene.start import random_points
from warp_splat.scene.types import Scene
from warp_splat.training.optimizer import Optimizer
from warp_splat.training.options import TrainConfig
from warp_splat.training.trainer import Trainer

METRICS = {"psnr": psnr, "ssim": ssim, "flip": flip}
HALVED = {"fox, full": 1, "fox": 2, "church, full": 1, "church": 2, "embedded": 1, "embedded, no points": 1}
MARKS = 20  # measurements over a run
BASE, NEW = "--preset fast, before", "--preset fast"
SIZES = {"coarse_by": "steps", "coarse_until_iter": 1500}  # until November 2026
GROWTH = {"growth": "reference"}  # likewise
EMBEDDED = {"coarse_until_iter": 500}  # likewise
STEPS = ("iterations", "position_lr_max_steps", "cooldown", "coarse_until_iter", "sh_interval")
SHORT = {name: PRESETS["fast"][name] * 3 // 4 for name in (*STEPS, "densify_from_iter", "densify_until_iter")}
OWN = {"embedded": 50_000, "embedded, no points": 60_000}  # --max_gaussians likewise; else 200,000


@contextmanager
def seldom() -> Iterator[None]:
    """Harmonics of higher degrees learn in every fourth step."""
    step = Optimizer._step

    def some(optimizer: Optimizer, names: Sequence[str], rows: int, radii: torch.Tensor | None) -> None:
        left = [name for name in names if optimizer.iteration % 4 == 0 or name != "sh_rest"]
        step(optimizer, left, rows, radii)

    with patch.object(Optimizer, "_step", some):
        yield


class Recipe(NamedTuple):
    """What is changed of ``--preset fast``, and where it is measured."""

    seeds: dict[tuple[str, int], int]  # of (scene, budget)
    options: dict = {}  # noqa: RUF012
    around: Callable[[], AbstractContextManager] = nullcontext  # changes the code


FULL, HALF = ("fox, full", "church, full"), ("fox", "church")
OURS = {("embedded", 50_000): 3}
RECIPES = {
    BASE: Recipe(
        {(scene, 200_000): 3 for scene in FULL}
        | OURS
        | {(scene, 200_000): 1 for scene in HALF}
        | {("fox", 30_000): 2, ("church", 30_000): 2, ("embedded", 30_000): 3, ("embedded, no points", 60_000): 1},
        GROWTH | SIZES,
    ),
    NEW: Recipe({(scene, 100_000): 3 for scene in FULL} | {(s, n): 1 for s in FULL for n in (30_000, 200_000)} | OURS),
    "three quarters of all steps": Recipe({("fox, full", 100_000): 1}, SHORT),
    "--growth budget": Recipe({("fox", 60_000): 1, ("church", 60_000): 1, ("embedded", 50_000): 1}, SIZES),
    "--coarse_by detail": Recipe({("fox", 200_000): 1, ("church", 200_000): 1}, GROWTH),
    "harmonics of higher degree in every 4th step": Recipe({("fox", 60_000): 1}, SIZES, seldom),
    "--growth mcmc": Recipe({("embedded", 30_000): 1, ("embedded, no points", 60_000): 1}, {"growth": "mcmc"} | SIZES),
}


def scene_of(name: str, place: Path) -> Scene:
    """Read, at its size."""
    scene = load_scene(place, eval=True, resolution=HALVED[name], report=str)
    if not name.endswith("no points"):
        return scene
    points, colors = random_points([view.camera for view in scene.train])
    return replace(scene, points=points, colors=colors)


def measure(scene: Scene, options: dict) -> dict:
    """Train, and measure on the held-out views."""
    trainer = Trainer(scene, TrainConfig(**options, device="cpu"))
    trainer.warm_up()
    seconds, curve, iterations = 0.0, [], options["iterations"]
    marks = {iterations * mark // MARKS for mark in range(1, MARKS + 1)}
    for iteration in range(1, iterations + 1):
        start = time.process_time()
        trainer.advance(iteration)
        seconds += time.process_time() - start
        if iteration in marks:
            curve.append((iteration, seconds, trainer.evaluate(scene.test), len(trainer.model)))
    pairs = [(trainer.picture(view.camera), view.picture) for view in scene.test]
    gaussians = trainer.model.activated(trainer.degree)
    counts = work.mean([work.count(gaussians, view.camera, trainer.options) for view in scene.test])
    return {
        **{name: float(np.mean([metric(*pair) for pair in pairs])) for name, metric in METRICS.items()},
        "seconds": seconds,
        "gaussians": len(trainer.model),
        "pairs": counts.pairs,
        "curve": curve,
    }


def options_of(scene: str, limit: int, seed: int, recipe: Recipe) -> dict:
    """Of a training."""
    ours = scene.startswith("embedded")
    preset = PRESETS["fast"] | (EMBEDDED_DEFAULTS["fast"] if ours else {}) | recipe.options
    if ours and "coarse_until_iter" in recipe.options:
        preset |= EMBEDDED
    return {**preset, "max_gaussians": limit, "seed": seed}


def train_all(runs: Path, places: dict[str, Path]) -> None:
    """Train what no other program has begun."""
    scenes = {}
    jobs = [(seed, *job) for job in jobs_of() for seed in range(job[-1])]
    for seed, name, scene, limit, _ in sorted(jobs, key=lambda job: (job[1] not in list(RECIPES)[:2], job[0])):
        path = file_of(runs, name, scene, limit, seed)
        if scene not in places or path.exists():
            continue
        with claimed(path), RECIPES[name].around():
            if scene not in scenes:
                scenes[scene] = scene_of(scene, places[scene])
            found = measure(scenes[scene], options_of(scene, limit, seed, RECIPES[name]))
            path.write_text(json.dumps(found))
            print(scene, limit, name, seed, round(found["psnr"], 2), round(found["seconds"]), flush=True)


def jobs_of() -> list[tuple[str, str, int, int]]:
    """Recipe, scene, budget and number of seeds."""
    return [(name, *place, seeds) for name, recipe in RECIPES.items() for place, seeds in recipe.seeds.items()]


def file_of(runs: Path, name: str, scene: str, limit: int, seed: int) -> Path:
    """Where a run is kept."""
    word = "".join(letter if letter.isalnum() else "_" for letter in name)
    return runs / f"{scene}_{limit}_{word}_{seed}.json"


def load(runs: Path, name: str, scene: str, limit: int, seeds: int) -> dict[int, dict]:
    """The runs that are finished, by seed."""
    paths = {seed: file_of(runs, name, scene, limit, seed) for seed in range(seeds)}
    return {seed: json.loads(p.read_text()) for seed, p in paths.items() if p.exists() and p.stat().st_size}


def seconds_to(curve: list, quality: float) -> float:
    """When a run first had this PSNR, between two measurements; infinite if never."""
    before = (0.0, curve[0][2])
    for _, seconds, value, _ in curve:
        if value >= quality:
            return before[0] + (seconds - before[0]) * max(quality - before[1], 0.0) / max(value - before[1], 1e-9)
        before = (seconds, value)
    return float("inf")


def row_of(runs: Path, name: str, scene: str, limit: int, seeds: int) -> tuple | None:
    """Means over the seeds that have been run, beside ``--preset fast`` with the same."""
    own = OWN.get(scene, 200_000)
    beside = load(runs, BASE, scene, limit if (scene, limit) in RECIPES[BASE].seeds else own, 3)
    pairs = [(run, beside[seed]) for seed, run in load(runs, name, scene, limit, seeds).items() if seed in beside]
    if not pairs:
        return None
    found = [run for run, _ in pairs]
    mean = {key: np.mean([run[key] for run in found]) for key in found[0] if key != "curve"}
    quality = [run["psnr"] for run in found]
    gain = [run["psnr"] - other["psnr"] for run, other in pairs]
    shares = [seconds_to(run["curve"], other["psnr"]) / other["seconds"] for run, other in pairs]
    reached = f"{100 * np.mean(shares):.0f} %" if np.isfinite(shares).all() else "never"
    return (
        *(scene, limit, name, len(found), f"{mean['psnr']:.2f}"),
        f"{min(quality):.2f} to {max(quality):.2f}" if len(found) > 1 else "",
        *("" if name == BASE else f"{np.mean(gain):+.2f}", f"{mean['ssim']:.4f}", f"{mean['flip']:.4f}"),
        *(
            round(mean["gaussians"]),
            f"{mean['pairs'] / 1e6:.1f}",
            f"{mean['seconds']:.0f}",
            "" if name == BASE else reached,
        ),
    )


HEADERS = (
    *("scene", "budget", "recipe", "seeds", "PSNR dB", "from to", "gain", "SSIM", "FLIP", "Gaussians", "Mpairs", "s"),
    "time to the PSNR before",
)
NOTE = (
    "Held-out views; means over seeds. full: 540 x 960 px (fox), 768 x 512 px (church); else half of these edges; "
    "embedded: whole. s: of the processor, of the steps on one thread; the machine did other work, too, so a few "
    "percent mean nothing. Mpairs: Gaussians blended into pixels, of a view. Gain and last column are beside the first "
    "recipe at the same budget, or at its own (200,000; embedded 50,000): after which share of its seconds a run first "
    "had its final PSNR."
)


def main() -> None:
    arguments = parse(__doc__, *RUNS)
    launch.prepare("cpu", 1)
    arguments.runs.mkdir(parents=True, exist_ok=True)
    given = {"fox": arguments.fox, "church": arguments.church, "embedded": embedded_scene()}
    places = {name: place for name in HALVED if (place := given[name.split(",")[0]])}
    if not arguments.only_table:
        train_all(arguments.runs, places)
    rows = [row for job in jobs_of() if (row := row_of(arguments.runs, *job))]
    rows.sort(key=lambda row: (list(HALVED).index(row[0]), row[1]))
    write_table("recipes", arguments.out, HEADERS, rows, NOTE)


if __name__ == "__main__":
    main()

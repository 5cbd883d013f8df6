"""Rates in plans that are shorter than `--preset fast`: those of the preset, and higher ones.

Trainings on one thread: photographs of an eighth of their edges (embedded: half), a budget of 8,000 (12,000), and at
most half of that, or little more, to begin with; and photographs of half of their edges, with 100,000. Runs are kept
in a folder and not repeated.

    python benchmarks/short_plans.py --runs output/short --fox path/to/fox --church path/to/church [--out folder]
"""

import json
from dataclasses import replace

import numpy as np
from common import PHOTOGRAPHS, parse, write_table
from made_up import take_steps

from warp_splat.evaluation.metrics import ssim
from warp_splat.presets import EMBEDDED_DEFAULTS, PRESETS
from warp_splat.runtime import launch
from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene
from warp_splat.scene.types import Scene
from warp_splat.training.options import TrainConfig
from warp_splat.training.plan import RATES, of_length, task_of
from warp_splat.training.trainer import Trainer

SMALL = {"fox": (8, 8000), "church": (8, 8000), "embedded": (2, 12_000)}  # divisor of edges, budget
SIZES = SMALL | {"fox, half": (2, 100_000), "church, half": (2, 100_000), "fox, full": (1, 100_000)}
#: Seeds of (scene, share of the preset's steps, times the preset's rates).
RUNS = {(name, 0.25, 2): 3 for name in SIZES}
RUNS |= {("embedded", 0.5, 1.41): 1, ("fox, half", 0.5, 1.41): 3, ("church, half", 0.5, 1.41): 3}
RUNS |= {("embedded", 0.25, 4): 1, ("embedded", 0.125, 2): 1}
RUNS |= {(name, 0.0625, times): 1 for times in (1.41, 2, 4) for name in SMALL}
HEADERS = ("scene", "steps", "times the rates", "seeds", "PSNR dB", "gain", "from to", "gain, training views", "SSIM")


def train(scene: Scene, name: str, factor: float, times: float, seed: int) -> dict:
    """What a plan of ``factor`` times the preset's steps, with ``times`` its rates, reaches."""
    limit = SIZES[name][1]
    every = max(len(scene.points) // (limit // 2), 1)
    scene = replace(scene, points=scene.points[::every], colors=scene.colors[::every])
    preset = PRESETS["fast"] | (EMBEDDED_DEFAULTS["fast"] if name == "embedded" else {})
    config = TrainConfig(**preset | {"max_gaussians": limit, "seed": seed, "device": "cpu"})
    task = task_of(config, scene, Trainer(scene, config).photographs.shares)
    rates = {rate: times * getattr(config.learn, rate) for rate in RATES}
    trainer = Trainer(scene, of_length(config, factor, task).changed(**rates))
    trainer.warm_up()
    take_steps(trainer, trainer.config.learn.iterations)
    similar = [ssim(trainer.picture(view.camera), view.picture) for view in scene.test]
    reached = {"psnr": trainer.evaluate(scene.test), "train": trainer.evaluate(scene.train[::4])}
    return reached | {"ssim": float(np.mean(similar))}


def main() -> None:
    arguments = parse(__doc__, *PHOTOGRAPHS)
    launch.prepare("cpu", 1)
    arguments.runs.mkdir(parents=True, exist_ok=True)
    places = {"fox": arguments.fox, "church": arguments.church, "embedded": embedded_scene()}
    rows, scenes = [], {}
    for (name, factor, times), seeds in RUNS.items():
        if not places[name.partition(",")[0]]:
            continue
        found: dict[float, list] = {1: [], times: []}
        for seed in range(seeds):
            for rate, runs in found.items():
                path = arguments.runs / f"{name}_{factor:g}_{rate:g}_{seed}.json"
                if not path.exists():
                    place = places[name.partition(",")[0]]
                    scenes[name] = scenes.get(name) or load_scene(place, eval=True, resolution=SIZES[name][0])
                    path.write_text(json.dumps(train(scenes[name], name, factor, rate, seed)))
                runs.append(json.loads(path.read_text()))
        before, after = ({key: np.array([run[key] for run in runs]) for key in runs[0]} for runs in found.values())
        gain, seen = after["psnr"] - before["psnr"], (after["train"] - before["train"]).mean()
        span = f"{gain.min():+.2f} to {gain.max():+.2f}" if seeds > 1 else ""
        quality = (f"{after['psnr'].mean():.2f}", f"{gain.mean():+.2f}", span, f"{seen:+.2f}")
        rows.append((name, f"{factor:g}", f"{times:g}", seeds, *quality, f"{after['ssim'].mean():.4f}"))
    note = (
        "Held-out views, beside the preset's rates with the same seeds. Photographs of an eighth of their edges "
        "(embedded: half), budgets of 8,000 and 12,000, at half and full size of 100,000, times the root of the "
        "share of steps."
    )
    write_table("short_plans", arguments.out, HEADERS, rows, note)


if __name__ == "__main__":
    main()

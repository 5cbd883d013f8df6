"""`--preset fast`, and half of its steps with `--parts exposure`: quality and processor time at full size, by seeds.

Trainings on one thread, whose seconds are the processor's, of their steps alone. Runs are kept in a folder and not
repeated; several of these programs may run at once, and share the work.

    python benchmarks/half_steps.py --runs output/half --fox path/to/fox --church path/to/church [--out docs/benchmarks]
"""

import json
import time

import numpy as np
from common import RUNS, claimed, parse, write_table
from made_up import take_steps

from warp_splat.color import to_bytes
from warp_splat.evaluation.metrics import psnr, ssim
from warp_splat.presets import PRESETS
from warp_splat.runtime import launch
from warp_splat.scene import load_scene
from warp_splat.scene.types import Scene
from warp_splat.training.options import TrainConfig
from warp_splat.training.plan import of_length, task_of
from warp_splat.training.trainer import Trainer

SEEDS = (0, 1, 2)
#: Share of the preset's steps, and parts.
RECIPES = {"--preset fast": (1.0, ""), "half of the steps, --parts exposure": (0.5, "exposure")}
COLUMNS = {
    **{"scene": "{scene}", "recipe": "{recipe}", "steps": "{steps:.0f}", "seeds": "{seeds}", "PSNR dB": "{psnr:.2f}"},
    **{"from to": "{span}", "without exposures": "{plain:.2f}", "SSIM": "{ssim:.4f}", "s": "{seconds:.0f}"},
}


def train(scene: Scene, share: float, parts: str, seed: int) -> dict[str, float]:
    """What a training reaches on the held-out views."""
    config = TrainConfig(**PRESETS["fast"] | {"seed": seed, "device": "cpu", "parts": parts})
    if share < 1.0:
        task = task_of(config, scene, Trainer(scene, config).photographs.shares)
        config = of_length(config, share, task).changed(max_gaussians=config.grow.max_gaussians)
    trainer = Trainer(scene, config)
    trainer.warm_up()
    begun, steps = time.process_time(), config.learn.iterations
    take_steps(trainer, steps)
    seconds = time.process_time() - begun
    plain = [psnr(to_bytes(trainer.look(view.camera).image, scene.linear), view.picture) for view in scene.test]
    alike = [ssim(trainer.picture(view.camera, view.name), view.picture) for view in scene.test]
    reached = {"psnr": trainer.evaluate(scene.test), "plain": float(np.mean(plain)), "ssim": float(np.mean(alike))}
    return reached | {"steps": steps, "seconds": seconds}


def main() -> None:
    arguments = parse(__doc__, *RUNS)
    launch.prepare("cpu", 1)
    arguments.runs.mkdir(parents=True, exist_ok=True)
    places = {name: place for name in ("fox", "church") if (place := getattr(arguments, name))}
    jobs = [(seed, name, recipe) for seed in SEEDS for name in places for recipe in RECIPES]
    paths = {job: arguments.runs / f"{job[1]}_{list(RECIPES).index(job[2])}_{job[0]}.json" for job in jobs}
    for seed, name, recipe in [] if arguments.only_table else jobs:
        path = paths[seed, name, recipe]
        if not path.exists():
            with claimed(path):
                scene = load_scene(places[name], eval=True, resolution=1)
                path.write_text(json.dumps(train(scene, *RECIPES[recipe], seed)))
                print(name, recipe, seed, path.read_text(), flush=True)
    records = []
    for name in places:
        for recipe in RECIPES:
            kept = [paths[job] for job in jobs if job[1:] == (name, recipe) and paths[job].exists()]
            texts = [text for path in kept if (text := path.read_text())]  # empty: under way
            if not texts:
                continue
            runs = [json.loads(text) for text in texts]
            found = [run["psnr"] for run in runs]
            mean = {key: np.mean([run[key] for run in runs]) for key in runs[0]}
            span = f"{min(found):.2f} to {max(found):.2f}"
            records.append({"scene": name, "recipe": recipe, "seeds": len(runs), "span": span, **mean})
    note = (
        "Held-out views at 540 x 960 px (fox) and 768 x 512 px (church), 100,000 Gaussians; means over seeds. Without "
        "exposures: PSNR of what a file of Gaussians alone shows. s: of the processor, of the steps on one thread."
    )
    write_table("half_steps", arguments.out, COLUMNS, records, note)


if __name__ == "__main__":
    main()

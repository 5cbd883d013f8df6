"""Plans far below `--preset fast`: with the full size as early as the preset has it, and as late as `--minutes` does.

Trainings on one thread, by turns, of about as many seconds: a plan whose full size comes later has more steps. Runs are
kept in a folder and not repeated.

    python benchmarks/brief_plans.py --runs output/brief --fox path/to/fox --church path/to/church [--out folder]
"""

import json
import time
from unittest import mock

import numpy as np
from common import PHOTOGRAPHS, parse, write_table
from made_up import take_steps

from warp_splat.evaluation.metrics import ssim
from warp_splat.presets import EMBEDDED_DEFAULTS, PRESETS
from warp_splat.runtime import launch
from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene
from warp_splat.scene.types import Scene
from warp_splat.training import plan
from warp_splat.training.options import TrainConfig
from warp_splat.training.trainer import Trainer

SEEDS = 3
#: Shares of the preset's steps: with its own sizes, and in as many seconds with the full size late.
SHARES = {
    ("fox", 1): ((0.16, 0.195), (0.08, 0.1)),
    ("church", 1): ((0.16, 0.185), (0.08, 0.097)),
    ("embedded", 1): ((0.16, 0.185), (0.08, 0.095)),
    ("fox", 2): ((0.16, 0.182),),
    ("church", 2): ((0.16, 0.178),),
}
HEADERS = ("scene", "steps", "steps now", "seeds", "s", "s now", "PSNR dB", "gain", "from to")
HEADERS += ("training views", "SSIM", "SSIM now")


def train(scene: Scene, name: str, share: float, brief: float, seed: int) -> dict:
    """What a plan reaches whose full size comes late below twice ``brief`` times the preset's steps."""
    preset = PRESETS["fast"] | (EMBEDDED_DEFAULTS["fast"] if name == "embedded" else {})
    config = TrainConfig(**preset | {"seed": seed, "device": "cpu"})
    task = plan.task_of(config, scene, Trainer(scene, config).photographs.shares)
    with mock.patch.object(plan, "BRIEF", brief):
        trainer = Trainer(scene, plan.of_length(config, share, task))
    trainer.warm_up()
    begun = time.process_time()
    take_steps(trainer, trainer.config.learn.iterations)
    seconds = time.process_time() - begun
    similar = [ssim(trainer.picture(view.camera), view.picture) for view in scene.test]
    reached = {"psnr": trainer.evaluate(scene.test), "train": trainer.evaluate(scene.train[::4])}
    return reached | {"ssim": float(np.mean(similar)), "seconds": seconds}


def main() -> None:
    arguments = parse(__doc__, *PHOTOGRAPHS)
    launch.prepare("cpu", 1)
    arguments.runs.mkdir(parents=True, exist_ok=True)
    places = {"fox": arguments.fox, "church": arguments.church, "embedded": embedded_scene()}
    rows = []
    for (name, divisor), pairs in SHARES.items():
        if not places[name]:
            continue
        scene = load_scene(places[name], eval=True, resolution=divisor if divisor > 1 else -1)
        for shares in pairs:
            found: tuple[list, list] = [], []
            for seed in range(SEEDS):
                for runs, share, brief in zip(found, shares, (1e-9, plan.BRIEF), strict=True):
                    path = arguments.runs / f"{name}_{divisor}_{share:g}_{brief:.2g}_{seed}.json"
                    if not path.exists():
                        path.write_text(json.dumps(train(scene, name, share, brief, seed)))
                    runs.append(json.loads(path.read_text()))
            before, after = ({key: np.array([run[key] for run in runs]) for key in runs[0]} for runs in found)
            gain, seen = after["psnr"] - before["psnr"], (after["train"] - before["train"]).mean()
            both = [f"{runs['seconds'].mean():.1f}" for runs in (before, after)]
            quality = f"{before['psnr'].mean():.2f}", f"{gain.mean():+.2f}", f"{gain.min():+.2f} to {gain.max():+.2f}"
            alike = [f"{runs['ssim'].mean():.4f}" for runs in (before, after)]
            size = name if divisor == 1 else f"{name}, half"
            rows.append((size, *(f"{share:g}" for share in shares), SEEDS, *both, *quality, f"{seen:+.2f}", *alike))
    note = (
        "Held-out views. steps: the share of the preset's; now: with the full size late, in about as many seconds of "
        "the processor. Gains are beside the same seeds."
    )
    write_table("brief_plans", arguments.out, HEADERS, rows, note)


if __name__ == "__main__":
    main()

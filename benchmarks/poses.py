"""Poses and a focal length that are wrong by known amounts, learned back by `--parts pose` on the embedded scene.

Of the photographs that train, each pose is off by half a degree and 1 % of the extent; the focal length is off by 1 %
(`assets/make_faults.py`). Held-out photographs have right poses. Pictures are of half size, so that a training takes
half a minute.

    python benchmarks/poses.py [--seed 0] [--out docs/benchmarks]
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from common import option, parse, write_table
from made_up import short_trainer, take_steps
from scipy.spatial.transform import Rotation

from warp_splat.evaluation.metrics import psnr
from warp_splat.runtime import launch
from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene
from warp_splat.scene.types import Scene, View
from warp_splat.training.parts.pose import Pose
from warp_splat.training.trainer import Trainer

sys.path.insert(0, str(Path(__file__).parents[1] / "assets"))

from make_faults import make_faulty

RESOLUTION, STEPS, GAUSSIANS = 2, 1200, 10_000
CURES = ({}, {"parts": "pose"}, {"parts": "pose", "pose_intrinsics": "focal"})
HEADERS = ("cameras", "options", "PSNR", "PSNR_POSE", "direction", "place", "focal length", "processor seconds")


def similarity(here: np.ndarray, there: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation and translation from points [N, 3] to others (Umeyama 1991)."""
    middles = here.mean(0), there.mean(0)
    a, b = here - middles[0], there - middles[1]
    u, sizes, v = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    rotation, scale = (u * signs) @ v, (sizes * signs).sum() / (a**2).sum()
    return scale, rotation, middles[1] - scale * rotation @ middles[0]


def errors(found: list[View], true: list[View], extent: float) -> tuple[float, float, float]:
    """After a similarity: median of degrees and of shares of the extent; error of the focal length."""
    scale, turn, shift = similarity(*(np.stack([view.camera.center for view in views]) for views in (found, true)))
    pairs = [(one.camera, two.camera) for one, two in zip(found, true, strict=True)]
    angles = [Rotation.from_matrix(one.rotation @ turn.T @ two.rotation.T).magnitude() for one, two in pairs]
    places = [np.linalg.norm(scale * turn @ one.center + shift - two.center) for one, two in pairs]
    focal = np.mean([one.fx / two.fx - 1 for one, two in pairs])
    return float(np.degrees(np.median(angles))), float(np.median(places) / extent), float(focal)


def aligned_psnr(trainer: Trainer) -> float:
    """Mean PSNR of the held-out views, from where the model says that they were taken."""
    where = trainer.where_taken()
    views = trainer.refined(trainer.scene.test)
    return float(np.mean([psnr(trainer.picture(where(view)), view.picture, view.mask) for view in views]))


def train(scene: Scene, seed: int, **options) -> tuple[Trainer, float]:
    """A whole training on one thread, and its processor seconds."""
    trainer = short_trainer(scene, STEPS, {"max_gaussians": GAUSSIANS, "seed": seed, **options})
    trainer.warm_up()
    start = time.process_time()
    take_steps(trainer, STEPS)
    return trainer, time.process_time() - start


def main() -> None:
    arguments = parse(__doc__, option("--seed", type=int, default=0))
    launch.prepare("cpu", 1)
    torch.set_num_threads(1)
    true = load_scene(embedded_scene(), eval=True, resolution=RESOLUTION, report=str)
    with tempfile.TemporaryDirectory() as folder:
        make_faulty(Path(folder) / "scene", ["pose", "focal"], arguments.seed)
        wrong = load_scene(Path(folder) / "scene", eval=True, resolution=RESOLUTION, report=str)
        verdict = Pose.needed(wrong).sentence
    rows, runs = [], {}
    for name, scene in (("right", true), ("wrong", wrong)):
        for options in CURES:
            trainer, seconds = train(scene, arguments.seed, **options)
            found = errors(trainer.refined(scene.train), true.train, true.extent)
            values = (trainer.evaluate(scene.test), aligned_psnr(trainer) if options else None)
            told = " ".join(f"--{key} {value}" for key, value in options.items()) or "none"
            runs[f"{name}, {told}"] = (*values, *found, seconds)
            shown = ("" if value is None else f"{value:.2f}" for value in values)
            angle, place, focal = found
            rows.append(
                (name, told, *shown, f"{angle:.3f}°", f"{100 * place:.3f} %", f"{100 * focal:+.3f} %", f"{seconds:.0f}")
            )
            print(*rows[-1], flush=True)
    note = (
        f"PSNR of held-out views in dB; medians of the training cameras after a similarity. {STEPS} steps, "
        f"{GAUSSIANS} Gaussians, an edge of {true.train[0].camera.width} px, seed {arguments.seed}."
    )
    data = {"runs": runs, "verdicts": [Pose.needed(true).sentence, verdict]}
    write_table("poses", arguments.out, HEADERS, rows, note, data)


if __name__ == "__main__":
    main()

"""Poses and a focal length that are wrong by known amounts, learned back by ``--parts pose`` on the embedded scene.

Each pose is off by half a degree and 1 % of the extent, the focal length by 1 %.

    python benchmarks/poses.py [--out docs/benchmarks]
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from cameras import direction
from common import machine, write_table
from scipy.spatial.transform import Rotation

from warp_splat.camera import Camera
from warp_splat.evaluation.alignment import where_taken
from warp_splat.evaluation.metrics import psnr
from warp_splat.presets import EMBEDDED_DEFAULTS, PRESETS
from warp_splat.runtime import launch
from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene
from warp_splat.scene.types import Scene, View
from warp_splat.training.options import TrainConfig
from warp_splat.training.trainer import Trainer

ANGLE, SHIFT, ZOOM = np.radians(0.5), 0.01, 1.01  # of each pose, as a share of the extent, of the focal length
FAST = {**PRESETS["fast"], **EMBEDDED_DEFAULTS["fast"], "device": "cpu", "eval": True}
HEADERS = ("cameras", "parts", "PSNR", "PSNR_POSE", "direction", "place", "focal length", "seconds")


def misplaced(scene: Scene, generator: np.random.Generator, zoom: float = ZOOM) -> Scene:
    """Every camera turned and moved in directions of its own, through a lens with another focal length."""

    def moved(view: View) -> View:
        turn = Rotation.from_rotvec(direction(generator, ANGLE)).as_matrix()
        center = view.camera.center + direction(generator, SHIFT * scene.extent)

        def camera(given: Camera) -> Camera:
            rotation = turn @ given.rotation
            pose = {"rotation": rotation, "translation": -rotation @ center}
            return replace(given, fx=zoom * given.fx, fy=zoom * given.fy, **pose)

        return replace(view, camera=camera(view.camera), original=camera(view.original))

    return replace(scene, train=[moved(view) for view in scene.train], test=[moved(view) for view in scene.test])


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


def score(trainer: Trainer, align: bool) -> float:
    """Mean PSNR of the held-out views, where they were given or where the model says they were taken."""
    gaussians = trainer.model.activated(trainer.degree)
    where = where_taken(gaussians, trainer.background, trainer.options, trainer.scene.extent)
    views = trainer.refined(trainer.scene.test)
    cameras = [where(view) if align else view.camera for view in views]
    pairs = zip(cameras, views, strict=True)
    return float(np.mean([psnr(trainer.picture(camera), view.picture, view.mask) for camera, view in pairs]))


def trained(scene: Scene, **options) -> tuple[Trainer, float]:
    """A whole training and its processor seconds."""
    trainer = Trainer(scene, TrainConfig(**{**FAST, **options}))
    trainer.warm_up()
    start = time.process_time()
    for iteration in range(1, trainer.config.learn.iterations + 1):
        if iteration > 1:
            trainer.update(iteration - 1)
        trainer.differentiate(iteration)
    return trainer, time.process_time() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="folder for poses.md and poses.json")
    arguments = parser.parse_args()
    launch.prepare("cpu", 1)
    torch.set_num_threads(1)
    true = load_scene(embedded_scene(), eval=True, report=lambda line: None)
    wrong = misplaced(true, np.random.default_rng(0))
    rows, runs = [], {}
    for name, scene in (("right", true), ("wrong", wrong)):
        for parts in ("", "pose"):
            options = {"parts": parts, "pose_intrinsics": "focal"}
            trainer, seconds = trained(scene, **options)
            angle, place, focal = errors(trainer.refined(scene.train), true.train, true.extent)
            plain, after = score(trainer, False), score(trainer, True)
            runs[f"{name} {parts or 'none'}"] = {
                **{"psnr": plain, "psnr_pose": after, "seconds": seconds},
                **{"degrees": angle, "place": place, "focal": focal},
            }
            row = (f"{plain:.2f}", f"{after:.2f}", f"{angle:.3f}°", f"{100 * place:.3f} %", f"{100 * focal:+.3f} %")
            rows.append((name, parts or "none", *row, f"{seconds:.0f}"))
            print(rows[-1], flush=True)
    note = (
        "Medians over the training cameras, after a similarity; places as shares of the extent. PSNR of held-out views "
        "at their given poses, PSNR_POSE after their poses were refined."
    )
    write_table("poses", arguments.out, HEADERS, rows, note, {"runs": runs, "machine": machine()})


if __name__ == "__main__":
    main()

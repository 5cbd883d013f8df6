"""Known faults in the embedded scene, and what parts recover of them: numbers of the truth, and PSNR.

Held-out photographs have no fault but the sky (`assets/make_faults.py`), so the PSNR of a model says how much of the
clean scene it has. Photographs are small, so that a training takes a minute.

    python benchmarks/faults.py [--seed 0] [--out docs/benchmarks]
"""

import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from common import option, parse, write_table
from made_up import short_trainer, take_steps

from warp_splat.color import from_srgb
from warp_splat.evaluation.metrics import psnr
from warp_splat.runtime import launch
from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene
from warp_splat.scene.types import Scene
from warp_splat.training.trainer import Trainer

sys.path.insert(0, str(Path(__file__).parents[1] / "assets"))

from make_faults import beyond, make_faulty, sky_light
from scene_geometry import still_life
from scene_trace import Measure

RESOLUTION, STEPS, GAUSSIANS = 4, 3000, 6000
LEAST = 0.004  # light of pixels whose ratio counts
#: By fault: the options that are to cure it.
CURES = {
    "exposure": ({"exposure": "gain"}, {"exposure": "affine"}),
    "vignetting": ({"exposure": "gain", "vignetting": True},),
    "sky": ({"parts": "sky"},),
}
HEADERS = ("fault", "options", "PSNR, clean", "with", "PSNR, faulty", "with", "recovered", "errors: median, largest")


def train(scene: Scene, seed: int, **options) -> tuple[Trainer, float]:
    """A training on one thread, and the PSNR of held-out views, which have no fault: drawn without what was learned."""
    trainer = short_trainer(
        scene, STEPS, {"max_gaussians": GAUSSIANS, "seed": seed, "eval": True, "coarse": 1} | options
    )
    take_steps(trainer, STEPS)
    return trainer, float(np.mean([psnr(trainer.picture(view.camera), view.picture) for view in scene.test]))


def errors_of(trainer: Trainer, clean: Scene, truth: dict) -> np.ndarray:
    """Of each photograph and channel: what its map makes of the clean photograph's light, against the truth - 1.

    Gains are relative to their mean over the photographs. Without gains: of the light in the corners.
    """
    part, found = trainer.parts[-1], []
    for view, whole in zip(trainer.scene.train, clean.train, strict=True):
        values = torch.from_numpy(whole.image / np.float32(255))
        with torch.no_grad():
            mapped = part.image(values, None, SimpleNamespace(view=view)).numpy()
        before, after = (from_srgb(np.float64(image).clip(0), np.where) for image in (values.numpy(), mapped))
        ratio = np.log2(np.where(before > LEAST, after.clip(1e-6) / before.clip(LEAST), np.nan))
        if "exposure" in truth:
            found.append(np.nanmedian(ratio, (0, 1)) - truth["exposure"][view.name])
        else:
            corners = ratio[[0, 0, -1, -1], [0, -1, 0, -1]] - ratio[ratio.shape[0] // 2, ratio.shape[1] // 2]
            found.append(np.nanmedian(corners, 0) - np.log2(1 - truth["vignetting"]))
    stops = np.array(found)
    return np.abs(2 ** (stops - stops.mean(0) * ("exposure" in truth)) - 1)


def errors_of_sky(trainer: Trainer) -> np.ndarray:
    """Of the light that held-out photographs show beyond the room, against the truth there."""
    found, shown = [], Measure(still_life())
    for view in trainer.scene.test:
        camera = view.camera
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rays = camera.rays(np.stack([x.ravel(), y.ravel()], 1)) @ camera.rotation
        origins = np.broadcast_to(camera.center, rays.shape)
        far = beyond(origins + shown(origins, rays)[:, None] * rays)
        light = from_srgb(trainer.picture(camera).reshape(-1, 3)[far] / 255, np.where)
        found.append((light / sky_light(rays[far]).clip(LEAST, 1)).mean(1) - 1)
    return np.abs(np.concatenate(found))


def main() -> None:
    arguments = parse(__doc__, option("--seed", type=int, default=0))
    launch.prepare("cpu", 1)
    clean = load_scene(embedded_scene(), eval=True, resolution=RESOLUTION, report=str)
    rows, started, untouched = [], time.perf_counter(), train(clean, arguments.seed)[1]
    for fault, cures in CURES.items():
        with tempfile.TemporaryDirectory() as folder:
            truth = make_faulty(Path(folder) / "scene", [fault], arguments.seed)
            faulty = load_scene(Path(folder) / "scene", eval=True, resolution=RESOLUTION, report=str)
        broken = train(faulty, arguments.seed)[1]
        for options in cures:
            trainer, cured = train(faulty, arguments.seed, **options)
            _, same = train(clean, arguments.seed, **options)
            errors = errors_of_sky(trainer) if fault == "sky" else errors_of(trainer, clean, truth)
            told = " ".join(f"--{name}" if value is True else f"--{name} {value}" for name, value in options.items())
            share = f"{100 * (cured - broken) / (untouched - broken):.0f} %"
            figures = (f"{value:.2f}" for value in (untouched, same, broken, cured))
            rows.append((fault, told, *figures, share, f"{100 * np.median(errors):.1f} %, {100 * errors.max():.1f} %"))
            print(*rows[-1], f"{time.perf_counter() - started:.0f} s", flush=True)
    note = f"dB of held-out views, which have no fault, drawn without maps; {STEPS} steps, an edge of 66 px, seed "
    note += f"{arguments.seed}. Errors are those of light."
    write_table("faults", arguments.out, HEADERS, rows, note, {"rows": rows})


if __name__ == "__main__":
    main()

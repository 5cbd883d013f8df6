"""Training with other cuts: PSNR with intervals over seeds, and time.

The embedded scene at half its size by the short schedule of ``warp-splat compare``, each training with each seed. A
model is judged by the views held out, rendered with the options of its training. Time is processor time of the steps.

    python benchmarks/training_cuts.py [--seeds 3] [--out docs/benchmarks]
"""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import option, parse, write_table
from made_up import take_steps
from scipy import stats

from warp_splat.compare.workloads import SHORT
from warp_splat.runtime import launch
from warp_splat.scene import Scene, load_scene
from warp_splat.scene.embedded import embedded_scene
from warp_splat.training.options import TrainConfig
from warp_splat.training.trainer import Trainer

CUTS = {
    "alpha_min 1/255": {},
    "alpha_min 4/255": {"alpha_min": 4 / 255},
    "alpha_min 1e-3": {"alpha_min": 1e-3},
    "alpha_min 1e-4": {"alpha_min": 1e-4},
    "t_min 1e-6": {"t_min": 1e-6},
    "tolerance 0.1": {"tolerance": 0.1},
    "tolerance 0.01": {"tolerance": 0.01},
}
HEADERS = ("options", "PSNR [dB]", "against the first, 95 % interval [dB]", "Gaussians", "time")


def trained(scene: Scene, seed: int, adjoint: str = "manual", **cuts) -> tuple[float, int, float]:
    """PSNR [dB] of the views held out, Gaussians and seconds."""
    trainer = Trainer(scene, TrainConfig(**SHORT, device="cpu", seed=seed, adjoint=adjoint))
    trainer.options = replace(trainer.options, **cuts)
    trainer.warm_up()
    start = time.process_time()
    take_steps(trainer, SHORT["iterations"])
    seconds = time.process_time() - start
    return trainer.evaluate(scene.test), len(trainer.model), seconds


def compare(name: str, variants: dict[str, dict], seeds: int, out: Path | None) -> None:
    """Train every variant with every seed; the table and its file bear this name."""
    launch.prepare("cpu", 0)
    scene = load_scene(embedded_scene(), resolution=2, eval=True, report=lambda _: None)
    found = {variant: [] for variant in variants}
    for seed in range(seeds):
        for variant, options in variants.items():
            found[variant].append(trained(scene, seed, **options))
            print(seed, variant, *found[variant][-1], flush=True)
    runs = np.array(list(found.values()))  # [variants, seeds, 3]
    gains, half, rows = runs[..., 0] - runs[0, :, 0], stats.t.ppf(0.975, seeds - 1) / seeds**0.5, []
    for variant, own, gain in zip(variants, runs, gains, strict=True):
        against = f"{gain.mean():+.2f} ± {half * gain.std(ddof=1):.2f}" if rows else ""
        ratio = np.median(own[:, 2] / runs[0, :, 2])
        rows.append((variant, f"{own[:, 0].mean():.2f}", against, f"{own[:, 1].mean():.0f}", f"{ratio:.2f}"))
    over, among = (runs[..., 0].std(axis, ddof=1).mean() for axis in (0, 1))
    note = (
        f"{SHORT['iterations']} steps of the embedded scene at half its size, {seeds} seeds. The standard deviation of "
        f"PSNR is {over:.3f} dB over rows of a seed, and {among:.3f} dB over seeds of a row."
    )
    write_table(name, out, HEADERS, rows, note, {"runs": found})


def main() -> None:
    arguments = parse(__doc__, option("--seeds", type=int, default=3))
    compare("training_cuts", CUTS, arguments.seeds, arguments.out)


if __name__ == "__main__":
    main()

"""`--half_moments`: what Adam's moments in 16 bits cost in quality, and gain in time and memory.

Trains the embedded scene and, with -s, photographs at a quarter of their size, briefly, with and without, over SEEDS.
A run whose results are there already is not repeated. Times are of a step of Adam alone on one thread, of 1,000,000
Gaussians of degree 3; both take turns.

    python benchmarks/half_moments.py --models output/halves [-s path/to/fox] [--out docs/benchmarks]
"""

import itertools
import statistics
import time
from pathlib import Path

import torch
from common import MODELS, SCENE, interleaved, parse, write_table
from preset import run

from warp_splat.runtime import launch
from warp_splat.training.adam_step import HALF, move

SEEDS = (0, 1, 2)
FLAGS = ["--preset", "fast", "--iterations", "600", "--max_gaussians", "15000"]
PHOTOGRAPHS = ["-r", "4", "--eval", *FLAGS]
KINDS = {"32 bits": [], "16 bits": ["--half_moments"]}
COUNT, WIDTHS = 1_000_000, (3, 3, 45, 1, 3, 4)  # Gaussians, and the numbers of each of their parameters
ROUNDS = 15


def qualities(models: Path, scenes: dict[str, list[str]]) -> dict[str, dict[str, list[float]]]:
    """PSNR [dB] of the held-out views, by scene and kind, a number for each seed."""
    found: dict[str, dict[str, list[float]]] = {scene: {kind: [] for kind in KINDS} for scene in scenes}
    for scene, flags in scenes.items():
        for seed in SEEDS:
            for kind, of_kind in KINDS.items():
                folder = models.resolve() / f"{scene}_{kind.replace(' ', '_')}_{seed}"
                found[scene][kind].append(run(folder, [*flags, *of_kind, "--seed", f"{seed}"])[0]["PSNR"])
    return found


def time_steps() -> dict[str, float]:
    """Least seconds of a step."""
    launch.prepare("cpu", 1)
    numbers, steps = [[1e-3, 1e-15, 1.0, 0.9, 0.1, 0.999, 0.001]] * len(WIDTHS), itertools.count()
    tables = {}
    for kind, dtype in zip(KINDS, (torch.float32, HALF), strict=True):
        rows = [[torch.randn(COUNT, width), 1e-4 * torch.randn(COUNT, width)] for width in WIDTHS]
        tables[kind] = [[*row, *(torch.zeros_like(row[0], dtype=dtype) for _ in range(2))] for row in rows]
    runs = {kind: lambda table=table: move(table, numbers, COUNT, None, next(steps)) for kind, table in tables.items()}
    return interleaved(runs, ROUNDS, time.thread_time, min)


def main() -> None:
    arguments = parse(__doc__, MODELS, SCENE)
    scenes = {"embedded": FLAGS}
    if arguments.scene:
        scenes["quarter"] = ["-s", f"{arguments.scene.resolve()}", *PHOTOGRAPHS]
    found, seconds = qualities(arguments.models, scenes), time_steps()
    rows = []
    for kind, bits in zip(KINDS, (32, 16), strict=True):
        quality = [
            f"{statistics.mean(found[scene][kind]):.2f} ({', '.join(f'{psnr:.2f}' for psnr in found[scene][kind])})"
            for scene in scenes
        ]
        rows.append([kind, *quality, f"{1e3 * seconds[kind]:.1f}", f"{1e-6 * COUNT * sum(WIDTHS) * 2 * bits / 8:.0f}"])
    headers = ("moments", *(f"{scene}: PSNR dB" for scene in scenes), "Adam at 1M: ms", "MB")
    note = f"Held-out views, {' '.join(FLAGS)}: the mean of seeds {', '.join(map(str, SEEDS))}, and each."
    write_table("half_moments", arguments.out, headers, rows, note, {"psnr": found, "seconds": seconds})


if __name__ == "__main__":
    main()

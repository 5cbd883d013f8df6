"""Train a scene of photographs twice and tell what came of it: quality on held-out views against time and memory.

Runs `-r 2` for 1,000 iterations and full size for 7,000 with the reference's schedule; a run whose results are there
already is not repeated.

    python benchmarks/training.py -s path/to/fox --models output/fox [--out docs/benchmarks]
"""

import json
import subprocess
import sys
from pathlib import Path

from common import MODELS, ROOT, option, parse, write_table

RUNS = {"half": ["-r", "2", "--iterations", "1000"], "full": ["-r", "1", "--iterations", "7000"]}
STATED = (1000, 3000, 7000)
COLUMNS = {
    **{"size": "{size}", "iteration": "{iteration}", "PSNR dB": "{PSNR:.2f}", "SSIM": "{SSIM:.4f}"},
    **{"s of steps": "{seconds:.0f}", "it/s": "{speed:.1f}", "Gaussians": "{gaussians}"},
    **{"wall s": "{wall:.0f}", "peak GB": "{peak:.1f}"},
}


def run(scene: Path, model: Path, flags: list[str]) -> None:
    """Train, and evaluate the models saved on the way."""
    if (model / "results.json").is_file():
        return
    last = int(flags[-1])
    saved = [str(iteration) for iteration in STATED if iteration <= last]
    train = ["train", "-s", scene, "-m", model, "--eval", *flags, "--save_iterations", *saved]
    subprocess.run([sys.executable, "-m", "warp_splat", *train, "--test_iterations", *saved], check=True, cwd=ROOT)
    for iteration in saved[:-1]:
        render = ["render", "-m", model, "--iteration", iteration, "--skip_train", "--quiet"]
        subprocess.run([sys.executable, "-m", "warp_splat", *render], check=True, cwd=ROOT)


def records_of(name: str, model: Path) -> list[dict]:
    """One for each stated iteration: quality of the saved model, time until then, speed, memory."""
    results = json.loads((model / "results.json").read_text())
    history = {record["iteration"]: record for record in json.loads((model / "history.json").read_text())}
    records = []
    for iteration in (iteration for iteration in STATED if f"ours_{iteration}" in results):
        entry, record = results[f"ours_{iteration}"], history[iteration]
        whole = {"wall": entry["seconds"], "peak": entry["peak_memory_mb"] / 1024} if iteration == max(history) else {}
        speed = iteration / record["seconds"]
        records.append({"size": name, "iteration": iteration, **entry, **record, "speed": speed, **whole})
    return records


def main() -> None:
    arguments = parse(__doc__, option("-s", "--scene", type=Path, required=True), MODELS)
    records = []
    for name, flags in RUNS.items():
        run(arguments.scene.resolve(), (arguments.models / name).resolve(), flags)
        records += records_of(name, arguments.models / name)
    note = "Held-out views (every 8th). Wall time holds loading, kernels, evaluations, pictures and plots as well."
    write_table("training", arguments.out, COLUMNS, records, note)


if __name__ == "__main__":
    main()

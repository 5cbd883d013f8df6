"""`--preset fast` against the default schedule: PSNR on held-out views over seconds of training, in a table and a plot.

Trains the embedded scene and, with -s, a scene of photographs at full size (the default for 7,000 iterations); a run
whose results are there already is not repeated. The models of benchmarks/training.py serve: `full` is one of them.

    python benchmarks/preset.py --models output/fox [-s path/to/fox] [--out docs/benchmarks]
"""

import json
from pathlib import Path

from common import MODELS, SCENE, parse, run_training, write_table
from panels import Panel, draw_panels

from warp_splat.evaluation.report import BLUE, ORANGE

EMBEDDED = {"embedded": [], "embedded, fast": ["--preset", "fast"]}
PHOTOGRAPHS = {
    "full": ["-r", "1", "--eval", "--iterations", "7000"],
    "full, fast": ["-r", "1", "--eval", "--preset", "fast"],
    **{f"full, fast, seed {seed}": ["-r", "1", "--eval", "--preset", "fast", "--seed", f"{seed}"] for seed in (1, 2)},
    "full, fast, --parts auto": ["-r", "1", "--eval", "--preset", "fast", "--parts", "auto"],
}
EARLY = 60  # s
COLUMNS = {
    **{"run": "{run}", "iterations": "{iterations}", f"PSNR dB by {EARLY} s": "{early:.2f}", "PSNR dB": "{PSNR:.2f}"},
    **{"SSIM": "{SSIM:.4f}", "s of steps": "{of_steps:.0f}", "wall s": "{seconds:.0f}", "Gaussians": "{gaussians}"},
}


def run(model: Path, flags: list[str]) -> tuple[dict, list[dict]]:
    """Train, if that has not been done; the results of the last iteration and the history."""
    return run_training(model, flags), json.loads((model / "history.json").read_text())


def plot(path: Path, found: dict[str, list[dict]]) -> None:
    """PSNR over seconds, a panel per scene."""
    panels = []
    for scene in dict.fromkeys(name.split(",")[0] for name in found):
        panels.append(panel := Panel(f"{scene}: PSNR [dB]", "seconds of training"))
        for name, color, label in ((scene, BLUE, "default"), (f"{scene}, fast", ORANGE, "--preset fast")):
            seconds, quality = zip(*((record["seconds"], record["psnr"]) for record in found[name]), strict=True)
            panel.marks(label, seconds, quality, (color, "o"), ls="-")
    draw_panels(path, panels, len(panels), 2.4, xscale="linear", yscale="linear")


def main() -> None:
    arguments = parse(__doc__, MODELS, SCENE)
    runs = dict(EMBEDDED)
    if arguments.scene:
        runs |= {name: ["-s", arguments.scene.resolve(), *flags] for name, flags in PHOTOGRAPHS.items()}
    folders = {name: arguments.models / name.replace(",", "").replace(" ", "_") for name in runs}
    found = {name: run(folders[name].resolve(), flags) for name, flags in runs.items()}
    records = []
    for name, (results, history) in found.items():
        early = max((record["psnr"] for record in history if record["seconds"] <= EARLY), default=None)
        records.append({"run": name, **results, "early": early, "of_steps": history[-1]["seconds"]})
    note = "Held-out views; a few of them in the column of the first minute."
    write_table("preset", arguments.out, COLUMNS, records, note)
    if arguments.out:
        plot(arguments.out / "preset.png", {name: history for name, (_, history) in found.items()})


if __name__ == "__main__":
    main()

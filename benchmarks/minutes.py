"""`--minutes`: seconds asked for and taken from the first step to the last, and the PSNR that was reached.

Trains the embedded scene and, with -s, a scene of photographs at half size; a run whose results are there already is
not repeated. `disturbed`: after 40 % of the time, as many processes as there are cores compute, too. `again`: the
options that a run stored, without a clock; its model has to be the same file. What undisturbed runs reached is what
--minutes compares a plan with.

    python benchmarks/minutes.py --models output/minutes [-s path/to/fox] [--out docs/benchmarks]
"""

import json
import subprocess
import sys
import time
import tomllib
from pathlib import Path

from common import MODELS, ROOT, SCENE, parse, write_table

from warp_splat.config import CORES
from warp_splat.formats.png import load_png
from warp_splat.training.deadline import REACHED
from warp_splat.training.plan import Reached

MINUTES = {"embedded": (0.5, 1, 2), "half": (1, 3)}
DISTURBED, AFTER = ("embedded", 1), 0.4
HEADERS = ("run", "asked s", "taken s", "off %", "planned", "iterations", "cooldown", "Gaussians", "PSNR dB")


def train(model: Path, flags: list, disturb_after: float = 0.0) -> dict:
    """Train, if that has not been done: its results, with its options, and the pixels of its photographs."""
    if not (model / "results.json").is_file():
        command = [sys.executable, "-u", "-m", "warp_splat", "train", "-m", model, *map(str, flags)]
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        busy = []
        for line in process.stdout or ():
            print(line, end="", flush=True)
            if disturb_after and line.startswith("Kernels ready"):
                time.sleep(disturb_after)
                busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(CORES)]
        for other in busy:
            other.kill()
        if process.wait():
            sys.exit(process.returncode)
    results = next(iter(json.loads((model / "results.json").read_text()).values()))
    height, width, _ = load_png(next(model.glob("test/*/renders/*.png"))).shape
    options = tomllib.loads((model / "config.toml").read_text())
    return results | {"options": options, "pixels": width * height}


def row_of(name: str, minutes: float, found: dict) -> tuple:
    """Asked and taken, planned and done."""
    asked, taken, options = 60 * minutes, found["spent"], found["options"]
    off = f"{100 * (taken / asked - 1):+.1f}"
    steps = (options["iterations"], found["iterations"], options["cooldown"])
    return (name, f"{asked:.0f}", f"{taken:.1f}", off, *steps, found["gaussians"], f"{found['PSNR']:.2f}")


def main() -> None:
    arguments = parse(__doc__, MODELS, SCENE)
    flags = {"embedded": []}
    if arguments.scene:
        flags["half"] = ["-s", arguments.scene.resolve(), "-r", "2", "--eval"]
    folder, rows, reached = arguments.models.resolve(), [], []
    for scene, given in flags.items():
        for minutes in MINUTES[scene]:
            found = train(folder / f"{scene}_{minutes:g}", [*given, "--minutes", minutes])
            rows.append(row_of(scene, minutes, found))
            fields = (found["pixels"], minutes, found["iterations"], found["gaussians"], round(found["PSNR"], 2))
            reached.append(Reached({"half": "a room"}.get(scene, "the embedded scene"), *fields))
    scene, minutes = DISTURBED
    found = train(folder / "disturbed", [*flags[scene], "--minutes", minutes], AFTER * 60 * minutes)
    rows.append(row_of(f"{scene}, disturbed", minutes, found))
    first = folder / f"embedded_{MINUTES['embedded'][0]:g}"
    again, found = train(folder / "again", ["--config", first / "config.toml"]), train(first, [])
    same = "the same file" if again["sha256"] == found["sha256"] else "ANOTHER FILE"
    rows.append(
        ("embedded, again", "", f"{again['spent']:.1f}", "", "", again["iterations"], *row_of("", 1, again)[6:])
    )
    note = (
        f"Held-out views. The model of the last row is {same} as that of the first. Disturbed: {CORES} other processes "
        f"compute from {AFTER:.0%} of the time on."
    )
    write_table("minutes", arguments.out, HEADERS, rows, note)
    if arguments.out:
        entries = ",\n ".join(json.dumps(entry._asdict()) for entry in reached)
        REACHED.write_text(f"[{entries}]\n")


if __name__ == "__main__":
    main()

"""What `simplify` saves, and what that costs: held-out PSNR and megabytes of half and a third of trained models.

Trains the embedded scene and, with -s, a scene of photographs at half size by `--preset fast`; a model that is there
already is not trained again.

    python benchmarks/simplify.py --models output/simplify [-s path/to/fox] [--out docs/benchmarks]
"""

import argparse
import subprocess
import sys
from pathlib import Path

from common import machine, write_table

from warp_splat.formats.splats import SplatArrays
from warp_splat.pruning.finished import Opened, open_finished, written_bytes
from warp_splat.pruning.simplify import squared_error
from warp_splat.pruning.thinning import fewer_harmonics, tuned

ROOT = Path(__file__).parents[1]
SHARES, STEPS = {"1/2": 1 / 2, "1/3": 1 / 3}, 300
FORMATS = (".sog", ".spz")
HEADERS = ("scene", "kept", "harmonics", "Gaussians", "test PSNR dB", "change dB", "SOG MB", "SPZ MB")


def train(folder: Path, flags: list) -> None:
    """Train, if that has not been done."""
    if not (folder / "results.json").is_file():
        command = [sys.executable, "-m", "warp_splat", "train", "-m", folder, "--preset", "fast", "--quiet", *flags]
        subprocess.run(command, check=True, cwd=ROOT)


def rows_of_model(scene: str, folder: Path) -> list[tuple]:
    """The model, and what is left of it."""
    opened = open_finished(str(folder), "", -1, "cpu", 0)
    whole = opened.file.splats
    before = opened.psnr(whole, opened.scene.test)
    rows = [row_of(opened, scene, "1", "all", whole, before)]
    for name, share in SHARES.items():
        count = round(share * len(whole.means))
        splats = tuned(opened.scene, opened.file, opened.setting, count, STEPS, opened.trained)
        rows.append(row_of(opened, scene, name, "all", splats, before))
        splats = fewer_harmonics(splats, opened.setting, squared_error(opened, splats))
        rows.append(row_of(opened, scene, name, "that show", splats, before))
    return rows


def row_of(opened: Opened, scene: str, kept: str, harmonics: str, splats: SplatArrays, before: float) -> tuple:
    """Quality on held-out views, and sizes of files."""
    quality = opened.psnr(splats, opened.scene.test)
    file = opened.file._replace(splats=splats)
    sizes = (f"{written_bytes(Path(f'a{ending}'), file) / 1e6:.2f}" for ending in FORMATS)
    change = "" if kept == "1" else f"{quality - before:+.2f}"
    row = (scene, kept, harmonics, len(splats.means), f"{quality:.2f}", change, *sizes)
    print(*row, flush=True)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--models", type=Path, required=True, help="folder for the models")
    parser.add_argument("-s", "--scene", type=Path, help="a scene of photographs, besides the embedded one")
    parser.add_argument("--out", type=Path, help="folder for simplify.md and simplify.json")
    arguments = parser.parse_args()
    flags = {"embedded": []}
    if arguments.scene:
        flags[arguments.scene.name] = ["-s", arguments.scene.resolve(), "-r", "2", "--eval"]
    rows = []
    for scene, given in flags.items():
        folder = (arguments.models / scene).resolve()
        train(folder, given)
        rows += rows_of_model(scene, folder)
    note = f"Held-out views; {STEPS} steps of training for what is kept; the harmonics that show, 0.02 dB aside."
    write_table(
        "simplify", arguments.out, HEADERS, rows, note, {"headers": HEADERS, "rows": rows, "machine": machine()}
    )


if __name__ == "__main__":
    main()

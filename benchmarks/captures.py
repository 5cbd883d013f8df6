r"""Real captures, `--preset fast` with and without parts: metrics of held-out views, mean and scatter over seeds.

A run whose results are there already is not repeated; `--given` trains nothing and shows what there is.

    python benchmarks/captures.py -s path/to/church --limit 80000 -s path/to/fox --limit 60000 -s embedded \
        --limit 50000 --parts floaters --models output/captures [-r 2] [--seeds 0 1 2] [--out docs/benchmarks]
"""

import argparse
import json
import statistics
import subprocess
import sys
from pathlib import Path

from common import machine, write_table

from warp_splat.formats.png import load_png

ROOT = Path(__file__).parents[1]
METRICS = {"PSNR": 2, "CC_PSNR": 2, "SSIM": 4, "FLIP": 4}  # and how many decimals
EMBEDDED = "embedded"  # has defaults of its own if no scene is given
HEADERS = ("scene", "pixels", "parts", "seeds", *METRICS, "PSNR of the worst view", "Gaussians")


def run(model: Path, flags: list, given: bool) -> dict | None:
    """Train, if that has not been done and may be; the metrics, the worst view's PSNR, and the size."""
    if not (model / "results.json").is_file():
        if given:
            return None
        command = [sys.executable, "-m", "warp_splat", "train", "--eval", "--preset", "fast", "--quiet", "-m", model]
        subprocess.run([*command, *flags], check=True, cwd=ROOT)
    results, views = (json.loads((model / f"{name}.json").read_text()) for name in ("results", "per_view"))
    last = max(results, key=lambda name: int(name.removeprefix("ours_")))
    height, width, _ = load_png(model / "test" / last / "gt" / "00000.png").shape
    kept = {name: results[last][name] for name in (*METRICS, "gaussians", "sha256")}
    return {**kept, "worst": min(views[last]["PSNR"].values()), "pixels": f"{width}x{height}"}


def row_of(scene: str, parts: str, found: list[dict]) -> tuple:
    """Means over the seeds, with the standard deviation where there are two or more."""

    def shown(name: str, decimals: int) -> str:
        values = [results[name] for results in found]
        scatter = f" ± {statistics.stdev(values):.{decimals}f}" if len(values) > 1 else ""
        return f"{statistics.mean(values):.{decimals}f}{scatter}"

    values = [shown(name, decimals) for name, decimals in {**METRICS, "worst": 2, "gaussians": 0}.items()]
    return (scene, found[0]["pixels"], parts, len(found), *values)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "-s", "--scene", type=Path, action="append", required=True, help="a scene, or embedded; may come again"
    )
    parser.add_argument("--limit", type=int, action="append", required=True, help="--max_gaussians of each scene")
    parser.add_argument("--parts", action="append", default=[], help="as of train.py; may come again")
    parser.add_argument("-r", "--resolution", default="2", help="as of train.py")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--given", action="store_true", help="train nothing")
    parser.add_argument("--models", type=Path, required=True, help="folder for the models")
    parser.add_argument("--out", type=Path, help="folder for captures.md and captures.json")
    arguments = parser.parse_args()
    rows, runs = [], {}
    for scene, limit in zip(arguments.scene, arguments.limit, strict=True):
        for parts in ("", *arguments.parts):
            found = []
            for seed in arguments.seeds:
                given, size = str(scene) != EMBEDDED, f"_{arguments.resolution}"
                name = f"{scene.name}{size * given}_{parts or 'none'}_{seed}"
                flags = ["--max_gaussians", str(limit), "--seed", str(seed), *(["--parts", parts] if parts else [])]
                flags += ["-s", scene.resolve(), "-r", arguments.resolution] * given
                if results := run((arguments.models / name).resolve(), flags, arguments.given):
                    runs[name] = results
                    found.append(results)
            if found:
                rows.append(row_of(scene.name, parts or "none", found))
    note = "Held-out views, dB where it says PSNR; mean ± standard deviation over the seeds."
    write_table("captures", arguments.out, HEADERS, rows, note, {"runs": runs, "machine": machine()})


if __name__ == "__main__":
    main()

r"""Real captures, `--preset fast` with and without parts: metrics of held-out views, mean and scatter over seeds.

A run whose results are there already is not repeated; `--given` trains nothing and shows what there is.

    python benchmarks/captures.py -s path/to/church --limit 80000 -s path/to/fox --limit 60000 -s embedded \
        --limit 50000 --parts floaters --models output/captures [-r 2] [--seeds 0 1 2] [--out docs/benchmarks]
"""

import json
import statistics
from pathlib import Path

from common import MODELS, option, parse, run_training, write_table

from warp_splat.formats.png import load_png

METRICS = {"PSNR": 2, "CC_PSNR": 2, "SSIM": 4, "FLIP": 4}  # and how many decimals
EMBEDDED = "embedded"  # has defaults of its own if no scene is given
HEADERS = ("scene", "pixels", "parts", "seeds", *METRICS, "PSNR of the worst view", "Gaussians")


def run(model: Path, flags: list, given: bool) -> dict | None:
    """Train, if that has not been done and may be; the metrics, the worst view's PSNR, and the size."""
    if given and not (model / "results.json").is_file():
        return None
    results = run_training(model, ["--eval", "--preset", "fast", "--quiet", *flags])
    worst = min(json.loads((model / "per_view.json").read_text())[f"ours_{results['iterations']}"]["PSNR"].values())
    height, width, _ = load_png(next(model.glob(f"test/ours_{results['iterations']}/gt/00000.png"))).shape
    kept = {name: results[name] for name in (*METRICS, "gaussians", "sha256")}
    return {**kept, "worst": worst, "pixels": f"{width}x{height}"}


def row_of(scene: str, parts: str, found: list[dict]) -> tuple:
    """Means over the seeds, with the standard deviation where there are two or more."""

    def shown(name: str, decimals: int) -> str:
        values = [results[name] for results in found]
        scatter = f" ± {statistics.stdev(values):.{decimals}f}" if len(values) > 1 else ""
        return f"{statistics.mean(values):.{decimals}f}{scatter}"

    values = [shown(name, decimals) for name, decimals in {**METRICS, "worst": 2, "gaussians": 0}.items()]
    return (scene, found[0]["pixels"], parts, len(found), *values)


def main() -> None:
    arguments = parse(
        __doc__,
        option("-s", "--scene", type=Path, action="append", required=True, help="a scene, or embedded; may come again"),
        option("--limit", type=int, action="append", required=True, help="--max_gaussians of each scene"),
        option("--parts", action="append", default=[], help="as of train.py; may come again"),
        option("-r", "--resolution", default="2", help="as of train.py"),
        option("--seeds", type=int, nargs="+", default=[0, 1, 2]),
        option("--given", action="store_true", help="train nothing"),
        MODELS,
    )
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
    write_table("captures", arguments.out, HEADERS, rows, note, {"runs": runs})


if __name__ == "__main__":
    main()

"""What `simplify` saves, and what that costs: held-out PSNR and megabytes of half and a third of trained models.

python benchmarks/simplify.py -m MODEL [-m MODEL ...] [--out docs/benchmarks]
"""

from pathlib import Path

from common import TRAINED, parse, write_table

from warp_splat.config import FinishedModel
from warp_splat.formats.splats import SplatArrays
from warp_splat.pruning.opened import Opened, written_bytes
from warp_splat.pruning.simplify import fewer_harmonics
from warp_splat.pruning.thinning import tuned

SHARES, STEPS = {"1/2": 1 / 2, "1/3": 1 / 3}, 300
FORMATS = (".sog", ".spz")
HEADERS = ("scene", "kept", "harmonics", "Gaussians", "test PSNR dB", "change dB", "SOG MB", "SPZ MB")


def rows_of(model: Path) -> list[tuple]:
    """The model, and what is left of it."""
    opened = Opened(FinishedModel(model=str(model), device="cpu"))
    whole = opened.file.splats
    before = opened.psnr(whole, opened.scene.test)
    rows = [row_of(opened, "1", "all", whole, before)]
    for name, share in SHARES.items():
        count = round(share * len(whole.means))
        splats = tuned(opened.scene, opened.file, opened.setting, count, STEPS, opened.trained)
        rows.append(row_of(opened, name, "all", splats, before))
        splats = fewer_harmonics(opened, splats)
        rows.append(row_of(opened, name, "that show", splats, before))
    return rows


def row_of(opened: Opened, kept: str, harmonics: str, splats: SplatArrays, before: float) -> tuple:
    """Quality on held-out views, and sizes of files."""
    scene, quality = Path(opened.trained["source_path"]).name, opened.psnr(splats, opened.scene.test)
    file = opened.file._replace(splats=splats)
    sizes = (f"{written_bytes(Path(f'a{ending}'), file) / 1e6:.2f}" for ending in FORMATS)
    change = "" if kept == "1" else f"{quality - before:+.2f}"
    row = (scene, kept, harmonics, len(splats.means), f"{quality:.2f}", change, *sizes)
    print(*row, flush=True)
    return row


def main() -> None:
    arguments = parse(__doc__, TRAINED)
    rows = [row for model in arguments.models for row in rows_of(model.resolve())]
    note = f"Held-out views; {STEPS} steps of training for what is kept. The harmonics that show: all but 0.02 dB."
    write_table("simplify", arguments.out, HEADERS, rows, note)


if __name__ == "__main__":
    main()

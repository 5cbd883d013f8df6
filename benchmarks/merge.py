"""How much like a trained model do a half, a fifth and a tenth as many Gaussians look, merged, and the largest of them?

A minute for each model of 200,000 Gaussians.

    python benchmarks/merge.py -m MODEL [-m MODEL ...] [--out docs/benchmarks]
"""

import time
from pathlib import Path

import numpy as np
from common import TRAINED, parse, picture_of, write_table

from warp_splat.evaluation.metrics import psnr
from warp_splat.export_html.merge import merged
from warp_splat.export_html.pack import shown
from warp_splat.formats import model_folder
from warp_splat.formats.splats import SplatArrays
from warp_splat.gaussians import GaussianModel
from warp_splat.rendering.finished import Finished
from warp_splat.runtime import launch

SHARES = {"1/2": 1 / 2, "1/5": 1 / 5, "1/10": 1 / 10}
VIEWS = 5
HEADERS = ("model", "Gaussians", "share", "merged dB", "largest dB", "merging s")


def rows_of(model: Path) -> list[tuple]:
    """A row for each share."""
    finished = Finished(model)
    cameras = [camera for _, camera in model_folder.read_cameras(model)]
    splats, rows = shown(finished.file.splats), []

    def pictures(chosen: SplatArrays) -> list[np.ndarray]:
        picture = picture_of(GaussianModel.from_splats(chosen), None, finished.options)
        return [picture(camera) for camera in cameras[:VIEWS]]

    everything = pictures(splats)
    for name, share in SHARES.items():
        count = round(share * len(splats.means))
        begun = time.perf_counter()
        coarse = merged(splats, count, cameras)[1]
        seconds = time.perf_counter() - begun
        chosen = (coarse, shown(splats, count))
        values = [np.mean([psnr(*pair) for pair in zip(pictures(few), everything, strict=True)]) for few in chosen]
        row = (model.name, len(splats.means), name, *(f"{value:.2f}" for value in values), f"{seconds:.1f}")
        rows.append(row)
        print(*row, flush=True)
    return rows


def main() -> None:
    arguments = parse(__doc__, TRAINED)
    launch.prepare("cpu", 0)
    rows = [row for model in arguments.models for row in rows_of(model)]
    note = f"PSNR of renders against those of all Gaussians, the first {VIEWS} cameras; merged ones have degree 0."
    write_table("merge", arguments.out, HEADERS, rows, note)


if __name__ == "__main__":
    main()

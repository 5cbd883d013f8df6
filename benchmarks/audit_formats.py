"""What a format loses, and what a viewer's own loader makes of it: the numbers that it read, and its picture.

The 60 Gaussians of the audit's ``cloud``, harmonics of degree 0, written by this package in each format and shown by
Spark in a headless Chromium, glTF by Babylon.js. Their loaders tell what they read.

    python benchmarks/audit_formats.py [--out docs/benchmarks]
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch
from audit_targets import FOLDER
from scipy.spatial import cKDTree

from warp_splat.audit.judged import exact_image, in_eight_bits
from warp_splat.audit.program import screenshot, stored
from warp_splat.audit.small_scenes import SCENES, on_all_pixels
from warp_splat.evaluation.report import machine
from warp_splat.formats.exchange import load_gaussians, save_gaussians
from warp_splat.formats.files import write_text
from warp_splat.formats.stored import SH_C0
from warp_splat.text import table_of

#: Who reads a format, and what the loader may leave to the viewer: axes turned.
SPARK = ("spark.html", (1, -1, -1))
FORMATS = {**dict.fromkeys(("ply", "spz", "splat", "sog"), SPARK), "glb": ("babylon.html", (-1, -1, 1))}
COLUMNS = {
    "format": "{format}",
    "the format's own error": "{format_error:.1e}",
    "the loader's error": "{loader_error:.1e}",
    "with axes turned": "{turned:.1e}",
    "picture off by, mean": "{mean:.1e}",
    "from that of the PLY file": "{from_ply:.1e}",
}


def numbers(splats) -> np.ndarray:
    """Means, scales, opacity and color of Gaussians as stored, [N, 10]."""
    opacity, color = 1 / (1 + np.exp(-splats.opacities)), 0.5 + SH_C0 * splats.sh[:, 0]
    return np.concatenate([splats.means, np.exp(splats.scales), opacity[:, None], color], 1)


def error(found: np.ndarray, given: np.ndarray) -> float:
    """The largest difference, each Gaussian compared with the nearest: formats exchange their order."""
    return float(np.abs(found[cKDTree(found[:, :3]).query(given[:, :3])[1]] - given).max())


def measured(suffix: str, folder: Path, workload, file) -> dict:
    def write(served: Path) -> None:
        save_gaussians(served / f"scene.{suffix}", file)

    write(folder)
    ours = numbers(load_gaussians(folder / f"scene.{suffix}").splats)
    page, turned = FORMATS[suffix]
    picture, read = screenshot(FOLDER / page, workload.camera, write, f"scene.{suffix}")
    given = lambda served: save_gaussians(served / "same.ply", file)  # noqa: E731
    of_ply, _ = screenshot(FOLDER / page, workload.camera, given, "same.ply")
    theirs = np.array(read)[:, [0, 1, 2, 7, 8, 9, 10, 11, 12, 13]]
    return {
        "format": suffix,
        "format_error": error(ours, numbers(file.splats)),
        "loader_error": error(theirs, ours),
        "turned": error(theirs * np.array([*turned, *[1] * 7]), ours),
        "mean": float(np.abs(picture / 255 - in_eight_bits(exact_image(workload))).mean()),
        "from_ply": float(np.abs(picture / 255 - of_ply / 255).mean()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks"))
    arguments = parser.parse_args()
    workload = on_all_pixels("cloud", SCENES["cloud"][1](), degree=0)
    *geometry, dc, rest = workload.gaussians
    file = stored(*geometry, torch.cat([dc, rest], 1))
    with tempfile.TemporaryDirectory() as name:
        rows = [measured(suffix, Path(name), workload, file) for suffix in FORMATS]
    note = f"Measured by `benchmarks/audit_formats.py` on {machine()}, with Spark 2.2.0; glb with Babylon.js 9.35.0."
    write_text(arguments.out / "audit_formats.md", f"{table_of(rows, COLUMNS)}\n\n{note}\n")
    print(table_of(rows, COLUMNS))


if __name__ == "__main__":
    main()

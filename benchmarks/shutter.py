"""Rolling shutter against the truth, a picture of which each row is drawn by a camera that stands still.

    python benchmarks/shutter.py --out docs/benchmarks

The truth is drawn by the renderer itself, row by row. Beside the two steps that find a Gaussian's time stand one step,
and a camera that stands still where its middle row is read.
"""

import functools
import time
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from cameras import cube
from common import interleaved, parse, write_table

from warp_splat import Camera, Lens, RasterOptions, Shutter, rasterize
from warp_splat.evaluation.report import new_panels, save_figure
from warp_splat.kernels.project.rolling import STEPS, make_expose
from warp_splat.raster import camera_parameters
from warp_splat.raster.data import Gaussians
from warp_splat.raster.project import project

SIZE, SEED = 96, 0
CAMERA = Camera(SIZE, SIZE, 1.2 * SIZE, 1.2 * SIZE, SIZE / 2, SIZE / 2, np.eye(3), np.array([0.0, 0.0, 1.5]))
FISHEYE = replace(CAMERA, fx=0.8 * SIZE, fy=0.8 * SIZE, lens=Lens("OPENCV_FISHEYE", (0.03, -0.01, 0.0, 0.0)))
MOTIONS = {
    "pans by 3 degrees": (CAMERA, Shutter((0.0, np.radians(3), 0.0))),
    "tilts by 3 degrees": (CAMERA, Shutter((np.radians(3), 0.0, 0.0))),
    "steps aside by 5 cm": (CAMERA, Shutter(shift=(0.05, 0.0, 0.0))),
    "rolls by 3 degrees, goes 5 cm ahead": (CAMERA, Shutter((0.0, 0.0, np.radians(3)), (0.0, 0.0, 0.05))),
    "pans by 20 degrees": (CAMERA, Shutter((0.0, np.radians(20), 0.0))),
    "tilts by 15 degrees": (CAMERA, Shutter((np.radians(15), 0.0, 0.0))),
    "fisheye, all of the first four": (FISHEYE, Shutter((np.radians(3),) * 3, (0.05, 0.0, 0.05))),
}
SHOWN = "steps aside by 5 cm"
TIMED, TURNS = 50_000, 15
HEADERS = ("the camera", "drawn with", "means [px]", "PSNR [dB]", "time")


def ways(camera: Camera) -> dict[str, tuple[Camera, int]]:
    """Camera and steps."""
    return {"standing still": (replace(camera, shutter=None), STEPS), "one step": (camera, 1), "two steps": (camera, 2)}


def with_steps(steps: int):
    """The renderer with so many steps."""
    return patch.object(camera_parameters, "make_expose", functools.partial(make_expose, steps=steps))


def row_by_row(scene: list[torch.Tensor], camera: Camera) -> torch.Tensor:
    """The true picture [H, W, 3]."""
    return torch.stack([rasterize(*scene, camera.at(row)).image[row] for row in range(camera.height)])


def true_means(means: torch.Tensor, camera: Camera) -> np.ndarray:
    """Where means [N, 3] are read, [N, 2] px: by fixed-point steps in float64 until nothing moves."""
    found = []
    for mean in means.double().numpy():
        row, place = 0.5 * camera.height, np.zeros(2)
        for _ in range(100):
            still = camera.at(np.clip(row, -0.15 * camera.height, 1.15 * camera.height) - 0.5)
            place = camera.pixels((still.rotation @ mean + still.translation)[None])[0]
            row = place[1]
        found.append(place)
    return np.stack(found)


def seconds_of(camera: Camera) -> dict[str, float]:
    """Processor seconds of projection and adjoint, the least of some turns."""
    given = [tensor.requires_grad_() for tensor in cube(SEED, TIMED)]
    gaussians = Gaussians(*given[:4], given[4][:, :1], given[4][:, 1:])

    def once(seen_by: Camera, steps: int) -> None:
        with with_steps(steps):
            splats = project(gaussians, seen_by, RasterOptions())
            torch.autograd.grad(splats[:5], gaussians[:5], [torch.ones_like(part) for part in splats[:5]])

    runs = {name: functools.partial(once, *way) for name, way in ways(camera).items()}
    return interleaved(runs, TURNS, time.process_time, min)


def measured(name: str) -> tuple[list[dict], dict[str, torch.Tensor]]:
    """A record for each way to draw what a camera sees, and the pictures."""
    camera, shutter = MOTIONS[name]
    camera, scene = replace(camera, shutter=shutter), cube(SEED)
    truth, places = row_by_row(scene, camera), true_means(scene[0], camera)
    inside = ((places > 0) & (places < SIZE)).all(1)
    seconds, records, pictures = seconds_of(camera), [], {"row by row": truth}
    for way, (seen_by, steps) in ways(camera).items():
        with with_steps(steps):
            out = rasterize(*scene, seen_by)
        off = np.hypot(*(out.means2d.numpy() - places)[inside].T)
        psnr = float(-10 * torch.log10((out.image - truth).square().mean()))
        records.append({"motion": name, "way": way, "off": float(off.max()), "psnr": psnr, "seconds": seconds[way]})
        pictures[way] = out.image
    return records, pictures


def plot(path: Path, pictures: dict[str, torch.Tensor]) -> None:
    """The truth, and ten times what the others are off by."""
    figure, panels = new_panels(2.9, columns=3)
    truth = pictures["row by row"]
    shown = {"row by row": truth}
    for way in ("standing still", "two steps"):
        shown[f"10 x the error, {way}"] = (10 * (pictures[way] - truth).abs()).clamp(0, 1)
    for axes, (title, picture) in zip(panels[0], shown.items(), strict=True):
        axes.imshow(picture.clamp(0, 1).numpy(), interpolation="nearest")
        axes.set_title(title, loc="left", fontsize=10, fontweight="bold")
        axes.set_axis_off()
    save_figure(figure, path)


def main() -> None:
    given = parse(__doc__)
    records = []
    for name in MOTIONS:
        found, pictures = measured(name)
        records += found
        if given.out and name == SHOWN:
            plot(given.out / "shutter.png", pictures)
    rows = []
    for record in records:
        still = next(r for r in records if r["motion"] == record["motion"])
        cells = (f"{record['off']:.1e}" if record["off"] < 0.01 else f"{record['off']:.2f}", f"{record['psnr']:.1f}")
        first = record["motion"] if record is still else ""
        rows.append([first, record["way"], *cells, f"{record['seconds'] / still['seconds']:.2f}"])
    note = (
        f"A cube of 1 m at 1.5 m, {SIZE} x {SIZE} px. Means: the largest error inside the picture. Time: "
        f"processor seconds of projection and adjoint of {TIMED:,} Gaussians on one thread, relative to a camera that "
        "stands still."
    )
    write_table("shutter", given.out, HEADERS, rows, note, {"records": records})


if __name__ == "__main__":
    main()

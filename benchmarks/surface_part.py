"""Whether a part `surface` makes a model's surface truer: a prototype, which is not in the package.

It adds to the loss how far the normals of the rendered depth are from the Gaussians' own, blended (as 2DGS, Huang et
al. 2024), and a price on each Gaussian's smallest scale (as PGSR, Chen et al. 2024). Surfaces are those of the model's
depths alone. Models are kept in a folder and not trained again.

    python benchmarks/surface_part.py --runs output/surface --fox path/to/fox --church path/to/church [--out folder]
"""

import json
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from common import ROOT, option, parse, write_table
from mesh import MEMORY, PIXELS, against_truth, to_mesh

from warp_splat.cli import main as run
from warp_splat.config import MeshConfig, RasterOptions
from warp_splat.flags import learning
from warp_splat.meshing.command import drawn_views, surface_in, trimesh_of
from warp_splat.meshing.fusion import agreed, pixel, rays, voxels_of
from warp_splat.pruning.opened import Opened
from warp_splat.raster.api import RenderOutput
from warp_splat.raster.data import Gaussians
from warp_splat.training.parts import PARTS
from warp_splat.training.seams import Entry, Setting, Step

FAST = ("--preset", "fast")
HALF = (*FAST, "-r", 2, "--iterations", 700, "--max_gaussians", 8000)
WHOLE = (*FAST, "--max_gaussians", 30_000)
SMALL = (*FAST, "-r", 135, "--iterations", 700, "--max_gaussians", 8000)
NONE, BOTH = (0, 0), (0.05, 100)  # weights of normals and of flatness
WEIGHTS = (NONE, (0.01, 0), (0.05, 0), (0.2, 0), (0, 10), (0, 100), (0.02, 100))
HEADERS = ("scene", "weights", "PSNR", "accuracy 1.0%", "F 1.0%", "normals, degrees", "points, median", "points, 90 %")
BEGIN, OPAQUE = 0.25, 0.5  # share of the steps after which normals count; alpha from which on a pixel has one


@dataclass(frozen=True)
class SurfaceOptions:
    surface_normals: float = learning(0.05, "weight of normals that do not agree")
    surface_flat: float = learning(100.0, "weight of the mean smallest scale, in shares of the extent")


class SurfacePart:
    def __init__(self, options: SurfaceOptions, setting: Setting):
        self.options, self.extent, self.begin = options, setting.scene.extent, BEGIN * setting.iterations

    def asks(self, options: RasterOptions, step: Step) -> RasterOptions:
        begun = self.options.surface_normals and (step.iteration >= self.begin or not step.iteration)
        return replace(options, depth=True, normals=True) if begun else options

    def loss(self, loss: torch.Tensor, out: RenderOutput, step: Step) -> torch.Tensor:
        if out.normals is None:
            return loss
        height, width = out.alpha.shape
        ray = rays(step.view.camera.resized(width, height), out.alpha.device)
        points = ray * (out.depth / out.alpha.clamp_min(1e-3))[..., None]
        across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
        normals = torch.nn.functional.normalize(torch.linalg.cross(down, across), dim=-1)
        alpha = out.alpha.detach()[1:-1, 1:-1]
        wrong = alpha - (normals * out.normals[1:-1, 1:-1]).sum(-1)
        return loss + self.options.surface_normals * torch.where(alpha > OPAQUE, wrong, 0.0).mean()

    def price(self, gaussians: Gaussians) -> torch.Tensor:
        smallest = gaussians.scales.nan_to_num().amin(1).double().sum() / len(gaussians.scales)
        return self.options.surface_flat * smallest / self.extent


def row_of(scene: str, flags: tuple, weights: tuple[float, float], runs: Path) -> tuple:
    folder = runs / "_".join(f"{word}" for word in (*scene.split(), *weights))
    if not (folder / "results.json").is_file():
        more = ("--parts", "surface", "--surface_normals", weights[0], "--surface_flat", weights[1])
        command = [sys.executable, __file__, "train", "-m", folder, "--eval", *flags, *(more if any(weights) else ())]
        subprocess.run([*map(str, command)], check=True, cwd=ROOT)
    result = next(iter(json.loads((folder / "results.json").read_text()).values()))
    opened = Opened(MeshConfig(model=str(folder), output=""))
    views = agreed(drawn_views(opened, MEMORY))
    voxel = PIXELS * pixel(views)
    found = trimesh_of(surface_in(voxels_of(views, voxel), views, voxel))
    truth = against_truth(found, opened.scene) if "still_life" in str(opened.trained["source_path"]) else [None] * 11
    far = to_mesh(opened.scene.points, found.vertices, found.faces)[0] / opened.scene.extent * 100
    numbers = [result["PSNR"], truth[3], truth[5], truth[10], np.median(far), np.quantile(far, 0.9)]
    return scene, "{:g}, {:g}".format(*weights), *("" if number is None else f"{number:.4g}" for number in numbers)


def main() -> None:
    paths = [option(f"--{name}", help="the scene's folder") for name in ("fox", "church")]
    arguments = parse(__doc__, option("--runs", type=Path, required=True, help="folder for the models"), *paths)
    cases = [("still_life half", HALF, weights) for weights in WEIGHTS]
    cases += [("still_life", WHOLE, weights) for weights in (NONE, BOTH)]
    for name in ("fox", "church"):
        if source := getattr(arguments, name):
            cases += [(f"{name} small", ("-s", source, *SMALL), weights) for weights in (NONE, BOTH)]
    rows = [row_of(*case, arguments.runs.resolve()) for case in cases]
    write_table(
        "surface_part",
        arguments.out,
        HEADERS,
        rows,
        "Percent of the extent but for PSNR [dB]; one seed each; models of 8,000 Gaussians, still_life of 30,000.",
    )


if __name__ == "__main__":
    if sys.argv[1:2] == ["train"]:
        PARTS["surface"] = Entry(SurfaceOptions, "__main__.SurfacePart")
        sys.exit(run(sys.argv[1:]))
    main()

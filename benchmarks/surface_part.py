"""What `--parts surface` costs, and whether it makes a model's surface truer, by its two weights.

Surfaces are those of the model's depths alone. Models are kept in a folder and not trained again.

    python benchmarks/surface_part.py --runs output/surface --fox path/to/fox --church path/to/church [--out folder]
"""

from pathlib import Path

import numpy as np
from common import option, parse, run_training, write_table
from mesh import MEMORY, PIXELS, against_truth, to_mesh

from warp_splat.config import MeshConfig
from warp_splat.meshing.command import drawn_views, surface_in, trimesh_of
from warp_splat.meshing.fusion import agreed, pixel, voxels_of
from warp_splat.pruning.opened import Opened

SMALL = ("--preset", "fast", "--iterations", 700, "--max_gaussians", 8000)
WHOLE = ("--preset", "fast", "--max_gaussians", 30_000)
NONE, BOTH, STRONG = (0, 0), (0.01, 0.5), (0.05, 0.5)  # weights of normals and of views
WEIGHTS = (NONE, BOTH, (0, 0.5), (0.05, 0), STRONG, (0.1, 0.5))
HEADERS = ("scene", "weights", "PSNR", "accuracy 1.0%", "F 1.0%", "normals, degrees", "points, median", "points, 90 %")


def row_of(scene: str, flags: tuple, weights: tuple[float, float], runs: Path) -> tuple:
    folder = runs / "_".join(f"{word}" for word in (*scene.split(), *weights))
    more = ("--parts", "surface", "--surface_normals", weights[0], "--surface_views", weights[1])
    result = run_training(folder, ["--eval", *flags, *(more if any(weights) else ())])
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
    sources = {name: ("-s", path) for name in ("fox", "church") if (path := getattr(arguments, name))}
    cases = [("still_life half", ("-r", 2, *SMALL), weights) for weights in WEIGHTS]
    cases += [
        (f"{name} 135 px", (*at, "-r", 135, *SMALL), weights) for name, at in sources.items() for weights in WEIGHTS
    ]
    cases += [("still_life", WHOLE, weights) for weights in (NONE, BOTH, STRONG)]
    cases += [
        (f"{name} 270 px", (*at, "-r", 270, *WHOLE), weights)
        for name, at in sources.items()
        for weights in (NONE, BOTH, STRONG)
    ]
    rows = [row_of(*case, arguments.runs.resolve()) for case in cases]
    write_table(
        "surface_part",
        arguments.out,
        HEADERS,
        rows,
        "Percent of the extent but for PSNR [dB]; one seed each; 700 steps to 8,000 Gaussians at half size and 135 px, "
        "else --preset fast to 30,000.",
    )


if __name__ == "__main__":
    main()

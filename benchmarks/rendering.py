"""How fast does a trained model render, and what do cheaper options save and cost? An orbit around the scene's focus.

The orbit goes around the point that the cameras of the scene look at. About 2 minutes on two cores.

    python benchmarks/rendering.py -s SCENE -m point_cloud.ply [more models] [--out docs/benchmarks]
"""

from pathlib import Path

import numpy as np
import torch
from common import interleaved, load_model, option, parse, picture_of, write_table

from warp_splat import rasterize, rasterize_views
from warp_splat.config import RasterOptions
from warp_splat.evaluation.metrics import psnr
from warp_splat.gaussians import GaussianModel
from warp_splat.rendering.camera_paths import focus_orbit
from warp_splat.runtime import launch, pool
from warp_splat.scene import load_scene
from warp_splat.text import format_table

FRAMES = 12  # of the orbit, in each round
ROUNDS = 5
FULL = "all"
OPTIONS = {
    FULL: RasterOptions(),
    **{f"sh_degree={degree}": RasterOptions(sh_degree=degree) for degree in (2, 1, 0)},
    **{f"t_min={least:g}": RasterOptions(t_min=least) for least in (1e-3, 1e-2, 3e-2)},
    **{f"max_steps={steps}": RasterOptions(max_steps=steps) for steps in (2048, 1024, 512)},
    **{f"exp_degree={degree}": RasterOptions(exp_degree=degree) for degree in (4, 3)},
    "sh_degree=0, t_min=0.01": RasterOptions(sh_degree=0, t_min=1e-2),
}
HEADERS = ("Gaussians", "options", "frames/s", "times all", "PSNR to all", "largest error", "test PSNR dB")


def measure(model: GaussianModel, names: list[str], cameras: list, test: list) -> list[tuple]:
    """A row for each of the options: speed on the orbit, error against the first of them, quality on held-out views."""
    pictures = {name: picture_of(model, None, OPTIONS[name]) for name in names}
    frames = {name: np.concatenate([picture(camera) for camera in cameras]) for name, picture in pictures.items()}
    runs = {name: lambda picture=picture: [picture(camera) for camera in cameras] for name, picture in pictures.items()}
    seconds, full, rows = interleaved(runs, ROUNDS), frames[FULL], []
    for name, picture in pictures.items():
        error = np.abs(frames[name].astype(int) - full).max()
        quality = np.mean([psnr(picture(view.camera), view.picture, view.mask) for view in test])
        speeds = (f"{len(cameras) / seconds[name]:.1f}", f"{seconds[FULL] / seconds[name]:.2f}")
        close = "" if name == FULL else f"{psnr(frames[name], full):.1f}"
        rows.append((len(model), name, *speeds, close, f"{error}/255", f"{quality:.2f}"))
    return rows


def compare_calls(model: GaussianModel, cameras: list) -> list[tuple]:
    """Milliseconds of a frame by a call for each camera, and by one call for all."""
    with torch.no_grad():
        means, quats, scales, opacities, *sh = model.activated()
        gaussians = (means, quats, scales, opacities, tuple(sh))
        runs = {
            "rasterize": lambda: [rasterize(*gaussians, camera) for camera in cameras],
            "rasterize_views": lambda: rasterize_views(*gaussians, cameras),
        }
        seconds = interleaved(runs, ROUNDS)
    return [(name, f"{1e3 * value / len(cameras):.1f}") for name, value in seconds.items()]


def main() -> None:
    arguments = parse(
        __doc__,
        option("-s", "--scene", type=Path, required=True, help="in which every 8th view was held out"),
        option("-m", "--models", type=Path, nargs="+", required=True, help="the first in all options"),
    )
    launch.prepare("cpu", 0)
    scene = load_scene(arguments.scene, eval=True, report=lambda _: None)
    cameras, rows = focus_orbit(scene, FRAMES), []
    models = [load_model(path).arranged() for path in arguments.models]
    for model in models:
        rows += measure(model, list(OPTIONS) if model is models[0] else [FULL], cameras, scene.test)
    calls = compare_calls(models[0], cameras)
    note = "\n\n".join(
        (
            f"An orbit of {FRAMES} frames at {cameras[0].width} x {cameras[0].height} px around the point that the "
            "cameras look at, as 8-bit pictures; errors against the first row, in levels of 255.",
            "The public functions, which check the Gaussians first:",
            format_table(("function", "ms per frame"), calls),
            f"{pool.get_threads()} threads.",
        )
    )
    data = {"headers": HEADERS, "rows": rows, "calls": calls}
    write_table("rendering", arguments.out, HEADERS, rows, note, data)


if __name__ == "__main__":
    main()

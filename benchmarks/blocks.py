"""Blocks of a scene, trained apart and merged, against one training of all of it: what it costs at their borders.

A made street of 400 photographs, and with -s a scene of photographs. All views are seen as often: a block with a third
of the photographs trains a third of the steps. A pixel belongs to the cell in which the undivided model has its depth.
A view looks across a border if a tenth of its pixels belong to other cells than most do; pixels within 3 of another
cell's are those of a seam.

    python benchmarks/blocks.py --models output/blocks [-s SCENE] [--blocks 4] [--seeds 0 1] [--out docs/benchmarks]
"""

from argparse import Namespace
from pathlib import Path

import numpy as np
import torch
from common import MODELS, SCENE, option, parse, run_training, write_table
from scipy.ndimage import maximum_filter, minimum_filter
from street import make_street

from warp_splat.camera import Camera
from warp_splat.color import to_bytes
from warp_splat.config import MergeConfig
from warp_splat.formats.model_folder import find_iteration, ply_path
from warp_splat.gaussians import GaussianModel
from warp_splat.presets import PRESETS
from warp_splat.raster.beside import rays
from warp_splat.rendering.finished import Finished
from warp_splat.scene import load_scene
from warp_splat.scene.blocks import Block, merge_blocks
from warp_splat.scene.types import View
from warp_splat.training.options import TrainConfig, schedule_of

ACROSS, SEAM = 0.1, 3
TOGETHER = ("--settle_from_iter", 1, "--out_of_core", "--optimizer_type", "sparse_adam")  # as --blocks does
COLUMNS = {
    **{"scene": "{scene}", "seed": "{seed}", "model": "{model}", "Gaussians": "{file}", "across": "{across:.2f}"},
    **{"within": "{within:.2f}", "seams": "{seams:.2f}", "elsewhere": "{rest:.2f}"},
    **{"starts from": "{largest}", "views": "{views}", "MB": "{mb:.0f}", "steps": "{steps}"},
}


def flags_of(source: Path, seed: int, share: float, iterations: int, width: int) -> list:
    """Of a training with a share of all views, its schedule as much shorter."""
    fast = schedule_of(TrainConfig(**PRESETS["fast"]))
    scale = share * iterations / fast["iterations"]
    schedule = [word for name, steps in fast.items() for word in (f"--{name}", round(steps * scale))]
    flags = ["-s", source, "-r", width, "--eval", "--preset", "fast", "--growth", "reference", "--device", "cpu"]
    flags += ["--densify_grad_threshold", 0.001]  # of small pictures
    return [*flags, *schedule, "--threads", 1, "--seed", seed]


def train_together(folder: Path, source: Path, seed: int, width: int, steps: int) -> dict:
    """Go on from the model in ``folder`` with all photographs: the results, of a folder within."""
    flags = ["-s", source, "-r", width, "--eval", "--device", "cpu", "--threads", 1, "--seed", seed]
    start = ply_path(folder, find_iteration(folder))
    return run_training(folder / f"and_{steps}", [*flags, "--start_ply", start, *TOGETHER, "--cooldown", steps - 1])


def cells_in(camera: Camera, depth: np.ndarray, block: Block) -> np.ndarray:
    """The number of the cell in which each pixel has its ``depth`` [H, W]; its shape."""
    along = rays(camera, torch.device("cpu")).numpy()
    points = (along * depth[..., None]).reshape(-1, 3) + camera.center
    held = [block._replace(number=number).holds(points) for number in range(len(block.cells))]
    return np.argmax(held, 0).reshape(depth.shape)


def errors_of(folder: Path, views: list[View]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The squared errors of each view [H, W], and its depths [H, W]."""
    finished = Finished(folder)
    draw, errors, depths = finished.renderer(GaussianModel.from_splats(finished.file.splats)), [], []
    for view in views:
        output = draw(view.camera, True)
        difference = to_bytes(output.image, False) / 255.0 - view.picture / 255.0
        errors.append((difference**2).mean(2))
        depths.append(output.depth.numpy())
    return errors, depths


def decibels(errors: list) -> float:
    """The mean PSNR of pictures, or of one list of pixels."""
    return float(np.mean([-10 * np.log10(error.mean()) for error in errors])) if errors else float("nan")


def compare(name: str, source: Path, seed: int, arguments: Namespace) -> list[dict]:
    """Rows of the table: trained as one, and as blocks; then more steps."""
    count, iterations, width = arguments.blocks, arguments.iterations, arguments.resolution
    whole, folder = (arguments.models / name / f"{seed}" / kind for kind in ("whole", "blocks"))
    trained: list[dict] = []
    load = lambda block: load_scene(source, eval=True, resolution=width, block=block, report=str)  # noqa: E731
    scene, names = load(""), [f"{number + 1}/{count}" for number in range(count)]
    result = run_training(whole, flags_of(source, seed, 1.0, iterations, width))
    records = [{"model": "one training", "largest": len(scene.points), "views": len(scene.train), "results": [result]}]
    blocks = [load(block) for block in names]
    for block, part in zip(names, blocks, strict=True):
        flags = flags_of(source, seed, len(part.train) / len(scene.train), iterations, width)
        trained.append(run_training(folder / block.replace("/", "_"), [*flags, "--block", block]))
    merge_blocks(MergeConfig(str(folder)))
    largest = max(blocks, key=lambda part: len(part.points))
    views = f"{min(len(part.train) for part in blocks)} to {max(len(part.train) for part in blocks)}"
    records.append({"model": f"{count} blocks", "largest": len(largest.points), "views": views, "results": trained})
    places = [whole, folder]
    for steps in arguments.together:
        for place, record in zip(places[:2], records[:2], strict=True):
            trained = [train_together(place, source, seed, width, steps)]
            records.append({**record, "model": f"{record['model']}, and {steps} steps", "results": trained})
            places.append(place / f"and_{steps}")
    errors, depths = zip(*(errors_of(place, scene.test) for place in places), strict=True)
    cells = [cells_in(view.camera, depth, blocks[0].block) for view, depth in zip(scene.test, depths[0], strict=True)]
    across = [(found != np.bincount(found.ravel()).argmax()).mean() > ACROSS for found in cells]
    seams = [maximum_filter(found, 2 * SEAM + 1) != minimum_filter(found, 2 * SEAM + 1) for found in cells]
    for place, of_model, record in zip(places, errors, records, strict=True):
        record["scene"], record["seed"] = f"{name}: {sum(across)} of {len(across)} across", seed
        record["file"] = len(Finished(place).file.splats.means)
        for of_views, of_pixels, chosen in (("across", "seams", True), ("within", "rest", False)):
            views = [error for error, beyond in zip(of_model, across, strict=True) if beyond == chosen]
            pixels = [error[near == chosen] for error, near in zip(of_model, seams, strict=True)]
            record |= {of_views: decibels(views), of_pixels: decibels([np.concatenate(pixels)])}
        record["mb"] = max(one["peak_memory_mb"] for one in record["results"])
        record["steps"] = sum(one["iterations"] for one in record["results"])
    return records


def main() -> None:
    arguments = parse(
        __doc__,
        MODELS,
        SCENE,
        option("--blocks", type=int, default=4),
        option("--seeds", type=int, nargs="+", default=[0], help="of the street's trainings; the first of others"),
        option("--together", type=int, nargs="+", default=[300, 800, 1600], help="steps after merging"),
        option("--iterations", type=int, default=800, help="of the undivided training"),
        option("-r", "--resolution", type=int, default=160, help="width of the pictures [px]"),
    )
    make_street(arguments.models / "street" / "scene")
    scenes = {"street": arguments.models / "street" / "scene"}
    if arguments.scene:
        scenes[arguments.scene.name] = arguments.scene
    seeds = {"street": arguments.seeds}
    runs = [(name, at.resolve(), seed) for name, at in scenes.items() for seed in seeds.get(name, arguments.seeds[:1])]
    records = [row for run in runs for row in compare(*run, arguments)]
    note = (
        f"PSNR [dB] of held-out views, {arguments.resolution} px wide, after {arguments.iterations} steps by --preset "
        "fast and --growth reference with --densify_grad_threshold 0.001, a block fewer in proportion to its "
        "photographs. Across: views of which a tenth or more lies in other cells than most of it; seams: pixels within "
        f"{SEAM} of another cell's; starts from: points of the largest block; and ... steps: --start_ply with all "
        f"photographs, {' '.join(map(str, TOGETHER))} --cooldown; MB: peak of the largest training; steps: of all "
        "trainings of this line."
    )
    write_table("blocks", arguments.out, COLUMNS, records, note, {"records": records})


if __name__ == "__main__":
    main()

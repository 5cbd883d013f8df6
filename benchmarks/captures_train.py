"""Photographs against seconds until the first step, memory, and time of a step, within `--photo_memory` and beyond it.

    python benchmarks/captures_train.py --counts 100 300 1000 3000 --work output/large [--size 1600 1200] [--masks]

A walk of `make_capture.py`, enlarged, with noise; of `--made` different photographs, the others are links to them. The
cameras are the true ones, the points lie at random in the rooms. Each row is a process of its own.
"""

import json
import os
import sys
import time
from pathlib import Path

import numpy as np
from common import in_process, option, parse, write_table
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "assets"))

HEADERS = {
    "photographs": lambda row: row["count"],
    "GiB decoded": lambda row: f"{row['decoded'] / 2**30:.1f}",
    "photo_memory GiB": lambda row: row["memory"],
    "scene open s": lambda row: f"{row['open']:.1f}",
    "first step s": lambda row: f"{row['first']:.1f}",
    "peak MiB": lambda row: row["peak"],
    "step s": lambda row: f"{row['step']:.2f}",
    "of all threads s": lambda row: f"{row['threads']:.2f}",
}
POINTS, STEPS = 20_000, 24


def make_scene(folder: Path, count: int, made: int, size: tuple[int, int], masks: bool) -> None:
    """A COLMAP scene of ``count`` photographs of ``size``, of which ``made`` are different."""
    from make_capture import FOCAL, HEIGHT, PER_ROOM, SIDE, make_capture, pose  # noqa: PLC0415 - compiles kernels

    from warp_splat.camera import Camera  # noqa: PLC0415
    from warp_splat.formats.colmap_text import write_colmap  # noqa: PLC0415

    small, random, rooms = folder.parent / f"walk{made}", np.random.default_rng(0), max(2, round(made / PER_ROOM))
    if not (small / "positions.csv").is_file():
        make_capture(small, "walk", made)
    (folder / "images").mkdir(parents=True)
    cameras = []
    for index in range(count):
        name, first = f"{index:05d}.jpg", folder / "images" / f"{index % made:05d}.jpg"
        if index < made:
            pixels = np.asarray(Image.open(small / "images" / name).resize(size, Image.Resampling.BICUBIC), np.float32)
            pixels = np.clip(pixels + random.normal(0.0, 4.0, pixels.shape), 0, 255).astype(np.uint8)
            Image.fromarray(pixels).save(first, quality=95)
        else:
            os.link(first, folder / "images" / name)
        center, rotation = pose("walk", index % made / made, rooms)
        lens = (FOCAL * size[0], FOCAL * size[0], size[0] / 2, size[1] / 2)
        cameras.append((name, Camera(*size, *lens, rotation=rotation, translation=-rotation @ center)))
        if masks:
            (folder / "masks").mkdir(exist_ok=True)
            ellipse = np.hypot(*np.meshgrid(np.linspace(-1, 1, size[0]), np.linspace(-1, 1, size[1]))) < 1.2
            place = folder / "masks" / f"{index:05d}.png"
            if index:
                os.link(folder / "masks" / "00000.png", place)
            else:
                Image.fromarray(255 * ellipse.astype(np.uint8)).save(place)
    points = random.uniform((0, -SIDE / 2, 0), (SIDE * rooms, SIDE / 2, HEIGHT), (POINTS, 3)).astype(np.float32)
    write_colmap(folder / "sparse" / "0", cameras, points, random.integers(0, 255, (POINTS, 3)).astype(np.uint8))


def measure(scene: Path, memory: float) -> dict:
    """Open the scene and train on it in this process, as the command does; ``memory``: GiB, 0 for no bound."""
    started = time.perf_counter()
    from warp_splat.runtime import launch, pool  # noqa: PLC0415 - what the user waits for, too
    from warp_splat.runtime.devices import peak_memory  # noqa: PLC0415
    from warp_splat.scene import load_scene  # noqa: PLC0415
    from warp_splat.training.options import TrainConfig  # noqa: PLC0415
    from warp_splat.training.trainer import Trainer  # noqa: PLC0415

    launch.prepare("cpu", 1)
    loaded = load_scene(scene, memory=memory * 2**30 or 2**50)
    opened = time.perf_counter() - started
    where = {"source_path": str(scene), "model_path": str(scene.with_name("model"))}
    trainer = Trainer(loaded, TrainConfig(device="cpu", **where))
    trainer.warm_up()
    seconds, threads, first = [], [], 0.0
    for iteration in range(1, STEPS + 1):
        begun, worked = time.perf_counter(), time.process_time()
        trainer.advance(iteration)
        seconds.append(time.perf_counter() - begun)
        threads.append(time.process_time() - worked)
        first = first or time.perf_counter() - started
    camera, count = loaded.train[0].camera, len(loaded.train)
    return {
        **{"count": count, "decoded": 3 * camera.width * camera.height * count, "memory": memory or "all"},
        **{"open": opened, "first": first, "peak": peak_memory(), "pool": pool.get_threads()},
        **{"step": float(np.median(seconds[1:])), "threads": float(np.median(threads[1:]))},
    }


def main() -> None:
    options = parse(
        __doc__,
        option("--counts", type=int, nargs="+", default=[100, 300]),
        option("--memories", type=float, nargs="+", default=[1.0], help="GiB; 0: all"),
        option("--work", type=Path, required=True, help="folder for scenes"),
        option("--made", type=int, default=50, help="different photographs"),
        option("--size", type=int, nargs=2, default=(1600, 1200)),
        option("--masks", action="store_true"),
        option("--one", type=Path, help="measure this scene in this process, and print JSON"),
    )
    if options.one:
        print(json.dumps(measure(options.one, options.memories[0])))
        return
    rows = []
    for count in options.counts:
        scene = options.work / f"enlarged{count}{'_masks' * options.masks}"
        if not (scene / "sparse").is_dir():
            make_scene(scene, count, options.made, tuple(options.size), options.masks)
        for memory in options.memories:
            rows.append(in_process(__file__, "--work", options.work, "--one", scene, "--memories", memory))
            print(rows[-1], flush=True)
    note = (
        f"Photographs of {options.size[0]} x {options.size[1]} px{' with masks' * options.masks}, {options.made} "
        f"different ones, {POINTS} Gaussians, one thread for the kernels. Seconds until the scene is open and the "
        f"first step is done are from the start of the process; a step is the median of {STEPS - 1}."
    )
    write_table("captures_train" + "_masks" * options.masks, options.out, HEADERS, rows, note)


if __name__ == "__main__":
    main()

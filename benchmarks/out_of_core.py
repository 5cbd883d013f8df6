"""Gaussians in a file: seconds of a step, memory and bytes of the model, against Gaussians in memory.

    python benchmarks/out_of_core.py --work output/large [--gaussians 2000000] [--limit 0.7] [--out docs/benchmarks]

A hundred cameras look down on a plane, each on a fiftieth of it. The points grow to the budget. `--limit`: GiB of its
own memory (RLIMIT_DATA) that the process may take beyond what it has before training. What lives in files is not
counted, but given back to the disk after each step (MADV_PAGEOUT), so that a step finds nothing of it in memory.
"""

import hashlib
import json
import resource
import statistics
import sys
import tempfile
import threading
import time
import weakref
from pathlib import Path

import numpy as np
from common import in_process, option, parse, status, write_table
from PIL import Image

from warp_splat.camera import Camera
from warp_splat.formats.colmap_text import write_colmap
from warp_splat.runtime import launch, pool
from warp_splat.scene import load_scene
from warp_splat.training.options import TrainConfig
from warp_splat.training.trainer import Trainer

GROWTH, STEPS, POINTS = 40, 12, 300_000
PAGEOUT = 21  # MADV_PAGEOUT of Linux, which Python's mmap does not name
HEADERS = {
    "Gaussians in": lambda row: row["kind"],
    "number": lambda row: row["count"],
    "GiB of parameters and moments": lambda row: f"{row['size'] / 2**30:.2f}",
    "of its own at most, GiB": lambda row: f"{row['own'] / 2**30:.2f}",
    "of the file in a step, GiB": lambda row: f"{row['file'] / 2**30:.2f}",
    "step s": lambda row: f"{row['step']:.2f}",
    "model": lambda row: row["sha256"][:12],
}


def make_scene(folder: Path) -> None:
    """Photographs of noise, from above."""
    random, cameras, down = np.random.default_rng(0), [], np.diag((1.0, -1.0, -1.0))
    (folder / "images").mkdir(parents=True)
    for index, (x, y) in enumerate(np.ndindex(10, 10)):
        center, name = np.array((x + 0.5, y + 0.5, 1.0)), f"{index:05d}.png"
        cameras.append((name, Camera(320, 240, 256, 256, 160, 120, down, -down @ center)))
        Image.fromarray(random.integers(0, 255, (240, 320, 3), np.uint8)).save(folder / "images" / name)
    points = random.uniform((0, 0, 0), (10, 10, 0.1), (POINTS, 3)).astype(np.float32)
    write_colmap(folder / "sparse" / "0", cameras, points, random.integers(0, 255, (POINTS, 3), np.uint8))


def keep_maps() -> list[weakref.ref]:
    """The maps of files that are made from now on."""
    maps, make = [], np.memmap

    def made(*args, **kwargs) -> np.memmap:
        content = make(*args, **kwargs)
        maps.append(weakref.ref(content))
        return content

    np.memmap = made
    return maps


def measure(scene: Path, count: int, limit: float, in_file: bool) -> dict:
    """Train in this process."""
    launch.prepare("cpu", 1)
    pool.set_threads(1)
    maps = keep_maps()
    with tempfile.TemporaryDirectory(dir=scene.parent) as folder:
        growth = {"growth": "budget", "max_gaussians": count, "densify_from_iter": 1, "densification_interval": 4}
        config = TrainConfig(
            source_path=str(scene), model_path=folder, optimizer_type="sparse_adam", out_of_core=in_file, device="cpu",
            densify_until_iter=GROWTH, iterations=GROWTH + STEPS, sh_interval=5, **growth,
        )  # fmt: skip
        trainer = Trainer(load_scene(scene), config)
        trainer.warm_up()
        before, own, done = status("RssAnon"), [0], threading.Event()

        def watch() -> None:
            while not done.wait(0.02):
                own[0] = max(own[0], status("RssAnon") - before)

        if in_file and limit:
            bound = status("VmData") + int(limit * 2**30)
            resource.setrlimit(resource.RLIMIT_DATA, (bound, bound))
        threading.Thread(target=watch, daemon=True).start()
        seconds, files = [], []
        for iteration in range(1, GROWTH + STEPS + 1):
            begun, had = time.perf_counter(), status("RssFile")
            trainer.advance(iteration)
            if iteration > GROWTH:
                seconds.append(time.perf_counter() - begun)
                files.append(status("RssFile") - had)
            for content in (known() for known in maps):
                if content is not None:
                    content._mmap.madvise(PAGEOUT)
        trainer.save(Path(folder) / "model.ply")
        done.set()
        with (Path(folder) / "model.ply").open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        size = 3 * 4 * len(trainer.model) * sum(leaf[0].numel() for leaf in trainer.model.parameters.values())
    found = {"count": len(trainer.model), "size": size, "own": own[0], "file": statistics.median(files)}
    return {**found, "step": statistics.median(seconds), "sha256": digest}


def main() -> None:
    options = parse(
        __doc__,
        option("--work", type=Path, required=True, help="folder for the scene"),
        option("--gaussians", type=int, default=2_000_000),
        option("--limit", type=float, default=0.0),
        option("--kind", choices=("memory", "file"), help="print one row as JSON"),
    )
    scene = options.work / "from_above"
    if not (scene / "sparse").is_dir():
        make_scene(scene)
    if options.kind:
        print(json.dumps(measure(scene, options.gaussians, options.limit, options.kind == "file")))
        return
    rows = [{"kind": kind, **in_process(*sys.argv, "--kind", kind)} for kind in ("memory", "file")]
    note = (
        f"One thread, degree 3, the last {STEPS} steps after growth; `of its own`: memory beyond that before training, "
        f"growth and the saving of the model included, which a limit of {options.limit:g} GiB (RLIMIT_DATA) held for "
        "`file`. After each step the file's pages are given back, so `of the file in a step` is what a step reads anew."
    )
    write_table("out_of_core", options.out, HEADERS, rows, note)


if __name__ == "__main__":
    main()

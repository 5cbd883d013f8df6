"""The stages of structure from motion, each with its progress: features, matches, cameras and points, undistortion.

What a stage has found is in the database at once. So a run that was stopped, by Ctrl-C or kill -9, goes on there. A
model or a folder of images gets its name only when it is complete.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from pathlib import Path

from tqdm import tqdm

from warp_splat.config import SfmConfig
from warp_splat.errors import InputError
from warp_splat.runtime.interrupts import interruptible
from warp_splat.scene.colmap_library import pycolmap

LENS = "OPENCV"  # fx, fy, cx, cy, two radial and two tangential coefficients: what phones and cameras need
POLL = 0.3  # seconds
FAISS_THRESHOLD = "_ZN5faiss31distance_compute_blas_thresholdE"  # queries from which on it calls BLAS
# Pairs are matched in blocks of BLOCK x BLOCK images, and Ctrl-C is heard in between. Tried:
# - 36 instead of 42 s for 1,225 pairs of 540 x 960 px: pycolmap's 50
BLOCK = 10
BAR = "{desc:12s} {percentage:3.0f}% |{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}]"


def run_watched(title: str, total: int, work: Callable, count: Callable[[], int], quiet: bool) -> None:
    """Run ``work`` in a thread and show a bar until it ends; Ctrl-C lets it end at the next image, then raises."""
    token = pycolmap.CancellationToken()
    pause = 0.1 if sys.stderr.isatty() else 10.0  # seconds between two lines; a log keeps them all
    bar = tqdm(total=total, desc=title, disable=quiet, bar_format=BAR, mininterval=pause, maxinterval=pause)
    with interruptible() as interrupted, bar, ThreadPoolExecutor(1) as pool:
        running = pool.submit(work, cancellation_token=token)
        while not running.done():
            wait([running], POLL)
            bar.update(min(count(), total) - bar.n)
            if interrupted:
                token.cancel()
    if interrupted:
        raise KeyboardInterrupt
    running.result()  # what it raised, in the thread that the user sees


def opened(database: Path) -> pycolmap.Database:
    """The database, which a ``with`` closes.

    What shows the progress of a stage opens it before the stage begins: opening writes, and may be refused, or refuse
    another. Python's sqlite3 would do harm: it drops the locks of pycolmap's copy of SQLite.
    """
    return pycolmap.Database.open(database)


def extract(database: Path, root: Path, groups: list[list[str]], config: SfmConfig) -> None:
    """Find SIFT features in the photographs below ``root``; those of a group share a lens."""
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = LENS
    for names in groups:  # first, so that images are numbered by name and not by which thread was faster
        with opened(database) as connection:
            new = [name for name in names if not connection.exists_image(name)]
            if len(new) < len(names):
                reader.existing_camera_id = connection.read_image_with_name((set(names) - set(new)).pop()).camera_id
        if new:
            pycolmap.import_images(database, root, pycolmap.CameraMode.SINGLE, new, reader)
    options = pycolmap.FeatureExtractionOptions(num_threads=config.threads, use_gpu=False)
    every = [name for names in groups for name in names]
    on_cpu = {"extraction_options": options, "device": pycolmap.Device.cpu}
    work = partial(pycolmap.extract_features, database, root, every, **on_cpu)
    with opened(database) as connection:
        numbers = [image.image_id for image in connection.read_all_images()]
        found = lambda: sum(map(connection.exists_keypoints, numbers))  # noqa: E731
        run_watched("features", len(numbers), work, found, config.quiet)


def avoid_blas() -> bool:
    """Have FAISS, which compares features inside of pycolmap, do without BLAS from now on; whether it can be told so.

    The OpenBLAS in pycolmap's wheels has no locks. Two threads that call it may get the same memory. It says "Bad
    memory unallocation!", or nothing, and matches are wrong. Tried, for 1,225 pairs of 264 x 248 px on two threads:
    - 8.3 s with BLAS, other matches than those of one thread in 3 of 14 runs
    - 10.3 s without, always the matches of one thread, which takes 10.7 s
    - 53.8 s by COLMAP's own comparison, which finds 1.6 % more
    """
    try:
        library = ctypes.CDLL(sys.modules["pycolmap._core"].__file__)
        ctypes.c_int.in_dll(library, FAISS_THRESHOLD).value = 2**31 - 1
    except (OSError, ValueError):
        return False
    return True


def match(database: Path, matching: str, config: SfmConfig) -> int:
    """Match all pairs of photographs or, "sequential", neighbors by name; returns how many pairs fit together."""
    threads = config.threads if avoid_blas() else 1
    options = pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = config.seed
    with opened(database) as connection:
        images = connection.num_images()
    if matching == "sequential":
        pairing = pycolmap.SequentialPairingOptions(num_threads=config.threads)
        # neighbors up to `overlap`, and at distances 2, 4, 8 ... up to 2^(overlap - 1)
        total, run = _sequential_pairs(images, pairing.overlap), pycolmap.match_sequential
    else:
        pairing = pycolmap.ExhaustivePairingOptions(block_size=BLOCK)
        total, run = images * (images - 1) // 2, pycolmap.match_exhaustive
    work = partial(run, database, options, pairing, verification, pycolmap.Device.cpu)
    with opened(database) as connection:
        run_watched("matches", total, work, connection.num_matched_image_pairs, config.quiet)
        _, inliers = connection.read_two_view_geometry_num_inliers()
    return sum(count > 0 for count in inliers)


def _sequential_pairs(images: int, overlap: int) -> int:
    gaps = {*range(1, overlap + 1), *(1 << power for power in range(overlap))}
    return sum(max(images - gap, 0) for gap in gaps)


def reconstruct(database: Path, root: Path, models: Path, config: SfmConfig) -> dict[int, pycolmap.Reconstruction]:
    """Cameras and points, incrementally; the models are in the folder ``models``, empty if no two photographs fit.

    This stage starts anew when it was stopped: it is the shortest on a CPU.
    """
    part = models.with_suffix(".part")
    if not models.is_dir():
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads, options.random_seed = config.threads, config.seed
        options.mapper.random_seed = options.triangulation.random_seed = config.seed
        registered = []
        with opened(database) as connection:
            images = connection.num_images()
        found = {
            "initial_image_pair_callback": lambda: registered.extend((1, 1)),
            "next_image_callback": lambda: registered.append(1),
        }
        work = partial(pycolmap.incremental_mapping, database, root, part, options, **found)
        run_watched("cameras", images, work, lambda: len(registered), config.quiet)
        os.replace(part, models)
    return {int(folder.name): pycolmap.Reconstruction(folder) for folder in models.iterdir() if folder.is_dir()}


def write_scene(model: Path, root: Path, scene: Path, part: Path, count: int, config: SfmConfig) -> None:
    """Write the photographs to ``scene``/images and their cameras to ``scene``/sparse/0.

    Without distortion, and pinholes; with ``config.keep_lens`` as they are.
    """
    shutil.rmtree(part, ignore_errors=True)
    shutil.rmtree(scene / "images", ignore_errors=True)  # of a run that was stopped before sparse/ got its name
    if config.keep_lens:
        title, work = "copies", partial(_copy, part, model, root)
    else:
        work = partial(pycolmap.undistort_images, part, model, root, num_threads=config.threads)
        title = "undistortion"

    def written() -> int:
        return sum(path.is_file() for path in (part / "images").rglob("*")) if part.is_dir() else 0

    run_watched(title, count, work, written, config.quiet)
    if written() < count:
        raise InputError(f"{part}: only {written()} of {count} images could be written; free some space and run again.")
    os.replace(part / "images", scene / "images")
    os.renames(part / "sparse", part / "model" / "0")
    os.replace(part / "model", scene / "sparse")  # the last step: where sparse/ is, all is
    shutil.rmtree(part, ignore_errors=True)


def _copy(part: Path, model: Path, root: Path, cancellation_token: object) -> None:
    """Photographs and model as they are, to where undistortion puts its own; too short to be canceled."""
    shutil.copytree(model, part / "sparse")
    found = pycolmap.Reconstruction(model)
    for name in (found.image(index).name for index in found.reg_image_ids()):
        (part / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(root / name, part / "images" / name)

"""The stages of structure from motion around the mapping, each with its progress: features, matches, undistortion.

What a stage has found is in the database at once. So a run that was stopped, by Ctrl-C or kill -9, goes on there. A
model or a folder of images gets its name only when it is complete.

What shows the progress of a stage opens the database before the stage begins: opening writes, and may be refused, or
refuse another. Python's sqlite3 would do harm: it drops the locks of pycolmap's copy of SQLite.
"""

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
from warp_splat.runtime.interrupts import interruptible, leave
from warp_splat.scene.colmap_library import pycolmap
from warp_splat.scene.images import read_kind, read_pixels
from warp_splat.text import few

LENS = "OPENCV"  # fx, fy, cx, cy, two radial and two tangential coefficients: what phones and cameras need
POLL = 0.3  # seconds
ROOM = 2**26  # bytes of a disk: where it has none left, pycolmap ends the process
# What stands for spaces and number signs in names while a list of pairs is matched: pycolmap splits its lines at the
# former, and leaves out those that begin with the latter. And back.
HIDING, SHOWING = str.maketrans(" #", "\x1f\x1e"), str.maketrans("\x1f\x1e", " #")
BAR = "{desc:12s} {percentage:3.0f}% |{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}]"


def run_watched(
    folder: Path, title: str, total: int, work: Callable, count: Callable[[], int], quiet: bool, stops: bool = True
) -> None:
    """Run ``work`` in a thread and show a bar until it ends; Ctrl-C lets it end at the next image, then raises.

    What does not stop, Ctrl-C ends with the whole process, and the ``folder`` that it writes with it.

    Raises:
        InputError: if the disk of ``folder`` is full, or becomes so, which ends it likewise.
    """
    check_room(folder)
    token = {"cancellation_token": pycolmap.CancellationToken()} if stops else {}
    pause = 0.1 if sys.stderr.isatty() else 10.0  # seconds between two lines; a log keeps them all
    bar = tqdm(total=total, desc=title, disable=quiet, bar_format=BAR, mininterval=pause, maxinterval=pause)
    full = False
    with interruptible() as interrupted, bar, ThreadPoolExecutor(1) as pool:
        running = pool.submit(work, **token)
        while not running.done():
            wait([running], POLL)
            bar.update(min(count(), total) - bar.n)
            if interrupted and not stops:
                shutil.rmtree(folder, ignore_errors=True)
                leave("warp-splat: interrupted; what was saved before stays.")
            full = full or shutil.disk_usage(folder).free < ROOM
            if stops and (interrupted or full):
                token["cancellation_token"].cancel()
    if interrupted:
        raise KeyboardInterrupt
    check_room(folder, full)
    running.result()  # what it raised, in the thread that the user sees


def check_room(folder: Path, full: bool = False) -> None:
    """Raise InputError if the disk of a folder is, or was, full."""
    if full or shutil.disk_usage(folder).free < ROOM:
        raise InputError(
            f"{folder}: expected {ROOM >> 20} MiB free on its disk, found less; free some and run the same again, "
            "which goes on here."
        )


def rename(database: Path, letters: dict[int, int]) -> None:
    """Change letters in the names of images."""
    # a string, here and elsewhere: of a Path, pycolmap runs Python, and a Ctrl-C that comes there becomes a TypeError
    with pycolmap.Database.open(str(database)) as connection:
        for image in connection.read_all_images():
            if (name := image.name.translate(letters)) != image.name:
                image.name = name
                connection.update_image(image)


def extract(database: Path, root: Path, groups: list[list[str]], config: SfmConfig, stops: bool = True) -> None:
    """Find SIFT features in the photographs below ``root``; those of a group share a lens. ``stops``: run_watched's."""
    rename(database, SHOWING)  # of a run that was killed while it matched
    for names in groups:  # first, so that images are numbered by name and not by which thread was faster
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = LENS
        with pycolmap.Database.open(str(database)) as connection:
            if len(new := [name for name in names if not connection.exists_image(name)]) < len(names):
                reader.existing_camera_id = connection.read_image_with_name((set(names) - set(new)).pop()).camera_id
        if new:
            pycolmap.import_images(str(database), str(root), pycolmap.CameraMode.SINGLE, new, reader)
    options = pycolmap.FeatureExtractionOptions(num_threads=config.threads, use_gpu=False)
    every = [name for names in groups for name in names]
    on_cpu = {"extraction_options": options, "device": pycolmap.Device.cpu}
    work = partial(pycolmap.extract_features, database, root, every, **on_cpu)
    with pycolmap.Database.open(str(database)) as connection:
        numbers = [image.image_id for image in connection.read_all_images()]
        found = lambda: sum(map(connection.exists_keypoints, numbers))  # noqa: E731
        run_watched(database.parent, "features", len(numbers), work, found, config.quiet, stops)


def write_scene(model: Path, root: Path, scene: Path, part: Path, count: int, config: SfmConfig) -> None:
    """Write the photographs to ``scene``/images and their cameras to ``scene``/sparse/0.

    Without distortion, and pinholes; as they are with ``config.keep_lens``, or if undistortion would lose something.
    """
    shutil.rmtree(part, ignore_errors=True)
    shutil.rmtree(scene / "images", ignore_errors=True)  # of a run that was stopped before sparse/ got its name
    undistort = partial(pycolmap.undistort_images, num_threads=config.threads)
    names = sorted(image.name for image in pycolmap.Reconstruction(str(model)).images.values())
    lost = [] if config.keep_lens else [name for name in names if _is_more_than_bytes(root / name)]
    if lost and not config.quiet:
        tqdm.write(f"All photographs keep their lens: undistortion would lose linear light or alpha of {few(lost)}.")
    title, write = ("copies", _copy) if config.keep_lens or lost else ("undistortion", undistort)

    def written() -> int:
        return sum(path.is_file() for path in (part / "images").rglob("*")) if part.is_dir() else 0

    run_watched(scene, title, count, partial(write, part, model, root), written, config.quiet)
    if written() < count:
        raise InputError(f"{part}: only {written()} of {count} images could be written; free some space and run again.")
    os.replace(part / "images", scene / "images")
    os.renames(part / "sparse", part / "model" / "0")
    os.replace(part / "model", scene / "sparse")  # the last step: where sparse/ is, all is
    shutil.rmtree(part, ignore_errors=True)


def _is_more_than_bytes(path: Path) -> bool:
    """Whether a photograph is in linear light, or something of it is transparent: pycolmap knows bytes of colors."""
    linear, alpha = read_kind(path)
    return linear or (alpha and read_pixels(path, 0.0).alpha is not None)


def _copy(part: Path, model: Path, root: Path, cancellation_token: object) -> None:
    """Photographs and model as they are, to where undistortion puts its own; too short to be canceled."""
    shutil.copytree(model, part / "sparse")
    found = pycolmap.Reconstruction(str(model))
    for name in (found.image(index).name for index in found.reg_image_ids()):
        (part / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(root / name, part / "images" / name)

"""What time and memory structure from motion will take, told before: a few of the photographs are tried."""

import tempfile
import time
from pathlib import Path

from warp_splat.config import CORES, SfmConfig
from warp_splat.runtime.devices import peak_memory
from warp_splat.scene.colmap_library import pycolmap
from warp_splat.scene.photos import PHOTOS, find_files, photo_root
from warp_splat.sfm import stages
from warp_splat.sfm.matching import match, pairs_compared
from warp_splat.text import Report

TRIED = 6  # photographs, of which each pair is matched
LEAST = 30  # of fewer a trial would take too large a share of the work itself
# Seconds of mapping for each feature, divided by the cube root of how many photographs there are: the least and the
# most of eight captures of 25 to 3,000 (Intel Xeon). A loop in one room and a blurred video take the most.
MAPPING = 3e-5, 1.4e-4
OF_FEATURE = 2048  # bytes in mapping, for each: 0.92 to 1.04 of the peaks of four captures of 25 to 1,000 photographs


def time_of_cameras(source: Path, say: Report) -> None:
    """Say what ``warp-splat sfm`` takes with the photographs below ``source``; nothing if that cannot be told.

    Features and pairs of TRIED photographs are timed on this machine. The time of mapping is known by its order only.
    """
    root = photo_root(source)
    names = find_files(root, PHOTOS)
    count = len(names)
    if pycolmap is None or count < LEAST:
        return
    say(f"Trying {TRIED} of {count} photographs ...")
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    config = SfmConfig(str(source), "", matching="exhaustive", threads=CORES, quiet=True)
    before = peak_memory() or 0
    tried = [names[index * count // TRIED] for index in range(TRIED)]
    try:
        extraction, features, matching = _measured(root, tried, config)
    except RuntimeError:  # of pycolmap: no room for temporary files, for one; who needs the cameras will be told
        return
    _, pairs = pairs_compared("auto", count)
    extraction, matching = extraction * count / CORES / 60, matching * pairs / CORES / 60
    least, most = (extraction + matching + rate * features * count ** (4 / 3) / 60 for rate in MAPPING)
    memory = max(peak_memory() or 0, before + OF_FEATURE * features * count / 2**20) / 1024
    if features:
        say(
            f"Cameras of {count} photographs will take about {least:.1f} to {most:.1f} min on {CORES} threads: "
            f"features {extraction:.1f}, {pairs} pairs {matching:.1f}, mapping the rest; {memory:.1f} GiB of memory."
        )


def _measured(root: Path, tried: list[str], config: SfmConfig) -> tuple[float, float, float]:
    """Seconds of all threads for a photograph, its features, and seconds for a pair, as means of those ``tried``."""
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        began = time.process_time()
        stages.extract(database, root, [tried], config, folder)
        extracted = time.process_time()
        with stages.opened(database) as connection:
            features = connection.num_keypoints()
        match(database, config, print)
        extraction, matching = extracted - began, time.process_time() - extracted
    return extraction / len(tried), features / len(tried), matching / (len(tried) * (len(tried) - 1) / 2)

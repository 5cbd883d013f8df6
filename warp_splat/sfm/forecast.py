"""How long structure from motion will take, told before it begins: a few of the photographs are tried."""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from warp_splat.config import CORES, SfmConfig
from warp_splat.scene.colmap_library import pycolmap
from warp_splat.scene.photos import PHOTOS, find_files, photo_root
from warp_splat.sfm import stages
from warp_splat.sfm.matching import match, pairs_compared

TRIED = 6  # photographs, of which each pair is matched
MAPPING = 1.3e-4, 4.5e-4  # seconds for each feature, the least and the most of five captures (AMD EPYC, Intel Xeon)


def time_of_cameras(source: Path) -> str | None:
    """A sentence on ``warp-splat sfm`` with the photographs below ``source``; None if there are too few to tell.

    Features and pairs of TRIED photographs are timed on this machine. What mapping takes is known by its order only.
    """
    root = photo_root(source)
    names = find_files(root, PHOTOS)
    count = len(names)
    if pycolmap is None or count <= TRIED:
        return None
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    config = SfmConfig(str(source), "", matching="exhaustive", threads=CORES, quiet=True)
    tried = [names[index * count // TRIED] for index in range(TRIED)]
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        extraction = _seconds(lambda: stages.extract(database, root, [tried], config)) / TRIED * count
        with stages.opened(database) as connection:
            features = connection.num_keypoints() / TRIED * count
        _, pairs = pairs_compared("auto", count)
        matching = _seconds(lambda: match(database, config, print)) / (TRIED * (TRIED - 1) / 2) * pairs
    least, most = (rate * features for rate in MAPPING)
    minutes = [(extraction + matching) / CORES / 60 + mapping / 60 for mapping in (least, most)]
    return (
        f"Cameras of {count} photographs will take about {minutes[0]:.1f} to {minutes[1]:.1f} min on {CORES} threads: "
        f"features {extraction / CORES / 60:.1f}, {pairs} pairs {matching / CORES / 60:.1f}, mapping the rest."
    )


def _seconds(work: Callable[[], object]) -> float:
    """Of all threads."""
    began = time.process_time()
    work()
    return time.process_time() - began

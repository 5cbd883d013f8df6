"""What time and memory structure from motion will take, told before: a few of the photographs are tried."""

import tempfile
import time
from itertools import combinations
from pathlib import Path

from warp_splat.config import CORES, SfmConfig
from warp_splat.errors import InputError
from warp_splat.runtime.devices import peak_memory
from warp_splat.scene.colmap_library import pycolmap
from warp_splat.scene.photos import PHOTOS, find_files, photo_root
from warp_splat.sfm import stages
from warp_splat.sfm.mapping import MANY
from warp_splat.sfm.matching import match_pairs, pairs_compared
from warp_splat.text import Report

# Of photographs at these places each pair is matched: a Golomb ruler, whose distances are as often small as large.
RULER = (0, 1, 4, 10, 12, 17)
NEAR = 27  # by name, the farthest apart of those tried, where those that look alike are compared
LEAST = 30  # photographs; of fewer a trial would take too large a share of the work itself
# Seconds of mapping, global and incremental, for one of features, divided by the cube root of how many photographs
# there are. Of sound captures of 25 to 1,000: 0.25 to 0.37 and 0.11 to 0.25. Where half fits nowhere, up to four times.
GLOBAL, INCREMENTAL = 0.3, 0.15
OF_FEATURE = 2048  # bytes in mapping, for each: 0.92 to 1.04 of the peaks of four captures of 25 to 1,000 photographs


def time_of_cameras(source: Path, say: Report) -> None:
    """Say what ``warp-splat sfm`` takes with the photographs below ``source``; nothing if that cannot be told.

    Features and pairs of some photographs are timed on this machine, and mapping goes by the features.
    """
    names = find_files(root := photo_root(source), PHOTOS)
    count = len(names)
    if pycolmap is None or count < LEAST:
        return
    matching, pairs = pairs_compared("auto", count)
    spans, span = (1, count - 1) if matching == "exhaustive" else (2, NEAR)
    starts = [(count - 1 - span) * (2 * place + 1) // (2 * spans) for place in range(spans)]
    tried = [[names[start + round(mark / RULER[-1] * span)] for mark in RULER] for start in starts]
    say(f"Trying {spans * len(RULER)} of {count} photographs ...")
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    before = peak_memory() or 0
    try:
        extraction, features, matching = _measured(root, tried, SfmConfig(str(source), "", threads=CORES, quiet=True))
    except (RuntimeError, OSError, InputError):  # no room for files, for one; who needs the cameras will be told
        return
    mapping = (GLOBAL + INCREMENTAL * (count <= MANY)) * count ** (4 / 3) * extraction / 60  # on one thread
    extraction, matching = extraction * count / CORES / 60, matching * pairs / CORES / 60
    memory = max(peak_memory() or 0, before + OF_FEATURE * features * count / 2**20) / 1024
    told = (
        f"Cameras of {count} photographs will take about {extraction + matching + mapping:.1f} min on {CORES} "
        f"cores, {memory:.1f} GiB: features {extraction:.1f}, {pairs} pairs {matching:.1f}, mapping {mapping:.1f} "
        "(up to four times that, if half of them do not fit together)."
    )
    say(told if features else "Nothing can be told of what cameras take: these have no features, or cannot be read.")


def _measured(root: Path, tried: list[list[str]], config: SfmConfig) -> tuple[float, float, float]:
    """Seconds of all threads for a photograph, its features, and seconds for a pair, as means of those ``tried``."""
    pairs = [pair for group in tried for pair in combinations(group, 2)]
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        began = time.process_time()
        stages.extract(database, root, tried, config, stops=False)
        extracted = time.process_time()
        with pycolmap.Database.open(str(database)) as connection:
            count, features = sum(map(len, tried)), connection.num_keypoints()
        match_pairs(database, pairs, len(pairs), config)
        return (extracted - began) / count, features / count, (time.process_time() - extracted) / len(pairs)

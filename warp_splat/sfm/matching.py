"""Features matched, pair by pair: of all photographs, of neighbors by name, or of those that look alike.

What is matched is in the database at once. So a run that was stopped goes on at the next block of pairs.
"""

import ctypes
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

from tqdm import tqdm

from warp_splat.config import SfmConfig
from warp_splat.formats.files import write_text
from warp_splat.scene.colmap_library import pycolmap
from warp_splat.sfm import looks
from warp_splat.sfm.stages import BAR, HIDING, SHOWING, rename, run_watched

FAISS_THRESHOLD = "_ZN5faiss31distance_compute_blas_thresholdE"  # queries from which on it calls BLAS
# Pairs are matched in blocks of BLOCK x BLOCK, and Ctrl-C is heard in between. Tried:
# - 36 instead of 42 s for 1,225 pairs of 540 x 960 px: pycolmap's 50
BLOCK = 10
TYPICAL = 30  # pairs for each photograph that looks find
PER_FEATURE, PER_SQUARE = 7.5e-6, 3.4e-9  # seconds of one thread for a pair (AMD EPYC): of a feature, of its square
MANY = 100  # photographs from which on "auto" compares those that look alike, and not all


def avoid_blas() -> bool:
    """Have FAISS, which compares features inside of pycolmap, do without BLAS from now on; whether it can be told so.

    The OpenBLAS in pycolmap's wheels has no locks. Two threads that call it may get the same memory. It says "Bad
    memory unallocation!", or nothing, and matches are wrong. Tried, for 1,225 pairs of 264 x 248 px on two threads:
    - 8.3 s with BLAS, other matches than those of one thread in 3 of 14 runs
    - 10.3 s without, always the matches of one thread, which takes 10.7 s
    - 53.8 s by COLMAP's own comparison, which finds 1.6 % more
    """
    try:
        ctypes.c_int.in_dll(ctypes.CDLL(sys.modules["pycolmap._core"].__file__), FAISS_THRESHOLD).value = 2**31 - 1
    except (OSError, ValueError):
        return False
    return True


def match(database: Path, config: SfmConfig, say: Callable[[str], object]) -> int:
    """Match photographs as ``config.matching`` says; returns how many pairs fit together."""
    with pycolmap.Database.open(str(database)) as connection:
        images = connection.num_images()
        features = connection.num_keypoints() / max(images, 1)
    matching, pairs = pairs_compared(config.matching, images)
    if pairs >= TYPICAL * MANY:
        seconds = pairs * (PER_FEATURE * features + PER_SQUARE * features**2) / config.threads
        say(f"matching will take about {seconds / 60:.1f} min: {pairs} pairs of {features:.0f} features each")
    if matching == "looks":
        _match_by_looks(database, config, say)
    elif matching == "sequential":
        pairing = pycolmap.SequentialPairingOptions(num_threads=config.threads)
        # neighbors up to `overlap`, and at distances 2, 4, 8 ... up to 2^(overlap - 1)
        gaps = {*range(1, pairing.overlap + 1), *(1 << power for power in range(pairing.overlap))}
        pairs = sum(max(images - gap, 0) for gap in gaps)
        _run(database, pycolmap.match_sequential, pairing, pairs, config)
    else:
        pairing = pycolmap.ExhaustivePairingOptions(block_size=BLOCK)
        _run(database, pycolmap.match_exhaustive, pairing, pairs, config)
    return len(fitting(database))


def pairs_compared(matching: str, images: int) -> tuple[str, int]:
    """How that many photographs are matched, which "auto" decides, and how many pairs are compared, about."""
    if matching == "auto":
        matching = "exhaustive" if images < MANY else "looks"
    every = images * (images - 1) // 2
    return matching, {"looks": min(every, TYPICAL * images), "exhaustive": every}.get(matching, 0)


def _run(database: Path, run: Callable, pairing: object, total: int, config: SfmConfig) -> None:
    options = pycolmap.FeatureMatchingOptions(num_threads=config.threads if avoid_blas() else 1, use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = config.seed
    work = partial(run, database, options, pairing, verification, pycolmap.Device.cpu)
    with pycolmap.Database.open(str(database)) as connection:
        run_watched(database.parent, "matches", total, work, connection.num_matched_image_pairs, config.quiet)


def fitting(database: Path) -> dict[tuple[int, int], int]:
    """How many features fit together, of the pairs of images of which some do."""
    with pycolmap.Database.open(str(database)) as connection:
        numbers, counts = connection.read_two_view_geometry_num_inliers()
    pairs = map(pycolmap.pair_id_to_image_pair, numbers)
    return {(min(pair), max(pair)): count for pair, count in zip(pairs, counts, strict=True) if count > 0}


def _match_by_looks(database: Path, config: SfmConfig, say: Callable[[str], object]) -> None:
    """Those that look alike and neighbors by name first; then, round by round, neighbors of what fits.

    Each round asks only what the ones before found. So a run that was stopped comes to the same pairs.
    """
    with pycolmap.Database.open(str(database)) as connection:
        images = sorted(connection.read_all_images(), key=lambda image: image.name)
        numbers, names = [image.image_id for image in images], [image.name for image in images]
        bar = tqdm(total=2 * len(images), desc="looks", disable=config.quiet, bar_format=BAR)

        def features(index: int):
            bar.update()
            return connection.read_descriptors(numbers[index]).data

        with bar:
            described = looks.described_by_words(features, len(images), config.seed)
    alike = looks.alike(described)
    pairs = sorted({*alike, *looks.next_in_order(len(images), alike)})
    places = {number: place for place, number in enumerate(numbers)}
    tried, matched = set(), {}
    while pairs:
        tried.update(pairs)
        match_pairs(database, [(names[a], names[b]) for a, b in pairs], len(tried), config)
        found = {tuple(sorted(map(places.__getitem__, pair))): count for pair, count in fitting(database).items()}
        matched = {pair: count for pair, count in found.items() if pair in tried}
        pairs = looks.beyond(matched, tried)
    every = len(images) * (len(images) - 1) // 2
    say(f"{len(tried)} of {every} pairs of photographs compared, by their looks; {len(matched)} fit")


def match_pairs(database: Path, pairs: list[tuple[str, str]], total: int, config: SfmConfig) -> None:
    """Match the ``pairs`` of names; ``total`` are to be there then, for the bar."""
    listed = database.with_name("pairs.txt")
    write_text(listed, "".join(" ".join(name.translate(HIDING) for name in pair) + "\n" for pair in pairs))
    pairing = pycolmap.ImportedPairingOptions(block_size=BLOCK * BLOCK, match_list_path=listed)
    rename(database, HIDING)
    try:
        _run(database, pycolmap.match_image_pairs, pairing, total, config)
    finally:
        rename(database, SHOWING)
    listed.unlink()

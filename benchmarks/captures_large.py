"""Photographs against seconds of all threads and memory of each stage, on walks through rooms that a ray tracer makes.

    python benchmarks/captures_large.py --counts 100 300 --work output/large [--out docs/benchmarks] [--all_pairs 150]

Up to `--all_pairs` photographs, all pairs are compared as well: what share of those that fit was found by looks?
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pycolmap
from common import option, parse, write_table

sys.path.insert(0, str(Path(__file__).parents[1] / "assets"))

from make_capture import PER_ROOM, make_capture

RIGHT = 0.1  # m from the true place, after the similarity that fits the most
STAGES = ("features", "matches", "cameras", "images")
HEADERS = (
    *("photographs", "pairs compared", "of all", "of those that fit"),
    *(f"{stage} s" for stage in STAGES),
    *("all pairs s", "peak MiB", "registered", "places right", "error of places mm", "in a room mm"),
)


def run(capture: Path, scene: Path, matching: str) -> dict:
    """`warp-splat sfm` on a capture; what it says of itself, and how far places are from the true ones."""
    options = ["--matching", matching, "--coordinates", "none", "--quiet"]
    subprocess.run(
        [sys.executable, "-m", "warp_splat", "sfm", str(capture / "images"), str(scene), *options], check=True
    )
    summary = json.loads((scene / "sfm" / "summary.json").read_text())
    found, true = places(scene, capture)
    ransac = pycolmap.RANSACOptions(max_error=RIGHT, random_seed=0)
    off = errors(pycolmap.estimate_sim3d_robust(found, true, ransac)["tgt_from_src"], found, true)
    rooms = [slice(first, first + PER_ROOM) for first in range(0, len(found) - PER_ROOM + 1, PER_ROOM)]
    alone = [errors(pycolmap.estimate_sim3d(found[room], true[room]), found[room], true[room]) for room in rooms]
    right = {"residual": float(np.median(off)), "right": float((off < RIGHT).mean())}
    return {**summary, **right, "residual_in_a_room": float(np.median(np.concatenate(alone)))}


def errors(true_from_found: pycolmap.Sim3d, found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """How far each place is from the true one, [N] in meters."""
    return np.linalg.norm(true_from_found * found - true, axis=1)


def places(scene: Path, capture: Path) -> tuple[np.ndarray, np.ndarray]:
    """Where cameras stand in the model, and in truth, [N, 3] each, in the order of the walk."""
    lines = [line.split(",") for line in (capture / "positions.csv").read_text().splitlines()[1:]]
    where = {name: np.array(place, dtype=float) for name, *place in lines}
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    images = sorted((model.image(number) for number in model.reg_image_ids()), key=lambda image: image.name)
    found = np.stack([image.projection_center() for image in images])
    return found, np.stack([where[Path(image.name).name] for image in images])


def fitting(scene: Path) -> tuple[set[int], int]:
    """Pairs of photographs that fit together, and how many were compared."""
    with pycolmap.Database.open(scene / "sfm" / "database.db") as database:
        pairs, counts = database.read_two_view_geometry_num_inliers()
        return {
            pair for pair, count in zip(pairs, counts, strict=True) if count > 0
        }, database.num_matched_image_pairs()


def measured(count: int, work: Path, all_pairs: bool) -> dict:
    """One row; what was made and measured before is not made again."""
    capture, kept = work / f"walk{count}", work / f"row{count}.json"
    if kept.is_file():
        return json.loads(kept.read_text())
    if not (capture / "positions.csv").is_file():
        make_capture(capture, "walk", count)
    row = {"photographs": count, **run(capture, work / f"looks{count}", "looks")}
    found, row["compared"] = fitting(work / f"looks{count}")
    row["share"] = row["compared"] / (count * (count - 1) / 2)
    if all_pairs:
        row["exhaustive"] = run(capture, work / f"exhaustive{count}", "exhaustive")
        every, _ = fitting(work / f"exhaustive{count}")
        row["recall"] = len(every & found) / len(every)
    kept.write_text(json.dumps(row))
    return row


def main() -> None:
    options = parse(
        __doc__,
        option("--counts", type=int, nargs="+", default=[100, 300]),
        option("--work", type=Path, required=True, help="folder for captures and scenes"),
        option("--all_pairs", type=int, default=150),
    )
    data = [measured(count, options.work, count <= options.all_pairs) for count in options.counts]
    rows = []
    for row in data:
        stages, whole = row["stages_of_last_run"], row.get("exhaustive")
        rows.append(
            (
                *(row["photographs"], row["compared"], f"{100 * row['share']:.0f} %"),
                f"{100 * row['recall']:.1f} %" if whole else "",
                *(f"{stages[stage]['seconds_of_threads']:.0f}" for stage in STAGES),
                f"{whole['stages_of_last_run']['matches']['seconds_of_threads']:.0f}" if whole else "",
                *(stages["images"]["peak_mib"], row["registered"], f"{100 * row['right']:.0f} %"),
                *(f"{1000 * row[error]:.1f}" for error in ("residual", "residual_in_a_room")),
            )
        )
    note = (
        "Walks of 320 x 240 px, a room for every 50 photographs. Seconds are of all threads together, "
        f"`all pairs s`: of matching all pairs instead, up to {options.all_pairs} photographs. Right are places within "
        "10 cm, in the similarity that fits most. Errors are medians; in a room: by one similarity for every 50 "
        "photographs."
    )
    write_table("captures_large", options.out, HEADERS, rows, note, {"rows": data})


if __name__ == "__main__":
    main()

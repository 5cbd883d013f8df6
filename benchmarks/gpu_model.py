"""What a training step needs at least on NVIDIA's cards: a model, no measurement.

    python benchmarks/gpu_model.py [--out docs/cuda] [--measured docs/benchmarks/gpu.json --card H200]

Bytes are those of arrays that a stage reads and writes, each once. Instructions are the machine code's
(``cubins.json``). A stage takes at least the longer of the two times: bytes by the card's bandwidth, instructions of
warps by four per cycle and multiprocessor. Launches and operations of torch are counted in a step of the real trainer,
in fibers. With a result of ``gpu.py``, its stages stand beside the model's.
"""

import heapq
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from common import ROOT, option, parse, versions
from gpu_counts import LAUNCHES, OPERATIONS, REST, WAITS, Scene, count_scene, count_step
from gpu_steps import STAGES
from made_up import cameras, make_crowd, make_gaussians

from warp_splat.evaluation.report import machine
from warp_splat.formats.files import write_json
from warp_splat.kernels.cuda.adam_by_number import AT_ONCE
from warp_splat.kernels.cuda.blend import EACH
from warp_splat.kernels.cuda.comparison import BAND, STRIP
from warp_splat.kernels.window import RADIUS
from warp_splat.runtime import launch
from warp_splat.text import format_table

CUBINS = ROOT / "docs/cuda/cubins.json"


class Card(NamedTuple):
    """As NVIDIA's data sheets have it."""

    arch: int
    processors: int  # streaming multiprocessors
    clock: float  # MHz, boost
    bandwidth: float  # GB/s


CARDS = {
    "T4": Card(75, 40, 1590, 320),
    "RTX 3090": Card(86, 82, 1695, 936),
    "RTX 4090": Card(89, 128, 2520, 1008),
    "A100 80 GB": Card(80, 108, 1410, 2039),
    "H100 SXM": Card(90, 132, 1980, 3350),
    "H200": Card(90, 132, 1980, 4800),
    "RTX 5090": Card(120, 170, 2407, 1792),
}
ISSUED = 4  # instructions of warps per cycle and multiprocessor, on all of them
SCENES = {
    "ball": (make_gaussians, 1_000_000, 980, 545),
    "crowd": (make_crowd, 1_000_000, 1920, 1080),
}
SHAPE, SH, SPLAT, RADII = 44, 192, 48, 4  # bytes of a Gaussian, its harmonics, projected, and the radius of that
GRADIENT, ROW, PLACE = 40, 36, 4  # of a projected Gaussian, of a tile instance, of an index
PARAMETERS = (SHAPE + SH) // 4
#: Instructions of a warp for one of the blocks of a tile instance, of the blend and of its adjoint; and of both for an
#: instance that is staged (docs/cuda.md).
BLENDED, BLOCK, STAGED = 23, 42, 13
CARD_HEADERS = (
    *("card", "code", "SMs", "MHz", "GB/s"),
    *(f"{name}: {what} ms" for name in SCENES for what in ("blend", "its adjoint", "step")),
)
ADJOINT_HEADERS = ("scene", "adjoint", "found", "instructions", "shuffles", "barriers", "atomic additions")
LOAD_HEADERS = ("scene", "warps of the adjoint", "warps", "longest", "mean", "slots busy: ms", "2 cycles", "4 cycles")
RESIDENT = 16  # of these warps on a multiprocessor, by their registers
PIECE = 256  # tile instances of a list that is split
ADD_ROW = 24  # of gather for a row: nine loads, nine additions, its place, the loop


def instructions(arch: int) -> dict[tuple[str, str], int]:
    """By module and kernel, of the longest innermost loop: all of a kernel that has none but that over its threads."""
    records = json.loads(CUBINS.read_text())["records"]
    return {(record["module"], record["kernel"]): record["loop"] for record in records if record["arch"] == arch}


def stages(scene: Scene, arch: int) -> dict[str, tuple[float, float]]:
    """Bytes, and instructions of warps, by stage."""
    n, drawn, pixels, m, walked = scene.gaussians, scene.drawn, scene.pixels, scene.instances, scene.walked
    code = instructions(arch)
    each = lambda *kernels: -(-n // 32) * sum(code[kernel] for kernel in kernels)  # noqa: E731
    by_depth = 8 * 12 * n + 32 * n  # four passes over keys and indices; the order, counts and their scan
    # with room for more: two passes over keys of 16 bits and indices of 64, then instances and places from these
    by_tile = 76 * 1.25 * m
    passes = STAGED + code["manual", "adj_blend"] - 8 * BLOCK  # of a tile instance, whatever it touches
    rows = 8 * (BAND + 2 * RADIUS) / BAND * 3 * pixels / STRIP  # of warps, in strips of three colors a pixel
    return {
        # activated; filled with zeros and projected; colors of those drawn
        "project": (
            32 * n + (SHAPE + 2 * GRADIENT) * n + (SH + 24) * drawn,
            each(("activate", "activate"), ("project", "project"), ("shade", "shade")),
        ),
        "bin": (
            by_depth + 2 * SPLAT * drawn + 40 * n + by_tile,
            each(("count tiles", "count_tiles"), ("list tiles", "list_tiles")),
        ),
        "blend": (
            (PLACE + SPLAT) * walked + 24 * pixels,
            STAGED * walked + (code["blend", "blend"] - EACH * BLENDED) * scene.halves + BLENDED * scene.blocks,
        ),
        # image and photograph in bytes; slopes of three colors
        "loss": ((12 + 3 + 36) * pixels, rows * code["loss", "compare_block"]),
        "adjoint of loss": ((12 + 3 + 36 + 12) * pixels, rows * code["loss", "adj_compare_block"]),
        # upstream; rows of the walked, zeros in the others; their sums
        "adjoint of blend": (
            60 * pixels + (PLACE + SPLAT) * walked + ROW * m + 28 * pixels + (PLACE + ROW) * m + (8 + GRADIENT) * n,
            8 * scene.tiles * code["upstream", "upstream"] + passes * walked + BLOCK * scene.blocks + ADD_ROW * m / 32,
        ),
        "adjoint of project": (
            (2 * SHAPE + SH + 32 + RADII) * n + (2 * GRADIENT + SH + SHAPE) * drawn + 48 * n,
            each(("adjoint of shade", "adj_shade"), ("project", "project, adjoint"))
            + 15 * each(("adjoint of coefficients", "adj_rest"))
            + each(("quarantine", "quarantine"), ("adjoint of activate", "adj_activate")),
        ),
        "densify": (28 * n, each(("observe", "observe"))),
        "Adam": (7 * 4 * PARAMETERS * n, each(("adam", "adam")) * PARAMETERS / AT_ONCE),  # a table takes a sixth of it
    }


def times(scene: Scene, card: Card) -> dict[str, tuple[float, float]]:
    """Milliseconds by bytes and by instructions, of each stage."""
    rate = ISSUED * card.processors * 1e6 * card.clock
    return {
        stage: (1e3 * size / (1e9 * card.bandwidth), 1e3 * issued / rate)
        for stage, (size, issued) in stages(scene, card.arch).items()
    }


def step_rows(counts: dict[str, np.ndarray], found: dict[str, dict]) -> list[list]:
    """Of each stage what it launches, and the least milliseconds by bytes and instructions on an H200."""
    rows = []
    for stage in (*STAGES, REST):
        here = counts.get(stage, np.zeros(3))
        cells = [f"{bound:.3f}" for name in found for bound in found[name].get(stage, (0.0, 0.0))]
        rows.append([stage, *(int(here[kind]) for kind in (LAUNCHES, OPERATIONS, WAITS)), *cells])
    total = sum(counts.values())
    least = [sum(max(pair) for pair in stages.values()) for stages in found.values()]
    cells = [cell for value in least for cell in ("longer of both:", f"{value:.2f}")]
    return [*rows, ["step", *(int(total[kind]) for kind in (LAUNCHES, OPERATIONS, WAITS)), *cells]]


def card_rows(scenes: dict[str, Scene]) -> list[list]:
    rows = []
    for name, card in CARDS.items():
        row = [name, f"sm_{card.arch}", card.processors, f"{card.clock:.0f}", f"{card.bandwidth:.0f}"]
        for scene in scenes.values():
            found = times(scene, card)
            row += [f"{max(found[stage]):.2f}" for stage in ("blend", "adjoint of blend")]
            row += [f"{sum(map(max, found.values())):.2f}"]
        rows.append(row)
    return rows


def adjoint_rows(scenes: dict[str, Scene]) -> list[list]:
    """What adjoints issue for a tile instance that is walked, over all warps of the tile.

    gsplat 1.5's (RasterizeToPixels3DGSBwd.cu) has a warp for 16 x 2 pixels. One in which no pixel blends stops after
    its test. The others sum nine numbers by five shuffles each, and one lane adds them to the Gaussian's by nine
    atomics. The reference's (backward.cu) has the same warps and no sums: a pixel that blends adds nine numbers by
    atomics. The operators of both are counted by hand in the sources: 30 for the test, 55 and 60 for the gradients.
    """
    code, rows = instructions(90)["manual", "adj_blend"], []
    for name, scene in scenes.items():
        blocks, warps, pairs = (value / scene.walked for value in (scene.blocks, scene.warps, scene.pairs))
        ours = STAGED + code - 8 * BLOCK + BLOCK * blocks
        rows += [
            [name, "manual: a warp for a tile", "counted", f"{ours:.0f}", "12", "0", "0"],
            [name, "a block of 256, before", "counted", "2046", "400", "4", "0"],
            [name, "gsplat", "by hand", f"{8 * 30 + warps * (55 + 90 + 18):.0f}", f"{45 * warps:.0f}", "0",
             f"{9 * warps:.1f}"],
            [name, "reference", "by hand", f"{8 * 30 + warps * (60 + 18):.0f}", "0", "0", f"{9 * pairs:.0f}"],
        ]  # fmt: skip
    return rows


def load_rows(scenes: dict[str, Scene], card: Card) -> list[list]:
    """The adjoint with its load balance: tiles by warps, and how else they might be shared out.

    Of two warps each has half of the blocks, and both stage all. A list that is split goes on from the state of pixels
    between its pieces, which the forward pass would have to keep.
    """
    passes, rows = instructions(card.arch)["manual", "adj_blend"] - 8 * BLOCK, []
    for name, scene in scenes.items():
        walked, blocks, halves = scene.by_tile.T.astype(float)
        whole = (STAGED + passes) * walked + BLOCK * blocks
        half = STAGED * walked + 0.5 * (passes * halves + BLOCK * blocks)
        pieces = np.maximum(np.ceil(walked / PIECE), 1).astype(int)
        ways = {
            "one for a tile": whole,
            "two of four pixels a lane": np.repeat(half, 2),
            f"one for {PIECE} of a list": np.repeat(whole / pieces, pieces),
            "one for a tile, the longest first": np.sort(whole)[::-1],
        }
        for way, each in ways.items():
            least = 1e3 * each.sum() / (ISSUED * card.processors * 1e6 * card.clock)
            ends = [f"{last_end(each, card, cycles):.3f}" for cycles in (2, 4)]
            rows.append([name, way, len(each), f"{each.max():.0f}", f"{each.mean():.0f}", f"{least:.3f}", *ends])
    return rows


def last_end(warps: np.ndarray, card: Card, cycles: float) -> float:
    """Milliseconds until the last of ``warps``, instructions each, has ended; they start in this order.

    Those on a multiprocessor share what it issues, and each has one instruction in ``cycles`` cycles at most.
    """
    waiting = iter(warps.tolist())
    issued, times, ends = [0.0] * card.processors, [0.0] * card.processors, [[] for _ in range(card.processors)]
    for place, work in zip(range(RESIDENT * card.processors), waiting, strict=False):
        heapq.heappush(ends[place % card.processors], work)

    def next_end(place: int) -> tuple[float, int]:
        rate = min(ISSUED / len(ends[place]), 1.0 / cycles)
        return times[place] + (ends[place][0] - issued[place]) / rate, place

    due = [next_end(place) for place in range(card.processors) if ends[place]]
    heapq.heapify(due)
    now = 0.0
    while due:
        now, place = heapq.heappop(due)
        times[place], issued[place] = now, heapq.heappop(ends[place])
        if (work := next(waiting, None)) is not None:
            heapq.heappush(ends[place], issued[place] + work)
        if ends[place]:
            heapq.heappush(due, next_end(place))
    return now / (1e3 * card.clock)


def measured_rows(path: Path, card: Card, scenes: dict[str, Scene]) -> list[list]:
    """Stages as gpu.py measured them, over the model's least times."""
    rows = []
    for row in json.loads(path.read_text())["tables"]["Training step"]:
        for name, scene in scenes.items():
            if (row["size"], row["Gaussians"]) == ("{} x {}".format(*SCENES[name][2:]), scene.gaussians):
                for stage, bounds in times(scene, card).items():
                    took, least = float(row[f"{stage} ms"]), max(bounds)
                    rows.append([name, stage, f"{took:.3f}", f"{least:.3f}", f"{took / least:.1f}"])
    return rows


def main() -> None:
    arguments = parse(
        __doc__,
        option("--measured", type=Path, help="what gpu.py wrote, to be compared"),
        option("--card", choices=CARDS, default="H200", help="on which that was (default: H200)"),
    )
    launch.prepare("cpu", 0)
    counts = count_step()
    scenes = {
        name: count_scene(make(count, "cpu"), cameras(*size, 1)[0]) for name, (make, count, *size) in SCENES.items()
    }
    found = {name: times(scene, CARDS["H200"]) for name, scene in scenes.items()}
    each = [f"{name}: {what} ms" for name in scenes for what in ("bytes", "instructions")]
    tables = [
        (("stage", "launches", "torch", "waits", *each), step_rows(counts, found), described(scenes)),
        (CARD_HEADERS, card_rows(scenes), "The longer of both times, stage by stage."),
        (ADJOINT_HEADERS, adjoint_rows(scenes), "For a tile instance that is walked, on sm_90."),
    ]
    note = "Modeled: an H200. Slots busy: no load balance; else the last warp's end, with so many cycles between two "
    note += "instructions of a warp: 4 if each needs the one before."
    loads = load_rows(scenes, CARDS["H200"])
    tables.append((LOAD_HEADERS, loads, note))
    if arguments.measured:
        ball = {"ball": scenes["ball"]}  # of the crowd gpu.py measures no step
        rows = measured_rows(arguments.measured, CARDS[arguments.card], ball)
        headers = ("scene", "stage", "measured ms", "modeled ms", "ratio")
        tables.append((headers, rows, f"Measured on an {arguments.card} by `gpu.py`, with the host's waits."))
    parts = [f"{format_table(headers, rows)}\n\n{note}" for headers, rows, note in tables]
    where = f"Modeled by `benchmarks/gpu_model.py` on {machine()}. {versions()}."
    text = "\n\n".join([*parts, where])
    print(text)
    if arguments.out:
        (arguments.out / "gpu_model.md").write_text(f"{text}\n")
        data = {"scenes": {name: asdict(replace(scene, by_tile=[])) for name, scene in scenes.items()}}
        data["loads"] = [dict(zip(LOAD_HEADERS, row, strict=True)) for row in loads]
        data["counts"] = {stage: here.tolist() for stage, here in counts.items()}
        write_json(arguments.out / "gpu_model.json", data)


def described(scenes: dict[str, Scene]) -> str:
    sizes = (
        f"{name}: {scene.gaussians} Gaussians, {scene.pixels} px, {scene.instances} tile instances, of which "
        f"{scene.walked} are walked, and {100 * scene.blocks / (8 * scene.walked):.0f} % of their blocks touched"
        for name, scene in scenes.items()
    )
    return f"Counted: launches, operations of torch, waits of the host. Modeled: an H200. {'; '.join(sizes)}."


if __name__ == "__main__":
    main()

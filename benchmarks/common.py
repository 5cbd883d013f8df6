"""What the benchmarks share: the command line, trainings, timing, the machine's name, and tables."""

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import torch
import warp as wp

from warp_splat.color import to_bytes
from warp_splat.config import RasterOptions
from warp_splat.evaluation.report import machine
from warp_splat.formats.exchange import load_gaussians
from warp_splat.gaussians import GaussianModel
from warp_splat.raster.drivers import DRIVERS, Driver
from warp_splat.rendering.finished import make_renderer
from warp_splat.runtime import launch, pool
from warp_splat.text import cells_of, format_table

ROOT = Path(__file__).parents[1]


def option(*names: str, **how):
    """As :meth:`argparse.ArgumentParser.add_argument` takes it."""
    return names, how


REPEATS = option("--repeats", type=int, default=7)
MODELS = option("--models", type=Path, required=True, help="folder for the models")
TRAINED = option("-m", "--models", type=Path, action="append", required=True, help="a trained model; may come again")
SCENE = option("-s", "--scene", type=Path, help="a scene of photographs, besides the embedded one")
PHOTOGRAPHS = (
    option("--runs", type=Path, required=True, help="folder for what has been run"),
    option("--fox", type=Path, help="photographs of 540 x 960 px"),
    option("--church", type=Path, help="photographs of 768 x 512 px"),
)
RUNS = (*PHOTOGRAPHS, option("--only_table", action="store_true", help="train nothing more"))


def parse(doc: str | None, *options: tuple) -> argparse.Namespace:
    """The command line of a program with this docstring: its options, and --out."""
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    for names, how in options:
        parser.add_argument(*names, **how)
    parser.add_argument("--out", type=Path, help="folder for the table, as .md and .json, and for plots")
    return parser.parse_args()


def load_model(path: Path) -> GaussianModel:
    """The Gaussians of a file. Raises InputError if it is missing or not one."""
    return GaussianModel.from_splats(load_gaussians(path).splats)


def run_training(model: Path, flags: Iterable) -> dict:
    """The results of the last iteration; trains only if they are not there."""
    if not (model / "results.json").is_file():
        command = [sys.executable, "-m", "warp_splat", "train", "-m", model, *map(str, flags)]
        subprocess.run(command, check=True, cwd=ROOT)
    results = json.loads((model / "results.json").read_text())
    return results[max(results, key=lambda name: int(name.removeprefix("ours_")))]


@contextmanager
def claimed(path: Path) -> Iterator[None]:
    """A file that is the block's to write, empty meanwhile: others leave it alone. It goes if nothing comes of it."""
    path.touch(exist_ok=False)
    try:
        yield
    finally:
        if not path.stat().st_size:
            path.unlink()


def status(name: str) -> int:
    """A line of this process's status, in bytes (its unit is KiB)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line.split()[1] for line in lines if line.startswith(name)))


def in_process(*command) -> dict:
    """What a script prints last, as JSON, in a process of its own; ``command``: its path and its words."""
    found = subprocess.run([sys.executable, *map(str, command)], check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(found.stdout.splitlines()[-1])


def with_threads(count: int, run: Callable[[], object]) -> Callable[[], None]:
    """``run`` on so many threads."""

    def timed() -> None:
        pool.set_threads(count)
        run()

    return timed


def interleaved(
    runs: Mapping[Hashable, Callable[[], object]], repeats: int, clock=time.perf_counter, of=statistics.median
) -> dict:
    """Median seconds of each run; rounds over all runs, so that a change of the machine's pace hits them alike."""
    seconds: dict = {name: [] for name in runs}
    for run in runs.values():
        run()
    for _ in range(repeats):
        for name, run in runs.items():
            start = clock()
            run()
            seconds[name].append(clock() - start)
    return {name: of(values) for name, values in seconds.items()}


def write_table(
    name: str, out: Path | None, headers: Sequence | Mapping, rows: Sequence, note: str, data: Mapping | None = None
) -> None:
    """Print a table; if a folder is given, write it to ``<out>/<name>.md``, and ``data`` or the rows to ``.json``.

    Rows are records if ``headers`` says what is shown of one, as for :func:`warp_splat.text.table_of`.
    """
    if isinstance(headers, Mapping):
        headers, rows = list(headers), cells_of(rows, headers)
    table = format_table(headers, rows)
    print(f"\n{table}\n\n{note}\n{machine()}")
    measured = {**({"headers": headers, "rows": rows} if data is None else data), "machine": machine()}
    if out:
        out.mkdir(parents=True, exist_ok=True)
        (out / f"{name}.md").write_text(
            f"{table}\n\n{note} Measured by `benchmarks/{name.removesuffix('_cuda')}.py` on {machine()}.\n"
        )
        (out / f"{name}.json").write_text(json.dumps(measured, indent=1) + "\n")


def transcribe(name: str, out: Path | None, measure: Callable[[Path, Callable[[str], None]], object]) -> None:
    """What ``measure`` says and on which machine, printed and written to ``<out>/<name>.txt``, beside its own files."""
    out, log = out or ROOT / "output" / "compare", []

    def say(text: str) -> None:
        print(text, flush=True)
        log.append(text)

    launch.prepare("cpu", 0)
    measure(out, say)
    say(f"\nMeasured on {machine()}, {pool.get_threads()} threads.")
    (out / f"{name}.txt").write_text("\n".join([*log, ""]))


def versions() -> str:
    """Of torch and Warp, of CUDA in both, and of the driver: they decide what code a GPU gets."""
    wp.init()
    dotted = lambda version: ".".join(map(str, version)) if version else "none"  # noqa: E731
    toolkit, driver = map(dotted, (wp.get_cuda_toolkit_version(), wp.get_cuda_driver_version()))
    built = f"torch {torch.__version__} (CUDA {torch.version.cuda}), Warp {wp.__version__} (CUDA {toolkit})"
    return f"{built}, driver for CUDA {driver}"


def milliseconds(run: Callable[[], object], device: str, repeats: int) -> float:
    """Median after a warm-up, by CUDA events (by the clock on a CPU)."""
    times = []
    for repeat in range(-2, repeats):
        if device == "cuda":
            start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            start.record()
            run()
            end.record()
            torch.cuda.synchronize()
            elapsed = start.elapsed_time(end)
        else:
            begun = time.perf_counter()
            run()
            elapsed = 1e3 * (time.perf_counter() - begun)
        if repeat >= 0:
            times.append(elapsed)
    return statistics.median(times)


def synchronize(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def picture_of(model: GaussianModel, background=None, options: RasterOptions | None = None, linear: bool = False):
    """A function from a camera to the model's image, [H, W, 3] uint8; see ``make_renderer``."""
    draw = make_renderer(model, background, options)
    return lambda camera: to_bytes(draw(camera).image, linear)


@contextmanager
def using(driver: Driver) -> Iterator[None]:
    """Render on the CPU by ``driver``, for tests and dry runs; a GPU's kernels then run in slow fibers."""
    before = DRIVERS["cpu"], wp.config.enable_cpu_blocks
    DRIVERS["cpu"], wp.config.enable_cpu_blocks = driver, True
    try:
        yield
    finally:
        DRIVERS["cpu"], wp.config.enable_cpu_blocks = before

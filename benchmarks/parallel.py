"""Train the embedded scene with one and with two processes: quality against time, for as many images or as many steps.

One process has one or two threads, two processes have one thread each. `two, as many steps` stretches the schedule, so
that everything happens at the same step as with one process, after twice as many images.

    python benchmarks/parallel.py --models output/parallel [--iterations 3000] [--out docs/benchmarks]
"""

import json
import subprocess
import sys
from pathlib import Path

from common import MODELS, ROOT, option, parse, write_table

from warp_splat.presets import EMBEDDED_DEFAULTS
from warp_splat.training.options import TrainConfig

#: name: processes, threads of each, factor of the schedule
RUNS = {
    "1 process, 2 threads": (1, 2, 1),
    "1 process, 1 thread": (1, 1, 1),
    "2 processes, as many images": (2, 1, 1),
    "2 processes, as many steps": (2, 1, 2),
}
COLUMNS = {
    **{"run": "{run}", "images": "{images}", "steps": "{steps}", "PSNR dB": "{PSNR:.2f}", "SSIM": "{SSIM:.4f}"},
    **{"s of steps": "{of_steps:.0f}", "images/s": "{speed:.1f}", "ms/step": "{ms:.0f}"},
    **{"Gaussians": "{gaussians}", "wall s": "{seconds:.0f}"},
}
SCHEDULE = (
    "iterations",
    "position_lr_max_steps",
    "sh_interval",
    "densify_from_iter",
    "densify_until_iter",
    "densification_interval",
    "opacity_reset_interval",
)


def flags_of(iterations: int) -> list[str]:
    """The embedded scene's flags, the schedule stretched or compressed to ``iterations``."""
    defaults = TrainConfig(**EMBEDDED_DEFAULTS[""]).flat()
    share = iterations / defaults["iterations"]
    schedule = [(f"--{name}", str(round(defaults[name] * share))) for name in SCHEDULE]
    return [word for pair in schedule for word in pair] + ["--max_gaussians", str(defaults["max_gaussians"]), "--eval"]


def run(model: Path, processes: int, threads: int, iterations: int) -> dict:
    """Train; a record for the table."""
    start = [sys.executable, "-m"]
    if processes > 1:
        start += ["torch.distributed.run", "--standalone", "--nproc-per-node", str(processes), "-m"]
    flags = [*flags_of(iterations), "--threads", str(threads), "--device", "cpu"]
    subprocess.run(
        [*start, "warp_splat", "train", "-s", ROOT / "assets" / "still_life", "-m", model, *flags], check=True, cwd=ROOT
    )
    (entry,) = json.loads((model / "results.json").read_text()).values()
    seconds = json.loads((model / "history.json").read_text())[-1]["seconds"]
    given = {"images": iterations, "steps": iterations // processes, "of_steps": seconds, "speed": iterations / seconds}
    return {**entry, **given, "ms": 1e3 * seconds * processes / iterations}


def main() -> None:
    arguments = parse(
        __doc__,
        MODELS,
        option("--iterations", type=int, default=3000, help="images in all but the last run, an even number"),
    )
    records = []
    for number, (name, (processes, threads, factor)) in enumerate(RUNS.items()):
        model = arguments.models.resolve() / str(number)
        records.append({"run": name, **run(model, processes, threads, factor * arguments.iterations)})
    note = (
        "Embedded scene, held-out views (every 8th); seconds of steps without evaluations and pictures; one run each."
    )
    write_table("parallel", arguments.out, COLUMNS, records, note)


if __name__ == "__main__":
    main()

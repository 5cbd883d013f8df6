"""Knobs of the forward pass: what each value saves, and what it costs in image and gradient.

The truth of a knob is float64 with this knob at its most exact and the others at their defaults: no early stop for
``t_min``, no cut for ``alpha_min``, the plain definition for the others. Measured on the layered scene of 1,000 and on
scenes in training.

    python benchmarks/knobs.py [-s SCENE] [--out docs/compare]
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import torch
from common import SCENE, parse, transcribe
from panels import Panel, draw_panels

from warp_splat.compare import adjoints, plots
from warp_splat.compare.truth import compute_truth
from warp_splat.compare.workloads import Workload, in_training, layered, named_scenes
from warp_splat.config import ALPHA_MIN, EXP_DEGREES, EXTENTS, T_MIN, RasterOptions
from warp_splat.formats.files import write_csv, write_json
from warp_splat.text import table_of

#: Knob: the values it is turned to while all else stays at its default (exp_degree none is the C library's, exact).
KNOBS: dict[str, tuple] = {
    "t_min": (1e-2, 1e-3, T_MIN, 1e-6, 1e-8, 0.0),
    "alpha_min": (4 * ALPHA_MIN, ALPHA_MIN, 1e-3, 1e-4, 0.0),
    "extent": EXTENTS,
    "exp_degree": EXP_DEGREES,
    "max_steps": (None, 2048, 512, 128),
}


def turned_knobs() -> list[adjoints.Variant]:
    """Every knob at every value; the default, marked by a star, once for each."""
    default = RasterOptions()
    return [
        adjoints.Variant(f"{knob} {_plain(value)}{' *' * (value == getattr(default, knob))}", "manual", {knob: value})
        for knob, values in KNOBS.items()
        for value in values
    ]


def run_knobs(workloads: Sequence[Workload], say: Callable[[str], None]) -> list[adjoints.Measurement]:
    """Every setting on every workload."""
    results = []
    for workload in workloads:
        start = time.perf_counter()
        most = {knob: {knob: 0.0} if knob in ("t_min", "alpha_min") else {} for knob in KNOBS}
        exact = {knob: replace(workload, options=replace(workload.options, **most[knob])) for knob in KNOBS}
        truths = {knob: compute_truth(exact[knob]) for knob in KNOBS}
        knobs = {variant: next(iter(variant.changes)) for variant in turned_knobs()}
        found = {variant: adjoints.first_run(workload, truths[knob], variant) for variant, knob in knobs.items()}
        adjoints.time_all(workload, found)
        results += found.values()
        say(f"{workload.name}: knobs measured in {time.perf_counter() - start:.0f} s")
    return results


def _plain(value) -> str:
    if value is None:
        return "none"
    return value if isinstance(value, str) else f"{value:.4g}"


def knob_table(measurements: Sequence[adjoints.Measurement]) -> str:
    """A row per scene and setting: image and gradient error against everything blended, times against the default."""
    found = []
    for item in measurements:
        name, error = item.worst
        relative = item.both / knob_default(measurements, item).both
        cells = {"image": item.image_error, "error": error, "of": name, "relative": relative}
        found.append({**adjoints.timed_cells(item), **cells})
    errors = {"image error": "{image:.1e}", "gradient error": "{error:.1e}", "of": "{of}"}
    times = {"forward ms": "{forward}", "backward ms": "{backward}", "x default": "{relative:.2f}"}
    return table_of(found, {"scene": "{scene}", "setting": "{variant}", **errors, **times})


def knob_default(measurements: Sequence[adjoints.Measurement], item: adjoints.Measurement) -> adjoints.Measurement:
    """The same knob at its default, on the same scene."""
    knob = item.variant.split()[0]
    here = (other for other in measurements if other.scene == item.scene and other.variant.split()[0] == knob)
    return next(other for other in here if other.variant.endswith("*"))


def plot_knobs(path: Path, measurements: Sequence[adjoints.Measurement]) -> None:
    """Error of image and gradient against time, relative to the default, a row per scene."""
    panels = []
    for scene in dict.fromkeys(item.scene for item in measurements):
        here = [item for item in measurements if item.scene == scene]
        for what in ("image", "gradient"):
            panel = Panel(f"{scene}: error of the {what}", "time of the pixel loop, default (*) = 1", ticks=True)
            for knob, style in zip(KNOBS, plots.STYLES.values(), strict=False):
                turned = [item for item in here if item.variant.startswith(f"{knob} ")]
                times = [item.both / knob_default(here, item).both for item in turned]
                errors = [(item.image_error or 0.0) if what == "image" else item.worst[1] for item in turned]
                errors = [max(error, plots.LEAST) for error in errors]
                panel.marks(knob, times, errors, style, ls="-", lw=0.8)
                for item, *place in zip(turned, times, errors, strict=True):
                    if place[0] > 1.2 or place[1] > 1e-5:  # the others lie on one spot
                        panel.notes.append((tuple(place), item.variant.removeprefix(f"{knob} "), (3, 3), "left"))
            panels.append(panel)
    draw_panels(path, panels, 2, 2.8)


def measure(scenes: dict, out: Path, say: Callable[[str], None]) -> None:
    """Every knob on the layered scene and the last stage of each scene in training; tables and plot in ``out``."""
    cpu = torch.device("cpu")
    workloads = [layered(1000), *(in_training(name, scene, cpu, say)[-1] for name, scene in scenes.items())]
    turned = run_knobs(workloads, say)
    say(f"\n{knob_table(turned)}")
    write_csv(out / "knobs.csv", adjoints.records(turned))
    write_json(out / "knobs.json", [asdict(item) for item in turned])
    plot_knobs(out / "knobs.png", turned)


def main() -> None:
    arguments = parse(__doc__, SCENE)
    scenes = named_scenes(str(arguments.scene or ""), print)
    transcribe("knobs", arguments.out, lambda out, say: measure(scenes, out, say))


if __name__ == "__main__":
    main()

"""Knobs of the forward pass: what each value saves, and what it costs in image and gradient.

The truth of a knob is float64 with this knob at its most exact and the others at their defaults: no early stop for
``t_min``, no cut for ``alpha_min``, the plain definition for the others.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from warp_splat.compare.adjoints import Measurement, Variant, first_run, time_all
from warp_splat.compare.truth import compute_truth
from warp_splat.compare.workloads import Workload
from warp_splat.config import ALPHA_MIN, EXP_DEGREES, EXTENTS, T_MIN, RasterOptions

#: Knob: the values it is turned to while all else stays at its default (exp_degree none is the C library's, exact).
KNOBS: dict[str, tuple] = {
    "t_min": (1e-2, 1e-3, T_MIN, 1e-6, 1e-8, 0.0),
    "alpha_min": (4 * ALPHA_MIN, ALPHA_MIN, 1e-3, 1e-4, 0.0),
    "extent": EXTENTS,
    "exp_degree": EXP_DEGREES,
    "max_steps": (None, 2048, 512, 128),
}


def variants() -> list[Variant]:
    """Every knob at every value; the default, marked by a star, once for each."""
    default = RasterOptions()
    return [
        Variant(f"{knob} {_plain(value)}{' *' * (value == getattr(default, knob))}", "manual", {knob: value})
        for knob, values in KNOBS.items()
        for value in values
    ]


def run_knobs(workloads: Sequence[Workload], say: Callable[[str], None]) -> list[Measurement]:
    """Every setting on every workload."""
    results = []
    for workload in workloads:
        start = time.perf_counter()
        most = {knob: {knob: 0.0} if knob in ("t_min", "alpha_min") else {} for knob in KNOBS}
        exact = {knob: replace(workload, options=replace(workload.options, **most[knob])) for knob in KNOBS}
        truths = {knob: compute_truth(exact[knob]) for knob in KNOBS}
        found = {variant: first_run(workload, truths[next(iter(variant.changes))], variant) for variant in variants()}
        time_all(workload, found)
        results += found.values()
        say(f"{workload.name}: knobs measured in {time.perf_counter() - start:.0f} s")
    return results


def _plain(value) -> str:
    if value is None:
        return "none"
    return value if isinstance(value, str) else f"{value:.4g}"

"""More plots of what ``warp-splat compare`` wrote: memory, shares of stages, growth of rounding.

python -m warp_splat.compare --out output/compare
python -m warp_splat.compare --stability --out output/compare
python benchmarks/compare_plots.py --out output/compare
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rounding
from common import ROOT, parse
from panels import Panel, draw_panels

from warp_splat.compare.plots import STYLES
from warp_splat.compare.workloads import CANDIDATES
from warp_splat.config import ADJOINTS
from warp_splat.evaluation import report

STAGES = ("project", "bin", "blend", "adjoint of blend", "adjoint of project")


def plot_memory(path: Path, measured: Sequence[Mapping[str, Any]]) -> None:
    """Peak memory against depth complexity, a line per variant."""
    panel = Panel("peak memory of a pass [MiB]", "candidates per pixel")
    of = {(item["scene"], item["variant"]): item["memory"] for item in measured if item["memory"]}
    for variant in dict.fromkeys(item["variant"] for item in measured if not item["variant"].startswith("cap")):
        points = [(n, of[key] / 2**20) for n in CANDIDATES if (key := (f"{n} layers", variant)) in of]
        if points:
            panel.marks(variant, *np.array(points).T, STYLES[variant], ls="-", linewidth=1.2)
    draw_panels(path, [panel], 1, 2.8)


def plot_stages(path: Path, measured: Sequence[Mapping[str, Any]]) -> None:
    """Share of each stage of rendering and differentiating, a bar per scene and mode."""
    chosen = [item for item in measured if item["variant"] in ADJOINTS and item["stages"]]
    figure, axes = report.new_panels(0.8 + 0.2 * len(chosen))
    report.plain_axes(axes, "share of each stage of rendering and differentiating")
    seconds = np.array([[item["stages"].get(stage, 0.0) for stage in STAGES] for item in chosen])
    share = seconds / seconds.sum(1, keepdims=True)
    left = np.cumsum(share, 1) - share
    labels = [f"{item['scene']}: {item['variant']}" for item in chosen]
    for place, color in enumerate(("#56B4E9", "#999999", report.BLUE, report.ORANGE, "#E69F00")):
        axes.barh(labels, share[:, place], left=left[:, place], color=color, height=0.75, label=STAGES[place])
    axes.set(xlim=(0, 1), ymargin=0.01)
    axes.invert_yaxis()
    axes.grid(False)
    axes.tick_params(axis="y", labelsize=7, length=0)
    figure.legend(loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    report.save_figure(figure, path)


def plot_stability(path: Path, measured: Mapping[str, Any]) -> None:
    """Draw the growth of rounding along a chain against its bound, and the error of two formulas for a determinant."""
    errors = {(row["case"], row["mode"]): row for row in measured["verdicts"]}
    found = [(case.removeprefix("chain_"), mode) for case, mode in errors]
    chains = [(int(length), mode) for length, mode in found if length.isdigit()]
    lengths, modes = (list(dict.fromkeys(part)) for part in zip(*chains, strict=True))
    chain = Panel("error of gradients and of T, n layers", "n")
    chain.line("n eps", lengths, [n * measured["eps"] for n in lengths], color=report.INK, lw=1.0, ls="--")
    for place, mode in enumerate(modes):
        # side by side, or equal errors would hide each other
        shifted = [n * 1.25 ** (place - 0.5 * (len(modes) - 1)) for n in lengths]
        chain.marks(mode, shifted, [errors[f"chain_{n}", mode]["gradient_error"] for n in lengths], STYLES[mode])
    recovered = [rounding.recovery_error(n) for n in lengths]
    chain.line("T recovered", lengths, recovered, color="#999999", lw=1.2)
    needle = Panel("error of det, worst of all angles", "scale ratio of the needle")
    for name, label, style in (("usual", "a c - b²", "stepwise"), ("ours", "sum of squares", "manual")):
        needle.marks(label, rounding.RATIOS, rounding.determinant_errors()[name], STYLES[style], ls="-")
    needle.line("", rounding.RATIOS, [1.0] * len(rounding.RATIOS), color=report.INK, ls="--")
    needle.notes.append(((rounding.RATIOS[0], 1.0), "no digit right", (0, 4), "left"))
    draw_panels(path, [chain, needle], 2, 2.8)


def main() -> None:
    out = parse(__doc__).out or ROOT / "output" / "compare"
    measured, cases = (json.loads((out / f"{name}.json").read_text()) for name in ("adjoints", "stability"))
    plot_memory(out / "memory.png", measured)
    plot_stages(out / "stages.png", measured)
    plot_stability(out / "stability.png", cases)


if __name__ == "__main__":
    main()

"""Training to the same end: every adjoint, the thesis's loop cap and the ellipsoid projection, in quality and time.

The adjoints give one gradient up to rounding. So their models should differ by less than those of two seeds. That is
tested before the first densification and at the end, because rounding may tip decisions. A cap on the entries of a
tile's list that a pixel looks at (2^11 in the thesis, to bound its tape) costs quality where lists are longer. Those of
the embedded scene hold some hundreds, so smaller caps are tried, too.

The short schedule is that of the embedded scene shrunk to 300 steps: densification at steps 100 and 150, the SH degree
up every 100 steps, the rate of the means at its end at step 300. PSNR is measured 12 times, on 8 held-out views at most
(all 7 of the embedded scene); time is that of training steps alone. Adjoints take three seeds, the others the first.

    python benchmarks/training_adjoints.py [-s SCENE] [--full] [--out docs/compare]
"""

import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import SCENE, option, parse, transcribe
from panels import Panel, draw_panels

from warp_splat.compare.workloads import CAPS, SHORT, named_scenes
from warp_splat.config import ADJOINTS
from warp_splat.errors import InputError
from warp_splat.evaluation import report
from warp_splat.evaluation.metrics import psnr, ssim
from warp_splat.formats.files import write_csv, write_json
from warp_splat.presets import EMBEDDED_DEFAULTS
from warp_splat.raster.drivers import driver_of
from warp_splat.raster.project import project
from warp_splat.scene import Scene, View
from warp_splat.text import table_of
from warp_splat.training.options import TrainConfig
from warp_splat.training.trainer import Trainer

SEEDS = (0, 1, 2)
EVALUATIONS, VIEWS = 12, 8
COMPARED = (1, 10, 99)  # steps after which parameters are compared; step 100 densifies
STYLES = ((report.BLUE, "-"), (report.ORANGE, "--"), (report.GREEN, "-."), ("#CC79A7", ":"))  # curves may coincide
COLUMNS = {
    "variant": lambda record: record["variant"] + " (refused)" * bool(record["refused"]),
    "PSNR [dB]": "{psnr:.2f}",
    "std over seeds": "{psnr_std:.2f}",
    "against manual": "{psnr_against_manual:+.2f}",
    "SSIM": "{ssim:.3f}",
    "Gaussians": "{gaussians:.0f}",
    "it/s": "{iterations_per_second:.1f}",
    "slowdown": "{slowdown:.2f}",
    "longest list": "{longest_list:.0f}",
    "lists cut": "{lists_cut:.1%}",
}


@dataclass
class Trained:
    """One training, or a trained model rendered in another way; NaN where there is no number."""

    scene: str
    variant: str
    seed: int
    psnr: float = math.nan  # dB, mean over the views
    ssim: float = math.nan
    gaussians: float = math.nan
    longest_list: float = math.nan  # of any tile in any view
    lists_cut: float = math.nan  # share of the tiles whose list is longer than the cap
    iterations_per_second: float = math.nan
    refused: str = ""  # why
    history: list[dict[str, float]] = field(default_factory=list)
    differences: list[dict[str, float]] = field(default_factory=list)  # of parameters, from manual with the first seed
    pictures: list[np.ndarray] = field(default_factory=list)  # of the views, [H, W, 3] uint8; first seed only


def run_trainings(
    out: Path,
    modes: Sequence[str],
    scenes: Mapping[str, Scene],
    full: bool = False,
    say: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Train all variants: about three minutes on two cores for four modes, an hour with ``full``.

    Args:
        out: folder for training.json, training.csv, training_modes.png and training_cap.jpg (of the last scene).
        modes: adjoints to compare, some of ``warp_splat.config.ADJOINTS``; "manual" is trained in any case.
        scenes: by name, with views held out.
        full: train by the embedded scene's whole schedule instead of the short one.
        say: receives a line for each run when those of its seed are done, and the tables.

    Returns:
        ``schedule``, ``runs``, ``summary`` (by variant) and ``equality`` (by scene), as written to training.json.

    Raises:
        InputError: if a file cannot be written.
    """
    out, names = Path(out), list(dict.fromkeys(("manual", *modes)))
    schedule = EMBEDDED_DEFAULTS[""] if full else SHORT
    variants: dict[str, dict[str, Any]] = {name: {"adjoint": name} for name in names}
    variants |= {f"cap {cap}": {"max_steps": cap} for cap in CAPS} | {"ellipsoid": {"projection": "ellipsoid"}}
    results: dict[str, Any] = {"schedule": schedule, "runs": [], "summary": [], "equality": {}}
    runs: list[Trained] = []
    for name, loaded in scenes.items():
        say(f"\nTraining on {name}, {schedule['iterations']} steps\n")
        found = train_all(loaded, name, variants, names, schedule, say)
        results["summary"] += (rows := summarize(found))
        results["equality"][name] = equality = compare_modes(found, names)
        say(f"\n{table_of(rows, COLUMNS)}\n\n{_verdict(equality) if equality else ''}")
        plot_cap(out / "training_cap.jpg", _views(loaded), found)
        runs += found
    results["runs"] = [{key: value for key, value in vars(r).items() if key != "pictures"} for r in runs]
    write_json(out / "training.json", results)
    flat = [{k: v for k, v in record.items() if not isinstance(v, list)} for record in results["runs"]]
    write_csv(out / "training.csv", flat)
    plot_modes(out / "training_modes.png", runs, names)
    return results


def train_all(
    scene: Scene, name: str, variants: Mapping, seeded: Sequence[str], schedule: Mapping, say
) -> list[Trained]:
    """Train every variant with the first seed and those ``seeded`` with all.

    The variants of a seed take their steps in turn, so that a disturbance of the machine meets all alike.
    """
    runs, rendered, reference = [], [], {}
    for options in variants.values():
        with suppress(InputError):  # the run itself will tell
            make_trainer(scene, schedule, SEEDS[0], **options).warm_up()
    for seed in SEEDS:
        results = [Trained(name, variant, seed) for variant in (variants if seed == SEEDS[0] else seeded)]
        trainers = [make_trainer(scene, schedule, seed, **variants[result.variant]) for result in results]
        trainings = [train_run(*pair, reference) for pair in zip(trainers, results, strict=True)]
        for _ in range(schedule["iterations"]):
            for result, steps in zip(results, trainings, strict=True):
                try:
                    next(steps, None)
                except InputError as error:
                    if result.variant == "manual":
                        raise
                    result.refused = str(error)  # "stored" may need more memory than there is
        for trainer, result in zip(trainers, results, strict=True):
            if not result.refused:
                _judge(trainer, result)
                result.iterations_per_second = schedule["iterations"] / result.history[-1]["seconds"]
            say(f"seed {seed}, {result.variant}: {result.refused or f'{result.psnr:.2f} dB'}")
        for cap in CAPS:  # what a cap costs that training knew nothing of
            trainers[0].options = replace(trainers[0].options, max_steps=cap)
            rendered.append(Trained(name, f"cap {cap}, rendering only", seed))
            _judge(trainers[0], rendered[-1])
        runs += results
    return runs + rendered


def make_trainer(scene: Scene, schedule: Mapping, seed: int, max_steps: int | None = None, **options) -> Trainer:
    """A trainer that has done nothing yet; ``max_steps`` caps the loop in training and in rendering."""
    trainer = Trainer(scene, TrainConfig(**{"device": "cpu", **schedule}, seed=seed, **options))
    trainer.options = replace(trainer.options, max_steps=max_steps)
    return trainer


def train_run(trainer: Trainer, result: Trained, reference: dict[int, torch.Tensor]) -> Iterator[None]:
    """Train, a step at a time, and note in ``result`` how it goes; ``reference`` keeps parameters of the first run."""
    last, views, seconds, losses = trainer.config.learn.iterations, _views(trainer.scene), 0.0, []
    checks = {last * k // EVALUATIONS for k in range(1, EVALUATIONS + 1)}
    for iteration in range(1, last + 1):
        start = time.perf_counter()
        losses.append(trainer.advance(iteration).item())  # no last update: a set densified just now is unsettled
        seconds += time.perf_counter() - start
        if iteration in checks:
            record = {"iteration": iteration, "seconds": seconds, "loss": float(np.mean(losses))}
            result.history.append({**record, "psnr": trainer.evaluate(views), "gaussians": len(trainer.model)})
            losses.clear()
        if (steps := iteration - 1) in COMPARED:
            parameters = torch.cat([tensor.detach().flatten() for tensor in trainer.model.parameters.values()])
            change = parameters - reference.setdefault(steps, parameters)
            rms = float(change.square().mean().sqrt())
            result.differences.append({"steps": steps, "largest": float(change.abs().max()), "rms": rms})
        yield


def _judge(trainer: Trainer, result: Trained) -> None:
    """Quality of the present model as the trainer's options render it, and the lengths of its tile lists."""
    views = _views(trainer.scene)
    pictures = [trainer.picture(view.camera) for view in views]
    for measure in (psnr, ssim):
        values = [measure(picture, view.picture, view.mask) for picture, view in zip(pictures, views, strict=True)]
        setattr(result, measure.__name__, float(np.mean(values)))
    lists, cap = np.concatenate([_list_lengths(trainer, view) for view in views]), trainer.options.max_steps
    result.gaussians, result.longest_list = len(trainer.model), int(lists.max())
    result.lists_cut = 0.0 if cap is None else float(np.mean(lists > cap))
    result.pictures = pictures if result.seed == SEEDS[0] else []


@torch.no_grad()
def _list_lengths(trainer: Trainer, view: View) -> np.ndarray:
    """Entries in the list of each tile of a view."""
    splats = project(trainer.model.activated(), view.camera, trainer.options)
    bins = driver_of(trainer.device).bin(splats, view.camera, trainer.options)
    return np.diff(bins.ranges.cpu().numpy())


def _views(scene: Scene) -> list[View]:
    held_out = scene.evaluated[1]
    return held_out[:: -(-len(held_out) // VIEWS)]


def summarize(runs: Sequence[Trained]) -> list[dict[str, Any]]:
    """A record for each variant: means over its seeds, and its gain and cost against manual with the same seed."""
    manual, records = {r.seed: r for r in runs if r.variant == "manual"}, []
    for variant in dict.fromkeys(r.variant for r in runs):
        every = [r for r in runs if r.variant == variant]
        record = {"scene": every[0].scene, "variant": variant, "seeds": len(every)}
        for key in ("psnr", "ssim", "gaussians", "longest_list", "lists_cut", "iterations_per_second"):
            record[key] = float(np.mean([getattr(r, key) for r in every]))
        record["psnr_std"] = float(np.std([r.psnr for r in every], ddof=1)) if len(every) > 1 else math.nan
        record["psnr_against_manual"] = float(np.mean([r.psnr - manual[r.seed].psnr for r in every]))
        speeds = [(manual[r.seed].iterations_per_second, r.iterations_per_second) for r in every]
        record["slowdown"] = float(np.mean([reference / own for reference, own in speeds]))
        record["refused"] = "; ".join({r.refused for r in every} - {""})
        records.append(record)
    return records


def compare_modes(runs: Sequence[Trained], modes: Sequence[str]) -> dict[str, Any]:
    """How far modes and how far seeds lie apart; without the modes refused, and empty if that leaves fewer than two."""
    runs = [r for r in runs if r.variant not in {r.variant for r in runs if r.refused}]
    of = {mode: chosen for mode in modes if (chosen := [r for r in runs if r.variant == mode])}
    if len(of) < 2:
        return {}
    values = np.array([[r.psnr for r in chosen] for chosen in of.values()])  # [modes, seeds]
    modes_std, seeds_std = (float(values.std(axis, ddof=1).mean()) for axis in (0, 1))
    groups = {"modes": [chosen[0] for chosen in of.values()][1:], "seeds": of["manual"][1:]}
    differ = "less than" if modes_std < seeds_std / 2 else "more than" if modes_std > 2 * seeds_std else "as much as"
    return {
        "modes_differ": differ,  # a few seeds tell a standard deviation within a factor of two or so
        "psnr_std_over_modes": modes_std,
        "psnr_std_over_seeds": seeds_std,
        "range_of_mean_psnr": float(np.ptp(values.mean(1))),
        "parameters": [
            {"steps": steps, "between": name, **{key: max(d[key] for d in found) for key in ("largest", "rms")}}
            for steps in COMPARED
            for name, group in groups.items()
            if (found := [d for r in group for d in r.differences if d["steps"] == steps])
        ],
    }


def _verdict(equality: Mapping[str, Any]) -> str:
    said = (
        "At the end modes differ {modes_differ} seeds do: the standard deviation of PSNR is {psnr_std_over_modes:.3f} "
        "dB over modes and {psnr_std_over_seeds:.3f} dB over seeds; the modes' means lie within "
        "{range_of_mean_psnr:.3f} dB. Before the first densification:\n\n"
    ).format(**equality)
    columns = {"steps": "{steps}", "parameters between": "{between}", "largest difference": "{largest:.1e}"}
    return said + table_of(equality["parameters"], {**columns, "rms difference": "{rms:.1e}"})


def plot_modes(path: Path, runs: Sequence[Trained], modes: Sequence[str]) -> None:
    """Draw PSNR over iterations and over seconds of training steps, by scene: each seed thin, their mean bold."""
    panels = []
    for scene, key in itertools.product(dict.fromkeys(r.scene for r in runs), ("iteration", "seconds")):
        panels.append(panel := Panel(f"{scene}: test PSNR [dB]", key))
        for mode, (color, dash) in zip(modes, STYLES, strict=False):
            histories = [r.history for r in runs if (r.scene, r.variant, r.refused) == (scene, mode, "")]
            curves = [[[record[k] for record in history] for k in (key, "psnr")] for history in histories]
            for x, y in curves:
                panel.line("", x, y, color=color, lw=0.5, alpha=0.5)
            if curves:
                panel.line(mode, *np.mean(curves, 0), ls=dash, color=color, lw=1.8)
    draw_panels(path, panels, 2, 2.8, xscale="linear", yscale="linear")


def plot_cap(path: Path, views: Sequence[View], runs: Sequence[Trained]) -> None:
    """Draw the view that the smallest cap hurts most: photograph, render and error without the cap and with it."""
    cap, of = f"cap {CAPS[-1]}", {r.variant: r.pictures for r in runs if r.pictures}
    losses = [psnr(a, v.picture) - psnr(b, v.picture) for a, b, v in zip(of["manual"], of[cap], views, strict=True)]
    index = int(np.argmax(losses))
    photo = views[index].picture
    renders = {"no cap": of["manual"][index], **{k: of[k][index] for k in (cap, f"{cap}, rendering only")}}
    rows = [(name, photo, render, f"{psnr(render, photo):.2f} dB") for name, render in renders.items()]
    report.contact_sheet(path, {"": rows})


def main() -> None:
    full = option("--full", action="store_true", help="train by the whole schedule instead of 300 steps")
    arguments = parse(__doc__, SCENE, full)
    scenes = named_scenes(str(arguments.scene or ""), print)

    def measure(out: Path, say: Callable[[str], None]) -> None:
        run_trainings(out, ADJOINTS, scenes, arguments.full, say)

    transcribe("training", arguments.out, measure)


if __name__ == "__main__":
    main()

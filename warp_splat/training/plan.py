"""From minutes to steps, sizes and Gaussians: arithmetic alone, on what was measured elsewhere.

The options of a training are the shape of a schedule: a plan stretches or shrinks all its steps by one factor, until
what they cost adds up to the time. Below the shape's own length there are also fewer Gaussians, by the square root of
that factor, and rates are higher by it, up to :data:`QUICKEST` times. The set grows at least as often as it has to
double. Below twice :data:`BRIEF`, photographs have their full size later, and the cooldown is shorter. A clock decides
on the end itself (:mod:`warp_splat.training.deadline`), so that a plan has to be good, but not exact.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from warp_splat.flags import flags_of
from warp_splat.scene.types import Scene
from warp_splat.training.growth import GROWTHS
from warp_splat.training.memory import expected_gaussians
from warp_splat.training.options import TrainConfig, schedule_of
from warp_splat.training.photographs import shrink_at

COOLDOWN = 0.2  # share of the steps, where the shape has none: the end needs a beginning
SHORTEST, LONGEST = 1e-4, 1e4  # times the shape
SAMPLES = 1000  # steps whose costs are added up
RATES = ("position_lr_init", "position_lr_final", "feature_lr", "opacity_lr", "scaling_lr", "rotation_lr")
QUICKEST = 2.0  # times the rates of the shape; four times lost 1 to 8 dB (benchmarks/short_plans.py)
BRIEF = 0.15  # times the shape, down to which the full size comes later and later (docs/recipes.md)
EARLY = 4  # densifications of a plan with too many points, at least: the first one takes the rest away
LIKE = 1.5  # factor between the steps and between the pixels of two trainings, up to which they are comparable


class StepTime(NamedTuple):
    """What a step takes."""

    gaussians: int
    pixels: int
    seconds: float


class Cost(NamedTuple):
    """Seconds of a step: a part of its own, one of each Gaussian, and one of each pixel."""

    step: float
    gaussian: float
    pixel: float

    @classmethod
    def of(cls, measured: Sequence[StepTime]) -> "Cost":
        """The costs, none negative, with the least squared error relative to each measurement."""
        from scipy.optimize import nnls  # noqa: PLC0415 - slow to load, and only --minutes needs it

        rows = np.array([(1.0, m.gaussians, m.pixels, m.seconds) for m in measured], dtype=np.float64)
        size = rows[:, :3].max(0)  # so that the columns are of one order
        found = nnls(rows[:, :3] / rows[:, 3:] / size, np.ones(len(rows)))[0] / size
        return cls(*found.tolist())


class Task(NamedTuple):
    """What of a scene a plan depends on."""

    pixels: int  # of a photograph at its full size
    start: int  # Gaussians at the start, where a plan has as many
    least: int  # that a plan has: those of the start, but where a growth shrinks, not more than are allowed
    most: int  # Gaussians that the shape is made for
    shares: tuple[float, ...]  # of --coarse_until_iter, where sizes end


def task_of(config: TrainConfig, scene: Scene, shares: tuple[float, ...]) -> Task:
    """Of a scene; ``shares`` as :func:`shares_of_size` gives them."""
    camera = scene.train[0].camera
    pixels = camera.width * camera.height
    start = len(scene.points)  # those of --start_ply are its Gaussians' centers
    most = config.grow.max_gaussians or expected_gaussians(start, pixels)[0]
    shrinks = getattr(GROWTHS[config.grow.growth].load(), "shrinks", False) and not scene.start
    return Task(pixels, start, min(start, most) if shrinks else start, most, shares)


def seconds_of(config: TrainConfig, cost: Cost, task: Task) -> float:
    """What a training takes by the costs of its steps; Gaussians are added as the square root of the steps that do."""
    learn, options = config.learn, config.flat()
    steps = (np.arange(SAMPLES) + 0.5) * learn.iterations / SAMPLES
    sides = 1.0 / np.array([shrink_at(learn, task.shares, step) for step in steps])
    begin, end = options["densify_from_iter"], min(options["densify_until_iter"], learn.iterations)
    grown = np.sqrt(((steps - begin) / max(end - begin, 1)).clip(0.0, 1.0))
    most = max(config.grow.max_gaussians or task.most, task.least)
    start = min(task.start, most)
    gaussians = start + grown * (most - start)
    each = cost.step + cost.gaussian * gaussians + cost.pixel * task.pixels * sides**2
    return float(each.mean()) * learn.iterations


def of_length(config: TrainConfig, factor: float, task: Task) -> TrainConfig:
    """The same shape over ``factor`` times as many steps, with a cooldown."""
    least = {item.name: max(item.metadata["least"], 1) for item in flags_of(TrainConfig) if item.metadata["schedule"]}
    steps = schedule_of(config)
    steps["cooldown"] = steps["cooldown"] or round(COOLDOWN * steps["iterations"])
    share, late = max(task.shares, default=0.0), min(max(2 - factor / BRIEF, 0.0), 1.0)
    if share * late and (full := steps["iterations"] - share * steps["coarse_until_iter"]) > 0:
        brief = min(max((1 - share) * steps["iterations"], 0.5 * full), full)  # no later than sizes take all steps
        brief = full - late * (full - brief)
        steps["coarse_until_iter"] = (steps["iterations"] - brief) / share
        steps["cooldown"] *= brief / full
    steps = {name: max(round(factor * value), least[name]) if value > 0 else value for name, value in steps.items()}
    shorter = min(factor, 1.0) ** 0.5
    most = max(round(task.most * shorter), task.least)
    quicker = min(1.0 / shorter, QUICKEST)
    rates = {name: float(f"{quicker * getattr(config.learn, name):.3g}") for name in RATES if factor < 1}
    steps["settle_from_iter"] = 0  # the clock says when to settle
    interval = config.flat()["densification_interval"]
    doublings = math.ceil(math.log2(most / task.start)) if most >= task.start else EARLY
    window = steps["densify_until_iter"] - 1 - max(steps["densify_from_iter"], 0)
    interval = min(interval, max(window // max(doublings, 1), 1))
    return config.changed(**steps, **rates, max_gaussians=most, densification_interval=interval)


def plan_for(config: TrainConfig, cost: Cost, seconds: float, task: Task) -> TrainConfig:
    """The shape ``config`` over as many steps as fit into ``seconds``, and one at least."""
    low, high = np.log(SHORTEST), np.log(LONGEST)
    for _ in range(40):
        middle = (low + high) / 2
        fits = seconds_of(of_length(config, float(np.exp(middle)), task), cost, task) <= seconds
        low, high = (middle, high) if fits else (low, middle)
    return of_length(config, float(np.exp(low)), task)


def as_flags(config: TrainConfig) -> str:
    """The schedule as flags of the command line; those of growths and parts that are at work."""
    used = {config.grow.growth, *config.model.parts.split(",")}
    idle = {name for group, options in config.plugins.items() if group not in used for name in vars(options)}
    idle -= {name for group in used if group in config.plugins for name in vars(config.plugins[group])}
    if not config.learn.settle_from_iter:
        idle.add("settle_from_iter")
    shown, values = {name: value for name, value in schedule_of(config).items() if name not in idle}, config.flat()
    shown |= {name: getattr(config.learn, name) for name in ("coarse", "coarse_by", *RATES)}
    shown |= {name: values[name] for name in ("max_gaussians", "densification_interval")}
    preset = f"--preset {config.data.preset} " if config.data.preset else ""
    return preset + " ".join(f"--{name} {value}" for name, value in shown.items())


class Reached(NamedTuple):
    """What a training reached, as benchmarks/minutes.py noted it."""

    scene: str
    pixels: int
    minutes: float
    iterations: int
    gaussians: int
    psnr: float


def comparable(table: Sequence[Reached], config: TrainConfig, task: Task) -> str:
    """A sentence: what scenes of about this size reached by about as many steps, or what the table has else."""
    steps = config.learn.iterations
    alike = lambda one, other: max(one, other) <= LIKE * min(one, other)  # noqa: E731
    if near := [entry for entry in table if alike(entry.pixels, task.pixels) and alike(entry.iterations, steps)]:
        told = (f"{entry.psnr:.1f} dB ({entry.scene}, {entry.iterations} steps)" for entry in near)
        return f"Comparable trainings reached {', '.join(told)} on held-out views; another scene is another matter."
    told = (f"{e.scene}, {e.pixels / 1e6:.2f} megapixels, {e.iterations} steps: {e.psnr:.1f} dB" for e in table)
    here = f"{task.pixels / 1e6:.2f} megapixels and {steps} steps"
    return f"Nothing comparable was measured for {here}. There is: {'; '.join(told)}."

"""A training that ends in time: the machine is measured before the first step, and a clock is asked after each."""

import json
import math
import statistics
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from warp_splat.errors import InputError
from warp_splat.runtime.distributed import ALONE, Processes
from warp_splat.scene.types import Scene
from warp_splat.training.options import LearnOptions, TrainConfig
from warp_splat.training.plan import Cost, Reached, StepTime, Task, as_flags, comparable, plan_for, seconds_of, task_of
from warp_splat.training.trainer import Trainer
from warp_splat.training.trial import suggested

REACHED = Path(__file__).with_name("reached.json")  # what benchmarks/minutes.py measured
REPEATS = 5  # steps of which one is timed: their median
WINDOW = 20  # parts of a training: as far back as the pace is looked at, which is from one evaluation to the next
APART = 50  # images between two evaluations, at least
FULL_WINDOW = 8  # likewise, of the steps at full size
FEWEST = 10  # images by which a pace is known
WIDER = 1.35  # than copies that cover what the start does: so they take 0.8 to 1.05 of trained ones' time (4 scenes)
KEPT = 4  # a cooldown is never shorter than one part in so many of the planned one


class Deadline:
    """Whether to settle now, so that the last step of the cooldown ends in time.

    It sees seconds and no clock. Only what is still to come may change: :attr:`LearnOptions.settle_from_iter`, and the
    length of the cooldown. So a training with these flags from its beginning makes the same bytes.

    Args:
        learn: as planned.
        shares: of --coarse_until_iter, where sizes of photographs end.
        count: images in a step.
    """

    def __init__(self, learn: LearnOptions, shares: Sequence[float] = (), count: int = 1):
        self.seconds, self.cooldown = 60.0 * learn.minutes, learn.cooldown
        self.full_size = learn.coarse_until_iter * shares[-1] if shares else 0.0  # the step from which they have it
        self.fewest = max(-(-FEWEST // count), 2)
        window = min(max(learn.iterations / WINDOW, APART), (learn.iterations - self.full_size) / FULL_WINDOW)
        self.past: deque[tuple[int, float]] = deque(maxlen=max(int(window / count), self.fewest))
        self.near = math.inf  # the step since which the end is near by each pace that was seen

    def due(self, iteration: int, spent: float, processes: Processes = ALONE) -> int:
        """The steps of a cooldown that begins now; 0: not yet. All processes call it; the first one's clock counts.

        Args:
            iteration: the last one that was done.
            spent: seconds since the first step.
            processes: those that train together.
        """
        steps = 0
        if iteration >= self.full_size:
            self.past.append((iteration, spent))
            first, then = self.past[0]
            left = (self.seconds - spent) * (iteration - first) / max(spent - then, 1e-9)
            if left > self.cooldown + iteration - first:
                self.near = math.inf
            elif len(self.past) == self.past.maxlen:
                self.near = min(self.near, iteration)
            # in time, by a pace that has been the same for a while; late, by the few steps there are
            late = left <= self.cooldown / 2 and len(self.past) >= self.fewest
            if late or (left <= self.cooldown and first >= self.near):
                steps = max(round(left), self.cooldown // KEPT, 1)
        return processes.largest(steps if processes.rank == 0 else 0)


def plan_training(scene: Scene, config: TrainConfig, processes: Processes, say: Callable[[str], None]) -> TrainConfig:
    """The options that a training of ``config.learn.minutes`` begins with: measured, planned, and told.

    Raises:
        InputError: if there is too little time for one change of the set of Gaussians, or the schedule does not fit.
    """
    minutes, learn = config.learn.minutes, config.learn
    say("Measuring this machine (kernels are compiled first, once on a machine, about 20 s) ...")
    measured_as = suggested(config, scene).changed(settle_from_iter=1, minutes=0.0)  # its set stays as it is
    trial = Trainer(scene, measured_as, processes)
    trial.warm_up()
    task = task_of(config, scene, trial.photographs.shares)
    if (late := max(learn.coarse_until_iter * max(task.shares, default=0), learn.cooldown)) > learn.iterations:
        raise InputError(
            f"--minutes: expected full size and cooldown in {learn.iterations} iterations, got {late:.0f}; lower "
            "coarse_until_iter, or cooldown."
        )
    cost = cost_of(trial, task, say)
    plan, images = plan_for(config, cost, 60.0 * minutes, task), processes.images
    plan = plan.changed(iterations=-(-plan.learn.iterations // images) * images)  # whole steps, as when it is repeated
    say(f"Plan for {minutes:g} minutes ({seconds_of(plan, cost, task):.0f} s by these figures): {as_flags(plan)}")
    if trial.growth.grows(config.learn.iterations):
        steps = plan.learn.iterations
        if not Trainer(scene, suggested(plan, scene), processes).growth.grows(steps - plan.learn.cooldown):
            raise InputError(
                f"--minutes {minutes:g}: expected time for one densification at least, found time for {steps} steps "
                "before the end; give more, or smaller images (-r)."
            )
    say(comparable([Reached(**entry) for entry in json.loads(REACHED.read_text())], plan, task))
    return plan


def cost_of(trial: Trainer, task: Task, say: Callable[[str], None]) -> Cost:
    """What steps cost on this machine, for each image, as ``trial`` takes a few; it is of no use afterwards."""
    processes = trial.processes
    measured = processes.first(_measured(trial, task))
    for row in measured:
        say(f"  {1e3 * row.seconds:.1f} ms a step with {row.gaussians} Gaussians and {row.pixels} pixels")
    return Cost.of([row._replace(seconds=row.seconds / processes.images) for row in measured])


def _measured(trial: Trainer, task: Task) -> list[StepTime]:
    """Steps of the smallest size and the full one, and of as many Gaussians as there will be."""
    end = trial.config.learn.iterations
    found = [_of_step(trial, 1), _of_step(trial, end)]
    if (most := max(task.most, task.least)) != task.start:
        _resize(trial, most)
        found.append(_of_step(trial, end))
    return found


def _of_step(trial: Trainer, iteration: int) -> StepTime:
    """Of the size and the degree that an iteration has."""
    seconds = []
    for _ in range(1 + REPEATS):  # the first one brings memory and photographs
        begun = time.perf_counter()
        trial.differentiate(iteration).item()  # waits for a GPU
        trial.update(iteration)
        seconds.append(time.perf_counter() - begun)
    camera, _ = trial.photographs.at_size(trial.scene.train[0], iteration)
    return StepTime(len(trial.model), camera.width * camera.height, statistics.median(seconds[1:]))


def _resize(trial: Trainer, count: int) -> None:
    """Copies of the Gaussians, or some of them, so wide that a step takes about what it will with trained ones."""
    present = len(trial.model)
    raw = {name: tensor.detach() for name, tensor in trial.model.parameters.items()}
    raw["scales"].add_(math.log(WIDER / math.sqrt(count / present)))
    rows = torch.arange(count, device=trial.device) * present // count
    trial.optimizer.replace(rows[:0], {name: tensor[rows] for name, tensor in raw.items()})

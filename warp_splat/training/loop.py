"""The training loop: a step, then what is due between two steps.

A step is two methods of the trainer, which ``advance`` calls: ``update`` changes the model by the gradients of the step
before, and ``differentiate`` finds those of another view. Between two steps the held-out views are measured, models and
checkpoints are written, and the viewer draws. This page and those two methods are the whole of a training.
"""

import sys
import time

import numpy as np
import torch
from tqdm import tqdm

from warp_splat.errors import InputError
from warp_splat.formats.png import save_png
from warp_splat.runtime import timers
from warp_splat.training.deadline import APART, Deadline
from warp_splat.training.live import TrainingViewer
from warp_splat.training.record import Run, keep, save_or_warn, warn
from warp_splat.training.trainer import Trainer

EVALUATIONS = 20  # over the run, at most, besides --test_iterations
PROGRESS_VIEWS = 8  # at most, in the evaluations while training
PREVIEW_SECONDS = 5.0
KEEP, STOP = 1, 2  # what a process may wish after a step: a checkpoint, an end


def train_steps(trainer: Trainer, run: Run, interrupted: list[int], viewer: TrainingViewer | None) -> None:
    """Train until the last step, or until Ctrl-C has put a signal into ``interrupted``."""
    report, processes = trainer.config.report, trainer.processes
    deadline = Deadline(trainer.config.learn, trainer.photographs.shares, processes.images)
    unprofiled = None  # iteration and seconds before the last --profile steps
    trainer.check_identical(run.iteration)
    with _progress_bar(trainer, run) as bar, timers.profile(report.profile > 0) as stages:
        while run.iteration < trainer.config.learn.end:
            iteration = run.iteration + processes.images
            if unprofiled is None and iteration > trainer.config.learn.end - report.profile:
                stages.clear()
                unprofiled = run.iteration, run.seconds
            start = time.perf_counter()
            run.losses.append(trainer.advance(iteration))  # models and checkpoints are of before its update
            run.iteration = iteration
            done = time.perf_counter()
            run.seconds += done - start
            run.spent += done - start
            stop = _do_what_is_due(trainer, run, interrupted, bar)
            bar.update(processes.images)
            if stop:
                break
            run.spent += time.perf_counter() - done
            if trainer.config.learn.minutes and (cooldown := deadline.due(iteration, run.spent, processes)):
                trainer.settle(iteration + 1, cooldown)
                bar.total = trainer.config.learn.end
            if report.viewer:
                trainer.lead(lambda: viewer and viewer.between_steps(interrupted))
    run.dropped = trainer.all_dropped()
    if report.profile and unprofiled:
        steps = (run.iteration - unprofiled[0]) // processes.images
        times = {name: 1e3 * seconds / steps for name, seconds in stages.items()}
        run.stages = {**times, "host": max(1e3 * (run.seconds - unprofiled[1]) / steps - sum(times.values()), 0.0)}


def _do_what_is_due(trainer: Trainer, run: Run, interrupted: list[int], bar: tqdm) -> bool:
    """Evaluate, write a checkpoint, save the model, as far as it is time; returns whether training ends here."""
    learn, report, processes = trainer.config.learn, trainer.config.report, trainer.processes
    keeping_is_due = 0 < 60 * report.checkpoint_interval <= time.perf_counter() - run.kept_at
    wish = processes.largest(STOP if interrupted else KEEP if keeping_is_due else 0)
    stop = wish == STOP or run.iteration >= learn.end
    checks = min(EVALUATIONS, learn.iterations // APART)
    some = [learn.iterations * k // checks for k in range(1, checks)]
    whole = processes.reaches(run.iteration, [*report.test_iterations, learn.end])
    check = whole or processes.reaches(run.iteration, some)
    named = processes.reaches(run.iteration, report.checkpoint_iterations)
    if check:
        try:
            _check(trainer, run, bar, whole)
        except InputError:  # a photograph has gone, but the model is whole
            if processes.count == 1:
                keep(trainer, run, named)
            raise
    if stop or wish == KEEP or named:
        keep(trainer, run, named)
    if stop and not check:  # after the checkpoint: a run that goes on from there never had this record
        _check(trainer, run, bar, whole=False)
    if processes.reaches(run.iteration, report.save_iterations) and not stop:
        trainer.lead(lambda: save_or_warn(trainer, run))
    return stop


def _progress_bar(trainer: Trainer, run: Run) -> tqdm:
    pause = 0.1 if sys.stderr.isatty() else 10.0  # seconds between two lines; a log keeps them all
    often = {"mininterval": pause, "maxinterval": pause, "miniters": 0}
    total, quiet = trainer.config.learn.end_or_plan, trainer.config.report.quiet
    return tqdm(total=total, initial=run.iteration, disable=quiet, unit="it", **often)


@timers.profile(False)
def _check(trainer: Trainer, run: Run, bar: tqdm, whole: bool) -> None:
    """Measure PSNR on the held-out views (a few of them, unless ``whole``), note it, show it, refresh the preview."""
    trainer.check_identical(run.iteration)
    run.gaussians = trainer.processes.total(len(trainer.model))
    trainer.lead(lambda: _measure(trainer, run, bar, whole))
    run.losses = []


def _measure(trainer: Trainer, run: Run, bar: tqdm, whole: bool) -> None:
    """What the first process does of :func:`_check`."""
    split, views = trainer.scene.evaluated
    if not whole:
        views = views[:: -(-len(views) // PROGRESS_VIEWS)]
    values = torch.stack(run.losses).double().cpu().numpy()
    record = {
        "iteration": run.iteration,
        "loss": float(np.mean(values)),
        "psnr": trainer.evaluate(views),
        "gaussians": run.gaussians,
        "seconds": run.seconds,
    }
    run.history.append(record)
    images = trainer.processes.images
    first = run.iteration - (len(values) - 1) * images
    points = [(first + place * images, "train/loss", loss) for place, loss in enumerate(values)]
    shown = {f"{split}/psnr_on_the_way": record["psnr"], "gaussians": record["gaussians"], "seconds": record["seconds"]}
    run.events.write(points + [(run.iteration, name, value) for name, value in shown.items()])
    text = f"loss {record['loss']:.4f}, {split} PSNR {record['psnr']:.2f}, {record['gaussians']} Gaussians"
    bar.set_postfix_str(text, refresh=False)
    if time.perf_counter() - run.preview > PREVIEW_SECONDS:
        run.preview = time.perf_counter()
        view = trainer.refined(views)[len(views) // 2]
        try:
            picture = trainer.picture(view.camera, view.name)
            save_png(run.folder / "preview.png", np.concatenate([view.picture, picture], 1))
        except InputError as error:
            warn(error)

"""A whole training run: scene in; model, pictures, plots and numbers out."""

from __future__ import annotations

import sys
import time
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from tqdm import tqdm

from warp_splat.errors import InputError
from warp_splat.formats import model_folder
from warp_splat.formats.checkpoint import Checkpoint, load_checkpoint
from warp_splat.formats.png import save_png
from warp_splat.runtime import pool, timers
from warp_splat.runtime.devices import memory_explained
from warp_splat.runtime.distributed import GroupError, Processes, join
from warp_splat.runtime.interrupts import interruptible
from warp_splat.training import memory
from warp_splat.training.config_file import write_config
from warp_splat.training.deadline import Deadline, plan_training
from warp_splat.training.opening import Say, open_scene, refuse_other_training, resolve, speaker, write_inputs
from warp_splat.training.options import ReportOptions, TrainConfig, check_train
from warp_splat.training.parts import PARTS
from warp_splat.training.record import (
    Run,
    finish,
    how_to_continue,
    keep,
    restore,
    save_model,
    save_or_warn,
    warn,
)
from warp_splat.training.tensorboard import EventLog
from warp_splat.training.trainer import Trainer
from warp_splat.training.trial import settle_parts

if TYPE_CHECKING:
    from warp_splat.training.live import TrainingViewer

EVALUATIONS = 20  # over the run, besides --test_iterations
PROGRESS_VIEWS = 8  # at most, in the evaluations while training
PREVIEW_SECONDS = 5.0
KEEP, STOP = 1, 2  # what a process may wish after a step: a checkpoint, an end


def train(config: TrainConfig) -> int:
    """Train as ``config`` says; returns the process's exit code.

    1: the model could not be written into its folder and was saved elsewhere. 130: interrupted, the model saved.

    Raises:
        InputError: if an option, the scene or the output folder is not usable; at the end, if the model, which is
            saved, has not the hash that ``verify`` asks for.
    """
    check_train(config)
    with join(config.machine.device) as processes:
        if config.report.viewer and processes.count > 1:
            raise InputError("--viewer: expected one process, since others would wait for it; leave it out.")
        return _train(config, processes)


def _train(config: TrainConfig, processes: Processes) -> int:
    """Resolve the options, open the scene, make the trainer, restore it or begin, run, and finish."""
    config, begun = resolve(config, processes)
    say = speaker(config.report.quiet)
    run = Run(Path(config.report.model_path), time.perf_counter())
    scene = open_scene(config, begun, say)
    if config.learn.minutes and not begun:
        config = plan_training(scene, config, processes, say)
    config, weighed = settle_parts(config, scene, processes, say)
    trainer = Trainer(scene, config, processes)
    trainer.told = weighed + trainer.told
    _tell(trainer, run, say)
    with model_folder.claimed(run.folder) if processes.rank == 0 else nullcontext(), _memory_explained(trainer):
        _restore_or_begin(trainer, run, begun, say)
        with _watched(trainer, run) as viewer:
            return _run(trainer, run, viewer) or _finish(trainer, run, viewer, say)


def _tell(trainer: Trainer, run: Run, say: Say) -> None:
    scene, processes = trainer.scene, trainer.processes
    together = f"{processes.count} processes with " * (processes.count > 1)
    width, height = scene.train[0].camera.width, scene.train[0].camera.height
    say(
        f"{len(scene.train)} training views, {len(scene.test)} test views, {width} x {height} px; "
        f"{len(scene.points)} points; {together}{pool.get_threads()} threads; output in {run.folder}"
    )
    for sentence in trainer.told:
        say(sentence)


def _restore_or_begin(trainer: Trainer, run: Run, begun: Checkpoint | None, say: Say) -> None:
    leads, config = trainer.processes.rank == 0, trainer.config
    if leads:
        refuse_other_training(run.folder, begun)  # again: one may have ended meanwhile
    say("Preparing kernels (compiled once on a machine, about 40 s) ...")
    start = time.perf_counter()
    trainer.warm_up()
    say(f"Kernels ready after {time.perf_counter() - start:.1f} s")
    if begun:
        restore(trainer, run, load_checkpoint(begun.path))
        say(f"Continuing after {run.iteration} iterations, from {begun.path}")
        before = begun.facts["options"].get("parts", "").split(",")
        for name in filter(lambda name: name in PARTS and name not in config.used_parts, before):
            say(f"Warning: the part {name} is left out from here on, with what it learned; --parts names those kept.")
    else:
        keep(trainer, run)
    if leads:  # only now: where a checkpoint is refused, the folder stays as it was
        write_inputs(run.folder, config, trainer.scene, continues=begun is not None)
    if leads and config.report.tensorboard:
        run.events = EventLog.open(run.folder, run.iteration)
    if config.machine.device == "cpu":
        say(memory.describe(trainer))


def _run(trainer: Trainer, run: Run, viewer: TrainingViewer | None) -> int:
    """Train and save; 1 if another process went away."""
    processes = trainer.processes
    with interruptible() as interrupted:
        if viewer:  # only now: who has read it may press Ctrl-C
            print(viewer.viewer.announcement, flush=True)
        try:
            _loop(trainer, run, interrupted, viewer)
        except GroupError as error:  # said here, where torchrun's SIGTERM does not end this process yet
            tqdm.write(f"warp-splat: error: {error}", file=sys.stderr)
            return 1
        finally:  # whatever happened, the model comes first
            if processes.rank == 0 or processes.lost:
                run.saved = save_model(trainer, run)
                print(f"Model after {run.iteration} iterations: {run.saved}")
            if run.kept is not None and run.iteration < trainer.config.learn.end:
                print(f"To continue after iteration {run.kept}: {how_to_continue(run.folder, processes)}")
    return 0


def _finish(trainer: Trainer, run: Run, viewer: TrainingViewer | None, say: Say) -> int:
    """Evaluate and tell; returns the process's exit code."""
    end = trainer.config.learn.end
    if viewer:
        viewer.show_end()
    if trainer.processes.rank == 0:
        finish(trainer, run, say)
    if viewer and run.iteration >= end:
        viewer.linger()
    if run.saved and run.saved != model_folder.ply_path(run.folder, run.iteration):
        elsewhere = f"The model is not in {run.folder}, but in {run.saved}; see the warning, and move it."
        tqdm.write(elsewhere, file=sys.stderr)
        return 1
    if run.iteration < end:
        return 130
    verify = trainer.config.report.verify
    if trainer.processes.rank == 0 and not run.sha256.startswith(verify):
        raise InputError(
            f"--verify: expected a model whose sha256 begins with {verify}, got {run.sha256}; another scene, version, "
            "option or kind of device makes another model, see docs/platforms.md."
        )
    return 0


def _watched(trainer: Trainer, run: Run) -> AbstractContextManager[TrainingViewer | None]:
    """The viewer, if one is asked for."""
    if not trainer.config.report.viewer:
        return nullcontext()
    from warp_splat.training.live import watched  # noqa: PLC0415 - viser takes half a second to load

    return watched(trainer, run)


def _memory_explained(trainer: Trainer):
    """See :func:`memory_explained`."""
    fewer = ["fewer Gaussians (--max_gaussians)", "smaller images (-r)"]
    if trainer.config.machine.data_device == "cuda":
        fewer.append("--data_device cpu")
    sizes = [(view.camera.width, view.camera.height) for view in trainer.scene.train]
    return memory_explained(trainer.device, trainer.model, sizes, f"train with {' or '.join(fewer)}")


def _loop(trainer: Trainer, run: Run, interrupted: list[int], viewer: TrainingViewer | None) -> None:
    learn, report, processes = trainer.config.learn, trainer.config.report, trainer.processes
    checks = {learn.iterations * k // EVALUATIONS for k in range(1, EVALUATIONS)}
    profiled, before_profile = max(learn.end - report.profile, run.iteration), run.seconds
    deadline = Deadline(learn, trainer.photographs.full_size_from, processes.count)
    pause = 0.1 if sys.stderr.isatty() else 10.0  # seconds between two lines; a log keeps them all
    often = {"mininterval": pause, "maxinterval": pause, "miniters": 0}
    bar = tqdm(total=learn.end_or_plan, initial=run.iteration, disable=report.quiet, unit="it", **often)
    trainer.check_identical(run.iteration)
    with bar, timers.profile(report.profile > 0) as stages:
        while run.iteration < (end := trainer.config.learn.end):
            iteration, whole_checks = run.iteration + processes.count, {*report.test_iterations, end}
            if processes.reaches(iteration, [profiled + 1]):
                stages.clear()
                before_profile = run.seconds
            start = time.perf_counter()
            if run.iteration:  # now, since models and checkpoints are those of before the update
                trainer.update(run.iteration)
            run.losses.append(trainer.differentiate(iteration))
            run.iteration = iteration
            done = time.perf_counter()
            run.seconds += done - start
            run.spent += done - start
            wish = processes.largest(STOP if interrupted else KEEP if _keeping_is_due(report, run) else 0)
            stop = wish == STOP or iteration >= end
            check, whole = (processes.reaches(iteration, marks) for marks in (checks | whole_checks, whole_checks))
            named = processes.reaches(iteration, report.checkpoint_iterations)
            if check:
                _check(trainer, run, bar, whole)
            if stop or wish == KEEP or named:
                keep(trainer, run, named)
            if stop and not check:  # after the checkpoint: a run that goes on from there never had this record
                _check(trainer, run, bar, whole=False)
            if processes.reaches(iteration, report.save_iterations) and not stop:
                save_or_warn(trainer, run)
            bar.update(processes.count)
            if stop:
                break
            run.spent += time.perf_counter() - done
            if trainer.config.learn.minutes and (cooldown := deadline.due(iteration, run.spent, processes)):
                trainer.settle(iteration + 1, cooldown)
                profiled = max(trainer.config.learn.end - report.profile, iteration)
                bar.total = trainer.config.learn.end
                if processes.rank == 0:
                    write_config(run.folder, trainer.config)
            if viewer:
                viewer.between_steps(interrupted)
    run.dropped = trainer.quarantine.read(processes)
    steps = -(-(run.iteration - profiled) // processes.count)
    if report.profile and steps > 0:
        times = {name: 1e3 * seconds / steps for name, seconds in stages.items()}
        step = 1e3 * (run.seconds - before_profile) / steps
        run.stages = {**times, "host": max(step - sum(times.values()), 0.0)}


def _keeping_is_due(report: ReportOptions, run: Run) -> bool:
    return 0 < 60 * report.checkpoint_interval <= time.perf_counter() - run.kept_at


@timers.profile(False)
def _check(trainer: Trainer, run: Run, bar: tqdm, whole: bool) -> None:
    """Measure PSNR on the held-out views (a few of them, unless ``whole``), note it, show it, refresh the preview."""
    trainer.check_identical(run.iteration)
    losses, run.losses = run.losses, []
    if trainer.processes.rank > 0:
        return
    split, views = trainer.scene.evaluated
    if not whole:
        views = views[:: -(-len(views) // PROGRESS_VIEWS)]
    values = torch.stack(losses).double().cpu().numpy()
    record = {
        "iteration": run.iteration,
        "loss": float(np.mean(values)),
        "psnr": trainer.evaluate(views),
        "gaussians": len(trainer.model),
        "seconds": run.seconds,
    }
    run.history.append(record)
    run.events.write_losses(run.iteration, values, trainer.processes.count)
    run.events.write_record(record, split)
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

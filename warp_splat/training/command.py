"""A whole training run: scene in; model, pictures, plots and numbers out."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from tqdm import tqdm

from warp_splat.config import TrainConfig, check_train
from warp_splat.errors import InputError
from warp_splat.evaluation.perceptual import choose_metrics
from warp_splat.formats import model_folder
from warp_splat.formats.checkpoint import LAST, Checkpoint, load_checkpoint, remove_leftovers
from warp_splat.formats.config_file import write_config
from warp_splat.formats.ply import save_points
from warp_splat.formats.png import save_png
from warp_splat.raster.selftest import settle_device
from warp_splat.runtime import launch
from warp_splat.runtime.devices import memory_explained
from warp_splat.runtime.distributed import GroupError, Processes, join
from warp_splat.runtime.interrupts import interruptible
from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene
from warp_splat.scene.types import Scene
from warp_splat.training import memory
from warp_splat.training.record import Run, finish, how_to_continue, keep, restore, save_model, save_or_warn, warn
from warp_splat.training.tensorboard import EventLog, check_available
from warp_splat.training.trainer import Trainer

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
        InputError: if an option, the scene or the output folder is not usable.
    """
    problem = check_train(config)
    if problem:
        raise InputError(problem)
    with join(config.device) as processes:
        if config.viewer and processes.count > 1:
            raise InputError("--viewer: expected one process, since others would wait for it; leave it out.")
        return _train(config, processes)


def _train(config: TrainConfig, processes: Processes) -> int:
    leads = processes.rank == 0
    config.quiet |= not leads
    say = (lambda *_: None) if config.quiet else tqdm.write
    threads = config.threads or max(1, launch.get_threads() // processes.local_count)
    choose_metrics(config.lpips_weights)  # what would be missed at the end is said now
    if config.tensorboard:
        check_available()
    checkpoint = load_checkpoint(config.start_checkpoint) if config.start_checkpoint else None
    begun = checkpoint.count("iteration") if checkpoint else 0
    if checkpoint and begun > config.iterations:  # at the end, what is written there is written again
        raise InputError(
            f"--iterations {config.iterations}: expected at least the {begun} after which {checkpoint.path} was "
            "written; name a later end."
        )
    config.iterations += -(config.iterations - begun) % processes.count  # whole steps
    folder = _choose_folder(config, checkpoint)
    device = settle_device(launch.prepare(config.device, threads), config.device, [config.adjoint], say)
    config.device = device.type
    if config.data_device == "cuda" and device.type != "cuda":
        raise InputError("--data_device cuda: expected training on a GPU, too; use --data_device cpu.")
    if config.sfm:
        from warp_splat.sfm.command import scene_for  # noqa: PLC0415 - only photographs without cameras need it

        config.source_path = scene_for(config, processes.count)
    config.source_path = os.path.abspath(config.source_path or embedded_scene())  # render.py may run elsewhere
    config.start_ply = config.start_ply and os.path.abspath(config.start_ply)
    started = time.perf_counter()
    say(f"Scene {config.source_path}")
    if config.coarse > 1 and config.coarse_until_iter > config.iterations:
        say(f"Warning: images reach their full size at --coarse_until_iter {config.coarse_until_iter}, after the end.")
    scene = load_scene(
        config.source_path,
        images=config.images,
        resolution=config.resolution,
        white_background=config.white_background,
        eval=config.eval,
        invert_masks=config.invert_masks,
        start=config.start_ply if not checkpoint or os.path.isfile(config.start_ply) else "",  # if it has gone
        report=say,
    )
    run = Run(Path(processes.first(str(folder))), started)
    together = f"{processes.count} processes with " * (processes.count > 1)
    width, height = scene.train[0].camera.width, scene.train[0].camera.height
    say(
        f"{len(scene.train)} training views, {len(scene.test)} test views, {width} x {height} px; "
        f"{len(scene.points)} points; {together}{launch.get_threads()} threads; output in {run.folder}"
    )
    if scene.random_points and not checkpoint:
        say("Warning: the scene has no points to start from; random ones are taken, which trains worse.")
    if scene.start and not checkpoint and scene.start.antialiased != config.antialiasing:
        which = "with" if scene.start.antialiased else "without"
        say(f"Warning: {config.start_ply} was trained {which} --antialiasing; the same option keeps its sizes right.")
    trainer = Trainer(scene, config, processes)
    say("Preparing kernels (compiled once on a machine, about 40 s) ...")
    start = time.perf_counter()
    with model_folder.claimed(run.folder) if leads else nullcontext(), _memory_explained(trainer):
        if leads:
            _refuse_other_training(run.folder, checkpoint)  # again: one may have ended meanwhile
        trainer.warm_up()
        say(f"Kernels ready after {time.perf_counter() - start:.1f} s")
        if checkpoint:
            restore(trainer, run, checkpoint)
            say(f"Continuing after {run.iteration} iterations, from {checkpoint.path}")
        else:
            keep(trainer, run)
        if leads:  # only now: where a checkpoint is refused, the folder stays as it was
            _write_inputs(run.folder, config, scene, continues=checkpoint is not None)
        del checkpoint  # its arrays take as much memory as the trainer's
        if leads and config.tensorboard:
            run.events = EventLog.open(run.folder, run.iteration)
        if device.type == "cpu":
            say(memory.describe(scene, config, len(trainer.model), processes.local_count))
        return _run(trainer, run, say)


def _run(trainer: Trainer, run: Run, say: Callable[[str], None]) -> int:
    """Train, save, and tell; returns the process's exit code."""
    processes, end = trainer.processes, trainer.config.iterations
    saved = None
    with _watched(trainer, run) as viewer:
        with interruptible() as interrupted:
            if viewer:  # only now: who has read it may press Ctrl-C
                viewer.announce()
            try:
                _loop(trainer, run, interrupted, viewer)
            except GroupError as error:  # said here, where torchrun's SIGTERM does not end this process yet
                tqdm.write(f"warp-splat: error: {error}", file=sys.stderr)
                return 1
            finally:  # whatever happened, the model comes first
                if processes.rank == 0 or processes.lost:
                    saved = save_model(trainer, run)
                    print(f"Model after {run.iteration} iterations: {saved}")
                if run.kept is not None and run.iteration < end:
                    print(f"To continue after iteration {run.kept}: {how_to_continue(run.folder, processes)}")
        if viewer:
            viewer.show_end()
        if processes.rank == 0:
            finish(trainer, run, say)
        if viewer and run.iteration == end:
            viewer.linger()
    if saved and saved != model_folder.ply_path(run.folder, run.iteration):
        tqdm.write(f"The model is not in {run.folder}, but in {saved}; see the warning, and move it.", file=sys.stderr)
        return 1
    return 130 if run.iteration < end else 0


def _watched(trainer: Trainer, run: Run) -> AbstractContextManager[TrainingViewer | None]:
    """The viewer, if one is asked for."""
    if not trainer.config.viewer:
        return nullcontext()
    from warp_splat.training.live import watched  # noqa: PLC0415 - viser takes half a second to load

    return watched(trainer, run)


def _choose_folder(config: TrainConfig, checkpoint: Checkpoint | None) -> Path:
    """Where the run writes; never over another training, nor over one that went on from its checkpoint."""
    default = checkpoint.path.parent if checkpoint else model_folder.default_model_path()
    folder = Path(config.model_path or default)
    model_folder.check_place(folder)
    if config.source_path and folder.resolve() == Path(config.source_path).resolve():
        raise InputError(f"-m {folder}: expected another folder than the scene's; choose a new one.")
    _refuse_other_training(folder, checkpoint)
    return folder


def _refuse_other_training(folder: Path, checkpoint: Checkpoint | None) -> None:
    continued = checkpoint and checkpoint.path.resolve() == (folder / LAST).resolve()
    if not continued and ((folder / LAST).exists() or any(folder.glob("point_cloud/*/*.ply"))):
        raise InputError(
            f"{folder}: this folder already holds a training; choose another with -m, move it, or continue where it "
            f"ended with --resume {folder}."
        )


def _write_inputs(folder: Path, config: TrainConfig, scene: Scene, continues: bool) -> None:
    model_folder.write_cfg_args(
        folder,
        {
            **asdict(config),
            "model_path": str(folder),
            "depths": "",
            "train_test_exp": False,
            "linear_light": scene.linear,
        },
    )
    write_config(folder, config)
    model_folder.write_cameras(folder, scene.test, scene.train)
    remove_leftovers(folder)
    if not (continues and (folder / "input.ply").exists()):
        save_points(folder / "input.ply", scene.points, scene.colors)


def _memory_explained(trainer: Trainer):
    """See :func:`memory_explained`."""
    fewer = ["fewer Gaussians (--max_gaussians)", "smaller images (-r)"]
    if trainer.config.data_device == "cuda":
        fewer.append("--data_device cpu")
    sizes = [(view.camera.width, view.camera.height) for view in trainer.scene.train]
    return memory_explained(trainer.device, trainer.model, sizes, f"train with {' or '.join(fewer)}")


def _loop(trainer: Trainer, run: Run, interrupted: list[int], viewer: TrainingViewer | None) -> None:
    config, processes = trainer.config, trainer.processes
    checks = {config.iterations * k // EVALUATIONS for k in range(1, EVALUATIONS)}
    whole_checks = {*config.test_iterations, config.iterations}
    saves = set(config.save_iterations) - {config.iterations}
    profiled, before_profile = max(config.iterations - config.profile, run.iteration), run.seconds
    pause = 0.1 if sys.stderr.isatty() else 10.0  # seconds between two lines; a log keeps them all
    bar = tqdm(
        total=config.iterations,
        initial=run.iteration,
        disable=config.quiet,
        unit="it",
        mininterval=pause,
        maxinterval=pause,
        miniters=0,
    )
    trainer.check_identical(run.iteration)
    with bar, launch.profile(config.profile > 0) as stages:
        for iteration in range(run.iteration + processes.count, config.iterations + 1, processes.count):
            if processes.reaches(iteration, [profiled + 1]):
                stages.clear()
                before_profile = run.seconds
            start = time.perf_counter()
            if run.iteration:  # now, since models and checkpoints are those of before the update
                trainer.update(run.iteration)
            run.losses.append(trainer.differentiate(iteration))
            run.iteration = iteration
            run.seconds += time.perf_counter() - start
            wish = processes.largest(STOP if interrupted else KEEP if _keeping_is_due(config, run) else 0)
            stop = wish == STOP or iteration == config.iterations
            check, whole = (processes.reaches(iteration, marks) for marks in (checks | whole_checks, whole_checks))
            named = processes.reaches(iteration, config.checkpoint_iterations)
            if check:
                _check(trainer, run, bar, whole)
            if stop or wish == KEEP or named:
                keep(trainer, run, named)
            if stop and not check:  # after the checkpoint: a run that goes on from there never had this record
                _check(trainer, run, bar, whole=False)
            if processes.reaches(iteration, saves) and not stop:
                save_or_warn(trainer, run)
            bar.update(processes.count)
            if stop:
                break
            if viewer:
                viewer.between_steps(interrupted)
    run.dropped = trainer.quarantine.read(processes)
    steps = -(-(run.iteration - profiled) // processes.count)
    if config.profile and steps > 0:
        times = {name: 1e3 * seconds / steps for name, seconds in stages.items()}
        step = 1e3 * (run.seconds - before_profile) / steps
        run.stages = {**times, "host": max(step - sum(times.values()), 0.0)}


def _keeping_is_due(config: TrainConfig, run: Run) -> bool:
    return 0 < 60 * config.checkpoint_interval <= time.perf_counter() - run.kept_at


@launch.profile(False)
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
        view = views[len(views) // 2]
        try:
            save_png(run.folder / "preview.png", np.concatenate([view.picture, trainer.picture(view.camera)], 1))
        except InputError as error:
            warn(error)

"""A whole training run: scene in; model, pictures, plots and numbers out."""

import math
import os
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from warp_splat.config import MergeConfig
from warp_splat.errors import InputError
from warp_splat.formats import model_folder
from warp_splat.formats.checkpoint import LAST, Checkpoint, load_own
from warp_splat.formats.ply import load_points
from warp_splat.runtime import pool
from warp_splat.runtime.devices import memory_explained
from warp_splat.runtime.distributed import GroupError, Processes, join
from warp_splat.runtime.interrupts import interruptible
from warp_splat.runtime.shards import Shards
from warp_splat.scene.blocks import BLOCK, holds_another, merge_blocks
from warp_splat.scene.start import load_start
from warp_splat.text import Report
from warp_splat.training import memory, opening
from warp_splat.training.deadline import plan_training
from warp_splat.training.live import TrainingViewer, watched
from warp_splat.training.loop import train_steps
from warp_splat.training.options import TrainConfig, check_train
from warp_splat.training.parts import PARTS
from warp_splat.training.record import Run, finish, how_to_continue, keep, restore, save_model
from warp_splat.training.tensorboard import EventLog
from warp_splat.training.trainer import Trainer
from warp_splat.training.trial import settle_parts

#: Options that may differ between processes that train together.
OWN = {"source_path", "start_ply", "start_checkpoint", "config", "model_path", "lpips_weights", "verify"}
OWN |= {"device", "data_device", "photo_memory", "threads", "quiet", "port", "tensorboard"}


def train(config: TrainConfig) -> int:
    """Train as ``config`` says; returns the process's exit code.

    1: the model could not be written into its folder and was saved elsewhere. 130: interrupted, the model saved.

    Raises:
        InputError: if an option, the scene or the output folder is not usable; at the end, if the model, which is
            saved, has not the hash that ``verify`` asks for.
    """
    check_train(config)
    if config.data.blocks:
        return _train_blocks(config)
    with join(config.machine.device, config.learn.views, Shards if config.machine.shard else Processes) as processes:
        if config.report.viewer and processes.count > 1 and not processes.sharded:
            raise InputError("--viewer: expected one process, or --shard, of which process 0 draws; leave it out.")
        return _train(config, processes)


def _train_blocks(config: TrainConfig) -> int:
    """Train each block that has not ended yet, merge them, and go on with all of it; returns the exit code."""
    folder, count = Path(config.report.model_path or model_folder.default_model_path()), config.data.blocks
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise InputError(f"--blocks: expected one process; let torchrun train one of them (--block 1/{count}).")
    if holds_another(folder):
        raise InputError(f"{folder}: it already holds another model; move it away, or choose another folder with -m.")
    opening.check_folder(config, folder)
    say, blocks = opening.speaker(config.report.quiet), {f"{n}/{count}": folder / str(n) for n in range(1, count + 1)}
    for block, place in blocks.items():
        opening.refuse_other_block(config.changed(blocks=0, block=block), place)
    for block, place in blocks.items():
        if (place / BLOCK).exists():
            say(f"Block {block}: trained to its end before, by the options of {place}/cfg_args.")
        elif code := _go_on(config, place, block=block, viewer=False, verify=""):
            print(f"The same command with -m {folder} goes on with block {block}.")
            return code
    merge_blocks(MergeConfig(str(folder)))
    before, (_, merged, _) = folder / "together" / "input.ply", load_start(str(folder), str)
    if before.exists() and not np.array_equal(load_points(before)[0], merged):
        raise InputError(
            f"{before.parent}: expected a training of these blocks as they are now, found one of others, as one was "
            "trained again; move that folder away, and the same command trains all of it anew."
        )
    settled = {"settle_from_iter": 1, "cooldown": config.learn.iterations - 1, "coarse": 1}  # nothing grows, rates fall
    if limit := config.grow.max_gaussians:
        settled["max_gaussians"] = max(limit, len(merged))  # it was each block's
    return _go_on(config, folder / "together", start_ply=str(folder), **settled)


def _go_on(config: TrainConfig, folder: Path, **changes: Any) -> int:
    """Train in ``folder``, from where it stands there."""
    begun = str(folder) if (folder / LAST).exists() else ""
    return train(config.changed(blocks=0, model_path=str(folder), start_checkpoint=begun, **changes))


def _train(config: TrainConfig, processes: Processes) -> int:
    """Resolve the options, open the scene, make the trainer, restore it or begin, run, and finish."""
    config, begun = opening.resolve(config, processes)
    say = opening.speaker(config.report.quiet)
    run = Run(Path(config.report.model_path), time.perf_counter())
    scene = opening.open_scene(config, begun, say, processes.local_count)
    facts = {name: value for name, value in config.flat().items() if name not in OWN}
    processes.check_alike(facts | {"photographs": [view.name for view in scene.train]})
    if config.learn.minutes and not begun:
        config = plan_training(scene, config, processes, say)
    config, weighed = settle_parts(config, scene, processes, say)
    trainer = Trainer(scene, config, processes)
    if config.data.block and (learned := list(trainer.optimizer.parts)):
        raise InputError(
            f"--block, --blocks: expected no part that learns, got {learned[0]}: each block would learn another."
        )
    trainer.told = weighed + trainer.told
    _tell(trainer, run, say)
    with model_folder.claimed(run.folder) if processes.rank == 0 else nullcontext(), _memory_explained(trainer):
        _restore_or_begin(trainer, run, begun, say)
        with watched(trainer, run) if config.report.viewer else nullcontext() as viewer:
            return _run(trainer, run, viewer) or _finish(trainer, run, viewer, say)


def _tell(trainer: Trainer, run: Run, say: Report) -> None:
    scene, processes = trainer.scene, trainer.processes
    together = f"{processes.count} processes with " * (processes.count > 1)
    width, height = scene.train[0].camera.width, scene.train[0].camera.height
    say(
        f"{len(scene.train)} training views, {len(scene.test)} test views, {width} x {height} px; "
        f"{len(scene.points)} points; {together}{pool.get_threads()} threads; output in {run.folder}"
    )
    learn, shares = trainer.config.learn, trainer.photographs.shares
    if shares and (full := math.ceil(learn.coarse_until_iter * shares[-1])) > learn.iterations:
        say(f"Warning: images reach their full size in iteration {full}, after the end; lower --coarse_until_iter.")
    for sentence in trainer.told:
        say(sentence)


def _restore_or_begin(trainer: Trainer, run: Run, begun: Checkpoint | None, say: Report) -> None:
    leads, config = trainer.processes.rank == 0, trainer.config
    if leads:
        opening.refuse_other_training(run.folder, begun)  # again: one may have ended meanwhile
    say("Preparing kernels (compiled once on a machine, about 20 s) ...")
    start = time.perf_counter()
    trainer.warm_up()
    say(f"Kernels ready after {time.perf_counter() - start:.1f} s")
    if begun:
        restore(trainer, run, load_own(begun.path, trainer.processes))
        say(f"Continuing after {run.iteration} iterations, from {begun.path}")
        before = begun.facts["options"].get("parts", "").split(",")
        for name in filter(lambda name: name in PARTS and name not in config.used_parts, before):
            say(f"Warning: the part {name} is left out from here on, with what it learned; --parts names those kept.")
    else:
        keep(trainer, run)
    if leads:  # only now: where a checkpoint is refused, the folder stays as it was
        opening.write_inputs(run.folder, config, trainer.scene, begun)
    if leads and config.report.tensorboard:
        run.events = EventLog(run.folder, run.iteration - len(run.losses) * trainer.processes.images)
    if config.machine.device == "cpu":
        say(memory.describe(trainer)[0])


def _run(trainer: Trainer, run: Run, viewer: TrainingViewer | None) -> int:
    """Train and save; 1 if another process went away."""
    processes = trainer.processes
    whole = not processes.sharded  # else only what all send makes a model
    with interruptible() as interrupted:
        if viewer:  # only now: who has read it may press Ctrl-C
            print(viewer.viewer.announcement, flush=True)
        try:
            train_steps(trainer, run, interrupted, viewer)
            whole = True
        except GroupError as error:  # said here, where torchrun's SIGTERM does not end this process yet
            tqdm.write(f"warp-splat: error: {error}", file=sys.stderr)
            return 1
        finally:  # whatever happened, the model comes first
            if whole and not trainer.optimizer.torn:
                run.saved = trainer.lead(lambda: save_model(trainer, run))
            if run.saved:
                print(f"Model after {run.iteration} iterations: {run.saved}")
            if run.kept is not None and run.iteration < trainer.config.learn.end:
                print(f"To continue after iteration {run.kept}: {how_to_continue(run.folder, processes)}")
    return 0


def _finish(trainer: Trainer, run: Run, viewer: TrainingViewer | None, say: Report) -> int:
    """Evaluate and tell; returns the process's exit code."""
    end, watched = trainer.config.learn.end, trainer.config.report.viewer
    if watched:
        trainer.lead(lambda: viewer and viewer.show_end())
    run.gaussians = trainer.processes.total(len(trainer.model))
    # as in the file: at one depth, the first is in front
    trainer.optimizer.arrange(trainer.model.arranging(trainer.processes, [len(trainer.model)]))
    elsewhere = run.saved and run.saved != model_folder.ply_path(run.folder, run.iteration)
    try:
        trainer.lead(lambda: finish(trainer, run, say))
    finally:  # the disk may be full for the pictures, too
        if elsewhere:
            text = f"The model is not in {run.folder}, but in {run.saved.parent}; see the warning, and move this."
            tqdm.write(text, file=sys.stderr)
    if watched and run.iteration >= end:
        trainer.lead(lambda: viewer and viewer.linger())
    if elsewhere:
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


def _memory_explained(trainer: Trainer):
    """See :func:`memory_explained`."""
    rest = " or --data_device cpu" * (trainer.config.machine.data_device == "cuda")
    advice = f"train with fewer Gaussians (--max_gaussians) or smaller images (-r){rest}"
    return memory_explained(trainer.device, trainer.model, (view.camera for view in trainer.scene.train), advice)

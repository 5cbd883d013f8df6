"""A run of training: what has happened so far, and what of it is kept: models, checkpoints, the summary."""

import hashlib
import shlex
import sys
import time
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import torch
from tqdm import tqdm

from warp_splat.errors import InputError
from warp_splat.evaluation import report
from warp_splat.evaluation.perceptual import choose_metrics
from warp_splat.evaluation.views import evaluate_views, metrics_line, show_views
from warp_splat.formats import model_folder
from warp_splat.formats.checkpoint import LAST, Checkpoint, save_checkpoint, save_in_blocks
from warp_splat.formats.colmap_text import write_colmap
from warp_splat.formats.exposures import write_exposures
from warp_splat.formats.files import save_somewhere, write_json
from warp_splat.runtime.devices import peak_memory
from warp_splat.runtime.distributed import Processes
from warp_splat.scene.blocks import write_block
from warp_splat.scene.types import View
from warp_splat.text import Report, format_table
from warp_splat.training.config_file import OF_ONE_RUN, write_config
from warp_splat.training.plan import as_flags
from warp_splat.training.seams import having
from warp_splat.training.tensorboard import EventLog
from warp_splat.training.trainer import Trainer

RECORD = {"iteration": int, "loss": float, "psnr": float, "gaussians": int, "seconds": float}


@dataclass
class Run:
    """What has happened so far."""

    folder: Path
    start: float  # of the work, on time.perf_counter; what was done before a checkpoint is behind it
    history: list[dict[str, float]] = field(default_factory=list)
    losses: list[torch.Tensor] = field(default_factory=list)  # since the last record, scalars on the device
    iteration: int = 0
    gaussians: int = 0  # of all processes, when last measured
    seconds: float = 0.0  # of training steps alone, without evaluations and pictures
    spent: float = 0.0  # seconds since the first step, with evaluations, without pauses
    preview: float = 0.0  # when last drawn
    saved: Path | None = None  # the model, at the end
    sha256: str = ""  # of that file: equal where the bytes are (docs/platforms.md says where)
    kept: int | None = None  # iteration of the last checkpoint
    kept_at: float = 0.0  # when that was written, on time.perf_counter
    stages: dict[str, float] = field(default_factory=dict)  # milliseconds per step
    dropped: dict[str, int] = field(default_factory=dict)  # see Trainer.all_dropped
    events: EventLog = field(default_factory=EventLog)


def warn(error: Exception) -> None:
    """Say what went wrong; training goes on."""
    tqdm.write(f"warning: {error}", file=sys.stderr)


def save_model(trainer: Trainer, run: Run) -> Path:
    """Save the model; if that fails, into the system's folder for temporary files, rather than lose it."""
    scene, refined = trainer.scene, _refined(trainer)

    def save(path: Path) -> None:  # the Gaussians last: without the rest, they would be drawn otherwise
        behind = trainer.behind.cpu().numpy()
        model_folder.write_environment(path, behind if behind.ndim > 1 else None)
        write_exposures(path, trainer.exposures)
        if refined:
            model_folder.write_cameras(path.parent, *refined, scene.coordinates)
        trainer.save(path)
        if not refined:
            model_folder.write_beside(path, model_folder.CAMERAS, None)

    own = model_folder.ply_path("", run.iteration)
    path = save_somewhere(run.folder / own, save, str(own))
    try:
        if refined:  # for viewers, and for other tools
            model_folder.write_cameras(run.folder, *refined, scene.coordinates)
            cameras = [(view.name, view.original) for views in refined[::-1] for view in views]
            write_colmap(run.folder / "colmap" / "sparse" / "0", cameras, scene.points, scene.colors)
        for files in having(trainer.parts, "files"):
            for name, value in files().items():
                write_json(run.folder / name, value)
    except InputError as error:
        warn(error)
    return path


def _refined(trainer: Trainer) -> tuple[list[View], list[View]] | None:
    """Test and training views with the cameras that were learned; None if none were, or they are not finite."""
    try:
        test, train = trainer.refined(trainer.scene.test), trainer.refined(trainer.scene.train)
    except (ValueError, ArithmeticError) as error:
        warn(InputError(f"the refined cameras are not saved: {error}"))
        return None
    return None if train is trainer.scene.train else (test, train)


def save_or_warn(trainer: Trainer, run: Run) -> None:
    """Save before the end: training goes on if that fails."""
    try:
        save_model(trainer, run)
    except (InputError, OSError) as error:
        warn(error)


def keep(trainer: Trainer, run: Run, named: bool = False) -> None:
    """Write a checkpoint, in the place of the last one; ``named``: and one that stays. Training goes on if that fails.

    All processes call this, where :meth:`Trainer.state` says; the first one writes, and each its own Gaussians.
    """
    tensors, facts = trainer.state()
    processes = trainer.processes
    save = partial(save_in_blocks, processes) if processes.sharded else save_checkpoint
    if processes.sharded or processes.rank == 0:
        if run.losses:
            tensors["losses"] = torch.stack(run.losses)
        options = {name: value for name, value in trainer.config.flat().items() if name not in OF_ONE_RUN}
        facts |= {"options": options, "iteration": run.iteration, "history": run.history}
        facts |= {"seconds": run.seconds, "spent": run.spent, "wall": time.perf_counter() - run.start}
        arrays = {name: tensor.cpu().numpy() for name, tensor in tensors.items()}
        try:
            for name in [LAST, f"chkpnt{run.iteration}.safetensors"][: 1 + named]:
                save(run.folder / name, arrays, facts)
            run.kept = run.iteration
        except InputError as error:
            warn(error)
    run.kept_at = time.perf_counter()


def restore(trainer: Trainer, run: Run, checkpoint: Checkpoint) -> None:
    """Let the run be where it was when :func:`keep` wrote this checkpoint.

    Raises:
        InputError: if it was written for another scene, or something in it does not fit.
    """
    trainer.restore(checkpoint)
    run.iteration = run.kept = checkpoint.count("iteration")
    run.seconds = checkpoint.fact("seconds", float)
    run.spent = checkpoint.fact("spent", float) if "spent" in checkpoint.facts else 0.0  # older ones have no minutes
    run.start -= checkpoint.fact("wall", float)
    run.history = checkpoint.fact("history", list)
    for record in run.history:
        if not isinstance(record, dict) or {name: type(value) for name, value in record.items()} != RECORD:
            raise InputError(f"{checkpoint.path}: expected a history of {', '.join(RECORD)}, found another.")
    if "losses" in checkpoint.arrays:
        run.losses = list(torch.from_numpy(checkpoint.array("losses", (-1,))).to(trainer.device))
    run.kept_at = time.perf_counter()


def how_to_continue(folder: Path, processes: Processes) -> str:
    """The command that continues a training, in the manner in which this program was started."""
    program = sys.orig_argv[: len(sys.orig_argv) - len(sys.argv[1:])]
    if sys.argv[1:2] == ["train"]:
        program = [*program, "train"]
    elif Path(sys.argv[0]).name != "train.py":  # called from Python
        program = ["warp-splat", "train"]
    if processes.count > 1:
        script = [word for word in program[1:] if word != "-u"]
        program = [sys.executable, "-m", "torch.distributed.run", f"--nproc-per-node={processes.local_count}", *script]
    return shlex.join([*program, "--resume", str(folder)])


def finish(trainer: Trainer, run: Run, say: Report) -> None:
    """Pictures, curves and numbers of the saved model, and where they lie."""
    assert run.saved
    wall = time.perf_counter() - run.start
    speed = run.iteration / run.seconds if run.seconds else 0.0  # a clock may stand still
    for place in (run.folder / "point_cloud").glob("iteration_*"):
        if (number := place.name.removeprefix("iteration_")).isdecimal() and int(number) > run.iteration:
            kept = place.rename(place.with_name(f"{place.name}.{place.stat().st_mtime_ns}"))
            say(f"Warning: {place} was of a run before this, and later; as the newest is drawn, it is {kept.name} now.")
    with run.saved.open("rb") as file:
        run.sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    split, views = trainer.scene.evaluated
    if split == "train" and len(views) < len(trainer.scene.train):
        say(f"Evaluating {len(views)} of {len(trainer.scene.train)} training views (--eval holds some out instead).")
    write_json(run.folder / "history.json", run.history)  # now, since the evaluation may fail
    if (decided := trainer.config.learn.settle_from_iter) > 1:  # by a clock, maybe; 1: blocks, together
        write_config(run.folder, trainer.config)
    plot = run.folder / "training.png"
    if run.history:  # none, if it was stopped before the first evaluation and goes no further
        report.plot_training(plot, run.history, split)
    extra = {
        "split": split,
        "iterations": run.iteration,
        "gaussians": run.gaussians,
        "sha256": run.sha256,
        "seconds": round(wall, 2),
        "iterations_per_second": round(speed, 2),
        "spent": round(run.spent, 2),
        "processes": trainer.processes.count,
        "peak_memory_mb": peak_memory(),
        "dropped": run.dropped,
    }
    # else the next run has to save it again
    if trainer.scene.block and run.iteration >= trainer.config.learn.end and run.saved.is_relative_to(run.folder):
        write_block(run.folder, trainer.scene.block)
    metrics, absent = choose_metrics(trainer.config.report.lpips_weights)
    for sentence in absent:
        say(sentence)
    views, where = trainer.refined(views), trainer.where_taken()
    means, compared = evaluate_views(trainer.picture, views, run.folder, split, run.iteration, extra, metrics, where)
    state = "Interrupted" if run.iteration < trainer.config.learn.end else "Done"
    names = ({"curves": plot.name} if run.history else {}) | {"numbers": "results.json"}
    try:
        show_views(compared, run.folder, split, run.iteration, say)
        names = {"pictures": "contact_sheet.png", "views": "per_view.md"} | names
        if run.stages:
            report.plot_profile(run.folder / "profile.png", run.stages)
            names["profile"] = "profile.png"
    finally:  # what was measured and written is told, even if the disk is full
        print(
            f"{state} after {run.iteration} iterations, {wall:.0f} s ({speed:.1f} it/s): "
            f"{split} {metrics_line(means)}, {run.gaussians} Gaussians"
        )
        for what, name in names.items():
            print(f"  {what:9s} {run.folder / name}")
    run.events.write((run.iteration, f"{split}/{name}", value) for name, value in means.items())
    if run.stages:
        total = sum(run.stages.values())
        rows = [(name, f"{value:.2f}", f"{100 * value / total:.0f} %") for name, value in run.stages.items()]
        say(format_table(("stage", "ms per step", "share"), [*rows, ("whole step", f"{total:.2f}", "")]))
    if decided > 1:
        print(f"  flags     {as_flags(trainer.config)}")
        print(f"  time      {run.spent:.1f} s from the first step to the last")
    if (dropped := run.dropped)["prunings"]:
        print(f"  warning   {dropped['prunings']} prunings would have removed every Gaussian and were refused")
    if dropped["pixels"] or dropped["gradients"] or dropped["gaussians"]:
        print(
            f"  kept from spreading: {dropped['pixels']} pixels and {dropped['gradients']} Gaussians with gradients, "
            f"and {dropped['gaussians']} Gaussians with parameters, that were not finite"
        )

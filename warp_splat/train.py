"""A whole training run: scene in; model, pictures, plots and numbers out."""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import threading
import time
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from warp_splat import forecast, launch, report
from warp_splat.config import TrainConfig, check_train
from warp_splat.devices import memory_explained, peak_memory
from warp_splat.distributed import GroupError, Processes, join
from warp_splat.errors import InputError
from warp_splat.evaluate import evaluate_views
from warp_splat.formats import model_folder
from warp_splat.formats.atomic import write_json
from warp_splat.formats.ply import save_points
from warp_splat.formats.png import save_png
from warp_splat.scene import load_scene
from warp_splat.scene.types import Scene
from warp_splat.selftest import settle_device
from warp_splat.trainer import Trainer

EVALUATIONS = 20  # over the run, besides --test_iterations
PROGRESS_VIEWS = 8  # at most, in the evaluations while training
PREVIEW_SECONDS = 5.0
SHEET_VIEWS = 6


@dataclass
class Run:
    """What has happened so far."""

    folder: Path
    start: float  # of the process's work, on time.perf_counter
    history: list[dict[str, float]] = field(default_factory=list)
    losses: list[torch.Tensor] = field(default_factory=list)  # since the last record, scalars on the device
    iteration: int = 0
    seconds: float = 0.0  # of training steps alone, without evaluations and pictures
    preview: float = 0.0  # when last drawn
    stages: dict[str, float] = field(default_factory=dict)  # milliseconds per step
    dropped: dict[str, int] = field(default_factory=dict)  # see Quarantine


def train(config: TrainConfig) -> int:
    """Train as ``config`` says; returns the process's exit code (130 if interrupted, with the model saved).

    Raises:
        InputError: if an option, the scene or the output folder is not usable.
    """
    problem = check_train(config)
    if problem:
        raise InputError(problem)
    with join(config.device) as processes:
        return _train(config, processes)


def _train(config: TrainConfig, processes: Processes) -> int:
    leads = processes.rank == 0
    config.quiet |= not leads
    config.iterations += -config.iterations % processes.count  # whole steps
    say = (lambda *_: None) if config.quiet else tqdm.write
    threads = config.threads or max(1, launch.get_threads() // processes.local_count)
    device = settle_device(launch.prepare(config.device, threads), config.device, [config.adjoint], say)
    config.device = device.type
    if config.data_device == "cuda" and device.type != "cuda":
        raise InputError("--data_device cuda: expected training on a GPU, too; use --data_device cpu.")
    config.source_path = os.path.abspath(config.source_path or embedded_scene())  # render.py may run elsewhere
    if config.model_path and any(Path(config.model_path).glob("point_cloud/*/*.ply")):
        raise InputError(
            f"-m {config.model_path}: this folder already holds a trained model; choose another, or move it."
        )
    started = time.perf_counter()
    say(f"Scene {config.source_path}")
    scene = load_scene(
        config.source_path,
        images=config.images,
        resolution=config.resolution,
        white_background=config.white_background,
        eval=config.eval,
        report=say,
    )
    run = Run(Path(processes.first(config.model_path or str(model_folder.default_model_path()))), started)
    together = f"{processes.count} processes with " * (processes.count > 1)
    width, height = scene.train[0].camera.width, scene.train[0].camera.height
    say(
        f"{len(scene.train)} training views, {len(scene.test)} test views, {width} x {height} px; "
        f"{len(scene.points)} points; {together}{launch.get_threads()} threads; output in {run.folder}"
    )
    trainer = Trainer(scene, config, processes)
    if leads:
        _write_inputs(model_folder.prepare(run.folder), config, scene)
    say("Preparing kernels (compiled once on a machine, about 15 s) ...")
    start = time.perf_counter()
    with _memory_explained(trainer):
        trainer.warm_up()
        say(f"Kernels ready after {time.perf_counter() - start:.1f} s")
        if device.type == "cpu":
            say(forecast.describe(scene, config, processes.local_count))
        with _interruptible() as interrupted:
            try:
                _loop(trainer, run, interrupted)
            except GroupError as error:  # said here, where torchrun's SIGTERM does not end this process yet
                tqdm.write(f"warp-splat: error: {error}", file=sys.stderr)
                return 1
            finally:  # whatever happened, the model comes first
                if leads or processes.lost:
                    print(f"Model after {run.iteration} iterations: {_save(trainer, run)}")
        if leads:
            _finish(trainer, run, say)
    return 130 if run.iteration < config.iterations else 0


def embedded_scene() -> Path:
    """The scene that comes with the package."""
    here = Path(__file__).parent
    for folder in (here / "assets" / "still_life", here.parent / "assets" / "still_life"):
        if folder.is_dir():
            return folder
    raise InputError("The embedded scene is missing from this installation; name a scene with -s.")


def _write_inputs(folder: Path, config: TrainConfig, scene: Scene) -> None:
    model_folder.write_cfg_args(
        folder,
        {**asdict(config), "model_path": str(folder), "depths": "", "train_test_exp": False},
    )
    model_folder.write_cameras(folder, scene.test, scene.train)
    save_points(folder / "input.ply", scene.points, scene.colors)


def _memory_explained(trainer: Trainer):
    """See :func:`memory_explained`."""
    fewer = ["fewer Gaussians (--max_gaussians)", "smaller images (-r)"]
    if trainer.config.data_device == "cuda":
        fewer.append("--data_device cpu")
    sizes = [(view.camera.width, view.camera.height) for view in trainer.scene.train]
    return memory_explained(trainer.device, trainer.model, sizes, f"train with {' or '.join(fewer)}")


@contextmanager
def _interruptible():
    """Ctrl-C (and SIGTERM) ends the loop after the step at hand, so that the model is whole, and is then saved."""
    interrupted: list[int] = []
    if threading.current_thread() is not threading.main_thread():  # only the main thread may handle signals
        yield interrupted
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    previous = [signal.signal(number, lambda number, frame: interrupted.append(number)) for number in numbers]
    try:
        yield interrupted
    finally:
        for number, handler in zip(numbers, previous, strict=True):
            signal.signal(number, handler)


def _loop(trainer: Trainer, run: Run, interrupted: list[int]) -> None:
    config, processes = trainer.config, trainer.processes
    checks = {config.iterations * k // EVALUATIONS for k in range(1, EVALUATIONS)}
    whole_checks = {*config.test_iterations, config.iterations}
    saves = set(config.save_iterations) - {config.iterations}
    profiled, before_profile = max(config.iterations - config.profile, 0), 0.0
    pause = 0.1 if sys.stderr.isatty() else 10.0  # seconds between two lines; a log keeps them all
    bar = tqdm(
        total=config.iterations, disable=config.quiet, unit="it", mininterval=pause, maxinterval=pause, miniters=0
    )
    trainer.check_identical(0)
    with bar, launch.profile(config.profile > 0) as stages:
        for iteration in range(processes.count, config.iterations + 1, processes.count):
            if processes.reaches(iteration, [profiled + 1]):
                stages.clear()
                before_profile = run.seconds
            start = time.perf_counter()
            run.losses.append(trainer.differentiate(iteration))
            run.iteration = iteration
            run.seconds += time.perf_counter() - start
            stop = processes.any(bool(interrupted)) or iteration == config.iterations
            if stop or processes.reaches(iteration, checks | whole_checks):
                with launch.profile(False):
                    _check(trainer, run, bar, whole=processes.reaches(iteration, whole_checks))
            if processes.reaches(iteration, saves) and not stop:
                _save_or_warn(trainer, run)
            bar.update(processes.count)
            if stop:
                break
            start = time.perf_counter()
            trainer.update(iteration)
            run.seconds += time.perf_counter() - start
    run.dropped = trainer.quarantine.read(processes)
    steps = -(-(run.iteration - profiled) // processes.count)
    if config.profile and steps > 0:
        times = {name: 1e3 * seconds / steps for name, seconds in stages.items()}
        step = 1e3 * (run.seconds - before_profile) / steps
        run.stages = {**times, "host": max(step - sum(times.values()), 0.0)}


def _check(trainer: Trainer, run: Run, bar: tqdm, whole: bool) -> None:
    """Measure PSNR on the held-out views (a few of them, unless ``whole``), note it, show it, refresh the preview."""
    trainer.check_identical(run.iteration)
    losses, run.losses = run.losses, []
    if trainer.processes.rank > 0:
        return
    split, views = trainer.scene.evaluated
    if not whole:
        views = views[:: -(-len(views) // PROGRESS_VIEWS)]
    record = {
        "iteration": run.iteration,
        "loss": float(np.mean(torch.stack(losses).double().cpu().numpy())),
        "psnr": trainer.evaluate(views),
        "gaussians": len(trainer.model),
        "seconds": run.seconds,
    }
    run.history.append(record)
    text = f"loss {record['loss']:.4f}, {split} PSNR {record['psnr']:.2f}, {record['gaussians']} Gaussians"
    bar.set_postfix_str(text, refresh=False)
    if time.perf_counter() - run.preview > PREVIEW_SECONDS:
        run.preview = time.perf_counter()
        view = views[len(views) // 2]
        try:
            save_png(run.folder / "preview.png", np.concatenate([view.image, trainer.picture(view.camera)], 1))
        except InputError as error:
            _warn(error)


def _warn(error: Exception) -> None:
    tqdm.write(f"warning: {error}", file=sys.stderr)


def _save(trainer: Trainer, run: Run) -> Path:
    """Save the model; if that fails, into the system's folder for temporary files, rather than lose it."""
    path = model_folder.ply_path(run.folder, run.iteration)
    antialiased = trainer.config.antialiasing
    try:
        trainer.model.save(path, antialiased)
    except InputError as error:
        _warn(error)
        path = Path(tempfile.mkdtemp(prefix="warp_splat-")) / f"iteration_{run.iteration}.ply"
        trainer.model.save(path, antialiased)
        tqdm.write(f"The model was saved as {path} instead.", file=sys.stderr)
    return path


def _save_or_warn(trainer: Trainer, run: Run) -> None:
    """Save on the way: training goes on if that fails."""
    if trainer.processes.rank > 0:
        return
    try:
        _save(trainer, run)
    except (InputError, OSError) as error:
        _warn(error)


def _finish(trainer: Trainer, run: Run, say) -> None:
    """Pictures, curves and numbers of the saved model, and where they lie."""
    wall = time.perf_counter() - run.start
    split, views = trainer.scene.evaluated
    extra = {
        "split": split,
        "iterations": run.iteration,
        "gaussians": len(trainer.model),
        "seconds": round(wall, 2),
        "iterations_per_second": round(run.iteration / run.seconds, 2),
        "processes": trainer.processes.count,
        "peak_memory_mb": peak_memory(),
        "dropped": run.dropped,
    }
    means, pictures = evaluate_views(trainer.picture, views, run.folder, split, run.iteration, extra)
    sheet, plot = run.folder / "contact_sheet.png", run.folder / "training.png"
    chosen = pictures[:: -(-len(pictures) // SHEET_VIEWS)]
    portrait = chosen[0][1].shape[0] > chosen[0][1].shape[1]
    report.contact_sheet(sheet, chosen, columns=2 if portrait else 1)
    report.plot_training(plot, run.history)
    write_json(run.folder / "history.json", run.history)
    lines = [("pictures", sheet), ("curves", plot), ("numbers", run.folder / "results.json")]
    if run.stages:
        report.plot_profile(run.folder / "profile.png", run.stages)
        lines += [("profile", run.folder / "profile.png")]
        total = sum(run.stages.values())
        rows = [(name, f"{value:.2f}", f"{100 * value / total:.0f} %") for name, value in run.stages.items()]
        say(report.format_table(("stage", "ms per step", "share"), [*rows, ("whole step", f"{total:.2f}", "")]))
    state = "Interrupted" if run.iteration < trainer.config.iterations else "Done"
    print(
        f"{state} after {run.iteration} iterations, {wall:.0f} s ({run.iteration / run.seconds:.1f} it/s): "
        f"{split} PSNR {means['PSNR']:.2f} dB, SSIM {means['SSIM']:.4f}, {len(trainer.model)} Gaussians"
    )
    for name, where in lines:
        print(f"  {name:9s} {where}")
    dropped = run.dropped
    if dropped["prunings"]:
        print(f"  warning   {dropped['prunings']} prunings would have removed every Gaussian and were refused")
    if dropped["pixels"] or dropped["gradients"] or dropped["gaussians"]:
        print(
            f"  kept from spreading: {dropped['pixels']} pixels and {dropped['gradients']} Gaussians with gradients, "
            f"and {dropped['gaussians']} Gaussians with parameters, that were not finite"
        )

"""Before the first step: options become what holds on this machine, the folder is chosen, the scene is read."""

import os
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from warp_splat.errors import InputError
from warp_splat.evaluation.perceptual import choose_metrics
from warp_splat.formats import model_folder
from warp_splat.formats.checkpoint import LAST, Checkpoint, load_own, remove_leftovers
from warp_splat.formats.coordinates import read_coordinates, write_coordinates
from warp_splat.formats.ply import save_points
from warp_splat.kernels.compiler import PORTABLE
from warp_splat.raster.selftest import settle_device
from warp_splat.runtime import pool
from warp_splat.runtime.distributed import Processes
from warp_splat.scene import MASKS, has_cameras, load_scene
from warp_splat.scene.blocks import BLOCK, COMMON
from warp_splat.scene.decoding import photo_memory
from warp_splat.scene.embedded import embedded_scene
from warp_splat.scene.photos import scene_of
from warp_splat.scene.types import Scene
from warp_splat.text import Report
from warp_splat.training.config_file import load_options, write_config
from warp_splat.training.options import FIXED_OPTIONS, TrainConfig
from warp_splat.training.tensorboard import tensorboard_library

OF_SCENE = ("images", "resolution", "white_background", "eval", "invert_masks", "lens", "block")  # load_scene's options


def speaker(quiet: bool) -> Report:
    """What prints a line above the progress bar, or nothing."""
    return (lambda *_: None) if quiet else tqdm.write


def resolve(config: TrainConfig, processes: Processes) -> tuple[TrainConfig, Checkpoint | None]:
    """The options that hold from now on, and the checkpoint to go on from, without its arrays.

    Raises:
        InputError: if an option cannot be had here, or the output folder not be used.
    """
    data, machine, iterations, end = config.data, config.machine, config.learn.iterations, config.learn.end
    quiet = config.report.quiet or processes.rank > 0
    threads = machine.threads or max(1, pool.get_threads() // processes.local_count)
    choose_metrics(config.report.lpips_weights)  # what would be missed at the end is said now
    if config.report.tensorboard:
        tensorboard_library()
    if machine.portable and not PORTABLE:
        raise InputError("portable: expected to be set before kernels are loaded; set WARP_SPLAT_PORTABLE=1 instead.")
    # whole, without its arrays: beside the trainer's they would take as much memory again
    begun = replace(load_own(data.start_checkpoint, processes), arrays={}) if data.start_checkpoint else None
    if begun and (kept := load_options(begun.path)["portable"]) != PORTABLE:
        expected, here = ("1", "unset") if kept else ("unset", "1")
        raise InputError(
            f"WARP_SPLAT_PORTABLE: expected it {expected}, as in {begun.path} ({FIXED_OPTIONS['portable']}), but it is "
            f"{here}; change it, or start anew."
        )
    for name in ("optimizer_type", "growth") if begun else ():
        if (here := config.flat()[name]) != (kept := load_options(begun.path)[name]):
            raise InputError(
                f"--{name} {here}: expected {kept}, as in {begun.path} ({FIXED_OPTIONS[name]}); leave it out."
            )
    done = begun.count("iteration") if begun else 0
    if begun and done >= end + processes.images:  # at the end, what is written there is written again
        raise InputError(f"--iterations {end}: expected at least {done}, as in {begun.path}; name a later end.")
    folder = Path(config.report.model_path or (begun.path.parent if begun else model_folder.default_model_path()))
    check_folder(config, folder)
    refuse_other_training(folder, begun)  # another, or one that went on from the checkpoint
    say = speaker(quiet)
    device = settle_device(machine.device, threads, [config.model.adjoint], say)
    if machine.data_device == "cuda" and device.type != "cuda":
        raise InputError("--data_device cuda: expected training on a GPU, too; use --data_device cpu.")
    source = data.source_path
    if data.sfm:
        from warp_splat.sfm.command import scene_for  # noqa: PLC0415 - only photographs without cameras need it

        options = {"seed": config.learn.seed % 2**31, "keep_lens": data.lens == "native"}
        if not source:
            raise InputError("--sfm: expected photographs, found none named; name their folder, or a video, with -s.")
        if not has_cameras(source):
            check_folder(config.changed(source_path=str(scene_of(Path(source)))), folder)
        source = scene_for(source, processes.count, threads=machine.threads, quiet=quiet, **options)
    more = -(iterations - done) % processes.images  # whole steps
    if more and not config.learn.minutes:
        say(f"A step trains on {processes.images} images: --iterations {iterations} ends after {iterations + more}.")
    config = config.changed(
        quiet=quiet,
        iterations=iterations + more,
        model_path=processes.first(str(folder)),
        device=device.type,
        portable=PORTABLE,  # which the variable of the environment may have set
        source_path=os.path.abspath(source or embedded_scene()),  # render.py may run elsewhere
        start_ply=data.start_ply and os.path.abspath(data.start_ply),
    )
    return config, begun


def check_folder(config: TrainConfig, folder: Path) -> None:
    """Raise InputError if a training may not write there, whatever the folder holds."""
    model_folder.check_place(folder)
    if source := config.data.source_path:
        place, scene = (Path(os.path.realpath(path)) for path in (folder, source))  # resolve() fails at loops of links
        own = {Path(os.path.realpath(scene / name)) for name in (config.data.images, "sparse", MASKS)} - {scene}
        if place == scene or any(map(place.is_relative_to, own)):
            raise InputError(f"-m {folder}: expected another folder than the scene's or its images'; choose a new one.")


def refuse_other_block(config: TrainConfig, folder: Path) -> None:
    """Raise InputError if the folder holds another block than ``config`` says, or one of another scene."""
    before = model_folder.read_cfg_args(folder) if (folder / "cfg_args").exists() else {}
    source = config.data.source_path
    source = str(scene_of(Path(source))) if config.data.sfm else source or embedded_scene()
    now = config.flat() | {"source_path": source}
    for name in (*OF_SCENE, *COMMON, "seed", "source_path", "start_ply"):
        there, here = before.get(name, now[name]), now[name]
        if name in ("source_path", "start_ply"):
            there, here = (path and os.path.realpath(path) for path in (str(there), here))
            there = there if not there or os.path.exists(there) else here  # it was moved, or trained elsewhere
        if there != here:
            raise InputError(f"{folder}: expected a block of --{name} {here}, found {there!r}; choose another with -m.")


def refuse_other_training(folder: Path, begun: Checkpoint | None) -> None:
    """Raise InputError if the folder holds a training that does not go on from here."""
    continued = begun and begun.path.resolve() == (folder / LAST).resolve()
    if not continued and ((folder / LAST).exists() or any(folder.glob("point_cloud/*/*.ply"))):
        raise InputError(f"{folder}: it already holds a training; choose another with -m, or --resume {folder}.")


def open_scene(config: TrainConfig, begun: Checkpoint | None, say: Report, processes: int = 1) -> Scene:
    """Read the scene and tell what may surprise."""
    data = config.data
    say(f"Scene {data.source_path}")
    needed = not begun or data.block  # whose cells it tells
    start = data.start_ply if needed or os.path.exists(data.start_ply) else ""  # if it has gone
    same = {name: getattr(data, name) for name in OF_SCENE}
    memory = photo_memory(config.machine.photo_memory, processes)
    scene = load_scene(data.source_path, **same, start=start, memory=memory, report=say)
    if begun:
        if data.start_ply and not start:  # whose points tell how near they come to cameras
            scene.__dict__["extent"] = begun.fact("extent", float)
        folder = begun.path.parent
        scene.refuse_other_frame(folder, read_coordinates(folder))
        if (args := folder / "cfg_args").is_file() and f"linear_light={not scene.linear}".encode() in args.read_bytes():
            expected = f"expected photographs {'not ' * scene.linear}in linear light, as {folder} was trained on"
            raise InputError(f"{data.source_path}: {expected}, found others; name those of then (-s), or start anew.")
        return scene
    if both := sorted({view.name for view in scene.train} & {view.name for view in scene.test}):
        raise InputError(f"{data.source_path}: expected photographs in one list, {both[0]} is in two; mend them.")
    if scene.block and scene.block.empty:  # before blocks are trained that could not be merged
        which = f"none of block {scene.block.empty[0] + 1}"
        raise InputError(f"--block {data.block}: expected photographs of each, found {which}; take fewer blocks.")
    if scene.random_points:
        say("Warning: the scene has no points to start from; random ones are taken, which trains worse.")
    if scene.start:
        scene.refuse_other_frame(start, scene.start.coordinates)
        if scene.test and (found := scene.trained_among(start)):
            say(f"Warning: {start} was trained on {len(found)} of {len(scene.test)} images that are held out.")
        if scene.start.antialiased != config.model.antialiasing:
            which = "with" if scene.start.antialiased else "without"
            say(f"Warning: {start} was trained {which} --antialiasing; the same option keeps its sizes right.")
        if scene.start.linear != scene.linear:
            say(f"Warning: only one of {start} and the photographs is said to be in linear light; colors may be off.")
    return scene


def write_inputs(folder: Path, config: TrainConfig, scene: Scene, begun: Checkpoint | None) -> None:
    """Write what this training was given: options, cameras, points."""
    config = config.changed(minutes=0.0)  # a clock cannot be repeated, what it decides can
    model_folder.write_cfg_args(folder, {**config.flat(), "train_test_exp": False, "linear_light": scene.linear})
    write_config(folder, config)
    coordinates = scene.coordinates or (read_coordinates(begun.path.parent) if begun else None)
    model_folder.write_cameras(folder, scene.test, scene.train, coordinates)
    write_coordinates(folder, coordinates)
    remove_leftovers(folder)
    (folder / BLOCK).unlink(missing_ok=True)  # until this, too, has ended
    if not (begun and (folder / "input.ply").exists()):
        save_points(folder / "input.ply", scene.points, scene.colors)

"""What a training of the scene will take on this machine: a few of its steps are tried."""

from collections.abc import Iterator

import torch

from warp_splat.errors import InputError
from warp_splat.inspect.subject import Finding, Subject
from warp_splat.presets import PRESETS
from warp_splat.raster.selftest import settle_device
from warp_splat.runtime.devices import memory_explained
from warp_splat.scene import Scene, load_scene
from warp_splat.scene.decoding import photo_memory
from warp_splat.text import Report
from warp_splat.training.deadline import cost_of
from warp_splat.training.memory import describe
from warp_splat.training.options import TrainConfig
from warp_splat.training.plan import seconds_of, task_of
from warp_splat.training.trainer import Trainer

RUNS = {"--preset fast": PRESETS["fast"], "the default": PRESETS[""]}


def check_cost(subject: Subject, say: Report) -> Iterator[Finding]:
    """Memory and time of a training by each of RUNS. None of a scene that cannot be loaded, which others tell."""
    try:
        scene = load_scene(subject.source, images=subject.folder, memory=photo_memory(), report=str)
    except InputError:
        return
    say("Trying a few steps (kernels are compiled once on a machine, about 20 s) ...")
    device = settle_device("auto", 0, say=say)
    cameras = [view.camera for view in scene.train]
    try:
        with memory_explained(device, scene.points, cameras, "take smaller images (-r), or fewer Gaussians"):
            yield from _tried(scene, device)
    except InputError as error:
        yield Finding("forecast", "warning", f"no more can be tried: {error}")


def _tried(scene: Scene, device: torch.device) -> Iterator[Finding]:
    runs = {name: TrainConfig(**options, device=device.type) for name, options in RUNS.items()}
    trials = {name: Trainer(scene, config.changed(settle_from_iter=1)) for name, config in runs.items()}  # none grows
    for trial in trials.values():
        trial.warm_up()
    told = {name: describe(trial) if device.type == "cpu" else ("", True) for name, trial in trials.items()}
    for name, config in runs.items():
        (text, fits), trial = told[name], trials.pop(name)
        if fits:
            task = task_of(config, scene, trial.photographs.shares)
            seconds, steps = seconds_of(config, cost_of(trial, task, str), task), config.learn.iterations
            time = f"{seconds / 60:.{int(seconds < 600)}f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
            text = f"about {time} for {steps} steps. {text}".rstrip()
        yield Finding("forecast", "note" if fits else "warning", f"{name}: {text}")

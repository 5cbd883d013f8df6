"""Short trainings of a small scene, step by step: their states, and whether they resume to the same bytes."""

import time

import torch

from warp_splat.formats.checkpoint import load_checkpoint
from warp_splat.runtime.distributed import Processes
from warp_splat.training.options import TrainConfig
from warp_splat.training.record import Run, keep, restore
from warp_splat.training.trainer import Trainer

#: Densifies, prunes, resets opacities and raises the SH degree within 50 steps.
SCHEDULE = {"device": "cpu", "iterations": 50, "sh_interval": 15, "opacity_reset_interval": 20}
SCHEDULE |= {"densify_from_iter": 10, "densify_until_iter": 45, "densification_interval": 10}
SCHEDULE |= {"densify_grad_threshold": 0.00005}


class Pretended(Processes):
    """One of ``count`` processes whose exchange another hand does."""

    def average(self, tensors):
        pass

    def check_identical(self, tensors, iteration):
        pass

    def _exchange(self, collective, *arguments):
        pass


def begin(scene, folder, **options):
    """A trainer and its run, as :func:`warp_splat.training.command.train` starts them."""
    return Trainer(scene, TrainConfig(**{**SCHEDULE, **options})), Run(folder, time.perf_counter())


def steps(trainer, run, end, watch=lambda: None):
    """Train until the loss of iteration ``end`` is differentiated, which is where models and checkpoints are saved."""
    for iteration in range(run.iteration + 1, end + 1):
        run.losses.append(trainer.advance(iteration))
        run.iteration = iteration
        watch()


def stepped(scene, folder, end, **options):
    """A trainer and its run after ``end`` steps."""
    trainer, run = begin(scene, folder, **options)
    steps(trainer, run, end)
    return trainer, run


def state_of(trainer, run):
    """All that the state holds, as bytes and values."""
    tensors, facts = trainer.state()
    tensors["losses"] = torch.stack(run.losses)
    return {name: (tensor.dtype, tensor.shape, tensor.numpy().tobytes()) for name, tensor in tensors.items()}, facts


def resumed(scene, folder, stops, then=None, **options):
    """A trainer that was kept and restored, with the scene ``then``, at all but the last of ``stops``, and its run."""
    trainer, run = begin(scene, folder, **options)
    for stop in stops[:-1]:
        steps(trainer, run, stop)
        keep(trainer, run)
        trainer, run = begin(then or scene, folder, **options)
        trainer.warm_up()
        restore(trainer, run, load_checkpoint(folder))
        assert run.iteration == stop
    steps(trainer, run, stops[-1])
    return trainer, run


def check_same(found, expected):
    """Of two trainers and their runs: no byte of the states differs."""
    (one, facts), (other, known) = state_of(*found), state_of(*expected)
    assert one.keys() == other.keys() and [name for name in one if one[name] != other[name]] == [] and facts == known

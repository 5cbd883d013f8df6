"""Gaussians in a file: the same bytes as in memory, and memory for what views show alone."""

import resource
import sys
from dataclasses import replace

import numpy as np
import psutil
import pytest
from commands import train
from trainings import begin, resumed, state_of

from warp_splat.errors import InputError
from warp_splat.formats.checkpoint import load_checkpoint
from warp_splat.training.record import keep, restore

SPARSE = {"optimizer_type": "sparse_adam"}


@pytest.mark.parametrize(
    "options",
    [
        {"sh_interval": 15},
        {"growth": "budget", "max_gaussians": 7000, "random_background": True, "prune_screen_size": 20},
        {"growth": "mcmc", "max_gaussians": 4900, "parts": "floaters"},
    ],
    ids=str,
)
def test_training_goes_on_as_in_memory(options, scene, tmp_path):
    """Also where it is stopped; but for gradients, and a loss, of prices of what the view does not show."""
    there = {"out_of_core": True, "model_path": str(tmp_path / "file")}
    expected, _ = state_of(*resumed(scene, tmp_path / "memory", [50], **SPARSE, **options))
    found, _ = state_of(*resumed(scene, tmp_path / "file", [20, 37, 50], **SPARSE, **there, **options))
    assert found.keys() == expected.keys()
    differing = {name for name in expected if found[name] != expected[name]}
    assert not {name for name in differing if not name.startswith(("gradients.", "losses"))}
    assert not differing or options.get("parts")


@pytest.mark.slow
def test_the_saved_model_is_that_of_memory(tmp_path):
    """With all that a command does before and after."""
    for folder, more in (("memory", ()), ("file", ("--out_of_core",))):
        assert train(tmp_path / folder, "--optimizer_type", "sparse_adam", *more) == 0
    one, other = (next((tmp_path / name).glob("point_cloud/*/*.ply")).read_bytes() for name in ("memory", "file"))
    assert one == other
    assert not list((tmp_path / "file").glob("tmp*"))


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere, nothing bounds a process's own memory alone")
def test_resuming_does_not_hold_all_in_memory(scene, tmp_path):
    """300,000 Gaussians have 203 MiB of parameters and moments."""
    rows = np.arange(300_000) % len(scene.points)
    many = replace(scene, points=scene.points[rows], colors=scene.colors[rows])
    trainer, run = begin(many, tmp_path, **SPARSE)
    trainer.differentiate(1)
    trainer.update(1)
    keep(trainer, run)
    trainer, run = begin(scene, tmp_path, out_of_core=True, model_path=str(tmp_path), **SPARSE)
    own, limits = psutil.Process().memory_info().data, resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (own + 96 * 2**20, limits[1]))
    try:
        restore(trainer, run, load_checkpoint(tmp_path))
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, limits)
    assert len(trainer.model) == len(rows) and trainer.optimizer.tables["sh_rest"].moments


@pytest.mark.parametrize(
    ("options", "found"),
    [({}, "optimizer_type default"), ({**SPARSE, "half_moments": True}, "half_moments")],
    ids=["dense", "halves"],
)
def test_what_needs_all_is_refused(options, found, scene, tmp_path):
    with pytest.raises(InputError, match=f"--out_of_core.*{found}"):
        begin(scene, tmp_path, out_of_core=True, model_path=str(tmp_path), **options)

"""Gaussians in a file: the same bytes as in memory, and memory for what views show alone."""

import pytest
from commands import train
from trainings import begin, resumed, state_of

from warp_splat.errors import InputError

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


def test_the_saved_model_is_that_of_memory(tmp_path):
    """With all that a command does before and after."""
    for folder, more in (("memory", ()), ("file", ("--out_of_core",))):
        assert train(tmp_path / folder, "--optimizer_type", "sparse_adam", *more) == 0
    one, other = (next((tmp_path / name).glob("point_cloud/*/*.ply")).read_bytes() for name in ("memory", "file"))
    assert one == other
    assert not list((tmp_path / "file").glob("tmp*"))


@pytest.mark.parametrize(
    ("options", "found"),
    [({}, "optimizer_type default"), ({**SPARSE, "half_moments": True}, "half_moments")],
    ids=["dense", "halves"],
)
def test_what_needs_all_is_refused(options, found, scene, tmp_path):
    with pytest.raises(InputError, match=f"--out_of_core.*{found}"):
        begin(scene, tmp_path, out_of_core=True, model_path=str(tmp_path), **options)

"""A training that goes on otherwise than it began: shorter, with other options, or where it may not write."""

import numpy as np
import pytest
from commands import python
from hostile import refusal
from PIL import Image
from trainings import begin, stepped

from warp_splat.cli import parse
from warp_splat.formats.checkpoint import LAST, load_checkpoint, save_checkpoint
from warp_splat.formats.model_folder import find_iteration, ply_path
from warp_splat.training.record import finish, keep, save_model


def test_a_run_that_ends_sooner_is_what_is_drawn(scene, tmp_path):
    """The last checkpoint was earlier than the last model; and the clock stands still."""
    save_model(*stepped(scene, tmp_path, 2))
    later, said = ply_path(tmp_path, 2).read_bytes(), []
    trainer, run = stepped(scene, tmp_path, 1)
    run.saved, run.dropped = save_model(trainer, run), trainer.all_dropped()
    assert run.seconds == 0.0 and find_iteration(tmp_path) == 2
    finish(trainer, run, said.append)
    assert find_iteration(tmp_path) == 1
    (kept,) = tmp_path.glob("point_cloud/iteration_2.*/*.ply")
    assert kept.read_bytes() == later
    assert any(f"later; as the newest is drawn, it is {kept.parent.name} now" in sentence for sentence in said)


BOTH = {"parts": "sky,exposure,pose", "exposure": "gain", "vignetting": True, "pose_intrinsics": "all"}


@pytest.mark.parametrize(
    ("options", "flags", "words"),
    [
        (BOTH, "--exposure affine", "--exposure affine: expected gain, as in"),
        (BOTH, "--no-vignetting", "--vignetting False: expected True, as in"),
        (BOTH, "--pose_intrinsics focal", "--pose_intrinsics focal: expected all, as in"),
        (BOTH | {"parts": "sky"}, "--exposure affine --no-vignetting --pose_intrinsics focal", None),
        (BOTH | {"vignetting": False, "pose_intrinsics": ""}, "--vignetting --pose_intrinsics focal", None),
    ],
)
def test_what_a_part_has_learned_by_stays(options, flags, words, scene, tmp_path):
    keep(*begin(scene, tmp_path))
    facts = load_checkpoint(tmp_path).facts
    save_checkpoint(tmp_path / LAST, {}, facts | {"options": facts["options"] | options})
    resume = ["train", "--resume", str(tmp_path), *flags.split()]
    if words:
        refusal(lambda: parse(resume), words, "leave it out")
    else:
        assert parse(resume).data.start_checkpoint == str(tmp_path)


@pytest.mark.parametrize("place", ["", "images", "sparse/0"])
def test_a_model_stays_out_of_the_scene_that_sfm_makes(place, tmp_path, fails):
    (tmp_path / "photos").mkdir()
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "photos" / "a.png")
    found = fails("train", "--sfm", "-s", tmp_path / "photos", "-m", tmp_path / "photos_scene" / place)
    assert "expected another folder than the scene's or its images'" in found


def test_sfm_wants_photographs(tmp_path, fails):
    assert "--sfm: expected photographs, found none named" in fails("train", "--sfm", "-m", tmp_path / "model")


def test_kernels_that_cannot_be_kept_are_a_sentence(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    load = (
        "from warp_splat.kernels import ssim; from warp_splat.runtime import launch; launch.load('cpu', ssim.compare)"
    )
    done = python("-c", load, check=False, WARP_CACHE_PATH=str(tmp_path / "file"))
    assert "InputError: WARP_CACHE_PATH or ~/.cache: expected a folder for compiled" in done.stderr

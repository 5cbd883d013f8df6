"""The preset, and training from coarse images to fine ones."""

from pathlib import Path

import numpy as np
import pytest

from warp_splat.cli import parse
from warp_splat.errors import InputError
from warp_splat.flags import flags_of
from warp_splat.presets import EMBEDDED_DEFAULTS, PRESETS
from warp_splat.scene import View, load_scene
from warp_splat.training.options import TrainConfig
from warp_splat.training.photographs import shares_of_size, shrink_at
from warp_splat.training.trainer import Trainer

SCENE = Path(__file__).parents[1] / "assets" / "still_life"


@pytest.fixture(scope="module")
def scene():
    return load_scene(SCENE, resolution=4, report=str)


def test_flags_go_before_the_preset_and_the_preset_before_defaults():
    assert parse(["train", "-s", "x"]) == TrainConfig(source_path="x")
    assert parse(["train", "-s", "x", "--preset", "fast"]) == TrainConfig(
        source_path="x", **{"preset": "fast", **PRESETS["fast"]}
    )
    assert parse(["train", "-s", "x", "--preset", "fast", "--coarse", "2"]).learn.coarse == 2
    embedded = parse(["train", "--preset", "fast", "--sh_interval", "7"])
    assert embedded.learn.sh_interval == 7 and embedded.data.eval
    assert embedded.learn.coarse == PRESETS["fast"]["coarse"]
    assert embedded.learn.iterations == EMBEDDED_DEFAULTS["fast"]["iterations"]


@pytest.mark.parametrize("flag", ["-s", "-m", "--resume", "--config"])
def test_empty_paths_are_refused(flag):
    with pytest.raises(InputError, match="an empty one"):
        parse(["train", flag, ""])


def test_presets_are_made_of_documented_flags():
    documented = {item.name for item in flags_of(TrainConfig) if item.metadata["help"]}
    for values in (*EMBEDDED_DEFAULTS.values(), *PRESETS.values()):
        assert set(values) <= documented


def test_images_grow_to_their_full_size(scene):
    trainer = Trainer(scene, TrainConfig(device="cpu", coarse=4, coarse_until_iter=10))
    view = scene.train[0]
    shrinks = []
    for iteration in range(1, 12):
        camera, photograph = trainer.photographs.at_size(view, iteration)
        assert photograph.image.shape == (camera.height, camera.width, 3)
        assert (camera.fx / camera.width, camera.cy / camera.height) == pytest.approx(
            (view.camera.fx / view.camera.width, view.camera.cy / view.camera.height)
        )
        shrinks.append(view.camera.width // camera.width)
    assert shrinks == [4] * 4 + [2] * 5 + [1] * 2
    assert camera is view.camera and np.array_equal(photograph.image.numpy(), view.image)


def test_a_size_lasts_as_long_as_its_share_of_the_detail():
    """White noise has as much in every frequency; a wave has all of it in one."""
    learn = TrainConfig(coarse=4, coarse_by="detail", coarse_until_iter=1000).learn
    camera = load_scene(SCENE, resolution=8, report=str).train[0].camera
    noise = np.repeat(np.random.default_rng(0).integers(0, 256, (240, 320, 1), dtype=np.uint8), 3, 2)
    wave = np.broadcast_to(np.rint(127 + 100 * np.sin(2 * np.pi * 16 * np.arange(80) / 80)), (240, 80))  # 0.2 per px
    wave = np.repeat(wave[..., None], 3, 2).astype(np.uint8)
    even = np.full((240, 320, 3), 9, np.uint8)
    for image, expected, margin in ((noise, (1 / 16, 1 / 4), 0.02), (wave, (0.0, 1.0), 0.05), (even, (0.25, 0.5), 0.0)):
        shares = shares_of_size(learn, [View("a", camera, image, camera)])
        assert shares == pytest.approx(expected, abs=margin)
        steps = [shrink_at(learn, shares, step) for step in range(1001)]
        assert steps == sorted(steps, reverse=True) and steps.count(4) == pytest.approx(1000 * shares[0], abs=1)
        assert steps[-1] == 1 and steps.count(1) == pytest.approx(1000 * (1 - shares[1]) + 1, abs=1)


def test_a_coarse_photograph_holds_the_means_of_the_fine_one(scene):
    image = np.random.default_rng(0).integers(0, 256, (40, 48, 3), dtype=np.uint8)
    camera = scene.train[0].camera.resized(48, 40)
    _, photograph = Trainer(scene, TrainConfig(device="cpu", coarse=4)).photographs.at_size(
        View("a", camera, image, camera), 1
    )
    means = image.reshape(10, 4, 12, 4, 3).mean((1, 3))
    assert np.abs(photograph.image.numpy() - means).max() <= 0.5 + 1e-3


def test_a_coarse_step_trains_on_a_coarse_image(scene):
    trainer = Trainer(scene, TrainConfig(device="cpu", coarse=4, coarse_until_iter=100))
    trainer.differentiate(1)
    assert trainer.photographs.kept and all(
        photograph.image.shape[0] == view.image.shape[0] // 4 for view, photograph in trainer.photographs.kept.items()
    )
    trainer.differentiate(60)
    assert all(
        photograph.image.shape[0] == view.image.shape[0] // 2 for view, photograph in trainer.photographs.kept.items()
    )

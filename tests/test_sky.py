"""The sky: what is saved is what training shows, who cannot carry it says so, and how much of it photographs show."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from test_checkpoints import begin, steps
from test_train import SCENE

from warp_splat.camera import Camera
from warp_splat.cli import main
from warp_splat.color import to_srgb
from warp_splat.errors import InputError
from warp_splat.formats.model_folder import ply_path, read_environment
from warp_splat.gaussians import GaussianModel
from warp_splat.rendering.command import make_picture
from warp_splat.scene import load_scene
from warp_splat.scene.horizon import share_of_sky
from warp_splat.training.options import TrainConfig
from warp_splat.training.record import save_model
from warp_splat.training.trial import weigh

sys.path.insert(0, str(Path(__file__).parents[1] / "assets"))

from make_faults import beyond, make_faulty, sky_light


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory):
    """A trainer with a sky, and the folder where it was saved."""
    folder = tmp_path_factory.mktemp("sky")
    trainer, run = begin(scene, folder, parts="sky")
    steps(trainer, run, 12)
    save_model(trainer, run)
    return trainer, folder


def test_what_is_saved_looks_as_in_training(trained, scene):
    trainer, folder = trained
    harmonics, camera = read_environment(folder, 12), scene.train[0].camera
    assert (harmonics != 0).all() and np.array_equal(harmonics, trainer.behind.numpy())
    assert np.array_equal(read_environment(ply_path(folder, 12), 0), harmonics)
    model = GaussianModel.load(ply_path(folder, 12))
    shown, without = (make_picture(model, False, trainer.options, False, some)(camera) for some in (harmonics, None))
    trainer.model = trainer.model.arranged()
    found = make_picture(trainer.model, False, trainer.options, False, harmonics)(camera)
    assert np.array_equal(shown, found) and not np.array_equal(shown, without)


def test_it_is_gray_at_first_and_learns_the_color_of_what_gaussians_do_not_cover(scene, tmp_path):
    trainer, run = begin(scene, tmp_path, parts="sky", sky_lr=0.05, iterations=200)
    blue = [replace(view, image=np.full_like(view.image, (30, 90, 200))) for view in scene.train[:3]]
    trainer.deck.views = blue
    trainer.model.parameters["opacities"].data.fill_(-12.0)  # under what is drawn
    assert (trainer.picture(blue[0].camera) == 128).all()
    steps(trainer, run, 200)
    assert np.abs(trainer.picture(blue[0].camera).astype(int) - (30, 90, 200)).max() < 12


def test_formats_without_it_say_so(trained, tmp_path, capsys):
    folder = str(trained[1])
    assert main(["convert", folder, str(tmp_path / "a.splat")]) == 0
    assert "what was learned behind the Gaussians (--parts sky), which no format has" in capsys.readouterr().out
    assert main(["export-html", folder, str(tmp_path / "a.html")]) == 0
    assert "The page does not have what was learned behind the Gaussians" in capsys.readouterr().out


@pytest.mark.parametrize("text", ["{", "[]", '{"harmonics": [[1, 2, 3]]}', '{"harmonics": [["a"]]}'])
def test_a_damaged_file_is_one_sentence(text, tmp_path):
    ply_path(tmp_path, 3).parent.mkdir(parents=True)
    (ply_path(tmp_path, 3).parent / "environment.json").write_text(text)
    with pytest.raises(InputError, match=r"environment\.json: expected harmonics as training writes them, found"):
        read_environment(tmp_path, 3)


def test_what_is_cut_out_has_no_sky(scene, tmp_path):
    clear = [replace(view, alpha=np.zeros(view.image.shape[:2], np.uint8)) for view in scene.train]
    with pytest.raises(InputError, match="--parts sky: expected photographs that are nowhere transparent, found"):
        begin(replace(scene, train=clear), tmp_path, parts="sky")


@pytest.mark.parametrize("roll", [0, 90, 180, 270])
def test_the_share_of_sky_of_a_plain(roll, scene, monkeypatch):
    """Points on the ground up to near the horizon, seen by level cameras: half of the picture, but for a cell."""
    turn = Rotation.from_euler("z", roll, degrees=True).as_matrix()
    level = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # looks along y, z is up
    x, y = np.meshgrid(np.linspace(-300, 300, 601), np.geomspace(1, 300, 300))
    ground = np.stack([x.ravel(), y.ravel(), np.full(x.size, -1.0)], 1)
    monkeypatch.setattr("warp_splat.scene.horizon.POINTS", 10**6)
    turns = [np.eye(3)] * 3 + [turn, turn.T]
    cameras = [Camera(240, 240, 120, 120, 120, 120, rotation @ level, np.zeros(3)) for rotation in turns]
    share = share_of_sky(cameras, ground)
    assert share == pytest.approx((12 - 1) / 24, abs=1e-9)
    wall = np.stack([x.ravel(), np.full(x.size, 400.0), y.ravel() * 1.5], 1)  # a ceiling would do as well
    assert share_of_sky(cameras, np.concatenate([ground, wall])) < share / 2


def test_auto_tells_how_much_sky_there_is(scene, tmp_path):
    trainer, _ = begin(scene, tmp_path)
    figure = "0.3 % of the photographs look up to where there are no points (limit 1.5 %)"
    assert weigh(trainer.config, scene)["sky"] == (False, figure)
    inside = (np.abs(scene.points[:, :2]).max(1) < 4.7) & (scene.points[:, 2] < 3.3)
    assert weigh(trainer.config, replace(scene, points=scene.points[inside]))["sky"].needed
    assert isinstance(trainer.behind, torch.Tensor) and trainer.behind.shape == (3,)


@pytest.mark.long
def test_the_sky_that_is_made_up_is_one(tmp_path):
    """Of every photograph: far pixels are the sky's color in their direction, near ones as they were."""
    make_faulty(tmp_path / "scene", ["sky"])
    clean, changed = (load_scene(path, eval=True, report=str) for path in (SCENE, tmp_path / "scene"))
    assert not beyond(changed.points).any() and len(changed.points) < len(clean.points)
    assert [name for name, verdict in weigh(TrainConfig(), changed).items() if verdict.needed] == ["sky"]
    for before, after in zip(clean.test + clean.train, changed.test + changed.train, strict=True):
        camera = after.camera
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rays = camera.rays(np.stack([x.ravel(), y.ravel()], 1)) @ camera.rotation
        light = sky_light(rays).clip(0, 1).reshape(after.image.shape)
        is_sky = np.abs(after.image - 255 * to_srgb(light, np.where)).max(-1) < 3
        as_before = np.abs(after.image.astype(int) - before.image).max(-1) < 2
        assert np.mean(is_sky | as_before) > 0.97 and 0.02 < is_sky.mean() < 0.5

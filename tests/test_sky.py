"""The sky: harmonics behind the Gaussians against float64; what is saved is what is shown; who cannot carry it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from commands import SCENE
from common import picture_of
from make_faults import beyond, make_faulty, sky_light
from scipy.spatial.transform import Rotation
from splat_files import some_file
from trainings import begin, stepped, steps

from warp_splat.camera import Camera
from warp_splat.color import to_srgb
from warp_splat.compare.oracle import sh_basis
from warp_splat.errors import InputError
from warp_splat.formats.exchange import load_gaussians, save_gaussians
from warp_splat.formats.model_folder import ply_path, read_environment, write_cfg_args
from warp_splat.gaussians import GaussianModel
from warp_splat.lenses import Lens
from warp_splat.raster.behind import put_behind
from warp_splat.raster.camera_parameters import CameraParameters
from warp_splat.scene import load_scene
from warp_splat.scene.horizon import share_of_sky
from warp_splat.scene.types import Decoded
from warp_splat.training.options import TrainConfig
from warp_splat.training.record import save_model
from warp_splat.training.trial import weigh


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory):
    """A trainer with a sky, and the folder where it was saved."""
    folder = tmp_path_factory.mktemp("sky")
    trainer, run = stepped(scene, folder, 12, parts="sky")
    save_model(trainer, run)
    return trainer, folder


def test_what_is_saved_looks_as_in_training(trained, scene):
    trainer, folder = trained
    harmonics, camera = read_environment(folder, 12), scene.train[0].camera
    assert (harmonics != 0).all() and np.array_equal(harmonics, trainer.behind.numpy())
    assert np.array_equal(read_environment(ply_path(folder, 12), 0), harmonics)
    model = GaussianModel.from_splats(load_gaussians(ply_path(folder, 12)).splats)
    shown, without = (picture_of(model, some, trainer.options)(camera) for some in (trainer.behind, None))
    trainer.model = trainer.model.arranged()
    found = picture_of(trainer.model, trainer.behind, trainer.options)(camera)
    assert np.array_equal(shown, found) and not np.array_equal(shown, without)


def test_behind_a_rolling_shutter_each_row_sees_its_own_sky(scene):
    """Also one that learns, and through a lens."""
    last = Rotation.from_rotvec([0.05, 0.3, 0.1]).as_matrix()
    harmonics = 0.5 * torch.randn(16, 3, generator=torch.Generator().manual_seed(0))
    for lens in (None, Lens("OPENCV_FISHEYE", (0.05, 0.0, 0.0, 0.0))):
        first = replace(scene.train[0].camera, lens=lens)
        camera = Camera.rolling(first, replace(first, rotation=last @ first.rotation))
        image, alpha = torch.zeros(camera.height, camera.width, 3), torch.zeros(camera.height, camera.width)
        rows = [put_behind(image, alpha, harmonics, camera.at(row))[row] for row in range(camera.height)]
        for shown in (camera, CameraParameters(camera)):
            np.testing.assert_allclose(put_behind(image, alpha, harmonics, shown), torch.stack(rows), atol=2e-6)


def test_it_is_gray_at_first_and_learns_the_color_of_what_gaussians_do_not_cover(scene, tmp_path):
    trainer, run = begin(scene, tmp_path, parts="sky", sky_lr=0.05, iterations=200)
    blue = [replace(view, photograph=Decoded(np.full_like(view.image, (30, 90, 200)))) for view in scene.train[:3]]
    trainer.deck.views = blue
    trainer.model.parameters["opacities"].data.fill_(-12.0)  # under what is drawn
    assert (trainer.picture(blue[0].camera) == 128).all()
    steps(trainer, run, 200)
    assert np.abs(trainer.picture(blue[0].camera).astype(int) - (30, 90, 200)).max() < 12


@pytest.mark.parametrize("command", [["view"], ["simplify", "-s", SCENE]])
def test_it_has_no_bound(trained, fails, command):
    assert "expected one color behind the Gaussians, found a sky" in fails(*command, trained[1], "--tolerance", 0.01)
    assert not list(trained[1].glob("simplified*"))


def test_formats_without_it_say_so(trained, tmp_path, ran):
    folder = trained[1]
    said = ran("convert", folder, tmp_path / "a.splat")
    assert "what was learned behind the Gaussians (--parts sky), which no format has" in said
    assert "(--parts sky): it is black there." in ran("export-html", folder, tmp_path / "a.html")
    write_cfg_args(folder, {"white_background": True})
    assert "(--parts sky): it is white there." in ran("export-html", folder, tmp_path / "a.html")
    (folder / "cfg_args").unlink()


@pytest.mark.parametrize("text", ["{", "[]", '{"harmonics": [[1, 2, 3]]}', '{"harmonics": [["a"]]}'])
def test_a_damaged_file_is_one_sentence(text, tmp_path, fails):
    ply_path(tmp_path, 3).parent.mkdir(parents=True)
    (ply_path(tmp_path, 3).parent / "environment.json").write_text(text)
    save_gaussians(ply_path(tmp_path, 3), some_file(9))
    with pytest.raises(InputError, match=r"environment\.json: expected harmonics as training writes them, found"):
        read_environment(tmp_path, 3)
    assert "environment.json" in fails("export-html", tmp_path, tmp_path / "a.html")
    assert not (tmp_path / "a.html").exists()


def test_what_is_cut_out_has_no_sky(scene, tmp_path):
    clear = [view.pixels._replace(alpha=np.zeros(view.image.shape[:2], np.uint8)) for view in scene.train]
    train = [replace(view, photograph=pixels) for view, pixels in zip(scene.train, clear, strict=True)]
    with pytest.raises(InputError, match="--parts sky: expected photographs that are nowhere transparent, found"):
        begin(replace(scene, train=train), tmp_path, parts="sky")


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
    up = np.array([0.0, 0.0, 1.0])
    share = share_of_sky(cameras, ground, up)
    assert share == pytest.approx((12 - 1) / 24, abs=1e-9)
    wall = np.stack([x.ravel(), np.full(x.size, 400.0), y.ravel() * 1.5], 1)  # a ceiling would do as well
    assert share_of_sky(cameras, np.concatenate([ground, wall]), up) < share / 2
    down = [Camera(240, 240, 120, 120, 120, 120, np.diag([1.0, -1.0, -1.0]), np.array([0, 0, 5.0]))]
    assert share_of_sky(down, ground[ground[:, 1] > 5], up) == 0


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


FISHEYE = Lens("OPENCV_FISHEYE", (0.01, 0.0, 0.0, 0.0))


def made(width, height, focal, lens=None):
    """A camera, and image, alpha, harmonics and an upstream gradient."""
    rotation, random = Rotation.from_rotvec([0.3, 0.9, -0.4]).as_matrix(), torch.Generator().manual_seed(1)
    camera = Camera(width, height, focal, 1.1 * focal, 0.5 * width + 1, 0.5 * height - 2, rotation, np.ones(3), lens)
    image, upstream = (torch.rand(height, width, 3, generator=random) for _ in range(2))
    alpha = torch.rand(height, width, generator=random)
    harmonics = 0.7 * torch.randn(16, 3, generator=random)
    return camera, [leaf.requires_grad_() for leaf in (image, alpha, harmonics)], upstream


def exact(camera, image, alpha, harmonics):
    """In float64, by the oracle's harmonics."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.rays(np.stack([x.ravel(), y.ravel()], 1))
    seen = torch.from_numpy(np.isfinite(rays).all(1)).view(alpha.shape)
    basis = sh_basis(torch.from_numpy(np.nan_to_num(rays) @ camera.rotation), 3)
    colors = (0.5 + basis @ harmonics).clamp_min(0.0).view(image.shape)
    return image + (seen * (1.0 - alpha))[..., None] * colors, seen


@pytest.mark.parametrize(("size", "lens"), [((37, 31), None), ((5, 3), None), ((64, 48), FISHEYE)], ids=str)
def test_image_and_gradients_are_those_of_float64(size, lens, driver):
    """Some colors are cut to 0; the fisheye leaves corners unseen."""
    camera, leaves, upstream = made(*size, 8.0, lens)
    wide = [leaf.detach().double().requires_grad_() for leaf in leaves]
    expected, seen = exact(camera, *wide)
    found = put_behind(*leaves, camera)
    gradients = torch.autograd.grad(found, leaves, upstream)
    assert bool(seen.all()) == (lens is None)
    torch.testing.assert_close(found.double(), expected, rtol=0.0, atol=3e-6)
    for gradient, right in zip(gradients, torch.autograd.grad(expected, wide, upstream.double()), strict=True):
        assert (gradient - right).norm() < 3e-6 * right.norm()


def test_threads_change_nothing(same_by_threads):
    camera, leaves, upstream = made(211, 130, 90.0)
    image = lambda: put_behind(*leaves, camera)  # noqa: E731
    same_by_threads(lambda: [image(), *torch.autograd.grad(image(), leaves, upstream)])


def test_a_pixel_that_is_not_finite_spoils_no_coefficient():
    camera, leaves, upstream = made(37, 31, 8.0)
    upstream[3, 4] = torch.inf
    (gradient,) = torch.autograd.grad(put_behind(*leaves, camera), leaves[2:], upstream)
    assert torch.isfinite(gradient).all()

"""Stems, starts, alpha, linear light: against formulas that share nothing with the loader."""

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import scene_files
import torch
from commands import SHORT
from hostile import refusal
from PIL import Image
from scene_files import HEIGHT, WIDTH, load, texture, write_colmap, write_floats, write_image, write_transforms
from splat_files import some_file

from warp_splat.formats.exchange import save_gaussians
from warp_splat.formats.model_folder import ply_path
from warp_splat.scene import load_scene
from warp_splat.scene.images import read_kind, read_mask, read_numbers, read_pixels
from warp_splat.training.loss import image_loss
from warp_splat.training.options import TrainConfig
from warp_splat.training.trainer import Trainer


def test_images_are_found_by_their_stems(tmp_path):
    root = write_colmap(tmp_path, ["a.png", "sub/b.png"])
    (root / "images" / "sub" / "b.png").rename(root / "images" / "sub" / "b.PNG")
    scene, lines = load(root)
    assert [view.name for view in scene.train] == ["a.png", "sub/b.png"]
    assert lines == ["Taking 1 of 2 images by their stems: b.PNG for sub/b.png, ..."]
    write_image(root / "images" / "sub" / "b.tif", texture())
    refusal(lambda: load(root), "several of this stem (b.PNG, b.tif)")


def test_without_an_ending_png_goes_first(tmp_path):
    """As in the reference, which adds .png: a preview lies beside it."""
    root = scene_files.write_blender(tmp_path)
    photo = min((root / "train").glob("*.png"))
    write_image(photo.with_suffix(".jpg"), texture())
    assert photo.name in {Path(view.name).name for view in load(root)[0].train}


@pytest.mark.parametrize("name", ["../a.png", "/etc/passwd", "sub/../../a.png"])
def test_names_that_leave_the_folder_are_refused(tmp_path, name):
    scene_files.write_model(tmp_path / "sparse" / "0", ["x.png"])
    path = tmp_path / "sparse" / "0" / "images.txt"
    path.write_text(path.read_text().replace("x.png", name))
    refusal(lambda: load(tmp_path), "in this folder")


@pytest.mark.parametrize("kind", ["colmap", "transforms"])
def test_without_points_random_ones_in_the_views(tmp_path, kind):
    root = write_colmap(tmp_path, points=()) if kind == "colmap" else write_transforms(tmp_path, points=False)
    scene, lines = load(root)
    assert scene.points.shape == scene.colors.shape == (50_000, 3) and scene.points.dtype == np.float32
    assert scene.random_points and not lines  # train says so, while render has no need of them
    inside = np.zeros(len(scene.points), int)
    for view in scene.train:
        camera = view.camera
        depth = (scene.points @ camera.rotation.T + camera.translation)[:, 2]
        pixels = scene_files.project(camera, scene.points)
        inside += (depth > 0) & (np.abs(pixels / (camera.width, camera.height) - 0.5) <= 0.5 + 1e-4).all(axis=1)
    assert (inside >= 2).all()
    np.testing.assert_array_equal(scene.points, load(root)[0].points)


@pytest.mark.parametrize(("degree", "folder"), [(0, False), (2, True), (3, False)])
def test_start_from_a_file(tmp_path, degree, folder):
    root = write_colmap(tmp_path / "scene")
    first = Trainer(load(root)[0], TrainConfig(device="cpu", sh_degree=2))
    with torch.no_grad():
        for leaf in first.model.parameters.values():
            leaf.add_(0.1 * torch.randn(leaf.shape, generator=torch.Generator().manual_seed(0)))
    first.model.save(path := ply_path(tmp_path / "model", 7))
    scene, _ = load(root, start=str(tmp_path / "model" if folder else path))
    second = Trainer(scene, TrainConfig(device="cpu", sh_degree=degree))
    for name, tensor in first.model.arranged().parameters.items():
        found = second.model.parameters[name]
        if name == "sh_rest":
            assert found.shape[1] == (degree + 1) ** 2 - 1
            common = min(found.shape[1], tensor.shape[1])
            assert torch.equal(found[:, :common], tensor[:, :common]) and not found[:, common:].any()
        else:
            assert torch.equal(found, tensor)
    camera, first.degree = scene.train[0].camera, min(degree, 2)  # training goes on with all harmonics of the file
    assert np.abs(first.look(camera).image - second.look(camera).image).max() < 1e-6
    refusal(lambda: load(root, start=str(tmp_path / "b.ply")), "no such file")
    save_gaussians(tmp_path / "empty.ply", some_file(0))
    empty = str(tmp_path / "empty.ply")
    refusal(lambda: load(root, start=empty), "empty.ply: expected at least one Gaussian to start from")


def test_a_limit_below_the_points_is_told(tmp_path):
    scene = load_scene(write_colmap(tmp_path))
    count = len(scene.points)
    told = Trainer(scene, TrainConfig(max_gaussians=5, device="cpu")).told
    assert told == [f"Warning: --max_gaussians 5 bounds growth alone; training starts with all {count} Gaussians."]
    assert not Trainer(scene, TrainConfig(max_gaussians=count, device="cpu")).told


def seen_targets(monkeypatch, scene, steps, **options):
    """(render, photograph) of each step as the loss gets them, and the backgrounds drawn."""
    trainer, found = Trainer(scene, TrainConfig(device="cpu", iterations=steps, **options)), []

    def spy(image, target, *arguments, **options):
        found.append((image.detach().clone(), target.clone()))
        return image_loss(image, target, *arguments, **options)

    monkeypatch.setattr("warp_splat.training.trainer.image_loss", spy)
    for iteration in range(1, steps + 1):
        trainer.advance(iteration)
    return found


@pytest.mark.parametrize("white", [False, True])
def test_alpha_is_composited_on_random_backgrounds(tmp_path, monkeypatch, white):
    pixels = texture(channels=4)
    scene, _ = load(write_colmap(tmp_path, pixels=pixels), white_background=white)
    found = seen_targets(monkeypatch, scene, 3, random_background=True, white_background=white)
    generator = torch.Generator().manual_seed(0)
    alpha = pixels[..., 3:] / 255.0
    for _, target in found:
        background = torch.rand(1, 3, generator=generator).numpy()
        expected = pixels[..., :3] / 255.0 * alpha + background * (1 - alpha)
        assert np.abs(target.numpy() - expected).max() < 0.51 / 255
    opaque = load(write_colmap(tmp_path / "opaque", pixels=texture(channels=3)))[0]
    assert opaque.train[0].alpha is None
    (_, target), *_ = seen_targets(monkeypatch, opaque, 1, random_background=True)
    assert target.dtype == torch.uint8


def light(dtype=float):
    return np.random.default_rng(5).exponential(0.5, (HEIGHT, WIDTH, 3)).astype(np.float16).astype(dtype)


def test_floats_are_linear_light(tmp_path, monkeypatch):
    root = write_colmap(tmp_path)
    for name in "abc":
        write_floats(root / "images" / f"{name}.exr", light())
        (root / "images" / f"{name}.png").unlink()
    scene, lines = load(root)
    view = scene.train[0]
    assert scene.linear and view.image.dtype == np.float32 and "a.exr for a.png" in lines[0]
    np.testing.assert_array_equal(view.image, light())  # above 1, too
    encoded = lambda x: np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)  # noqa: E731
    assert np.abs(view.picture - 255 * encoded(light().clip(0, 1))).max() <= 0.5 + 1e-4
    assert view.picture.dtype == np.uint8
    logarithmic = (np.log(light() + 1e-3) - np.log(1e-3)) / (np.log(1 + 1e-3) - np.log(1e-3))
    for space, expected in (("srgb", encoded(light())), ("log", logarithmic)):
        ((image, target),) = seen_targets(monkeypatch, scene, 1, loss_space=space)
        np.testing.assert_allclose(target, expected, atol=2e-6)
        assert image.isfinite().all()
    trainer = Trainer(scene, TrainConfig(device="cpu"))
    for iteration in range(1, 31):
        loss = trainer.advance(iteration)
    assert loss.isfinite() and all(tensor.isfinite().all() for tensor in trainer.model.parameters.values())


def test_photographs_that_have_become_linear(tmp_path, ran, fails):
    """A training does not go on with them, and what it made is no start without a word."""
    root, model = write_colmap(tmp_path / "scene"), tmp_path / "model"
    ran("train", "-s", root, "-m", model, *SHORT, "--iterations", "2")
    for photo in (root / "images").iterdir():
        write_floats(photo.with_suffix(".exr"), light())
        photo.unlink()
    assert "expected photographs not in linear light, as" in fails("train", "--resume", model, "--iterations", "4")
    begun = ran("train", "-s", root, "-m", tmp_path / "new", "--start_ply", model, "--iterations", "1")
    assert f"only one of {model} and the photographs is said to be in linear light" in begun
    assert "expected a scene not in linear light" in fails("simplify", model, "-s", root, "--keep", "0.5")


def write_exr(path, channels, size=(WIDTH, HEIGHT)):
    """An EXR of so many pixels, whose picture has those of the others; a channel is 1/8, 2/8, ..., or no number."""
    spec, file = oiio.ImageSpec(*size, len(channels), oiio.FLOAT), oiio.ImageOutput.create("a.exr")
    spec.channelnames, spec.full_width, spec.full_height = channels, WIDTH, HEIGHT
    values = [{"Z": 1e30, "A": 1.0, "cut.A": 0.5}.get(name, (1 + place) / 8) for place, name in enumerate(channels)]
    pixels = np.tile(np.float32(values), (size[1], size[0], 1))
    assert file.open(str(path), spec) and file.write_image(pixels) and file.close()


EXR_NUMBERS = {
    "A Z": 1e30,
    "B G R Z": 1e30,
    "Y": 0.125,
    "V A": 0.125,
    "a.R depth.Z": 0.25,
    "R normal.Z": 0.125,
    "R z": 0.25,
    "R depth_std Depth": 0.375,
}


@pytest.mark.parametrize(("channels", "found"), EXR_NUMBERS.items())
def test_numbers_of_an_exr_are_those_of_z(tmp_path, channels, found):
    write_exr(tmp_path / "a.exr", channels.split())
    assert (read_numbers(tmp_path / "a.exr") == np.float32(found)).all()


@pytest.mark.parametrize(
    ("channels", "found"),
    [
        ("R G B Z", [1, 2, 3]),  # renders bring depths along, where nothing is 1e30
        ("Z L.R L.G L.B L.A", [2, 3, 4]),
        ("Albedo.R Albedo.G Albedo.B R G B A", [4, 5, 6]),
        ("Y", [1, 1, 1]),
        ("V", [1, 1, 1]),
        ("Y A Z", [1, 1, 1]),
        ("Red Green Blue", [1, 2, 3]),
        ("R G B matte.B", [1, 2, 3]),
        ("Albedo.R Albedo.G Albedo.B L.R L.G L.B L.A", "R, G, B of one layer, found Albedo"),
        ("a.red a.green a.blue b.red b.green b.blue", "expected R, G, B of one layer"),
        ("N.X N.Y N.Z", "expected R, G, B of one layer"),
        ("RY BY Y", "expected R, G, B of one layer"),
        ("R G", "expected R, G, B of one layer"),
    ],
)
def test_colors_of_an_exr_are_found_by_their_names(tmp_path, channels, found):
    root = write_colmap(tmp_path, ["a.exr"])
    write_exr(root / "images" / "a.exr", channels.split())
    if isinstance(found, str):
        refusal(lambda: load(root), match=found)
    else:
        assert (load(root)[0].train[0].image == np.float32(found) / 8).all()


def test_an_exr_with_fewer_pixels_than_its_picture_is_refused(tmp_path):
    root = write_colmap(tmp_path, ["a.exr"])
    write_exr(root / "images" / "a.exr", ["R", "G", "B"], (WIDTH // 2, HEIGHT // 2))
    refusal(lambda: load(root), "expected a flat EXR whose data window is its picture, found another")


def test_a_gif_is_read(tmp_path):
    """OpenImageIO says that alpha is in a channel that is not there."""
    Image.new("RGB", (4, 3), (51, 102, 153)).save(tmp_path / "a.gif")
    found = read_pixels(tmp_path / "a.gif", 1.0)
    assert found.alpha is None and np.abs(found.color * 255 - [51, 102, 153]).max() < 1e-4


def test_a_deep_exr_is_refused(tmp_path):
    """Of which only parts would be read into memory that held something else."""
    spec, data, file = oiio.ImageSpec(4, 4, 3, oiio.FLOAT), oiio.DeepData(), oiio.ImageOutput.create("a.exr")
    spec.deep = True
    data.init(16, 3, [oiio.FLOAT] * 3, ["R", "G", "B"])
    assert file.open(str(tmp_path / "a.exr"), spec) and file.write_deep_image(data) and file.close()
    refusal(lambda: read_kind(tmp_path / "a.exr"), "expected a flat EXR")


@pytest.mark.parametrize("channels", ["A", "V", "Y"])
def test_masks_in_an_exr_have_one_channel_of_any_name(tmp_path, channels):
    write_exr(tmp_path / "a.exr", [channels])
    assert read_mask(tmp_path / "a.exr", (WIDTH, HEIGHT), invert=False).all()


def test_alpha_of_an_exr_is_that_of_its_colors(tmp_path):
    root = write_colmap(tmp_path, ["a.exr"])
    write_exr(root / "images" / "a.exr", ["R", "G", "B", "cut.A"])
    assert not read_kind(root / "images" / "a.exr")[1]
    found = load(root)[0].train[0]
    assert found.alpha is None and (found.image == np.float32([1, 2, 3]) / 8).all()


def test_one_kind_of_light_in_a_scene(tmp_path):
    root = write_colmap(tmp_path)
    write_floats(root / "images" / "b.exr", light())
    (root / "images" / "b.png").unlink()
    refusal(lambda: load(root), "one kind, but a.png is as a screen shows it and b.png in linear light")
    scene, _ = load(write_colmap(tmp_path / "png"))
    config = TrainConfig(device="cpu", loss_space="log")
    refusal(lambda: Trainer(scene, config), "--loss_space log: expected photographs in linear light")


def test_sixteen_bit_files_that_say_so_are_linear(tmp_path):
    pixels = texture(dtype=np.uint16)
    root = write_colmap(tmp_path, ["a.png"], pixels)
    assert not load(root)[0].linear
    write_image(root / "images" / "a.png", pixels, [("oiio:ColorSpace", "lin_rec709_scene")])
    scene, _ = load(root)
    assert scene.linear
    np.testing.assert_allclose(scene.train[0].image, pixels / 65535, atol=1e-6)


def test_absurd_sizes_are_refused_before_they_are_decoded(tmp_path, monkeypatch):
    root = write_colmap(tmp_path)
    monkeypatch.setattr("warp_splat.scene.images.PIXELS_MOST", WIDTH * HEIGHT - 1)
    refusal(lambda: load(root), match=rf"a\.png.*{WIDTH} x {HEIGHT} x 1 pixels of 3 channels")

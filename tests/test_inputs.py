"""Cameras in JSON, masks, alpha, linear light, stems, starts: against formulas that share nothing with the loader."""

import json

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from scene_files import (
    COLORS,
    HEIGHT,
    POINTS,
    WIDTH,
    load,
    look_at_origin,
    project,
    texture,
    write_colmap,
    write_image,
    write_model,
)
from splat_files import some_file
from test_losses import oracle
from test_scene import distorted_picture, fisheye, pattern, radial

from warp_splat.config import TrainConfig
from warp_splat.errors import InputError
from warp_splat.evaluate import evaluate_views
from warp_splat.formats.exchange import save_gaussians
from warp_splat.formats.ply import save_points
from warp_splat.losses import LossByConvolution, image_loss
from warp_splat.metrics import METRICS, psnr, ssim
from warp_splat.scene.images import read_mask
from warp_splat.trainer import Trainer

LENS = {"w": WIDTH, "h": HEIGHT, "fl_x": 40.0, "fl_y": 44.0, "cx": 22.5, "cy": 17.25}


def write_transforms(root, names=("images/a.png", "images/b.png"), pixels=None, frame=None, points=True, **values):
    """A nerfstudio scene; ``frame`` changes the frame of an index."""
    frames = []
    for index, name in enumerate(names):
        write_image(root / name, texture() if pixels is None else pixels)
        matrix = look_at_origin(np.array((4.0, -1.0 + index, 1.5)))
        frames.append({"file_path": name, "transform_matrix": matrix.tolist(), **(frame(index) if frame else {})})
    if points:
        save_points(root / "points.ply", POINTS, COLORS.astype(np.uint8))
        values["ply_file_path"] = "points.ply"
    (root / "transforms.json").write_text(json.dumps({**LENS, **values, "frames": frames}))
    return root


def write_floats(path, pixels, kind="half", names=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec) and output.write_image(pixels.astype(np.float32)) and output.close()


# transforms.json ---------------------------------------------------------------------------------


def test_transforms_cameras_points_and_axes(tmp_path):
    scene, lines = load(write_transforms(tmp_path, applied_transform=np.eye(4)[[1, 0, 2]].tolist()))
    assert [view.name for view in scene.train] == ["images/a.png", "images/b.png"] and not lines
    camera = scene.train[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (40, 44, 22.5, 17.25)
    np.testing.assert_allclose(camera.center, (4.0, -1.0, 1.5))  # as in the file: applied_transform is not undone
    np.testing.assert_allclose(project(camera, [(0, 0, 0)]), [(22.5, 17.25)], atol=1e-9)
    assert project(camera, [(0, 0, 0.5)])[0, 1] < 15  # the world's z is up
    np.testing.assert_array_equal(scene.points, POINTS.astype(np.float32))
    np.testing.assert_array_equal(scene.colors, COLORS)


def test_transforms_intrinsics_of_frames_go_before_those_of_the_file(tmp_path):
    root = write_transforms(tmp_path, frame=lambda index: {"fl_x": 50.0, "fl_y": 51.0, "cx": 20} if index else {})
    cameras = [view.camera for view in load(root)[0].train]
    assert [(c.fx, c.fy, c.cx, c.cy) for c in cameras] == [(40, 44, 22.5, 17.25), (50, 51, 20, 17.25)]


def test_transforms_sizes_twice_those_of_the_files(tmp_path):
    camera = load(write_transforms(tmp_path, w=2 * WIDTH, h=2 * HEIGHT))[0].train[0].camera
    assert (camera.width, camera.fx, camera.fy, camera.cx, camera.cy) == (WIDTH, 20, 22, 11.25, 8.625)


def test_transforms_with_lists_of_names(tmp_path):
    names = [f"images/{name}.png" for name in "abcde"]
    root = write_transforms(tmp_path, names, train_filenames=[names[3], f"./{names[0]}"], val_filenames=[names[1]])
    scene, lines = load(root, eval=True)
    assert [view.name for view in scene.train] == [names[0], names[3]]
    assert [view.name for view in scene.test] == [names[1]]
    assert lines == ["Leaving out 2 of 5 images that transforms.json neither trains nor tests on."]
    assert [view.name for view in load(root)[0].train] == [names[0], names[3], names[1]]
    scene, lines = load(
        write_transforms(tmp_path, names, test_filenames=names[2:4], val_filenames=names[:1]), eval=True
    )
    assert [view.name for view in scene.train] == [names[0], names[1], names[4]] and not lines
    assert [view.name for view in scene.test] == names[2:4]


def full_radial(x, y, k1, k2, p1, p2, k3, k4=0.0, k5=0.0, k6=0.0):
    """OpenCV's rational model."""
    r2 = x * x + y * y
    factor = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return (
        x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * factor + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
    )


def thin_prism(x, y, k1, k2, p1, p2, k3, k4, s1, s2):
    """Weng et al. 1992 on the angles of a fisheye, in COLMAP's order of the parameters."""
    x, y = fisheye(x, y, 0.0, 0.0, 0.0, 0.0)
    dx, dy = full_radial(x, y, k1, k2, p1, p2, k3)
    r2 = x * x + y * y
    return dx + x * k4 * r2**4 + s1 * r2, dy + y * k4 * r2**4 + s2 * r2


def field_of_view(x, y, omega):
    """Devernay and Faugeras 2001."""
    r = np.hypot(x, y)
    factor = np.arctan(2 * r * np.tan(omega / 2)) / (r * omega)
    return x * factor, y * factor


def check_ideal(view):
    camera = view.camera
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    ideal = pattern((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy) * 255
    assert view.image.shape == ideal.shape
    assert np.abs(view.image - ideal)[2:-2, 2:-2].max() < 0.6  # levels of 255; quantization alone gives 0.5


@pytest.mark.parametrize(
    ("model", "distort", "params", "values"),
    [
        ("OPENCV", radial, (-0.15, 0.04, 0.002, -0.003), {"k1": -0.15, "k2": 0.04, "p1": 0.002, "p2": -0.003}),
        ("OPENCV", full_radial, (-0.1, 0.03, 0.002, 0.001, -0.01), {}),
        ("OPENCV_FISHEYE", fisheye, (0.02, -0.01, 0.003, 0.0), {}),
    ],
)
def test_transforms_with_distortion(tmp_path, model, distort, params, values):
    width, height, lens = 160, 120, (150, 156, 83.2, 58.6)
    keys = ("k1", "k2", "p1", "p2", "k3") if distort is full_radial else ("k1", "k2", "k3", "k4")
    values = {**(values or dict(zip(keys, params, strict=True))), "camera_model": model}
    values |= dict(zip(("w", "h", "fl_x", "fl_y", "cx", "cy"), (width, height, *lens), strict=True))
    pixels = distorted_picture(distort, params, width, height, *lens)
    scene, lines = load(write_transforms(tmp_path, ["a.png"], pixels, **values))
    check_ideal(scene.train[0])
    assert len(lines) == 1 and "Undistorting 1 of 1" in lines[0]


@pytest.mark.parametrize(
    ("model", "distort", "params"),
    [
        ("FULL_OPENCV", full_radial, (-0.1, 0.03, 0.002, 0.001, -0.01, 0.02, 0.01, 0.003)),
        ("SIMPLE_RADIAL_FISHEYE", fisheye, (0.02,)),
        ("RADIAL_FISHEYE", fisheye, (0.02, -0.01)),
        ("THIN_PRISM_FISHEYE", thin_prism, (0.02, -0.01, 0.002, 0.001, 0.003, 0.0, 0.004, -0.002)),
        ("FOV", field_of_view, (0.4,)),
    ],
)
def test_other_models_of_colmap(tmp_path, model, distort, params):
    fx, fy, cx, cy = (150, 150 if "RADIAL" in model else 156, 83.2, 58.6)
    focal = (fx,) if "RADIAL" in model else (fx, fy)
    bent = (*params, *[0.0] * (4 - len(params))) if distort is fisheye else params
    pixels = distorted_picture(distort, bent, 160, 120, fx, fy, cx, cy)
    numbers = " ".join(map(str, (model, 160, 120, *focal, cx, cy, *params)))
    scene, lines = load(write_colmap(tmp_path, ["a.png"], pixels, camera=numbers))
    check_ideal(scene.train[0])
    assert model in lines[0]


def broken(change=None, **values):
    def make(root):
        write_transforms(root, **values)
        if change:
            content = json.loads((root / "transforms.json").read_text())
            change(content)
            (root / "transforms.json").write_text(json.dumps(content))

    return make


def deep(root):
    (root / "transforms.json").write_text("[" * 100_000)


def huge(root):
    (root / "transforms.json").write_text("[" + "[]," * 6_000_000 + "[]]")


BAD = {
    "k4": (broken(k1=0.1, k4=0.1), ["frame 0", "OPENCV", "k4 = 0.1"]),
    "fisheye-p1": (broken(camera_model="OPENCV_FISHEYE", p1=0.1), ["frame 0", "p1 = 0.1"]),
    "model": (broken(camera_model="EQUIRECTANGULAR"), ["frame 0", "EQUIRECTANGULAR"]),
    "model-list": (broken(camera_model=[1]), ["frame 0", "camera_model"]),
    "focal": (broken(fl_x="wide"), ["frame 0", "fl_x as a number", "'wide'"]),
    "focal-0": (broken(fl_x=0), ["fx", "positive"]),
    "focal-large": (broken(fl_x=10**400), ["frame 0", "fl_x"]),
    "no-focal": (broken(lambda c: c.pop("fl_x")), ["frame 0", "camera_angle_x"]),
    "size": (broken(w=32, h=48), ["a.png", "32 x 48", f"{WIDTH} x {HEIGHT}"]),
    "size-half": (broken(w=1.5), ["frame 0", "w and h"]),
    "frame": (broken(lambda c: c["frames"].append(5)), ["frame 2", "file_path"]),
    "outside": (broken(lambda c: c["frames"][0].update(file_path="../a.png")), ["in this folder", "'../a.png'"]),
    "absolute": (broken(lambda c: c["frames"][0].update(file_path="/etc/hostname")), ["'/etc/hostname'"]),
    "long": (broken(lambda c: c["frames"][0].update(file_path="x" * 5000)), ["1 of them cannot be found"]),
    "nul": (broken(lambda c: c["frames"][0].update(file_path="a\0b/c")), ["1 of them cannot be found"]),
    "list": (broken(test_filenames=["images/c.png"]), ["'images/c.png' has no frame or is in two"]),
    "list-twice": (broken(train_filenames=["images/a.png"], val_filenames=["images/a.png"]), ["'images/a.png'"]),
    "list-all": (broken(val_filenames=["images/a.png", "images/b.png"]), ["none is left to train on"]),
    "list-odd": (broken(train_filenames="images/a.png"), ["train_filenames as a list of names", "'images/a.png'"]),
    "points": (broken(lambda c: c.update(ply_file_path="b.ply")), ["'b.ply'", "no such file"]),
    "points-outside": (broken(lambda c: c.update(ply_file_path="../b.ply")), ["in this folder"]),
    "points-number": (broken(lambda c: c.update(ply_file_path=3)), ["string as ply_file_path"]),
    "mask": (broken(lambda c: c["frames"][1].update(mask_path="m.png")), ["frame 1", "the mask 'm.png'"]),
    "matrix-large": (
        broken(lambda c: c["frames"][1].update(transform_matrix=[[10**400] * 4] * 4)),
        ["frame 1", "4 x 4 finite"],
    ),
    "deep": (deep, ["transforms.json", "cannot be parsed"]),
    "huge": (huge, ["transforms.json", "at most 16777216 bytes"]),
}


@pytest.mark.parametrize(("make", "parts"), BAD.values(), ids=BAD.keys())
def test_bad_transforms_are_one_sentence(tmp_path, make, parts):
    make(tmp_path)
    with pytest.raises(InputError) as caught:
        load(tmp_path)
    message = str(caught.value)
    assert all(part in message for part in parts), message
    assert "\n" not in message and message.endswith(".") and len(message) < 700 + 2 * len(str(tmp_path))


# stems and starts --------------------------------------------------------------------------------


def test_images_are_found_by_their_stems(tmp_path):
    root = write_colmap(tmp_path, ["a.png", "sub/b.png"])
    (root / "images" / "sub" / "b.png").rename(root / "images" / "sub" / "b.PNG")
    scene, lines = load(root)
    assert [view.name for view in scene.train] == ["a.png", "sub/b.png"]
    assert lines == ["Taking 1 of 2 images by their stems: b.PNG for sub/b.png, ..."]
    write_image(root / "images" / "sub" / "b.tif", texture())
    with pytest.raises(InputError, match=r"several of this stem \(b\.PNG, b\.tif\)"):
        load(root)


@pytest.mark.parametrize("name", ["../a.png", "/etc/passwd", "sub/../../a.png"])
def test_names_that_leave_the_folder_are_refused(tmp_path, name):
    write_model(tmp_path / "sparse" / "0", ["x.png"])
    path = tmp_path / "sparse" / "0" / "images.txt"
    path.write_text(path.read_text().replace("x.png", name))
    with pytest.raises(InputError, match="in this folder"):
        load(tmp_path)


@pytest.mark.parametrize("kind", ["colmap", "transforms"])
def test_without_points_random_ones_in_the_views(tmp_path, kind):
    if kind == "colmap":
        root = write_colmap(tmp_path)
        (root / "sparse" / "0" / "points3D.txt").write_text("# none\n")
    else:
        root = write_transforms(tmp_path, points=False)
    scene, lines = load(root)
    assert scene.points.shape == scene.colors.shape == (50_000, 3) and scene.points.dtype == np.float32
    assert scene.random_points and not lines  # train says so, while render has no need of them
    inside = np.zeros(len(scene.points), int)
    for view in scene.train:
        camera = view.camera
        depth = (scene.points @ camera.rotation.T + camera.translation)[:, 2]
        pixels = project(camera, scene.points)
        inside += (depth > 0) & (np.abs(pixels / (camera.width, camera.height) - 0.5) <= 0.5 + 1e-4).all(axis=1)
    assert (inside >= 2).all()
    np.testing.assert_array_equal(scene.points, load(root)[0].points)


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_start_from_a_file(tmp_path, degree):
    root = write_colmap(tmp_path / "scene")
    first = Trainer(load(root)[0], TrainConfig(device="cpu", sh_degree=2))
    with torch.no_grad():
        for leaf in first.model.parameters.values():
            leaf.add_(0.1 * torch.randn(leaf.shape, generator=torch.Generator().manual_seed(0)))
    first.model.save(tmp_path / "a.ply")
    scene, _ = load(root, start=str(tmp_path / "a.ply"))
    second = Trainer(scene, TrainConfig(device="cpu", sh_degree=degree))
    for name, tensor in first.model.parameters.items():
        found = second.model.parameters[name]
        if name == "sh_rest":
            assert found.shape[1] == (degree + 1) ** 2 - 1
            common = min(found.shape[1], tensor.shape[1])
            assert torch.equal(found[:, :common], tensor[:, :common]) and not found[:, common:].any()
        else:
            assert torch.equal(found, tensor)
    with pytest.raises(InputError, match="no such file"):
        load(root, start=str(tmp_path / "b.ply"))
    save_gaussians(tmp_path / "empty.ply", some_file(0))
    with pytest.raises(InputError, match=r"empty\.ply: expected at least one Gaussian to start from"):
        load(root, start=str(tmp_path / "empty.ply"))


# masks -------------------------------------------------------------------------------------------


def some_mask(height=HEIGHT, width=WIDTH):
    mask = np.full((height, width, 1), 255, np.uint8)
    mask[height // 4 : height // 2, width // 3 : width // 2] = 0
    return mask


@pytest.mark.parametrize("name", ["sub/a.jpg.png", "sub/a.png"])
@pytest.mark.parametrize("invert", [False, True])
def test_masks_by_either_name(tmp_path, name, invert):
    names = ["b.jpg", "sub/a.jpg"]
    write_model(tmp_path / "sparse" / "0", names)
    for image in names:
        write_image(tmp_path / "images" / image, texture())
    mask = some_mask() // (255 if invert else 1)  # 0 and 1, as some tools write it
    write_image(tmp_path / "masks" / name, 1 - mask if invert else mask)
    scene, lines = load(tmp_path, invert_masks=invert)
    assert scene.train[0].mask is None
    np.testing.assert_array_equal(scene.train[1].mask, some_mask()[..., 0] > 0)
    assert lines == ["Masks for 1 of 2 images; b.jpg and 0 others are used whole."]


def test_masks_follow_their_photographs(tmp_path):
    """Undistorted, halved, and drawn at twice the size: what counts is where the photograph is red."""
    width, height = 160, 120
    mask = some_mask(height, width)
    pixels = np.concatenate([mask, np.zeros((height, width, 2), np.uint8)], axis=2)
    root = write_colmap(tmp_path, ["a.png"], pixels, camera=f"OPENCV {width} {height} 150 150 80 60 -0.15 0.04 0 0")
    write_image(root / "masks" / "a.png", np.repeat(np.repeat(mask, 2, 0), 2, 1))
    view = load(root, resolution=2)[0].train[0]
    assert view.mask.shape == view.image.shape[:2] and view.mask.dtype == np.uint8
    np.testing.assert_array_equal(view.mask, view.image[..., 0] >= 128)
    assert 0 < 1 - view.mask.mean() < 0.2


def test_photographs_that_are_masked_all_over_are_left_out(tmp_path):
    root = write_colmap(tmp_path)
    black = np.zeros((HEIGHT, WIDTH, 1), np.uint8)
    write_image(root / "masks" / "a.png", black)
    scene, lines = load(root)
    assert [view.name for view in scene.train] == ["b.png", "c.png"]
    assert "Leaving out 1 of 3" in lines[-1]
    for name in "bc":
        write_image(root / "masks" / f"{name}.png", black)
    with pytest.raises(InputError, match="all 3 images are black"):
        load(root)
    assert len(load(root, invert_masks=True)[0].train) == 3


def test_masks_of_another_shape_are_refused(tmp_path):
    write_image(tmp_path / "m.png", some_mask(WIDTH, HEIGHT))
    with pytest.raises(InputError, match=rf"m\.png.*{WIDTH} x {HEIGHT}.*got {HEIGHT} x {WIDTH}"):
        read_mask(tmp_path / "m.png", (WIDTH, HEIGHT), False)


@pytest.mark.parametrize("bytes_", [False, True])
@pytest.mark.parametrize("loss_of", ["kernels", "convolutions"])
@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_masked_loss(share, loss_of, bytes_):
    generator = torch.Generator().manual_seed(4)
    image, target, other = torch.rand(3, 40, 53, 3, generator=generator)
    if bytes_:
        target, other = ((255 * picture).to(torch.uint8) for picture in (target, other))
    mask = (torch.rand(40, 53, 1, generator=generator) > 0.2).to(torch.uint8)
    mask[5:30, 10:40] = 0

    def loss(image, target):
        leaf = image.clone().requires_grad_()
        if loss_of == "kernels":
            value = image_loss(leaf, target, share, mask)
        else:
            value = LossByConvolution.apply(leaf * mask, target * mask, share)
        value.backward()
        return value.item(), leaf.grad

    value, gradient = loss(image, target)
    exact = image.double().requires_grad_()
    keep = mask.double()
    expected = oracle(exact * keep, (target / 255.0 if bytes_ else target) * keep, share)
    expected.backward()
    assert abs(value - expected.item()) < 1e-6
    assert (gradient - exact.grad).norm() < 1e-5 * exact.grad.norm()
    assert not gradient[mask[..., 0] == 0].any()
    hidden = mask == 0
    again = loss(torch.where(hidden, 1 - image, image), torch.where(hidden, other, target))
    assert again[0] == value and torch.equal(again[1], gradient)


def test_metrics_do_not_see_what_is_masked(tmp_path):
    random = np.random.default_rng(0)
    image, reference, other = random.integers(0, 256, (3, 40, 50, 3), dtype=np.uint8)
    mask = some_mask(40, 50)[..., 0]
    kept = mask > 0
    expected = -10 * np.log10(np.mean((image[kept] / 255 - reference[kept] / 255) ** 2))
    assert psnr(image, reference, mask) == pytest.approx(expected)
    hidden = np.where(kept[..., None], reference, other)
    assert ssim(image, reference, mask) == ssim(image, hidden, mask)
    assert ssim(image, reference, np.ones_like(mask)) == ssim(image, reference)
    black = ssim(image * kept[..., None], reference * kept[..., None])  # mean over all, windows of black ones are 1
    assert ssim(image, reference, mask) < black


def test_evaluation_keeps_and_uses_masks(tmp_path):
    root = write_colmap(tmp_path / "scene")
    write_image(root / "masks" / "b.png", some_mask())
    views = load(root)[0].train

    def picture(camera):
        image = texture() // 2
        image[some_mask()[..., 0] == 0] = 255
        return image

    means, _ = evaluate_views(picture, views, tmp_path / "model", "test", 1, {}, METRICS)
    folder = tmp_path / "model" / "test" / "ours_1"
    assert [path.name for path in (folder / "masks").iterdir()] == ["00001.png"]
    values = json.loads((tmp_path / "model" / "per_view.json").read_text())["ours_1"]["PSNR"]
    kept = some_mask()[..., 0] > 0
    expected = -10 * np.log10(np.mean((texture()[kept] / 255 - texture()[kept] // 2 / 255) ** 2))
    assert values["00001.png"] == pytest.approx(expected) and values["00000.png"] < expected
    assert means["PSNR"] == pytest.approx(np.mean(list(values.values())))
    evaluate_views(picture, views[:1], tmp_path / "model", "test", 1, {}, METRICS)
    assert not list((folder / "masks").iterdir())


@pytest.mark.parametrize("coarse", [1, 2])
def test_training_does_not_see_what_is_masked(tmp_path, coarse):
    """Photographs that differ under their masks alone give the same bytes."""
    models = []
    for value in (0, 255):
        root = tmp_path / str(value)
        pixels = texture()
        mask = np.full((HEIGHT, WIDTH, 1), 255, np.uint8)
        mask[8:16, 16:32] = 0
        pixels[mask[..., 0] == 0] = value
        write_colmap(root, pixels=pixels)
        for name in "abc":
            write_image(root / "masks" / f"{name}.png", mask)
        trainer = Trainer(load(root)[0], TrainConfig(device="cpu", coarse=coarse, iterations=6))
        for iteration in range(1, 6):
            trainer.differentiate(iteration)
            trainer.update(iteration)
        models.append(trainer.model.parameters)
    assert all(torch.equal(models[0][name], models[1][name]) for name in models[0])


# alpha and linear light --------------------------------------------------------------------------


def seen_targets(monkeypatch, scene, steps, **options):
    """(render, photograph) of each step as the loss gets them, and the backgrounds drawn."""
    trainer, found = Trainer(scene, TrainConfig(device="cpu", iterations=steps, **options)), []

    def spy(image, target, share, mask):
        found.append((image.detach().clone(), target.clone()))
        return image_loss(image, target, share, mask)

    monkeypatch.setattr("warp_splat.trainer.image_loss", spy)
    for iteration in range(1, steps + 1):
        trainer.differentiate(iteration)
        trainer.update(iteration)
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
    x = light().clip(0, 1)
    shown = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055) * 255
    assert np.abs(view.picture - shown).max() <= 0.5 + 1e-4 and view.picture.dtype == np.uint8
    y = light()
    curves = {
        "srgb": np.where(y <= 0.0031308, 12.92 * y, 1.055 * y ** (1 / 2.4) - 0.055),
        "log": (np.log(y + 1e-3) - np.log(1e-3)) / (np.log(1 + 1e-3) - np.log(1e-3)),
    }
    for space, expected in curves.items():
        ((image, target),) = seen_targets(monkeypatch, scene, 1, loss_space=space)
        np.testing.assert_allclose(target, expected, atol=2e-6)
        assert image.isfinite().all()
    trainer = Trainer(scene, TrainConfig(device="cpu"))
    for iteration in range(1, 30):
        loss = trainer.differentiate(iteration)
        trainer.update(iteration)
    assert loss.isfinite() and all(tensor.isfinite().all() for tensor in trainer.model.parameters.values())


def test_one_kind_of_light_in_a_scene(tmp_path):
    root = write_colmap(tmp_path)
    write_floats(root / "images" / "b.exr", light())
    (root / "images" / "b.png").unlink()
    with pytest.raises(InputError, match=r"one kind, but a\.png is as a screen shows it and b\.png in linear light"):
        load(root)
    scene, _ = load(write_colmap(tmp_path / "png"))
    with pytest.raises(InputError, match="--loss_space log: expected photographs in linear light"):
        Trainer(scene, TrainConfig(device="cpu", loss_space="log"))


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
    with pytest.raises(InputError, match=rf"a\.png.*{WIDTH} x {HEIGHT} x 1 pixels of 3 channels"):
        load(root)

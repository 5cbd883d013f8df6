"""Masks: how they are found, and that neither loss, metrics nor training see what they cover."""

import json

import numpy as np
import pytest
import torch
from hostile import refusal
from scene_files import HEIGHT, WIDTH, load, texture, write_colmap, write_image, write_model
from test_losses import check, differentiated

from warp_splat.evaluation.metrics import METRICS, psnr, ssim
from warp_splat.evaluation.views import evaluate_views
from warp_splat.scene import images
from warp_splat.scene.images import read_counts, read_mask
from warp_splat.training.options import TrainConfig
from warp_splat.training.trainer import Trainer


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


def test_photographs_that_are_masked_all_over_are_left_out(tmp_path, monkeypatch):
    """That is known from masks alone: photographs that memory does not hold are not decoded for it."""
    root = write_colmap(tmp_path)
    black = np.zeros((HEIGHT, WIDTH, 1), np.uint8)
    write_image(root / "masks" / "a.png", black)
    with monkeypatch.context() as patched:
        patched.setattr("warp_splat.scene.decoding.decode", None)
        lazily = load(root, memory=1.0)
    for scene, lines in (load(root), lazily):
        assert [view.name for view in scene.train] == ["b.png", "c.png"]
        assert "Leaving out 1 of 3" in lines[-1]
    for name in "bc":
        write_image(root / "masks" / f"{name}.png", black)
    refusal(lambda: load(root), "all 3 images are black; use --invert_masks, or change the masks.")
    refusal(lambda: load(root, eval=True), "all 2 images are black")
    for name in "bc":
        (root / "masks" / f"{name}.png").unlink()
    refusal(lambda: load(root, eval=True), "all 1 images (those held out) are black")
    for name in "bc":
        write_image(root / "masks" / f"{name}.png", black)
    assert len(load(root, invert_masks=True)[0].train) == 3


@pytest.mark.parametrize("resolution", [1, 2])
def test_a_thumbnail_never_decides_that_a_mask_covers_all(tmp_path, monkeypatch, resolution):
    """Of a photograph with a lens, it only tells that some pixels count."""
    width, height, widths = 160, 120, []
    masks = {name: np.zeros((height, width, 1), np.uint8) for name in ("black", "corner", "large", "small")}
    masks["large"][30:90, 40:120] = masks["small"][56:60, 70:74] = masks["corner"][0, 0] = 255
    lens = f"OPENCV {width} {height} 150 150 80 60 -0.15 0.04 0 0"
    root = write_colmap(tmp_path, [f"{name}.png" for name in masks], texture(width, height), camera=lens)
    for name, mask in masks.items():
        write_image(root / "masks" / f"{name}.png", mask)
    monkeypatch.setattr(images, "read_counts", lambda *of: widths.append(of[1].width) or read_counts(*of))
    kept = [view.name for view in load(root, resolution=resolution, memory=1.0)[0].train]
    assert kept == ["large.png", "small.png"]
    assert len(widths) == 7 and widths.count(min(widths)) == 4 and min(widths) < max(widths) / 10


def test_a_thumbnail_of_which_half_counts_decides_nothing(tmp_path):
    """Filters go beyond 0 and 1: of this band, half of a thumbnail's pixel counts, and no pixel of the view."""
    side, names = 1024, ["a.png", "b.png"]
    lens = f"SIMPLE_RADIAL {side} {side} {side} {side / 2} {side / 2} -0.05"
    root, (y, x) = write_colmap(tmp_path, names, texture(side, side), camera=lens), np.mgrid[:side, :side]
    shares = 30 * np.clip(np.minimum(x - 400, 656 - x) / 16, 0, 1)  # of 64 pixels that become one
    order = np.random.default_rng(0).permutation(64).reshape(8, 8)[y % 8, x % 8]
    for name, counts in zip(names, (shares > order, x < side / 2), strict=True):
        write_image(root / "masks" / name, 255 * counts.astype(np.uint8)[..., None])
    scene, _ = load(root, resolution=8, memory=1.0)
    assert [view.name for view in scene.train] == ["b.png"]


def test_masks_of_another_shape_are_refused(tmp_path):
    write_image(tmp_path / "m.png", some_mask(WIDTH, HEIGHT))
    sizes = f"{WIDTH} x {HEIGHT}", f"got {HEIGHT} x {WIDTH}"
    refusal(lambda: read_mask(tmp_path / "m.png", (WIDTH, HEIGHT), False), "m.png", *sizes)


@pytest.mark.parametrize("bytes_", [False, True])
@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_masked_loss(share, driver, bytes_):
    generator = torch.Generator().manual_seed(4)
    image, target, other = torch.rand(3, 40, 53, 3, generator=generator)
    if bytes_:
        target, other = ((255 * picture).to(torch.uint8) for picture in (target, other))
    mask = (torch.rand(40, 53, 1, generator=generator) > 0.2).to(torch.uint8)
    mask[5:30, 10:40] = 0
    loss = lambda image, target: differentiated(image, target, share, mask)  # noqa: E731
    value, gradient = check(image, target, share, mask)
    assert not gradient[mask[..., 0] == 0].any()
    hidden = mask == 0
    again = loss(torch.where(hidden, 1 - image, image), torch.where(hidden, other, target))
    assert again[0] == value and torch.equal(again[1], gradient)
    mask *= 255  # nor does it matter what stands for "counts", or that a hidden pixel is no number
    again = loss(torch.where(hidden, torch.nan, image), target if bytes_ else torch.where(hidden, torch.inf, target))
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

    def picture(camera, name):
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
        for iteration in range(1, 7):
            trainer.advance(iteration)
        models.append(trainer.model.parameters)
    assert all(torch.equal(models[0][name], models[1][name]) for name in models[0])

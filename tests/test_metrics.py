"""Metrics against closed forms and other implementations, and the JSON files that they are kept in."""

import json
import math
import sys
from functools import partial

import numpy as np
import pytest
import torch
from hostile import refusal
from scenes import make_camera
from test_losses import oracle

from warp_splat.evaluation.metrics import METRICS, cc_psnr, psnr, ssim, write_results
from warp_splat.evaluation.perceptual import choose_metrics, flip
from warp_splat.evaluation.views import evaluate_views
from warp_splat.formats.png import load_png, save_png
from warp_splat.scene.types import Decoded, View


def images(height, width, noise=20, seed=0):
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (height, width, 3))
    other = np.clip(image + rng.normal(0, noise, image.shape), 0, 255)
    return image.astype(np.uint8), other.astype(np.uint8)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 40), (11, 11), (37, 53)])
@pytest.mark.parametrize("noise", [1, 20, 200])
def test_ssim_agrees_with_torch(height, width, noise):
    """The formula with a dense two-dimensional window, in float64."""
    image, reference = images(height, width, noise)
    expected = 1 - oracle(*(torch.from_numpy(array).double() / 255 for array in (image, reference)), share=1.0).item()
    assert ssim(image, reference) == pytest.approx(expected, abs=1e-12)
    assert ssim(image, image) == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("step", [1, 16, 255])
def test_psnr_of_a_constant_error(step):
    black = np.zeros((5, 7, 3), np.uint8)
    assert psnr(black, black + np.uint8(step)) == pytest.approx(20 * math.log10(255 / step), abs=1e-12)
    assert psnr(black, black) == math.inf


#: Of red, green, blue and 255: whole numbers, so that no color of the tests below is rounded.
MAP = np.array([[2, -1, 0, 0], [0, 1, 0, 0.2], [1, 1, -1, 0]])


def mapped(image):
    return np.concatenate([image, np.full((*image.shape[:2], 1), 255)], 2) @ MAP.T


def between(low, high, shape=(40, 30, 3), seed=0):
    return np.random.default_rng(seed).integers(low, high, shape).astype(np.uint8)


def test_cc_psnr_forgives_an_affine_map_of_the_colors():
    image = between(60, 110)
    assert psnr(image, mapped(image).astype(np.uint8)) < 25
    assert cc_psnr(image, mapped(image).astype(np.uint8)) > 200
    assert cc_psnr(image, image) > 200


def test_cc_psnr_leaves_out_what_is_saturated_in_either_and_cuts_what_comes_out():
    """A third of the reference is cut at 255 or 0, where no affine map leads; of the image, an eighth is black."""
    image = between(2, 240)
    reference = np.clip(mapped(image), 0, 255).astype(np.uint8)
    assert 0.2 < (reference % 255 == 0).mean() < 0.5
    assert cc_psnr(image, reference) > 200
    image[:5] = 0  # says nothing of the map, but counts
    wrong = (np.clip(mapped(image), 0, 255) - reference) / 255
    assert cc_psnr(image, reference) == pytest.approx(-10 * np.log10((wrong**2).mean()), abs=1e-6)


def test_cc_psnr_is_that_of_the_least_squares_where_nothing_is_saturated():
    image, noise = between(60, 190), np.random.default_rng(1).normal(0, 8, (40, 30, 3))
    reference = np.round(0.6 * image + 40 + noise).astype(np.uint8)
    terms, wanted = np.c_[image.reshape(-1, 3) / 255, np.ones(image.size // 3)], reference.reshape(-1, 3) / 255
    _, left, *_ = np.linalg.lstsq(terms, wanted, rcond=None)
    assert cc_psnr(image, reference) == pytest.approx(-10 * np.log10(left.sum() / wanted.size), abs=1e-9)


def test_cc_psnr_of_what_cannot_be_fitted():
    """Gray images leave the map open; where all is saturated, colors stay."""
    gray = between(60, 110, (20, 20, 1)).repeat(3, 2)
    assert cc_psnr(gray, 2 * gray + 3) > 150
    black, white, middle = (np.full((4, 5, 3), value, np.uint8) for value in (0, 255, 100))
    assert cc_psnr(black, white) == psnr(black, white) == 0 and cc_psnr(black, middle) == psnr(black, middle)
    assert cc_psnr(white, white) == math.inf and cc_psnr(middle, middle + np.uint8(50)) > 200


def test_cc_psnr_neither_fits_nor_counts_what_is_masked():
    image = between(60, 110)
    mask = np.ones(image.shape[:2], np.uint8)
    mask[:, 15:] = 0
    reference = np.where(mask[..., None] > 0, mapped(image), between(0, 255, seed=2)).astype(np.uint8)
    assert cc_psnr(image, reference, mask) > 200 > 30 > cc_psnr(image, reference)


@pytest.mark.parametrize("metric", [psnr, ssim, cc_psnr])
def test_metrics_check_their_images(metric):
    image, _ = images(4, 5)
    for bad in (image[:3], image.astype(np.float32), image[..., 0]):
        refusal(partial(metric, image, bad), "image: expected")


def test_png_keeps_every_value_and_gives_equal_bytes(tmp_path):
    image, _ = images(31, 17)
    save_png(tmp_path / "a.png", image)
    save_png(tmp_path / "b.png", image[:, ::-1][:, ::-1])
    np.testing.assert_array_equal(load_png(tmp_path / "a.png"), image)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_png_errors(tmp_path):
    image, _ = images(31, 17)
    save_png(tmp_path / "a.png", image)
    (tmp_path / "b.png").write_bytes((tmp_path / "a.png").read_bytes()[:500])
    for name, sentence in (("none.png", "could not be read"), ("b.png", "b.png")):
        refusal(partial(load_png, tmp_path / name), sentence)
    refusal(lambda: save_png(tmp_path / "a.xyz", image), "ending in .png")


def test_views_have_the_metrics_of_the_files_that_are_written(tmp_path):
    pairs = [images(20, 30, 5, seed=1), images(25, 12, 60, seed=2)]
    cameras = [make_camera(31, 17, seed=i) for i in (0, 1)]
    views = [View(f"{i}.jpg", camera, Decoded(pairs[i][1]), camera) for i, camera in enumerate(cameras)]
    metrics = {"SSIM": ssim, "PSNR": psnr}
    means, compared = evaluate_views(lambda _, name: pairs[int(name[0])][0], views, tmp_path, "test", 7, {}, metrics)
    written = json.loads((tmp_path / "per_view.json").read_text())["ours_7"]
    for name, metric in metrics.items():
        folders = [tmp_path / "test" / "ours_7" / folder for folder in ("renders", "gt")]
        expected = [metric(*(load_png(folder / f"{i:05d}.png") for folder in folders)) for i in (0, 1)]
        assert written[name] == {"00000.png": expected[0], "00001.png": expected[1]}
        assert [view.values[name] for view in compared] == expected and means[name] == pytest.approx(np.mean(expected))


def read_strictly(path):
    def refuse(name):
        raise AssertionError(f"{name} is not JSON")

    return json.loads(path.read_text(), parse_constant=refuse)


def test_results_are_json_and_keep_other_methods(tmp_path):
    other = '{"ours_7000": {"SSIM": 0.5, "PSNR": Infinity}, "ours_30000": {"LPIPS": 0.1}}'
    (tmp_path / "results.json").write_text(other)  # the reference writes Infinity
    means = {"SSIM": 1.0, "PSNR": np.inf, "CC_PSNR": np.inf}
    per_view = {name: {"00000.png": value} for name, value in means.items()}
    write_results(tmp_path, 30000, {**means, "gaussians": 12, "seconds": 1.5}, per_view)
    ours = {"SSIM": means["SSIM"], "PSNR": None, "CC_PSNR": None, "gaussians": 12, "seconds": 1.5}
    expected = {"ours_7000": {"SSIM": 0.5, "PSNR": None}, "ours_30000": ours}
    assert read_strictly(tmp_path / "results.json") == expected
    equal = {"00000.png": None}
    views = {"SSIM": {"00000.png": means["SSIM"]}, "PSNR": equal, "CC_PSNR": equal}
    assert read_strictly(tmp_path / "per_view.json") == {"ours_30000": views}


@pytest.mark.parametrize("text", ["{", "[]", '{"ours_1": 3}', "\xff"])
def test_results_that_are_not_json_are_left_alone(tmp_path, text):
    (tmp_path / "results.json").write_bytes(text.encode("latin-1"))
    refusal(lambda: write_results(tmp_path, 1, {"SSIM": 1.0, "PSNR": 2.0}, {}), match=r"results\.json.*move it away")
    assert (tmp_path / "results.json").read_bytes() == text.encode("latin-1")


TO_XYZ = np.array([[10135552, 8788810, 4435075], [2613072, 8788810, 887015], [1425312, 8788810, 70074405]])
TO_XYZ = TO_XYZ / [[24577794], [12288897], [73733382]]


def flip_of_colors(color, reference):
    """FLIP of two areas of one color each, by the paper alone (Andersson et al. 2020, sections 4.1 and 4.3).

    Filters leave a constant as it is and there are no edges or points, so the error of colors is all.
    """

    def hunt(rgb):
        rgb = np.asarray(rgb, np.float64)
        linear = np.where(rgb > 0.04045, ((rgb + 0.055) / 1.055) ** 2.4, rgb / 12.92)
        x, y, z = TO_XYZ @ linear / (TO_XYZ @ np.ones(3))
        f = [np.cbrt(v) if v > (6 / 29) ** 3 else v / (3 * (6 / 29) ** 2) + 4 / 29 for v in (x, y, z)]
        lightness = 116 * f[1] - 16
        return np.array([lightness, 5 * lightness * (f[0] - f[1]), 2 * lightness * (f[1] - f[2])])

    def distance(a, b):
        difference = np.abs(hunt(a) - hunt(b))
        return (difference[0] + np.hypot(difference[1], difference[2])) ** 0.7

    largest, found = distance([0, 1, 0], [0, 0, 1]), distance(color, reference)
    knee = 0.4 * largest
    return 0.95 * found / knee if found < knee else 0.95 + 0.05 * (found - knee) / (largest - knee)


@pytest.mark.parametrize(
    ("color", "reference"),
    [
        ((0, 0, 0), (255, 255, 255)),
        ((0, 255, 0), (0, 0, 255)),
        ((10, 20, 30), (12, 20, 28)),
        ((200, 90, 40), (90, 180, 200)),
        ((128, 128, 128), (128, 128, 128)),
    ],
)
def test_flip_of_constant_colors_is_that_of_the_paper(color, reference):
    image, other = (np.broadcast_to(np.array(c, np.uint8), (20, 24, 3)).copy() for c in (color, reference))
    expected = flip_of_colors(np.array(color) / 255, np.array(reference) / 255)
    assert flip(image, other) == pytest.approx(expected, abs=2e-4)


def test_flip_of_pictures():
    image, reference = images(40, 30, 20)
    assert flip(image, image) == 0 and flip(image, reference) == flip(image, reference)
    errors = [flip(images(40, 30, noise)[1], image) for noise in (2, 10, 50)]
    assert 0 < errors[0] < errors[1] < errors[2] < 1
    assert flip(*images(1, 1)) > 0


def test_flip_sees_nothing_under_a_mask():
    image, reference = images(40, 30, 20)
    mask = np.ones(image.shape[:2], np.uint8)
    assert flip(image, reference, mask) == flip(image, reference)
    mask[:, 15:] = 0
    other = np.where(mask[..., None] > 0, image, 255 - image)
    assert flip(other, reference, mask) == flip(image, reference, mask) != flip(image, reference)


def test_flip_that_is_not_installed_is_named(monkeypatch):
    monkeypatch.setattr("warp_splat.evaluation.perceptual.find_spec", lambda _: None)
    metrics, absent = choose_metrics("")
    assert set(metrics) == set(METRICS)
    assert [sentence.split()[0] for sentence in absent] == ["FLIP", "LPIPS"] and "pip install flip" in absent[0]


@pytest.mark.parametrize(
    ("net", "name"),
    [
        pytest.param("vgg16", "LPIPS", marks=pytest.mark.long),
        pytest.param("alexnet", "LPIPS_ALEX", marks=pytest.mark.slow),
    ],
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_lpips_takes_weights_from_disk(tmp_path, net, name):
    """The layers of torchvision's own network put into the authors' LPIPS, against the file of its weights."""
    lpips, torchvision = pytest.importorskip("lpips"), pytest.importorskip("torchvision")
    torch.manual_seed(0)
    layers = getattr(torchvision.models, net)(weights=None).features
    file = tmp_path / f"{net}.pth"
    torch.save({f"features.{key}": value for key, value in layers.state_dict().items()}, file)
    metrics, absent = choose_metrics(str(file))
    assert not absent and list(metrics)[-1] == name
    theirs = lpips.LPIPS(net="alex" if net == "alexnet" else "vgg", pnet_rand=True, verbose=False)
    for block in theirs.net.children():
        for index in list(block._modules):
            block._modules[index] = layers[int(index)]
    image, reference = images(40, 50)
    pair = [torch.from_numpy(array).permute(2, 0, 1)[None] / 255 for array in (image, reference)]
    with torch.no_grad():
        expected = float(theirs(*pair, normalize=net == "alexnet"))
    assert expected > 0 and metrics[name](image, reference) == pytest.approx(expected, rel=1e-5)
    assert metrics[name](image, image) == 0 and math.isnan(metrics[name](*images(40, 20)))


class Trap:
    """Runs something when it is unpickled."""

    def __reduce__(self):
        return (print, ("sprung",))


def test_lpips_weights_that_are_none(tmp_path, capsys):
    refusal(lambda: choose_metrics(str(tmp_path / "none.pth")), "none.pth: no such file")
    file = tmp_path / "a.pth"
    for value in ({"fc.weight": torch.zeros(2)}, [1, 2], {"features.28.weight": torch.zeros(2)}, Trap(), "text"):
        torch.save(value, file) if value != "text" else file.write_text("not weights")
        refusal(lambda: choose_metrics(str(file)), "a.pth: expected torchvision's weights")
    assert "sprung" not in capsys.readouterr().out


def test_lpips_without_its_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "lpips", None)
    torch.save({"features.28.weight": torch.zeros(2)}, tmp_path / "a.pth")
    refusal(lambda: choose_metrics(str(tmp_path / "a.pth")), "pip install lpips")

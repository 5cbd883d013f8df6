"""Parts that add to the loss: known depths, in maps and points, and a price on opacity; verdicts; what is refused."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from hostile import refusal
from scene_files import change_json, write_floats, write_image
from trainings import begin, steps

from warp_splat.runtime.distributed import ALONE
from warp_splat.scene.depth_maps import PARAMETERS, read_inverse_depths
from warp_splat.training.options import TrainConfig
from warp_splat.training.seams import Step
from warp_splat.training.trial import settle_parts, weigh

DEPTH = {"parts": "depth", "depth_l1_weight_init": 0.5}


@pytest.fixture(scope="module")
def made(scene, tmp_path_factory):
    """Maps of a scene: of the size at which it is loaded, but for the first, of the file's."""
    folder = tmp_path_factory.mktemp("maps")
    fits, random = {}, np.random.default_rng(0)
    for index, view in enumerate(scene.train):
        size = (248, 264) if index == 0 else view.image.shape[:2]
        write_image(folder / "depths" / view.name, random.integers(0, 2**16, (*size, 1), dtype=np.uint16))
        fits[view.name[:-4]] = {"scale": 20.0 if index == 2 else 1.5 + 0.01 * index, "offset": -0.25}
    (folder / PARAMETERS).parent.mkdir(parents=True)
    (folder / PARAMETERS).write_text(json.dumps(fits))
    return scene, folder


@pytest.fixture
def mapped(made, tmp_path):
    """The scene, as if it lay in a folder of its own, and that folder."""
    scene, folder = made
    return replace(scene, source=shutil.copytree(folder, tmp_path / "scene")), tmp_path / "scene"


def test_the_term_is_the_mean_of_what_each_point_says(scene, tmp_path):
    """And so is its gradient, written out in float64; of points in one pixel, the nearer one counts."""
    trainer, _ = begin(scene, tmp_path, **DEPTH)
    view, part = scene.train[3], trainer.parts[0]
    out = trainer.look(view.camera, depth=True)
    out.depth = out.depth.clone().requires_grad_()
    out.alpha[::2] = 0.4  # of rows that show too little
    loss = part.loss(torch.zeros(()), out, Step(25, view))
    loss.backward()
    known, (height, width) = {}, out.alpha.shape
    for point in scene.tracks[view.name].points:
        x, y, z = view.camera.rotation @ point + view.camera.translation
        u, v = view.camera.fx * x / z + view.camera.cx, view.camera.fy * y / z + view.camera.cy
        if 0 <= u < width and 0 <= v < height:
            place = int(v), int(u)
            known[place] = min(known.get(place, z), z)
    weight, extent = 0.5 * (0.01 / 0.5) ** (25 / 50), scene.extent
    total, gradient = 0.0, np.zeros((height, width))
    for (row, column), z in known.items():
        depth = out.depth[row, column].item()
        if out.alpha[row, column] > 0.5:
            error = abs(extent / depth - extent / z)
            total += 0.1 * error / (error + 0.1)
            slope = -np.sign(extent / depth - extent / z) * extent / depth**2
            gradient[row, column] = weight / len(known) * slope * 0.01 / (error + 0.1) ** 2
    assert len(known) > 100 and loss.item() == pytest.approx(weight * total / len(known), rel=1e-5)
    assert np.abs(out.depth.grad.numpy() - gradient).max() < 1e-5 * np.abs(gradient).max()


def test_geometry_learns_from_it(scene, tmp_path):
    """Alone, without photographs, expected depths come closer to those of the points."""
    trainer, run = begin(scene, tmp_path, **DEPTH, densify_from_iter=99)
    part, view = trainer.parts[0], scene.train[5]

    def measure():
        out = trainer.look(view.camera, depth=True)
        return part._error(out, part._points_at(view, *out.alpha.shape)).item()

    before = measure()
    weigh = part.loss
    part.loss = lambda loss, out, step: weigh(0.0 * loss, out, step)  # the photograph's does not count
    steps(trainer, run, 40)
    assert measure() < 0.7 * before


def test_maps_are_read_as_the_reference_writes_them(mapped):
    scene, folder = mapped
    maps = read_inverse_depths(scene, "depths")
    (folder / PARAMETERS).rename(folder / "depth_params.json"), shutil.rmtree(folder / "sparse")  # no COLMAP model
    assert all(np.array_equal(found, maps[view]) for view, found in read_inverse_depths(scene, "depths").items())
    told = f"1 of {len(scene.train)} depth maps are left out, of scales far from the median."
    assert told in begin(scene, folder / "model", depths="depths")[0].told
    assert scene.train[2] not in maps and len(maps) == len(scene.train) - 1  # far from the median scale
    for index, step in ((0, 8), (7, 1)):
        view = scene.train[index]
        raw = np.asarray(oiio.ImageBuf(str(folder / "depths" / view.name)).get_pixels(oiio.UINT16))[..., 0]
        expected = raw[step // 2 :: step, step // 2 :: step] / 65536 * (1.5 + 0.01 * index) - 0.25
        assert maps[view].shape == view.image.shape[:2]
        assert np.allclose(maps[view], np.where(expected < 0, -1, expected), atol=1e-6)


def test_exr_needs_no_parameters_and_masks_count(mapped):
    scene, folder = mapped
    scene = replace(scene, train=scene.train[:2])
    numbers = np.linspace(0, 2, 31 * 33, dtype=np.float32).reshape(31, 33)
    numbers[2], numbers[3] = np.nan, -1
    for view in scene.train:
        write_floats((folder / "exr" / view.name).with_suffix(".exr"), numbers[..., None], "float")
    (folder / PARAMETERS).unlink()
    mask = np.ones((31, 33), np.uint8)
    mask[5] = 0
    masked = replace(scene, train=[replace(view, photograph=view.pixels._replace(mask=mask)) for view in scene.train])
    for given, unknown in ((scene, [2, 3]), (masked, [2, 3, 5])):
        expected = numbers.copy()
        expected[unknown] = -1
        assert np.array_equal(read_inverse_depths(given, str(folder / "exr"))[given.train[1]], expected)


def test_maps_are_compared_like_points(mapped, tmp_path):
    scene, _ = mapped
    trainer, _ = begin(scene, tmp_path, depths="depths")
    view, part = scene.train[7], trainer.parts[0]
    out = trainer.look(view.camera, depth=True)
    target = part._map_at(view, *out.alpha.shape)
    numbers, depth = (np.float64(a) for a in (part.maps[view], out.depth))
    error = np.abs(scene.extent / np.where(depth > 0, depth, 1) - scene.extent * numbers)
    counts = (out.alpha.numpy() > 0.5) & (numbers >= 0)
    expected = np.where(counts, 0.1 * error / (error + 0.1), 0).mean()
    assert float(part._error(out, target)) == pytest.approx(expected, rel=1e-5)
    small = part._map_at(view, 31, 11).nearness.view(31, 11)
    assert np.allclose(small, np.float32(scene.extent) * part.maps[view][:, 1::3])


@pytest.mark.parametrize(("part", "every", "photographs"), [("depth", 8, "6"), ("floaters", 2, "22")])
def test_verdict(part, every, photographs, scene):
    assert not weigh(TrainConfig(), scene)[part].needed
    few = replace(scene, train=scene.train[::every])
    verdict = weigh(TrainConfig(), few)[part]
    assert verdict.needed and f"half of its points lie in {photographs} photographs or fewer (limit " in verdict[1]
    assert not weigh(TrainConfig(), replace(few, find_tracks=dict))[part].needed


def in_map(change):
    """Damage to the map of one photograph."""
    return lambda folder: change(folder / "depths" / "view_009.png")


def another_map(height, width, kind):
    return in_map(lambda path: write_image(path, np.zeros((height, width, 1), kind)))


def in_fits(change):
    """Damage to the parameters of the maps."""
    return lambda folder: change_json(folder, change, PARAMETERS)


def scaled(scale):
    return in_fits(lambda fits: fits.update(view_009={"scale": scale, "offset": 0}))


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (in_map(Path.unlink), "view_009.png: expected a map of inverse depth for view_009.png, found none; add it."),
        (
            another_map(100, 264, np.uint16),
            "expected a map of 264 x 248 pixels as its photograph has, or scaled by one factor, got 264 x 100",
        ),
        (another_map(248, 264, np.uint8), "view_009.png: expected numbers of 16 bits or floats, found uint8"),
        (
            lambda folder: (folder / PARAMETERS).unlink(),
            "depth_params.json: expected scale and offset of each map of inverse depth, found no such file",
        ),
        (
            in_fits(lambda fits: [fit.update(scale=-1.0) for fit in fits.values()]),
            "--depths depths: expected maps of 1 / depth, found scales or numbers below 0; fit them.",
        ),
        (in_fits(lambda fits: fits.pop("view_009")), "depth_params.json: expected JSON of the kind"),
        (scaled(None), "found {'scale': None, 'offset': 0} for view_009"),
        (scaled(10**400), "depth_params.json: the file is damaged"),
        (
            in_fits(lambda fits: [fit.update(scale=1e300) for fit in fits.values()]),
            "--depths depths: expected maps of 1 / depth, found scales or numbers below 0; fit them.",
        ),
    ],
)
def test_what_does_not_fit_is_one_sentence(damage, sentence, mapped):
    scene, folder = mapped
    damage(folder)
    refusal(lambda: read_inverse_depths(scene, "depths"), sentence)


def test_photographs_that_were_undistorted_have_no_maps(mapped):
    scene, _ = mapped
    bent = replace(scene, train=[replace(scene.train[0], undistorted=True)])
    refusal(lambda: read_inverse_depths(bent, "depths"), "which is undistorted as it is read")


def test_a_scene_without_depths_is_refused(scene, tmp_path):
    plain = replace(scene, find_tracks=dict)
    refusal(lambda: begin(plain, tmp_path, **DEPTH), "--parts depth: expected a scene that says which points")


def differentiated(scene, folder, **options):
    """A trainer after the loss of its first view, and that loss."""
    trainer, _ = begin(scene, folder, **options)
    return trainer, float(trainer.differentiate(1))


def test_it_adds_the_mean_opacity_and_its_gradient(scene, tmp_path):
    """To every Gaussian's logit, in view or not, and to nothing else."""
    (plain, loss), (priced, with_price) = (differentiated(scene, tmp_path, parts=parts) for parts in ("", "floaters"))
    opacities = torch.sigmoid(plain.model.parameters["opacities"].detach().double())
    assert with_price == pytest.approx(loss + 0.05 * float(opacities.mean()), abs=1e-7)
    for name, leaf in plain.model.parameters.items():
        if name != "opacities" and leaf.grad is not None:
            assert torch.equal(priced.model.parameters[name].grad, leaf.grad), name
    before, after = (trainer.model.parameters["opacities"].grad.double() for trainer in (plain, priced))
    expected = 0.05 / len(opacities) * opacities * (1.0 - opacities)
    unseen = before == 0
    assert unseen.any() and not unseen.all()
    torch.testing.assert_close(after[unseen], expected[unseen], rtol=1e-6, atol=0.0)
    torch.testing.assert_close(after, before + expected, rtol=1e-6, atol=1e-12)


def test_the_sum_is_the_same_in_any_order_and_leaves_out_what_is_not_finite(scene, tmp_path):
    trainer, _ = begin(scene, tmp_path, parts="floaters")
    out = trainer.look(scene.train[0].camera)
    opacities = torch.rand(100_001, generator=torch.Generator().manual_seed(0)).square().requires_grad_()
    trainer.parts[0].model, losses = range(100_001), []
    for order in (slice(None), torch.arange(100_000, -1, -1), torch.randperm(100_001)):
        losses.append(trainer.parts[0].price(out.gaussians._replace(opacities=opacities[order])).float())
    assert losses[0] == losses[1] == losses[2]
    exact = 0.05 * math.fsum(opacities.tolist()) / 100_001
    assert losses[0].item() == pytest.approx(exact, abs=0.05 * 2**-24, rel=1e-7)
    (gradient,) = torch.autograd.grad(losses[2], opacities)
    assert torch.equal(gradient, torch.full_like(gradient, 0.05 / 100_001))  # rounded once
    trainer.parts[0].model = range(2)
    gaussians = out.gaussians._replace(opacities=torch.tensor([0.5, float("nan")]))
    assert float(trainer.parts[0].price(gaussians)) == pytest.approx(0.0125)


def test_without_it_nothing_changes_and_that_is_told(scene):
    assert settle_parts(TrainConfig(), scene, ALONE, str) == (TrainConfig(), [])
    config, told = settle_parts(TrainConfig(opacity_reg=9.0), scene, ALONE, str)
    assert not config.used_parts
    assert told == ["Warning: the part floaters is not used, without which --opacity_reg will change nothing."]

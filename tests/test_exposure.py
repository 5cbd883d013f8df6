"""Exposure: kernels against float64, the gauge, what it finds of faults that are known, and the same bytes again."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from commands import SCENE, train
from fake_viser import at_rest, drawn, entered, some_scene
from make_faults import make_faulty
from splat_files import small_splats
from trainings import begin, stepped, steps

from warp_splat.camera import Camera
from warp_splat.color import COLOR_MAPS, from_srgb, to_srgb
from warp_splat.errors import InputError
from warp_splat.formats.exposures import Exposures, read_exposures
from warp_splat.formats.model_folder import ply_path
from warp_splat.formats.png import load_png
from warp_splat.gaussians import GaussianModel
from warp_splat.rendering.finished import as_photographed, make_renderer
from warp_splat.scene import load_scene
from warp_splat.scene.gains import gains_of
from warp_splat.scene.neighbors import guessed
from warp_splat.scene.types import Decoded
from warp_splat.training.options import TrainConfig
from warp_splat.training.parts import exposure
from warp_splat.training.record import save_model
from warp_splat.training.trial import weigh
from warp_splat.viewer import server

SIZE = (21, 37)  # pixels that are no multiple of sixteen
KINDS = ("gain", "affine", "bilateral")


@pytest.fixture(scope="module")
def faulty(tmp_path_factory):
    """The embedded scene with gains and white balances, and what they are."""
    folder = tmp_path_factory.mktemp("faulty") / "scene"
    return folder, make_faulty(folder, ["exposure"])["exposure"]


def part_of(scene, folder, **options):
    return begin(scene, folder, **options)[0].parts[-1]


def exact(kind, numbers, falloff, pivot, image):
    """What the part makes of an image, in float64 by torch's own operations; of grids, by weights of all cells."""
    height, width, _ = image.shape
    y, x = ((torch.arange(n, dtype=torch.float64) + 0.5 - n / 2) for n in (height, width))
    square = (y[:, None] ** 2 + x**2) / ((height**2 + width**2) / 4)
    image = (image + pivot) * (1 + falloff[0] * square + falloff[1] * square**2)[..., None]
    if kind == "gain":
        return image * (1 + numbers) - pivot
    if kind == "affine":
        return image + image @ numbers[:9].view(3, 3) + numbers[9:] - pivot
    _, deep, high, wide = numbers.shape
    z = ((image - pivot).mean(-1) * (deep - 1)).clamp(0, deep - 1)
    y, x = (((torch.arange(n, dtype=torch.float64) + 0.5) / n * (m - 1)) for n, m in ((height, high), (width, wide)))
    hats = [(1 - (a[..., None] - torch.arange(n)).abs()).clamp_min(0) for a, n in ((z, deep), (y, high), (x, wide))]
    sliced = torch.einsum("kdij,hwd,hi,wj->hwk", numbers, *hats)
    return image + torch.einsum("hwc,hwcd->hwd", image, sliced[..., :9].unflatten(-1, (3, 3))) + sliced[..., 9:] - pivot


@pytest.mark.parametrize("kind", KINDS)
def test_images_and_gradients_are_those_of_float64(kind, driver, scene, tmp_path):
    """Of image, map and vignetting."""
    part = part_of(scene, tmp_path, exposure=kind, vignetting=True)
    random = torch.Generator().manual_seed(1)
    image, upstream = (torch.rand(*SIZE, 3, generator=random) for _ in range(2))
    with torch.no_grad():
        part.maps[3] = 0.2 * torch.rand(part.maps[3].shape, generator=random) - 0.1
        part.falloff[:] = torch.tensor([-0.2, 0.05])
    leaves = [image.requires_grad_(), part.maps, part.falloff]
    wide = [leaf.detach().double().requires_grad_() for leaf in leaves]
    made = exact(kind, wide[1][3], wide[2], part.pivot, wide[0])
    found = part.image(image, None, SimpleNamespace(view=scene.train[3]))
    gradients = torch.autograd.grad(found, leaves, upstream)
    torch.testing.assert_close(found.double(), made, rtol=0.0, atol=1e-6)
    for gradient, right in zip(gradients, torch.autograd.grad(made, wide, upstream.double()), strict=True):
        assert (gradient - right).norm() < 2e-6 * right.norm()


@pytest.mark.parametrize("kind", KINDS)
def test_at_first_it_is_the_identity_and_its_mean_stays_so(kind, scene, tmp_path):
    """Exactly, over the photographs; in the sum of float32 as well."""
    plain, _ = begin(scene, tmp_path)
    trainer, run = begin(scene, tmp_path, exposure=kind)
    assert torch.equal(plain.differentiate(1), trainer.differentiate(1))
    steps(trainer, run, 12)
    maps = trainer.parts[0].maps.detach()
    assert torch.equal(maps.double().sum(0), torch.zeros(maps.shape[1:], dtype=torch.float64))
    assert (maps != 0).any(1).all() if kind == "gain" else (maps != 0).any()


@pytest.mark.parametrize("kind", KINDS)
def test_a_pixel_that_is_not_finite_spoils_no_map(kind, scene, tmp_path):
    trainer, _ = begin(scene, tmp_path, exposure=kind, vignetting=True)
    part, image = trainer.parts[0], torch.rand(5, 7, 3)
    image[2, 3] = torch.inf
    part.image(image, None, SimpleNamespace(view=scene.train[0])).clamp(0, 1).sum().backward()
    assert torch.isfinite(part.maps.grad).all() and torch.isfinite(part.falloff.grad).all()
    assert part.maps.grad.any()


def test_rates_cannot_fall_to_nothing(scene, tmp_path):
    with pytest.raises(InputError, match="--exposure_lr_final: expected a positive number"):
        begin(scene, tmp_path, exposure="gain", exposure_lr_final=0.0)


@pytest.mark.parametrize("kind", ["gain", "affine"])
def test_the_folder_has_the_maps_in_the_layout_of_the_reference(kind, scene, tmp_path):
    trainer, run = stepped(scene, tmp_path, 9, exposure=kind)
    save_model(trainer, run)
    maps = json.loads((tmp_path / "exposure.json").read_text())
    assert list(maps) == [view.name for view in scene.train]
    view, image = scene.train[5], torch.rand(5, 7, 3)
    image_map = torch.tensor(maps[view.name])
    expected = image @ image_map[:3, :3] + image_map[:3, 3]
    assert not torch.allclose(expected, image, atol=1e-4)
    torch.testing.assert_close(trainer.parts[0].image(image, None, SimpleNamespace(view=view)), expected)


@pytest.mark.parametrize("name", ["exposures.json", "cameras.json"])
def test_gaussians_are_saved_with_all_that_they_are_drawn_with(scene, tmp_path, monkeypatch, name):
    """Elsewhere, if one of these files cannot be written."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    trainer, run = stepped(scene, tmp_path / "model", 3, parts="sky,exposure,pose")
    own = ply_path(tmp_path / "model", 3)
    (own.parent / name).mkdir(parents=True)
    path = save_model(trainer, run)
    saved = {"point_cloud.ply", "environment.json", "exposures.json", "cameras.json"}
    assert {found.name for found in path.parent.iterdir()} == saved and not own.exists()
    assert (tmp_path / "model" / "cameras.json").is_file() and (tmp_path / "model" / "exposure.json").is_file()


def test_a_held_out_one_is_guessed_where_neighbors_are_alike():
    """Along a walk; and not where each is as it likes."""
    places = np.linspace(0.0, 6.0, 41)
    walk = [Camera(9, 9, 9.0, 9.0, 4.5, 4.5, np.eye(3), (-x, 0.0, 0.0)) for x in places]
    values, held = np.stack([np.sin(places), np.cos(places)], 1), np.arange(41) % 8 == 4
    known, others = ([camera for camera, here in zip(walk, chosen, strict=True) if here] for chosen in (~held, held))
    assert np.abs(guessed(values[~held], known, others, 6.0) - values[held]).max() < 0.03
    assert np.abs(guessed(1e-3 * values[~held], known, others, 6.0) - 1e-3 * values[held]).max() < 3e-5
    assert not guessed(np.resize([0.1, -0.1], len(known)), known, others, 6.0).any()
    assert not guessed(np.zeros((1, 12)), known[:1], others, 6.0).any()
    assert guessed(values, walk, [], 6.0).shape == (0, 2)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_pictures_are_exposed_as_their_photographs(kind, tmp_path, ran):
    """In the evaluation as by render.py, of train and test views."""
    model = tmp_path / "model"
    options = f"--eval --iterations 60 --exposure {kind} --vignetting --exposure_lr_init 0.05 --quiet -r 8"
    ran("train", "-s", SCENE, "-m", model, *options.split())
    before = json.loads((model / "per_view.json").read_text())["ours_60"]
    ran("render", "-m", model, "--quiet")
    assert json.loads((model / "per_view.json").read_text())["ours_60"]["PSNR"] == before["PSNR"]
    pictures = [load_png(model / f"{split}/ours_60/renders/00003.png") for split in ("train", "test")]
    (model / "point_cloud/iteration_60/exposures.json").unlink()
    ran("render", "-m", model, "--quiet")
    plain = [load_png(model / f"{split}/ours_60/renders/00003.png") for split in ("train", "test")]
    assert all((exposed != mean).any() for exposed, mean in zip(pictures, plain, strict=True))


@pytest.mark.parametrize("kind", KINDS)
def test_threads_change_nothing(kind, scene, tmp_path, same_by_threads):
    part = part_of(scene, tmp_path, exposure=kind, vignetting=True)
    image = torch.rand(130, 131, 3, generator=torch.Generator().manual_seed(2)).requires_grad_()
    made = lambda: part.image(image, None, SimpleNamespace(view=scene.train[0])).square().sum()  # noqa: E731
    same_by_threads(lambda: torch.autograd.grad(made(), [image, part.maps, part.falloff]))


def test_gains_are_found_from_the_tracks_and_decide_what_auto_takes(faulty):
    """With those of the truth, but for what shine, noise and eight bits leave."""
    folder, truth = faulty
    clean, changed = (load_scene(path, eval=True, report=str) for path in (SCENE, folder))
    for scene, needed, figure in ((clean, False, "0.0"), (changed, True, "0.2")):
        verdict = weigh(TrainConfig(), scene)["exposure"]
        assert verdict.needed == needed and verdict.sentence.startswith(f"photographs differ by {figure}")
    gains = gains_of(changed).stops
    assert gains.keys() == truth.keys()
    errors = np.array([gains[name] - truth[name] for name in truth])
    assert np.median(np.abs(2 ** (errors - errors.mean(0)) - 1)) < 0.01
    assert abs(sum(gains.values())).max() < 1e-12
    assert not any(verdict.needed for verdict in weigh(TrainConfig(), replace(changed, find_tracks=dict)).values())


@pytest.mark.slow
def test_faults_are_what_they_say(tmp_path):
    """Of all kinds at once: poses, focal lengths, falling light, photographs left out; none of what is held out."""
    truth = make_faulty(tmp_path / "scene", ["vignetting", "pose", "focal", "corner"], seed=3)
    clean, changed = (load_scene(path, eval=True, report=str) for path in (SCENE, tmp_path / "scene"))
    assert len(truth["corner"]) == 2 and len(changed.train) == 41
    assert all(np.array_equal(a.image, b.image) for a, b in zip(clean.test, changed.test, strict=True))
    whole, angles, shifts = {view.name: view for view in clean.train}, [], []
    for view in changed.train:
        before = whole[view.name].camera
        assert view.camera.fx == pytest.approx(1.01 * before.fx)
        turn = view.camera.rotation @ before.rotation.T
        angles.append(np.degrees(np.arccos((np.trace(turn) - 1) / 2)))
        shifts.append(np.linalg.norm(view.camera.center - before.center) / clean.extent)
        corner, middle = (view.image[p] / whole[view.name].image[p].clip(1) for p in ((0, 0), (124, 132)))
        assert (middle > 0.97).all() and (corner < 0.9).all()
    assert np.sqrt(np.mean(np.square(angles))) == pytest.approx(0.5, rel=0.15)
    assert np.sqrt(np.mean(np.square(shifts))) == pytest.approx(0.01, rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["gain", "affine"])
def test_it_learns_gains_to_two_percent_of_light(kind, scene, tmp_path):
    """Of photographs that are what the Gaussians show, brighter or darker; these do not learn."""
    still = dict.fromkeys(("feature_lr", "opacity_lr", "scaling_lr", "rotation_lr"), 0.0)
    still |= dict.fromkeys(("position_lr_init", "position_lr_final"), 1e-12)
    still |= dict.fromkeys(("densify_from_iter", "opacity_reset_interval"), 999)
    few, gains = scene.train[::6], np.random.default_rng(5).permutation(np.linspace(-0.45, 0.45, 9))
    shown, _ = begin(replace(scene, train=few), tmp_path)
    light = [from_srgb(shown.picture(v.camera) / 255, np.where) * 2**gain for v, gain in zip(few, gains, strict=True)]
    images = [np.rint(255 * to_srgb(image, np.where).clip(0, 1)).astype(np.uint8) for image in light]
    views = [replace(view, photograph=Decoded(image)) for view, image in zip(few, images, strict=True)]
    trainer, _ = stepped(replace(scene, train=views), tmp_path, 300, exposure=kind, iterations=300, **still)
    gray = torch.full((1, 1, 3), 0.4)
    found = [trainer.parts[0].image(gray, None, SimpleNamespace(view=view)).mean().item() for view in views]
    stops = 2.4 * np.log2((np.array(found) + 0.055) / 0.455)
    errors = stops - stops.mean() - (gains - gains.mean())
    assert np.abs(2**errors - 1).max() < 0.02


def test_light_times_a_number_is_a_gain_of_what_a_screen_shows():
    """But for the darkest 4 %: the premise of maps without powers."""
    light = np.linspace(0.004, 0.6, 1000)
    for stops in (-0.5, 0.6):
        factor = 2 ** (stops / 2.4)
        expected = (to_srgb(light, np.where) + 0.055) * factor - 0.055
        assert np.abs(to_srgb(light * 2**stops, np.where) - expected)[light * 2**stops > 0.0032].max() < 1e-12


@pytest.mark.slow
def test_inspect_tells_it_beside_exif(faulty, tmp_path, ran):
    """Two photographs of three have EXIF."""
    folder, truth = faulty
    said = ran("inspect", folder, "-o", tmp_path / "page.html")
    line = next(line for line in said.splitlines() if " exposure " in line)
    found = re.fullmatch(
        r"warning +exposure +photographs differ by (\S+) stops .*: (\S+) \((\S+)\) to (\S+) \((\S+)\) in all; EXIF has "
        r"the exposure of 29 of 50, (\S+) stops beside .*; train with --parts exposure\.",
        line,
    )
    assert found and float(found[1]) > 0.15 and float(found[6]) < 0.05
    green = {name: change[1] for name, change in truth.items()}
    assert green[found[3]] < min(green.values()) + 0.05 and green[found[5]] > max(green.values()) - 0.05
    assert (tmp_path / "page.html").read_text().count("<img") == 5


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A model, and its file of exposures, where the second photograph that trains has a gain of 1.5."""
    folder = tmp_path_factory.mktemp("model")
    assert train(folder, "--iterations", "6", "-r", "8", "--parts", "exposure") == 0
    file = folder / "point_cloud" / "iteration_6" / "exposures.json"
    facts = json.loads(file.read_text())
    assert len(facts["maps"]) == 50
    facts["maps"] = {name: [0.5] if name == "view_002.png" else [0.0] for name in facts["maps"]}
    file.write_text(json.dumps(facts))
    return folder, file


def test_formats_without_them_say_so(trained, tmp_path, ran):
    said = ran("convert", trained[0], tmp_path / "a.ply")
    assert "how photographs were exposed (--parts exposure), which no format has" in said


def test_render_shows_photographs_as_they_were_taken(trained, ran, monkeypatch):
    """By a gain on value + 0.055 in float64; and as the mean photograph where there is no file. A bound is before."""
    (folder, file), written = trained, []
    monkeypatch.setattr("warp_splat.rendering.command.write_maps", lambda *_: 0.0)  # test_bound.py looks at maps
    for name in ("exposures.json", "away.json"):
        file.rename(file.with_name(name))
        said = ran("render", "-m", folder, "--bound") + ran("export-html", folder, folder / "a.html")
        for sentence in (" (before exposures): ", "The page shows the mean exposure"):
            assert (sentence in said) == (name == "exposures.json")
        written.append([load_png(folder / f"train/ours_6/renders/{place:05d}.png") for place in (0, 1)])
        file.with_name(name).rename(file)
    renders, neutral = written
    expected = 1.5 * (neutral[1] / 255 + 0.055) - 0.055
    assert np.abs(renders[1] / 255 - expected.clip(0, 1)).max() < 1.5 / 255
    assert np.array_equal(renders[0], neutral[0])


def test_held_out_exposures_are_guessed_once_after_each_step(tmp_path, monkeypatch):
    calls, guess = [], exposure.guessed
    monkeypatch.setattr(exposure, "guessed", lambda *given: calls.append(1) or guess(*given))
    scene = load_scene(SCENE, resolution=8, eval=True)
    trainer, run = begin(scene, tmp_path, parts="exposure")
    before = trainer.exposures.maps[scene.train[0].name].copy()
    trainer.evaluate(scene.test)
    steps(trainer, run, 3)
    after = trainer.exposures.maps[scene.train[0].name]
    trainer.evaluate(scene.test)
    assert len(calls) == 2 and not np.array_equal(before, after)


def test_exposures_are_those_beside_the_gaussians(trained):
    folder, file = trained
    assert read_exposures(folder, 6) and not read_exposures(folder, 5)
    assert read_exposures(file.parent / "point_cloud.ply", 0)


DAMAGED = [{"kind": "else"}, {"maps": {"a": [1, 2]}}, {"maps": [1]}, {"falloff": [1e999, 0]}, {"pivot": "x"}]


@pytest.mark.parametrize("changes", ["{", "[]", "{}", *DAMAGED], ids=str)
def test_damaged_exposures_are_one_sentence(changes, trained, fails):
    folder, file = trained
    whole = file.read_text()
    file.write_text(changes if isinstance(changes, str) else json.dumps(json.loads(whole) | changes))
    assert "exposures.json: expected exposures as training writes them" in fails("render", "-m", str(folder))
    file.write_text(whole)


def test_the_viewer_shows_it_within_the_photograph(fake_viser, monkeypatch):
    at_rest(monkeypatch)
    model, frames = GaussianModel.from_splats(small_splats(50)), []
    draw = make_renderer(model)
    for factor in (1.0, 0.25):
        maps = {"0.png": np.array([factor - 1], np.float32)}
        exposures = lambda maps=maps: Exposures("gain", 0.0, np.zeros(2, np.float32), maps)  # noqa: E731
        with server.Viewer(draw, model, some_scene(), 8080, exposures=exposures) as viewer:
            client = entered(viewer, some_scene().train[1].camera, size=(120, 60))
            drawn(viewer)
            free = client.frames[-1][0]
            viewer.watchers[1].view.value = "0.png"
            drawn(viewer)
            frames.append((free, client.frames[-1][0]))
    (free, one), (free_again, other) = frames
    assert np.array_equal(free, free_again)
    assert np.array_equal(one[:, :30], other[:, :30]) and np.array_equal(one[:, 90:], other[:, 90:])
    assert one[:, 30:90].any() and np.abs(0.25 * one[:, 30:90] - other[:, 30:90]).max() <= 1


@pytest.mark.parametrize("options", [{"exposure": "affine"}, {"exposure": "gain", "vignetting": True}], ids=str)
def test_training_shows_what_it_compares(options, scene, tmp_path):
    trainer, _ = stepped(scene, tmp_path, 12, **options)
    view, (part,) = scene.train[3], trainer.parts
    image, exposures = trainer.look(view.camera).image, trainer.exposures
    expected = part.image(image, None, SimpleNamespace(view=view)).detach()
    assert torch.equal(as_photographed(exposures, image, view.name), expected)
    assert as_photographed(exposures, image, "another") is image


@pytest.mark.parametrize("kind", ["gain", "affine"])
def test_what_a_model_has_of_exposures_is_not_learned_again(scene, tmp_path, kind):
    """As simplify and clean train it; of another kind, all is learned anew."""
    trainer, run = begin(scene, tmp_path, parts="exposure", exposure="gain")
    (part,) = trainer.parts
    shape, random = COLOR_MAPS[kind], np.random.default_rng(0)
    maps = {view.name: random.normal(0, 0.1, shape).astype(np.float32) for view in scene.train[1:]}
    part.begin(Exposures(kind, part.pivot, np.zeros(2, np.float32), maps))
    before = part.maps.detach().clone()
    steps(trainer, run, 5)
    trainer.update(5)
    kept = torch.equal(part.maps, before)
    assert kept == (kind == "gain") and before.any() == kept

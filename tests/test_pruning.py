"""What Gaussians do to images against images without them; what simplify and clean leave out, and their sentences."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from commands import changes_told, no_space
from scenes import C0, SCENES
from scipy.spatial.transform import Rotation
from splat_files import some_splats

from warp_splat.cli import main
from warp_splat.compare.scenes import make_camera
from warp_splat.config import FinishedModel, RasterOptions
from warp_splat.formats.coordinates import write_coordinates
from warp_splat.formats.exchange import load_gaussians, save_gaussians
from warp_splat.formats.model_folder import ply_path, write_cfg_args
from warp_splat.formats.splats import SplatArrays, SplatFile, concatenated
from warp_splat.gaussians import GaussianModel
from warp_splat.pruning.clean import floaters
from warp_splat.pruning.opened import Opened
from warp_splat.pruning.score import ViewSetting, carried, costs, weights
from warp_splat.pruning.simplify import _narrowed, bytes_of, degrees_of, fewer_harmonics
from warp_splat.pruning.thinning import Thinning, _config
from warp_splat.raster.api import render
from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene
from warp_splat.scene.types import Decoded, View

SIZE = (48, 36)
OPTIONS = RasterOptions()
OF_SCENE = {"source_path": str(embedded_scene()), "resolution": 8, "eval": True}


def splats_before(camera, count=40, seed=0, depth=(3, 5), scale=-2.0):
    """Gaussians in front of a camera, of degree 3, none of them dark."""
    rng = np.random.default_rng(seed)
    seen = np.stack([rng.uniform(-1, 1, count), rng.uniform(-0.8, 0.8, count), rng.uniform(*depth, count)], axis=1)
    sh = [rng.uniform(0.5, 1.5, (count, 1, 3)), rng.normal(scale=0.05, size=(count, 15, 3))]
    return SplatArrays(
        means=(seen @ camera.rotation + camera.center).astype(np.float32),
        sh=np.concatenate(sh, axis=1).astype(np.float32),
        opacities=rng.uniform(-1, 2, count).astype(np.float32),
        scales=rng.normal(scale, 0.3, (count, 3)).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
    )


def views_of(cameras):
    """Black photographs."""
    pictures = [np.zeros((camera.height, camera.width, 3), np.uint8) for camera in cameras]
    return [View(str(i), c, Decoded(p), original=c) for i, (c, p) in enumerate(zip(cameras, pictures, strict=True))]


def setting_of(cameras, device="cpu", background=(0.2, 0.4, 0.7)):
    return ViewSetting(views_of(cameras), OPTIONS, torch.tensor(background, device=device))


def drawn(splats, setting, camera, options=OPTIONS):
    """An image, float64."""
    model = GaussianModel.from_splats(splats).to(setting.background.device)
    with torch.no_grad():
        return render(model.activated(), camera, setting.background, options).image.cpu().double()


def without(splats, row):
    return SplatArrays(*(np.delete(array, row, axis=0) for array in splats))


def cost(splats, other, setting, camera):
    """The squared change of an image."""
    return float(((drawn(splats, setting, camera) - drawn(other, setting, camera)) ** 2).sum())


def test_an_image_loses_what_the_adjoint_says(device):
    """Against images without each Gaussian in turn."""
    camera = make_camera(*SIZE, seed=3)
    setting, splats = setting_of([camera], device), splats_before(camera)
    upstream = torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        gaussians = GaussianModel.from_splats(splats).to(torch.device(device)).activated()
    found = carried(gaussians, setting.views[0], setting, upstream)
    lost = (found.opacities.grad * found.opacities.detach()).cpu().double()
    whole = drawn(splats, setting, camera)
    for row in range(len(splats.means)):
        wanted = float((upstream.double() * (whole - drawn(without(splats, row), setting, camera))).sum())
        assert float(lost[row]) == pytest.approx(wanted, abs=2e-3)
    shares, depths = weights(gaussians, setting.views[0], setting)
    alpha = render(gaussians, camera, setting.background, OPTIONS).alpha.detach().double()
    assert float(shares.sum()) * SIZE[0] * SIZE[1] == pytest.approx(float(alpha.sum()), rel=1e-4)
    seen = (splats.means - camera.center) @ camera.rotation.T
    np.testing.assert_allclose(depths.cpu().numpy(), seen[:, 2], rtol=1e-4)


def test_a_panorama_is_weighed_across_its_seam():
    scene = SCENES["panorama"]()
    setting, gaussians = setting_of([scene.camera]), scene.gaussians()
    shares, _ = weights(gaussians, setting.views[0], setting)
    alpha = render(gaussians, scene.camera, setting.background, OPTIONS).alpha
    assert float(shares.sum()) == pytest.approx(float(alpha.mean()), rel=1e-4)


def test_costs_are_the_squared_changes_of_images(device):
    """Random signs give their mean: 150 of them against images without a Gaussian, and without its harmonics."""
    camera = make_camera(*SIZE, seed=3)
    splats, repeats = splats_before(camera, 12), 150
    setting = setting_of([camera] * repeats, device)
    found = costs(GaussianModel.from_splats(splats).to(torch.device(device)), setting)
    wanted = [cost(splats, without(splats, row), setting, camera) for row in range(12)]
    for one, other in zip(found.gaussians, wanted, strict=True):
        assert float(one) / repeats == pytest.approx(other, rel=0.5, abs=1e-3)
    assert float(found.gaussians.sum()) / repeats == pytest.approx(sum(wanted), rel=0.15)
    for degree, coefficients in enumerate((1, 4, 9)):
        wanted = 0.0
        for row in range(12):
            fewer = splats._replace(sh=splats.sh.copy())
            fewer.sh[row, coefficients:] = 0
            wanted += cost(splats, fewer, setting, camera)
        assert float(found.harmonics[:, degree].sum()) / repeats == pytest.approx(wanted, rel=0.15)


def test_what_a_mask_covers_does_not_count():
    camera = make_camera(*SIZE, seed=3)
    splats, setting = splats_before(camera), setting_of([camera])
    model = GaussianModel.from_splats(splats)
    masked = replace(setting.views[0], photograph=setting.views[0].pixels._replace(mask=np.zeros(SIZE[::-1], np.uint8)))
    assert float(costs(model, setting._replace(views=[masked])).gaussians.abs().sum()) == 0


def test_what_is_hidden_goes_first():
    """Thirty Gaussians behind an opaque wall, and thirty before it."""
    camera = make_camera(*SIZE, seed=3)
    front, back = splats_before(camera, 30, 1, (3, 4)), splats_before(camera, 30, 2, (8, 9))
    wall = splats_before(camera, 2, 3, (5, 5))
    wall.means[:] = np.float32([[0, 0, 5], [0, 0, 5.1]]) @ camera.rotation + camera.center
    wall.scales[:], wall.opacities[:] = [2.0, 2.0, -4.0], 12.0
    wall.quats[:] = Rotation.from_matrix(camera.rotation.T).as_quat()[[3, 0, 1, 2]]
    splats = concatenated([front, back, wall])
    thinning = Thinning(splats, setting_of([camera]))
    kept = thinning.to(32)
    np.testing.assert_array_equal(kept.means, np.concatenate([front.means, wall.means]))
    fewer = thinning.to(20)
    assert len(fewer.means) == 20 and {tuple(m) for m in fewer.means} <= {tuple(m) for m in kept.means}
    np.testing.assert_array_equal(thinning.to(32).means, kept.means)
    assert [len(thinning.to(count).means) for count in (5, 1)] == [5, 1]  # four fifths of four are four: it ends


def test_harmonics_that_do_not_show_become_zeros():
    cameras = [make_camera(*SIZE, seed=3)] * 30  # of one, the estimate is a guess
    splats = splats_before(cameras[0])
    splats.sh[:10, 9:] *= 1e-4
    splats.sh[10:20, 4:] *= 1e-4
    splats.sh[20:25, 1:] *= 1e-4
    setting = setting_of(cameras)
    error = 30.0 * SIZE[0] * SIZE[1] * 3 * 0.01**2  # 40 dB
    train, tried = [SimpleNamespace(camera=camera) for camera in cameras], []
    model = SimpleNamespace(setting=setting, scene=SimpleNamespace(train=train), psnr=lambda *_: 40.0)
    found = fewer_harmonics(model, splats)
    degrees = degrees_of(found)
    assert (degrees[:10] <= 2).all() and (degrees[10:20] <= 1).all() and (degrees[20:25] == 0).all()
    assert degrees[25:].max() == 3
    changed = len(cameras) * cost(splats, found, setting, cameras[0])
    assert 0 < changed < 1.5 * error * (10 ** (0.02 / 10) - 1)
    np.testing.assert_array_equal(found.sh[found.sh != 0], splats.sh[found.sh != 0])
    model.psnr = lambda some, _: tried.append(degrees_of(some).sum()) or 40.0 - (len(tried) > 1)
    np.testing.assert_array_equal(fewer_harmonics(model, splats).sh, splats.sh)  # whatever is left out costs more
    assert len(tried) > 2 and tried[1:] == sorted(tried[1:]) and tried[1] == degrees.sum()
    np.testing.assert_array_equal(fewer_harmonics(model, splats, 50.0).sh, splats.sh)  # there is nothing to spend


def test_a_view_that_is_drawn_exactly_hides_no_other():
    views = [SimpleNamespace(camera=0, name=name, picture=np.zeros((4, 4, 3), np.uint8), mask=None) for name in "ab"]
    model = SimpleNamespace(picture_of=lambda *_: lambda camera, name: np.full((4, 4, 3), 10 * (name == "b"), np.uint8))
    assert Opened.psnr(model, None, views) == pytest.approx((99 + 20 * np.log10(25.5)) / 2)


def test_floaters_hang_before_few_cameras():
    """A cloud that eight cameras see, and a Gaussian right before one of them."""
    first = make_camera(*SIZE, seed=3)
    places = [first.translation + np.float64([0.3 * step, 0, 0]) for step in np.arange(8) - 4.0]
    cameras = [replace(first, translation=place) for place in places]
    splats = splats_before(first, 60, depth=(4, 6))
    floater = splats_before(first, 1)
    floater.means[:] = np.float32([[0, 0, 0.4]]) @ cameras[2].rotation + cameras[2].center
    floater.scales[:] = -5.0
    both = concatenated([splats, floater])
    found = floaters(both, setting_of(cameras), 3.0, 0.5)
    assert np.flatnonzero(found).tolist() == [60]
    assert not floaters(both, setting_of(cameras), 3.0, 0.01).any()  # not near enough
    assert not floaters(both, setting_of(cameras), 0.5, 0.5).any()  # no Gaussian has fewer than one view


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A model of the embedded scene at an eighth of its size: its points, some of them twice."""
    folder = tmp_path_factory.mktemp("model")
    scene = load_scene(embedded_scene(), resolution=8, eval=True, report=str)
    model = GaussianModel.from_points(scene.points[::4], scene.colors[::4], 2)
    splats = model.splats()
    splats.opacities[:] = 1.0
    save_gaussians(ply_path(folder, 7), SplatFile(splats))
    write_cfg_args(folder, OF_SCENE)
    return folder, splats


@pytest.mark.slow
def test_simplify_to_a_share_with_training(folder, tmp_path, ran, monkeypatch):
    monkeypatch.setattr("warp_splat.pruning.simplify.LEVELS", (1.0, 0.6))
    (folder, splats), output = folder, tmp_path / "small.sog"
    count = len(splats.means)
    out = ran("simplify", ply_path(folder, 7), *"--keep 0.5 --steps 6 --device cpu -o".split(), output)
    assert f"{output}: {round(count / 2)} of {count} Gaussians" in out and "test PSNR" in out and "harmonics: " in out
    assert len(load_gaussians(output).splats.means) == round(count / 2)
    assert (tmp_path / "small.curve.png").stat().st_size > 10_000
    lines = (tmp_path / "small.curve.csv").read_text().splitlines()
    assert lines[0] == "kept,Gaussians,MB,frames_per_second,test_PSNR" and len(lines) == 3


@pytest.mark.long
def test_simplify_to_a_size_and_to_a_loss(folder, tmp_path, ran):
    folder, splats = folder
    save_gaussians(tmp_path / "whole.spz", SplatFile(splats))
    size = int(0.7 * (tmp_path / "whole.spz").stat().st_size)
    arguments = ("simplify", folder, "--device", "cpu")
    for steps in (0, 6):
        ran(*arguments, "--size", f"{size / 1000}kB", "--steps", steps, "-o", tmp_path / "a.spz")
        assert 0.9 * size < (tmp_path / "a.spz").stat().st_size <= size
    said = ran(*arguments, "--max_loss", 0.5, "-o", tmp_path / "b.ply")
    loss = float(said.split("train PSNR")[1].split("(")[1].split(")")[0])
    assert loss >= -0.5 and len(load_gaussians(tmp_path / "b.ply").splats.means) < len(splats.means)


@pytest.mark.slow
def test_only_what_a_crop_leaves_is_compared(folder, tmp_path, ran, fails):
    """Otherwise what lies around the box is missing in all pictures: figures are far lower."""
    folder, splats = folder
    low, high = (np.quantile(splats.means, share, axis=0) for share in (0.2, 0.8))
    found = {}
    arguments = ("clean", folder, "-o", tmp_path / "a.ply", "--device", "cpu")
    for name, crop in {"whole": (), "box": ("--crop", *low, *high)}.items():
        out = ran(*arguments, *crop)
        found[name] = [float(line.split("PSNR")[1].split()[0]) for line in out.splitlines() if " PSNR " in line]
    assert "of 43 views" in out and found["box"] == pytest.approx(found["whole"], abs=2)
    one = splats.means[0]
    assert "cover pixels of photographs" in fails(*arguments, "--crop", *(one - 1e-3), *(one + 1e-3))


@pytest.mark.slow
@pytest.mark.parametrize("command", [["simplify", "--keep", "0.9"], ["clean"]], ids=lambda words: words[0])
def test_what_a_file_has_no_room_for_counts(folder, tmp_path, ran, monkeypatch, fails, command):
    """What is said of a .splat is what is there, which has no harmonics, nor a mark of antialiasing."""
    monkeypatch.setattr("warp_splat.pruning.simplify.LEVELS", (1.0,))
    splats, output, sh = folder[1], ("-o", tmp_path / "a.splat", "--device", "cpu"), folder[1].sh.copy()
    sh[:, 0] -= 0.5
    sh[:, 2] = -0.6  # brighter from above, where the cameras are
    save_gaussians(ply_path(tmp_path, 7), SplatFile(splats._replace(sh=sh), antialiased=True))
    write_cfg_args(tmp_path, OF_SCENE)
    out = ran(*command, tmp_path, *output)
    assert "lost: " in out and "all harmonics, for which such a file has no room" in out
    opened = Opened(FinishedModel(model=str(tmp_path), device="cpu"))
    whole, left = (load_gaussians(path) for path in (ply_path(tmp_path, 7), output[1]))
    before, unlike = (opened.psnr(file.splats, opened.scene.train) for file in (whole, left))
    after = opened.psnr(left.splats, opened.scene.train, OPTIONS)
    assert opened.options.antialiasing and abs(unlike - after) > 0.02
    told = re.search(r"train PSNR (\S+) -> (\S+) dB", out)
    assert before - after > 0.3
    assert (float(told[1]), float(told[2])) == pytest.approx((before, after), abs=0.01)
    for promise in ("--max_loss", "--tolerance"):
        assert "expected a format with room for harmonics" in fails("simplify", tmp_path, promise, 0.001, *output)
    said = ran("simplify", tmp_path, "--max_loss", 0.001, "--steps", 2, *output)
    assert "That is more than --max_loss" in said
    save_gaussians(ply_path(tmp_path, 7), SplatFile(splats))  # whose harmonics are zeros
    assert "all harmonics" not in ran("simplify", tmp_path, "--tolerance", 0.3, *output)


def test_a_small_part_of_a_model_is_found():
    """And a large one after as few tries as before."""
    tried = []
    fits = lambda count: tried.append(count) or count <= 54  # noqa: E731
    assert _narrowed(1, 4500, fits, 19)[0] == 54
    tried.clear()
    assert 2900 <= _narrowed(1, 4500, lambda count: tried.append(count) or count <= 3000)[0] <= 3000 and len(tried) <= 6


@pytest.mark.slow
@pytest.mark.parametrize("steps", [1, 4])
def test_a_few_steps_leave_as_many_as_asked_for(folder, tmp_path, ran, steps):
    ran("simplify", folder[0], "--keep", 0.5, "--steps", steps, "--device", "cpu", "-o", tmp_path / "a.ply")
    assert len(load_gaussians(tmp_path / "a.ply").splats.means) == round(0.5 * len(folder[1].means))


@pytest.mark.parametrize(("name", "there"), [("", True), ("maps", True), ("gone", False)])
def test_maps_of_depth_are_those_of_the_training(tmp_path, name, there):
    """A scene without tracks has no other depths; without the folder, those of tracks are left."""
    (tmp_path / "maps").mkdir()  # in the scene, or a path
    depths, scene = name or str(tmp_path), SimpleNamespace(source=tmp_path)
    trained = {"parts": "depth,pose", "depths": depths}
    config = _config(scene, SplatFile(some_splats(3)), 5, 0, trained, torch.device("cpu"))
    assert config.model.parts == "depth" and config.flat()["depths"] == depths * there


@pytest.mark.long
def test_simplify_within_a_tolerance(folder, tmp_path, ran):
    (folder, splats), output = folder, tmp_path / "b.ply"
    measured, bound = changes_told(ran("simplify", folder, "--device", "cpu", "--tolerance", 0.05, "-o", output))
    views, left = load_scene(embedded_scene(), resolution=8, eval=True, report=str).train, load_gaussians(output).splats
    setting = setting_of([view.camera for view in views], background=(0.0, 0.0, 0.0))
    changes = [(drawn(splats, setting, v.camera) - drawn(left, setting, v.camera)).abs().max() for v in views]
    assert max(changes) == pytest.approx(measured, rel=0.1) and measured <= bound <= 0.05
    assert len(left.means) < len(splats.means)


@pytest.mark.parametrize("gone", ["", "/nowhere/scene"])
def test_simplify_without_a_scene_keeps_the_opaque_and_large(tmp_path, ran, gone):
    """Also a file in a model's folder whose scene is not there."""
    path = ply_path(tmp_path, 1) if gone else tmp_path / "a.ply"
    if gone:
        write_cfg_args(tmp_path, {"source_path": gone})
    splats = splats_before(make_camera(*SIZE, seed=3))
    splats.opacities[::2] = -5
    save_gaussians(path, SplatFile(splats))
    assert "Without a scene" in ran("simplify", path, "--keep", 0.5, "-o", tmp_path / "b.glb")
    np.testing.assert_allclose(load_gaussians(tmp_path / "b.glb").splats.means, splats.means[1::2], atol=1e-6)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ("", "expected one of --keep, --max_loss, --size and --tolerance above 0, got none"),
        ("--keep 0.5 --size 1MB", "got --keep and --size"),
        ("--keep 0.001", "nothing would be left of 40 Gaussians"),
        ("--keep 1.5", "--keep: expected"),
        ("--size 10miles", "--size 10miles: expected a size of file such as 10MB"),
        ("--size 3B", "nothing would be left of 40 Gaussians"),
        ("--max_loss 0.1", "expected photographs to compare;"),
        ("--tolerance 0.1", "expected photographs to compare;"),
        ("--tolerance 0.1 --steps 3", "training changes all pixels"),
        ("--keep 0.5 --steps -1", "--steps: expected"),
        ("--keep 0.5 -o b.obj", "b.obj: expected a name that ends in"),
        ("--keep 0.5 -o a.ply", "a.ply: expected another file than the model"),
        ("--keep 0.5 -o a.ply/b.ply", "a.ply: expected a folder that can be written"),
    ],
)
def test_simplify_refuses_in_one_sentence(tmp_path, fails, monkeypatch, options, sentence):
    monkeypatch.chdir(tmp_path)
    save_gaussians("a.ply", SplatFile(splats_before(make_camera(*SIZE, seed=3))))
    assert sentence in fails("simplify", "a.ply", *options.split())
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


def test_clean_reports_before_and_after(folder, tmp_path, ran):
    """With a dark Gaussian planted right before the first training camera."""
    folder, splats = folder
    camera = load_scene(embedded_scene(), resolution=8, eval=True, report=str).train[0].camera
    planted = concatenated([splats, splats.take(slice(1))])
    planted.means[-1] = np.float32([0, 0, 0.3]) @ camera.rotation + camera.center
    planted.sh[-1, 0], planted.scales[-1], planted.opacities[-1] = -0.5 / C0, -2.5, 5.0
    output, copy = tmp_path / "b.spz", tmp_path / "model"
    save_gaussians(ply_path(copy, 7), SplatFile(planted))
    write_cfg_args(copy, OF_SCENE)
    write_coordinates(copy, {"origin": [1.0, 2.0, 3.0]})
    out = ran("clean", copy, "-o", output, "--device", "cpu")
    assert re.search("lost: .*where they are in the world", out)
    left = int(out.split(f"{output}: ")[1].split(" of ")[0])
    assert len(planted.means) - 20 < left < len(planted.means)
    gain = float(out.split("train PSNR")[1].split("(")[1].split(")")[0])
    assert gain >= 0.01 and (tmp_path / "b.sheet.png").stat().st_size > 10_000
    found = load_gaussians(output).splats.means
    assert np.abs(found - planted.means[-1]).max(axis=1).min() > 1e-3


def test_a_full_disk_loses_no_result(folder, tmp_path, monkeypatch, capsys):
    """That of the output, and then that for temporary files, where sizes are tried."""
    (model, splats), spare = folder, tmp_path / "spare"
    spare.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(spare))
    for code, full, place in ((1, "out", spare), (0, spare.name, tmp_path / "out")):
        write = lambda path, *rest, full=full: (no_space if full in str(path) else save_gaussians)(path, *rest)  # noqa: E731
        monkeypatch.setattr("warp_splat.pruning.opened.save_gaussians", write)
        assert main(["clean", str(model), "-o", str(tmp_path / "out" / "a.ply"), "--device", "cpu"]) == code
        (saved,) = place.rglob("a.ply")
        out = capsys.readouterr().out
        assert f"{saved}: " in out and (" MB" in out) == (place == spare) and "train PSNR" in out
        assert 0 < len(load_gaussians(saved).splats.means) <= len(splats.means)
        saved.unlink()


@pytest.mark.parametrize(("text", "wanted"), [("10MB", 10**7), ("500 kB", 500_000), ("1.5g", 1_500_000_000), ("7", 7)])
def test_sizes_as_people_write_them(text, wanted):
    assert bytes_of(text) == wanted

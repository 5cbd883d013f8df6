"""The scene doctor finds what was broken on purpose, and nothing else."""

import re
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from commands import SCENE, no_space
from scene_files import HEIGHT, WIDTH, load, texture, write_blender, write_colmap, write_image, write_transforms
from test_scene_input import BAD

from warp_splat.cli import main
from warp_splat.inspect import command, cost, geometry
from warp_splat.inspect.subject import read_subject
from warp_splat.training import deadline, memory
from warp_splat.training.plan import StepTime


@pytest.fixture
def life(tmp_path, monkeypatch):
    """A copy of the embedded scene that may be damaged, of which one step of each kind is tried."""
    monkeypatch.setattr(deadline, "REPEATS", 1)
    shutil.copytree(SCENE, tmp_path / "life")
    return tmp_path / "life"


@pytest.fixture
def examine(tmp_path, capsys, monkeypatch):
    """Examines a scene: findings as (level, check, text), and the page; pictures, which take long, if asked for."""

    def run(scene, code=0, *words, pictures=False):
        page = tmp_path / "page.html"
        with monkeypatch.context() as patch:
            patch.setattr(command, "draw_pictures", command.draw_pictures if pictures else lambda subject: ())
            assert main(["inspect", str(scene), "-o", str(page), *words]) == code
        said = capsys.readouterr()
        assert "Traceback" not in said.err
        lines = [re.fullmatch(r"(\w+) +(.{13}) (.*)", line) for line in said.out.splitlines()]
        return [(m[1], m[2].strip(), m[3]) for m in lines if m and m[1] in ("ok", "note", "warning", "error")], page

    return run


def worst(findings):
    return {(level, check) for level, check, _ in findings if level in ("warning", "error")}


def change_model(scene, change):
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    change(model)
    for path in (scene / "sparse" / "0").iterdir():
        path.unlink()
    model.write_binary(scene / "sparse" / "0")


@pytest.mark.usefixtures("laid_out")
def test_a_good_scene_has_no_finding(examine):
    findings, page = examine(SCENE, pictures=True)
    assert not worst(findings)
    html = page.read_text()
    assert html.count('src="data:image/jpeg;base64,') == html.count("<img") == 5
    text = re.sub('base64,[^"]*', "", html)  # in which any word may stand
    assert "http" not in text and "<script" not in text
    assert {check for _, check, _ in findings} >= {
        "cameras", "intrinsics", "sizes", "files", "sub-models", "reprojection", "coverage", "unseen points",
        "axes", "exposure", "duplicates", "masks", "loading", "forecast",
    }  # fmt: skip


def test_photographs_alone_are_told_how_long_their_cameras_take(tmp_path, capsys, monkeypatch):
    """Unless they are few, cannot be read, or there is no room to try some."""
    photos = shutil.copytree(SCENE / "images", tmp_path / "photos")
    names = sorted(photos.iterdir())
    count = len(names)
    (photos / "output" / "mine" / "test").mkdir(parents=True)
    (photos / "output" / "mine" / "cfg_args").touch()
    shutil.copy(names[0], photos / "output" / "mine" / "test")  # a picture of a model, no photograph
    for done, said, instead in (
        (lambda: None, True, ""),
        (lambda: monkeypatch.setattr(pycolmap.Database, "open", no_room), False, ""),
        (lambda: monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "missing")), False, ""),
        (lambda: monkeypatch.undo() or [name.write_text("no picture") for name in names], False, "have no features"),
        (lambda: [name.unlink() for name in names[29:]], False, ""),
    ):
        done()
        assert main(["inspect", str(photos)]) == 1
        told = capsys.readouterr()
        assert "photographs alone" in told.err and "`warp-splat sfm" in told.err
        assert (f"Cameras of {count} photographs will take about " in told.out) == said
        assert (f"{count * (count - 1) // 2} pairs" in told.out) == said
        assert instead in told.out


def no_room(*_):
    raise RuntimeError("No registered database factory succeeded")


def test_the_reprojection_error_is_that_of_pycolmap(capsys):
    subject, _ = read_subject(SCENE, "images")
    list(geometry.check_reprojection(subject))
    errors = np.concatenate(list(subject.errors.values()))
    subject.model.update_point_3d_errors()
    points = subject.model.points3D.values()
    expected = sum(point.error * point.track.length() for point in points) / len(errors)
    assert np.isclose(errors.mean(), expected, rtol=1e-6)


def test_points_at_infinity_hide_no_errors():
    subject, _ = read_subject(SCENE, "images")
    list(geometry.check_reprojection(subject))
    whole, few = dict(subject.errors), list(subject.model.points3D)[:5]
    for number in few:
        subject.model.point3D(number).xyz = np.full(3, np.inf)
    list(geometry.check_reprojection(subject))
    assert all(np.isfinite(errors).all() and len(errors) > 0.9 * len(whole[n]) for n, errors in subject.errors.items())


ASIDE = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array((0.3, 0.0, 0.0)))
WIDE = (30.0, 30.0, 130.0, 125.0)
FLIP = pycolmap.Rigid3d(pycolmap.Rotation3d(np.diag((1.0, -1.0, -1.0))), np.zeros(3))


def in_model(change):
    """Damage to the COLMAP model."""
    return lambda scene: change_model(scene, change)


def in_poses(turn, *places):
    """Damage to the poses of all images, or of those at some places."""

    def change(model):
        numbers = sorted(model.reg_image_ids())
        for image in map(model.image, [numbers[place] for place in places] or numbers):
            image.frame.rig_from_world = turn(image.cam_from_world())

    return in_model(change)


def in_points(count, place):
    """Damage to the first points."""
    return in_model(lambda model: [setattr(p, "xyz", place) for p in list(model.points3D.values())[:count]])


def in_photo(change):
    return lambda scene: change(scene / "images" / "view_003.png")


def two_of_one_stem(path):
    for ending in (".tif", ".jpg"):
        shutil.copy(path, path.with_suffix(ending))
    path.unlink()


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (in_photo(Path.unlink), "error files: view_003.png"),
        (in_photo(two_of_one_stem), "error files: several of this stem (view_003.jpg, view_003.tif)"),
        (in_photo(lambda path: write_image(path, texture(200, 264))), "error sizes: 264 x 248"),
        (in_photo(lambda path: path.write_bytes(path.read_bytes()[:9000])), "error files: view_003.png"),
        (in_photo(lambda path: shutil.copy(path, path.with_name("view_004.png"))), "warning duplicates: view_003.png"),
        (lambda s: (s / "sparse/0/points3D.bin").write_bytes(bytes(8)), "warning points: random ones"),
        (in_photo(lambda path: write_image(path, 0 * texture(264, 248))), "warning contents: 1 of 50"),
        (in_photo(lambda path: write_image(path, texture(264, 248, 4))), "warning alpha: 1 of 50"),
        (lambda s: write_image(s / "masks/view_003.png.png", texture(264, 248, 1)), "warning masks: masks for 1 of 50"),
        (lambda s: shutil.copytree(s / "sparse/0", s / "sparse/1"), "warning sub-models: sparse/1"),
        pytest.param(
            *(
                in_model(lambda model: [model.delete_point3D(n) for n in [*model.points3D]]),
                "warning points: random ones",
            ),
            marks=pytest.mark.slow,
        ),
        (in_model(lambda model: setattr(model.cameras[1], "params", WIDE)), "error reprojection: do not belong"),
        (in_poses(lambda pose: ASIDE * pose, 3), "warning reprojection: 1 images are much worse"),
        (in_poses(lambda pose: FLIP * pose), "error axes: with OpenGL axes"),
        (in_poses(lambda pose: pose.inverse()), "error axes: with camera-to-world the"),
        (in_points(9, (1e6, 0, 0)), "warning points: 9 of 4500"),
        # squares do not fit into 32 bits
        pytest.param(in_points(9, (1e38, 0, 0)), "warning points: 9 of 4500", marks=pytest.mark.slow),
        (in_points(9, (1e300, 0, 0)), "warning points: 9 of 4500 are not finite in 32 bits"),
        (in_points(900, (0, 0, 40)), "warning unseen points: 20.0 %"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_damage_is_found(life, examine, monkeypatch, damage, told):
    finding, _, text = told.partition(": ")
    if finding != "warning points":  # which the steps of a trial are tried on, too
        monkeypatch.setattr(command, "check_cost", lambda *_: ())
    damage(life)
    findings, _ = examine(life, 1 if finding.startswith("error") else 0)
    assert any(text in what for level, check, what in findings if f"{level} {check}" == finding), findings


@pytest.mark.parametrize("case", BAD)
def test_what_the_loader_refuses_is_an_error(tmp_path, examine, case):
    source, options = BAD[case][0](tmp_path)
    if options.keys() - {"images"}:
        return  # of the resolution or the split, which this command does not have
    examine(source, 1, "-i", options.get("images", "images"))


@pytest.mark.parametrize(
    ("far", "apart", "words"), [(0.0, 0.0, "all cameras stand at one place"), (5.5e6, 1.0, "too little for 32 bits")]
)
def test_cameras_at_one_place_or_far_away(tmp_path, examine, far, apart, words):
    def frame(index):
        return {"transform_matrix": [[1, 0, 0, far + apart * index], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}

    findings, _ = examine(write_transforms(tmp_path / "a", frame=frame, points=False))
    assert any(level == "warning" and words in text for level, _, text in findings), findings
    assert any(words in line for line in load(tmp_path / "a")[1]) == bool(far)


def test_a_page_that_cannot_be_written_loses_no_verdict(life, examine, monkeypatch):
    monkeypatch.setattr("warp_splat.inspect.command.write_page", no_space)
    assert examine(life, 1)[0]


@pytest.mark.slow
def test_a_scene_so_small_that_little_of_it_is_drawn(life, examine):
    """Both training and this command say by how much it should grow; then neither does."""

    def grow(times):
        bigger = pycolmap.Sim3d(times, pycolmap.Rotation3d(), np.zeros(3))
        change_model(life, lambda model: model.transform(bigger))

    grow(0.1)
    findings, _ = examine(life)
    (text,) = [what for _, _, what in findings if "never drawn" in what]
    assert f"Warning: {text}" in load(life)[1]
    grow(float(re.search(r"by ([\d.]+)\.$", text)[1]))
    assert not worst(examine(life)[0])


def test_masks_that_a_frame_names(tmp_path, examine):
    names = ["a.png", "b.png", "c.png"]
    root = write_transforms(tmp_path / "a", names, frame=lambda index: {"mask_path": "seen.png"} if index == 0 else {})
    write_image(root / "seen.png", texture(channels=1))
    findings, _ = examine(root)
    assert ("warning", "masks", "there are masks for 1 of 3 images; none for b.png, c.png.") in findings


@pytest.mark.parametrize("black", ["ab", "abc"])
def test_black_masks(tmp_path, examine, black):
    level, words = ("note", "masks of 2 images are black") if black == "ab" else ("error", "all 3 images are black")
    root = write_colmap(tmp_path / "a")
    for name in "abc":
        write_image(root / "masks" / f"{name}.png", np.full((HEIGHT, WIDTH, 1), 255 * (name not in black), np.uint8))
    findings, _ = examine(root, level == "error")
    assert any(found == level and words in text for found, _, text in findings), findings


def test_other_endings_and_two_kinds_of_light(tmp_path, examine):
    root = write_colmap(tmp_path / "a")
    write_image(root / "images" / "more.exr", np.ones((HEIGHT, WIDTH, 3), np.float32))
    findings, _ = examine(root)
    assert any(check == "unregistered" and "more.exr" in text for _, check, text in findings)
    (root / "images" / "b.png").unlink()
    (root / "images" / "more.exr").rename(root / "images" / "b.exr")
    findings, _ = examine(root, 1)
    assert any(found == "error" and "b.png in linear light" in text for found, _, text in findings)
    assert not any(check == "unregistered" for _, check, _ in findings)


def test_a_few_steps_tell_how_long_a_training_takes(tmp_path, examine, monkeypatch):
    """By the steps of a trial; without them where memory is short; nothing of a scene that training refuses."""
    half = lambda trial, _: StepTime(len(trial.model), trial.scene.train[0].camera.width, 0.5)  # noqa: E731
    monkeypatch.setattr(deadline, "_of_step", half)

    def told():
        return [(level, text) for level, check, text in examine(SCENE)[0] if check == "forecast"]

    (fast, first), (plain, second) = told()
    assert fast == plain == "note" and first.startswith("--preset fast: about 30 min for 3600 steps. About ")
    assert " at 100000 Gaussians (--max_gaussians)." in first and "the default: about 4.2 h for 30000 steps." in second
    with monkeypatch.context() as context:
        context.setattr(cost, "cost_of", lambda *_: bytearray(2**62))
        level, text = told()[-1]
        assert level == "warning" and text.startswith("no more can be tried: Out of memory on cpu between two stages")
    monkeypatch.setattr(memory, "available_memory", lambda device: 0)
    assert all(level == "warning" and " min " not in text and "Only " in text for level, text in told())
    broken = shutil.copytree(SCENE, tmp_path / "broken")
    next((broken / "images").iterdir()).unlink()
    assert not [check for _, check, _ in examine(broken, 1)[0] if check == "forecast"]


def test_no_file_but_a_page_is_written_over(tmp_path, fails):
    photo = tmp_path / "photo.jpg"
    photo.write_text("a photograph")
    assert "ends in .html" in fails("inspect", SCENE, "-o", photo) and photo.read_text() == "a photograph"
    assert "photo.jpg is no folder" in fails("inspect", SCENE, "-o", photo / "page.html")


def test_text_of_the_scene_is_not_html(tmp_path, examine):
    name = "<script>alert(1)</script>.png".replace("/", "_")
    examine(write_colmap(tmp_path / "a", names=(name, "b.png", "c.png")), pictures=True)
    (tmp_path / "a" / "images" / name).unlink()
    findings, page = examine(tmp_path / "a", 1, pictures=True)
    assert any(name in text for _, _, text in findings) and "<script" not in page.read_text()


def test_nerf_synthetic_scenes_are_examined(tmp_path, examine):
    findings, _ = examine(write_blender(tmp_path / "a"))
    assert worst(findings) == {("warning", "cameras"), ("warning", "duplicates")}  # three images, all the same


def test_a_folder_that_is_no_scene_gets_one_sentence(tmp_path, fails):
    write_image(tmp_path / "photos" / "a.png", texture())
    assert "warp-splat sfm" in fails("inspect", tmp_path / "photos")
    assert not (tmp_path / "output").exists()


def test_photographs_of_one_column_have_a_page(tmp_path, examine):
    pixels = np.full((2400, 1, 3), 128, np.uint8)
    scene = write_colmap(tmp_path / "strips", pixels=pixels, camera="PINHOLE 1 2400 20 20 0.5 1200")
    _, page = examine(scene, pictures=True)
    assert page.read_text().count("<img") == 3

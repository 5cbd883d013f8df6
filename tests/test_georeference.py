"""Scale, up and origin of a model, against positions that are known."""

import json
import shutil

import numpy as np
import pycolmap
import pytest
from commands import SHORT
from hostile import refusal
from PIL import Image
from scipy.spatial.transform import Rotation
from splat_files import some_file

from warp_splat.formats import coordinates
from warp_splat.formats.coordinates import COMMENT, MODEL_FROM_WORLD, of_comments, read_coordinates, write_coordinates
from warp_splat.formats.exchange import save_gaussians
from warp_splat.formats.model_folder import ply_path, write_cameras
from warp_splat.inspect.subject import Subject
from warp_splat.inspect.verdicts import check_coordinates
from warp_splat.rendering.camera_paths import focus_point
from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene
from warp_splat.sfm.georeference import UP, _by_distances, _gps, fit, georeference, require_named

UTM = np.array([691_000.25, 5_335_000.5, 520.0])
COUNT = 16


def model_of(centers, random, down=False, ahead=None):
    """Cameras at centers [N, 3] (x east, y north, z up) that look level, down or ``ahead`` [3], in another frame."""
    model = pycolmap.Reconstruction()
    lens = pycolmap.Camera(camera_id=1, model="PINHOLE", width=8, height=8, params=[8, 8, 4, 4])
    model.add_camera_with_trivial_rig(lens)
    for index, center in enumerate(centers):
        forward = np.append(random.normal(size=2), 0.0) if ahead is None else np.array(ahead)
        forward = forward / np.linalg.norm(forward)
        below = forward[2] * forward - (0, 0, 1)
        below /= np.linalg.norm(below)
        rotation = np.stack([np.cross(below, forward), below, forward])
        if down:
            rotation = np.stack([rotation[0], -forward, (0, 0, -1)])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ center)
        image = pycolmap.Image(name=f"{index}.jpg", camera_id=1, image_id=index + 1)
        model.add_image_with_trivial_frame(image, pose)
    model.transform(pycolmap.Sim3d(0.037, pycolmap.Rotation3d(random.normal(size=3)), random.normal(size=3)))
    return model


def by_positions(folder, model, positions):
    """Coordinates of a model by positions in a file, and what was told."""
    rows = [f"{index}.jpg,{x!r},{y!r},{z!r}" for index, (x, y, z) in enumerate(positions.tolist())]
    (folder / "a.csv").write_text("\n".join(["name,x,y,z", *rows]))
    told = []
    return georeference(model, folder, str(folder / "a.csv"), 0, told.append), told


def placed(model, found):
    """Positions of the model's cameras in the world, by its coordinates as a file has them."""
    found = json.loads(json.dumps(found, allow_nan=False))
    local = np.array([model.image(i + 1).projection_center() for i in range(COUNT)])
    assert np.abs(local).max() < 100  # so float32 holds them
    return local.astype(np.float32) @ MODEL_FROM_WORLD + np.array(found["origin"])


@pytest.mark.parametrize("along", ["an area", "a line"])
def test_positions_place_a_model_and_outliers_are_left_out(tmp_path, along):
    random = np.random.default_rng(3)
    centers = random.uniform(-20, 20, (COUNT, 3)) * ((1, 1, 0.1) if along == "an area" else (1, 0, 0))
    model, world = model_of(centers, random), centers + UTM
    noisy = world + random.normal(size=world.shape) * 1e-3
    noisy[4] += (30, 0, 9)
    noisy[5] = 0.0  # as GPS that has found no place
    found, _ = by_positions(tmp_path, model, noisy)
    assert np.linalg.norm(placed(model, found) - world, axis=1).max() < 0.01
    assert found["left_out"] == ["4.jpg", "5.jpg"]
    assert 25 < found["residuals"]["4.jpg"] < 40 and found["residuals"]["0.jpg"] < 0.01
    down = np.array([model.image(i + 1).cam_from_world().rotation.matrix()[1] for i in range(COUNT)])
    np.testing.assert_allclose(down, np.broadcast_to((0, 1, 0), down.shape), atol=0.01)


@pytest.mark.parametrize(
    ("spans", "ahead", "noise", "wrong", "line"),
    [
        ((20, 20, 0), (0, 1, 0), 0.0, 0, False),  # z is 520 m everywhere
        ((20, 0, 0), (0, 1, 0), 0.0, 0, True),
        ((100, 0, 0), (1, 0, -0.5), 0.02, 0, True),
        ((100, 0, 10), (1, 0, -0.1), 0.02, 30, True),
        ((250, 12, 0), (0, 1, -1), 0.03, 30, False),  # what leaves the line by 25 m tells up
        ((60, 2, 0), (1, 0, 0), 1.0, 0, True),  # but not if positions err by more
        ((0, 4, 60), (1, 0, 0), 0.5, 0, True),  # up goes along it, and tells nothing
    ],
)
def test_what_positions_do_not_tell_cameras_do(tmp_path, spans, ahead, noise, wrong, line):
    """Whole meters, lines and cameras that look down ahead; 30 of 100 positions are wrong."""
    random, count = np.random.default_rng(3), 100
    along, aside = np.linspace(-1, 1, count), random.uniform(-1, 1, count)
    centers = np.stack([along, aside, along], 1) * spans
    slow = np.sin(9 * along[:, None] + (0, 1, 2))  # as GPS errs, which no number of photographs takes away
    positions = centers + UTM.round() + noise * (random.normal(size=centers.shape) + slow)
    positions[:wrong] += 60 * random.normal(size=(wrong, 3))
    model = model_of(centers, random, ahead=ahead)
    found, told = by_positions(tmp_path, model, positions)
    turned = np.stack([model.image(i + 1).cam_from_world().rotation.matrix()[2] for i in range(count)])
    off = turned @ MODEL_FROM_WORLD - np.array(ahead) / np.linalg.norm(ahead)
    local = np.array([model.image(i + 1).projection_center() for i in range(count)])
    assert np.abs(off).max() < max(1e-3, 0.2 * noise), off
    assert np.abs(local @ MODEL_FROM_WORLD + found["origin"] - centers - UTM.round()).max() < 3 * noise + 1e-4
    assert ("check the turn about it" in told[0]) == line and {f"{i}.jpg" for i in range(wrong)} <= {*found["left_out"]}


@pytest.mark.parametrize("seed", range(4))
def test_most_may_stand_in_one_place(tmp_path, seed):
    """Near each other, compared with how positions err, and the others around them."""
    random = np.random.default_rng(seed)
    centers = random.uniform(-1, 1, (COUNT, 3)) * np.where(np.arange(COUNT) < 12, 0.4, 20)[:, None]
    model, noisy = model_of(centers, random), centers + UTM + 0.2 * random.normal(size=(COUNT, 3))
    assert np.linalg.norm(placed(model, by_positions(tmp_path, model, noisy)[0]) - centers - UTM, axis=1).max() < 1


@pytest.mark.parametrize(("others", "noise"), [("around", 0.2), ("at another place", 0.01)])
@pytest.mark.parametrize("seed", range(4))
def test_cameras_may_stray_where_most_stand_in_one_place(seed, others, noise):
    random = np.random.default_rng(seed)
    if others == "around":
        world = random.uniform(-1, 1, (30, 3)) * np.where(np.arange(30) < 22, 0.5, 30)[:, None] * (1, 1, 0.2)
        strays = np.arange(30) < 4
    else:
        world = 0.5 * random.normal(size=(30, 3)) + np.where(np.arange(30) < 24, 0, 50)[:, None] * (1, 0.2, 0)
        strays = random.permutation(30) < 8
    centers = world + strays[:, None] * 90 * random.normal(size=(30, 3))
    fitted, _, right, _ = fit(0.05 * centers, world + noise * random.normal(size=world.shape), UP, 0)
    assert not right[strays].any() and np.linalg.norm(fitted * (0.05 * world) - world, axis=1).max() < 1.5


def test_exact_positions_stay_beside_wrong_ones():
    """Along a spiral that becomes ever narrower."""
    random, t = np.random.default_rng(12), np.linspace(-1, 0, 100)
    world = 100 * np.exp(6 * t)[:, None] * np.stack([np.cos(12 * t), np.sin(12 * t), 0.1 + 0 * t], 1)
    wrong = np.isin(np.arange(100), random.choice(100, 20, replace=False))
    positions = world + 2 * wrong[:, None] * random.normal(size=(100, 3))
    assert fit(0.05 * world, positions, UP, 0)[2][~wrong].all()


@pytest.mark.parametrize("looks", ["level", "down"])
def test_axes_that_may_be_exchanged_are_told(tmp_path, looks):
    """What is flat turns over where x and y are exchanged: a mirror is no rotation."""
    random = np.random.default_rng(3)
    centers = random.uniform(-20, 20, (COUNT, 3)) * (1, 1, 0.02)
    for world, doubted in ((centers[:, [1, 0, 2]], True), (centers, False)):
        found, told = by_positions(tmp_path, model_of(centers, random, looks == "down"), world + UTM)
        assert ("are x and y exchanged?" in told[0]) == ("exchanged" in found["reference"]) == doubted


def test_three_positions_say_that_they_always_fit(tmp_path):
    random = np.random.default_rng(3)
    centers = random.uniform(-20, 20, (COUNT, 3)) * (1, 1, 0.1)
    for count in (3, 4):
        _, told = by_positions(tmp_path, model_of(centers, random), (centers + UTM)[:count])
        assert ("three always fit" in told[0]) == (count == 3)


def test_distances_give_the_scale_and_cameras_the_up_and_unknown_names_are_told(tmp_path):
    random = np.random.default_rng(4)
    centers = random.uniform(-5, 5, (COUNT, 3))
    model = model_of(centers, random)
    between = np.linalg.norm(centers[0] - centers[1]), np.linalg.norm(centers[2] - centers[3])
    rows, places = [(["0.jpg", "1.jpg"], [between[0]])], dict(zip(("0.jpg", "1.jpg"), centers, strict=False))
    assert _by_distances(model_of(centers, random), places, np.zeros(3), rows, "a", str)["scale"] == pytest.approx(1)
    lines = f"0.jpg,1.jpg,{between[0]}\n2.jpg, 3.jpg, {between[1]}\nother.jpg,1.jpg,7\n"
    (tmp_path / "d.csv").write_text(f"name,other,distance\n{lines}")
    found = georeference(model, tmp_path, str(tmp_path / "d.csv"), 0, (told := []).append)
    assert len(told) == 2 and told[0].endswith("has the name other.jpg") and "2 distances fit within" in told[1]
    world = placed(model, found)
    np.testing.assert_allclose(world[:, 2] - world[0, 2], centers[:, 2] - centers[0, 2], atol=1e-4)
    apart, true = (np.linalg.norm(places - places[0], axis=1) for places in (world, centers))
    np.testing.assert_allclose(apart, true, 1e-5)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "name,other,distance, found nothing"),
        ("x,y\n1,2", "expected a CSV file that begins with name,x,y,z"),
        ("name,x,y,z\na.jpg,1,2,1e300", "found the line a.jpg,1,2,1e300"),
        ('name,x,y,z\n"' + "a.jpg,1,2,3\n" * 20_000, "field larger than field limit"),
        ("name,x,y,z\na.jpg,1,2", "found the line a.jpg,1,2"),
        ("name,x,y,z\na.jpg,1,2,b", "without numbers"),
        ("name,x,y,z\na.jpg,1,2,3\nb.jpg,1,nan,3", "found the line b.jpg,1,nan,3"),
        ("name,x,y,z\na.jpg,1,2,3", "of at least 3 photographs"),
        ("name,x,y,z\na.jpg,1,2,3\nb.jpg,1,2,3\n  \na.jpg,1,2,4", "more than one line for a.jpg"),
        ("name,other,distance\na.jpg,b.jpg,3", "above 0 of registered photographs such as 0.jpg"),
        ("name,other,distance\n0.jpg,1.jpg,2\n0.jpg,1.jpg,0", "distances above 0"),
        ("name,other,distance\n0.jpg,1.jpg,1\n1.jpg,2.jpg,1e3\n2.jpg,3.jpg,1e6", "found 100% off"),
        ("name,other,distance\n0.jpg,0.jpg,3", "distances above 0"),
        ("name,x,y,z\n" + "\n".join(f"{k}.jpg,{k**3 % 7},{k**5 % 11},{k**2 % 5}" for k in range(COUNT)), "fit the cam"),
        ("name,x,y,z\n" + "\n".join(f"{k}.jpg,691000.25,5335000.5,520" for k in range(COUNT)), "they span 0 m"),
    ],
)
def test_files_that_do_not_fit_get_one_sentence(tmp_path, text, words):
    random = np.random.default_rng(5)
    (tmp_path / "a.csv").write_text(text)
    model = model_of(random.uniform(-5, 5, (COUNT, 3)), random)
    refusal(lambda: georeference(model, tmp_path, str(tmp_path / "a.csv"), 0, print), match=words)


def test_a_file_that_cannot_be_read_is_refused_before_cameras_are_computed(tmp_path, fails):
    (tmp_path / "photos").mkdir()
    (tmp_path / "a.csv").write_text("x,y\n1,2")
    said = fails("sfm", tmp_path / "photos", tmp_path / "scene", "--coordinates", tmp_path / "a.csv")
    assert "begins with name,x,y,z" in said and not (tmp_path / "scene").exists()


@pytest.mark.parametrize("latitude", [48, 0])
def test_gps_of_photographs_is_read_as_utm(tmp_path, latitude):
    """Against the zone's own middle meridian: 500 km east, and there the scale is 0.9996. Also across the equator."""
    for index in range(3):
        exif = Image.new("RGB", (64, 48)).getexif()
        north = latitude + index > 0
        seconds = 36.0 * (index or not latitude)
        exif.get_ifd(0x8825).update({1: "SN"[north], 2: (latitude, 0.0, seconds), 3: "E", 4: (9.0, 0.0, 0.0)})
        exif.get_ifd(0x8825).update({5: b"\0", 6: 500.0})
        Image.effect_noise((64, 48), 50).convert("RGB").save(tmp_path / f"{index}.jpg", exif=exif)
    database = tmp_path / "database.db"
    pycolmap.Database.open(database).close()
    pycolmap.import_images(database, tmp_path, image_names=[f"{index}.jpg" for index in range(3)])
    found, reference = _gps(database)
    assert "UTM zone 32 north" in reference
    apart = 0.9996 * (1111.97 if latitude else 2 * 1105.74)  # a hundredth of a degree, or two
    np.testing.assert_allclose([found[f"{k}.jpg"][[0, 2]] for k in range(3)], [(500_000, 500)] * 3, atol=0.01)
    assert abs((found["1.jpg"] - found["0.jpg"])[1] - apart) < 1.0


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("name,x,y,z\na,1,2,3\nb.jpg,1,2,4\nc,2,2,3", "lines of photographs such as a.jpg, 3 at least, found 1"),
        ("name,other,distance\na,b.jpg,3", "lines of photographs such as a.jpg, 1 at least, found 0"),
        ("name,x,y,z\na.jpg,1,2,3\nb.jpg,1,2,4\nc.jpg,2,2,3\nd,1,1,1", ""),
        ("name,other,distance\na.jpg,b.jpg,3", ""),
    ],
)
def test_names_of_no_photograph_are_told_before_cameras_are_computed(text, found, tmp_path):
    (tmp_path / "a.csv").write_text(text)
    ask = lambda: require_named(tmp_path / "a.csv", ["a.jpg", "b.jpg", "c.jpg"])  # noqa: E731
    refusal(ask, found) if found else ask()


def test_a_scene_with_coordinates_is_upright_and_says_where(tmp_path):
    shutil.copytree(embedded_scene(), tmp_path / "scene")
    assert abs(load_scene(tmp_path / "scene", resolution=8, report=str).up[2]) > 0.9  # z is up in it, as cameras tell
    residuals = {"a": 0.5, "b": 0.25, "c": 9.0, "d": 0.25, "e": 0.375}
    where = {"origin": UTM.tolist(), "reference": "UTM", "residuals": residuals, "left_out": ["c"]}
    write_coordinates(tmp_path / "scene", where)
    scene = load_scene(tmp_path / "scene", resolution=8, report=str)
    np.testing.assert_array_equal(focus_point(scene)[1], (0, -1, 0))
    write_cameras(tmp_path, scene.test, scene.train, scene.coordinates)
    assert json.loads((tmp_path / "cameras.json").read_text())[3]["origin"] == UTM.tolist()
    (finding,) = check_coordinates(Subject(tmp_path / "scene", tmp_path))
    told = ["UTM, origin at 691000.25, 5335000.5, 520; 4 fit within 0.31 m (median)", "the worst, a, within 0.5 m"]
    assert all(words in finding.text for words in (*told, "left out: c"))
    assert finding.level == "warning"


@pytest.mark.slow
def test_gaussians_from_another_origin_are_refused(tmp_path, ran, fails):
    """Those of a file, of a model folder, and of a training that goes on: the scene was placed anew since."""
    scene, here, there = tmp_path / "scene", {"origin": [1.0, 2.0, 3.0]}, {"origin": [9.0, 2.0, 1.0]}
    shutil.copytree(embedded_scene(), scene)
    write_coordinates(scene, here)
    model = tmp_path / "model"
    ran("train", "-s", scene, "-m", model, *SHORT, "--iterations", 1)
    for name, where in (("same", here), ("other", there), ("unknown", None)):
        save_gaussians(tmp_path / f"{name}.ply", some_file(9)._replace(coordinates=where))
        if name != "other":
            load_scene(scene, start=str(tmp_path / f"{name}.ply"), report=str)
            ran("render", "-m", tmp_path / f"{name}.ply", "-s", scene, "--quiet")
    said = "expected Gaussians from the origin [1.0, 2.0, 3.0]"
    assert said in fails("render", "-m", tmp_path / "other.ply", "-s", scene)
    assert said in fails("train", "-s", scene, "-m", tmp_path / "new", "--start_ply", tmp_path / "other.ply")
    write_coordinates(scene, there)
    said = "expected Gaussians from the origin [9.0, 2.0, 1.0]"
    assert said in fails("render", "-m", model) and said in fails("train", "--resume", model, "--iterations", "2")
    assert said in fails("train", "-s", scene, "-m", tmp_path / "new", "--start_ply", model)
    assert read_coordinates(model) == here
    write_coordinates(scene, None)
    for place in (model, tmp_path / "further"):
        ran("train", "--resume", model, "--iterations", 2, "-m", place)
        assert read_coordinates(place) == here
        assert json.loads((place / "cameras.json").read_text())[0]["origin"] == here["origin"]


@pytest.mark.slow
def test_a_model_of_other_cameras_is_refused(tmp_path, ran, fails):
    """Structure from motion was run again: names are the same, and places are not."""
    model, cameras = tmp_path / "model", tmp_path / "model" / "cameras.json"
    ran("train", "-s", embedded_scene(), "-m", model, *SHORT, "--iterations", 1)
    entries = json.loads(cameras.read_text())

    def write(scale):
        moved = [{**entry, "position": [scale * x for x in entry["position"]]} for entry in entries]
        cameras.write_text(json.dumps(moved))

    write(1.001)  # as a training refines them
    ran("render", "-m", model, "--skip_train", "--quiet")
    ran("train", "--start_ply", model, "-m", tmp_path / "going on", *SHORT, "--iterations", 1)
    write(2.0)
    ran("train", "--resume", tmp_path / "going on", "--iterations", 2)  # its Gaussians are in the checkpoint
    new = ["train", "-s", embedded_scene(), "-m", tmp_path / "new", "--start_ply", model]
    resumed = ["train", "--resume", model, "--iterations", "2"]
    for command in (["render", "-m", model, "--quiet"], new, resumed):
        assert "name the scene that it was trained on" in fails(*command)
    beside = ply_path(model, 1).parent / "cameras.json"
    beside.write_text(cameras.read_text())  # refined with the Gaussians, but not from another place
    assert "name the scene that it was trained on" in fails(*resumed)
    write(1.2)  # as far as was asked for
    ran(*resumed, "-m", tmp_path / "refined")
    beside.unlink()
    axes = np.array([entry["rotation"] for entry in entries])  # columns, in the world
    for angle, share, refused in ((0.01, 1, False), (0.1, 1, True), (0.1, 0.4, True), (0.1, 0.1, False)):
        angles = [angle * (place < share * len(axes)) for place in range(len(axes))]
        moved = axes @ Rotation.from_rotvec(np.outer(angles, (0, 0, 1))).as_matrix()
        turned = [{**entry, "rotation": axis.tolist()} for entry, axis in zip(entries, moved, strict=True)]
        cameras.write_text(json.dumps(turned))  # about its own place
        if refused:
            assert "moved or turned by 10% of its size" in fails(*resumed)
        else:
            ran("render", "-m", model, "--skip_train", "--quiet")


def test_damaged_coordinates_get_one_sentence(tmp_path):
    assert read_coordinates(tmp_path) is None
    right = '{"origin": [1, 2, 3], '
    wrong = [right + f'"residuals": {found}}}' for found in ("[1, 2]", '{"a": "x"}', '{"a": Infinity}')]
    wrong += [f'{{"origin": {found}}}' for found in ('["1", "2", "3"]', "[[1], [2], [3]]", "[true, 2, 3]")]
    wrong += [f'{{"origin": {found}}}' for found in ("[1, 2]", "[1, 2, NaN]", '["a", 2, 3]')]
    wrong += [right + found for found in ('"left_out": 5}', '"reference": NaN}')]
    for text in (*wrong, f'{{"origin": [1{"0" * 400}, 2, 3]}}', "[]", "{"):
        (tmp_path / "coordinates.json").write_text(text)
        refusal(lambda: read_coordinates(tmp_path), match=r"coordinates\.json")
    write_coordinates(tmp_path, {"origin": [1.0, 2.0, 3.0]})
    assert json.loads((tmp_path / "coordinates.json").read_text()) == read_coordinates(tmp_path)
    assert coordinates.kept({"origin": [10**400, 2, 3]}) is None and of_comments([COMMENT + "[" * 100_000]) is None
    write_coordinates(tmp_path, None)
    assert read_coordinates(tmp_path) is None
    (tmp_path / "coordinates.json").mkdir()
    refusal(lambda: read_coordinates(tmp_path), match=r"coordinates\.json")

"""The model folder: arguments that are never evaluated, cameras, iterations, and folders that cannot be written."""

import argparse
import json
import subprocess
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from commands import full_disk, started
from hostile import refusal
from scene_files import write_colmap
from scipy.spatial.transform import Rotation
from splat_files import some_splats

from warp_splat.camera import Camera
from warp_splat.errors import InputError
from warp_splat.formats import model_folder
from warp_splat.formats.coordinates import write_coordinates
from warp_splat.formats.exchange import load_gaussians, save_gaussians
from warp_splat.formats.splats import SplatFile
from warp_splat.rendering.finished import Finished
from warp_splat.scene.start import load_start
from warp_splat.scene.types import Decoded, View

ARGUMENTS = {
    "sh_degree": 3,
    "source_path": "a folder/it's",
    "model_path": Path("output") / "x",
    "white_background": False,
    "test_iterations": [7000, 30000],
    "position_lr_init": 1.6e-4,
    "offset": -1,
    "start_checkpoint": None,
}


def test_cfg_args_are_what_argparse_prints_and_come_back(tmp_path):
    model_folder.write_cfg_args(tmp_path, ARGUMENTS)
    plain = ARGUMENTS | {"model_path": str(ARGUMENTS["model_path"])}
    assert (tmp_path / "cfg_args").read_text() == str(argparse.Namespace(**plain))
    assert model_folder.read_cfg_args(tmp_path) == plain


@pytest.mark.parametrize(
    "text",
    [
        "Namespace(a=__import__('os').system('touch {marker}'))",
        "Namespace(a=[].__class__)",
        "Namespace(**__import__('os').system('touch {marker}'))",
        "Namespace(__import__('os').system('touch {marker}'))",
        "__import__('os').system('touch {marker}')",
        "Namespace(a=1); import os",
        "Namespace(a=1).__class__",
        "dict(a=1)",
        "Namespace(a=1",
        "Namespace(a=f'{{open}}')",
        "Namespace(a=[" + "(" * 5000 + ")" * 5000 + "])",
        "Namespace(a={{[]: 1}})",
        "",
        "\0",
    ],
)
def test_cfg_args_refuses_all_but_literals_and_runs_nothing(tmp_path, text):
    marker = tmp_path / "executed"
    (tmp_path / "cfg_args").write_text(text.format(marker=marker))
    refusal(lambda: model_folder.read_cfg_args(tmp_path), "cfg_args")
    assert not marker.exists()


def test_cfg_args_missing_or_not_text(tmp_path):
    for content, sentence in ((None, r"is .* a model folder"), (b"\xff\xfe\x00", "could not be read")):
        if content:
            (tmp_path / "cfg_args").write_bytes(content)
        refusal(lambda: model_folder.read_cfg_args(tmp_path), match=sentence)


@pytest.mark.parametrize("value", [object(), float("nan"), float("inf"), np.float32(1)])
def test_cfg_args_that_could_not_be_read_are_not_written(tmp_path, value):
    refusal(lambda: model_folder.write_cfg_args(tmp_path, {"a": value}), "literal")
    assert not list(tmp_path.iterdir())


def view(name, seed):
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    original = Camera(800, 600, 700, 710, 390, 310, rotation, rng.normal(size=3))
    return View(name, original.resized(400, 300), Decoded(np.zeros((300, 400, 3), np.uint8)), original)


def test_cameras_test_first_at_original_size(tmp_path):
    test, train = [view("a/1.jpg", 1)], [view("2.jpg", 2), view("3.jpg", 3)]
    model_folder.write_cameras(tmp_path, test, train)
    entries = json.loads((tmp_path / "cameras.json").read_text())
    assert [(entry["id"], entry["img_name"]) for entry in entries] == [(0, "a/1.jpg"), (1, "2.jpg"), (2, "3.jpg")]
    assert model_folder.trained_names(tmp_path) == {"2.jpg", "3.jpg"}
    for entry, expected in zip(entries, test + train, strict=True):
        numbers = ["width", "height", "position", "rotation", "fy", "fx", "cx", "cy"]
        assert list(entry) == ["id", "img_name", *numbers, "trained"]
        assert (entry["width"], entry["height"], entry["fx"], entry["fy"]) == (800, 600, 700, 710)
        camera_from_world = np.eye(4)
        camera_from_world[:3, :3], camera_from_world[:3, 3] = expected.original.rotation, expected.original.translation
        world_from_camera = np.linalg.inv(camera_from_world)
        np.testing.assert_allclose(entry["rotation"], world_from_camera[:3, :3], atol=1e-12)
        np.testing.assert_allclose(entry["position"], world_from_camera[:3, 3], atol=1e-12)


def test_cameras_come_back(tmp_path):
    """Those without a principal point, as the reference writes them, have it in the middle."""
    assert model_folder.read_cameras(tmp_path) == []
    views = [view("a/1.jpg", 1), view("2.jpg", 2)]
    model_folder.write_cameras(tmp_path, [], views)
    for (name, camera), expected in zip(model_folder.read_cameras(tmp_path), views, strict=True):
        assert name == expected.name
        for field in ("width", "height", "fx", "fy", "cx", "cy"):
            assert getattr(camera, field) == getattr(expected.original, field)
        np.testing.assert_allclose(camera.rotation, expected.original.rotation, atol=1e-12)
        np.testing.assert_allclose(camera.translation, expected.original.translation, atol=1e-12)
    entries = json.loads((tmp_path / "cameras.json").read_text())
    del entries[0]["cx"], entries[0]["cy"]
    (tmp_path / "cameras.json").write_text(json.dumps(entries))
    (_, camera), _ = model_folder.read_cameras(tmp_path)
    assert (camera.cx, camera.cy) == (400, 300)


@pytest.mark.parametrize(
    "damage",
    [
        *("{", "{}", "[1]", "[{}]", "[" * 100_000),
        *({"width": "wide"}, {"width": None}, {"rotation": [[1]]}, {"rotation": [[[]]]}, {"fx": 0}),
        *({"position": [0, 0, 1e400]}, {"position": {"x": 0}}),
    ],
    ids=lambda damage: str(damage)[:20],
)
def test_damaged_cameras_are_refused_by_a_sentence(tmp_path, damage):
    entry = {"img_name": "1", "width": 4, "height": 3, "fx": 2, "fy": 2}
    entry |= {"position": [0, 0, 0], "rotation": np.eye(3).tolist()}
    text = damage if isinstance(damage, str) else json.dumps([entry | damage])
    (tmp_path / "cameras.json").write_text(text)
    refusal(lambda: model_folder.read_cameras(tmp_path), "cameras.json")


def test_find_iteration_takes_the_largest_number(tmp_path):
    refusal(lambda: model_folder.find_iteration(tmp_path), "found none")
    for iteration in (7000, 30000, 999):
        path = model_folder.ply_path(tmp_path, iteration)
        path.parent.mkdir(parents=True)
        path.write_text("ply")
    (tmp_path / "point_cloud" / "iteration_40000").mkdir()
    (tmp_path / "point_cloud" / "notes.txt").write_text("")
    assert model_folder.find_iteration(tmp_path) == 30000
    assert model_folder.find_iteration(tmp_path, 7000) == 7000
    with pytest.raises(InputError, match="iteration 8000 was not saved; those saved: 999, 7000, 30000"):
        model_folder.find_iteration(tmp_path, 8000)


def test_prepare_creates_and_leaves_nothing_behind(tmp_path):
    folder = model_folder.prepare_folder(tmp_path / "a" / "b")
    assert folder.is_dir() and not list(folder.iterdir())
    model_folder.prepare_folder(folder)


CLAIMING = """
import sys
from pathlib import Path
from warp_splat.formats.model_folder import claimed
with claimed(Path(sys.argv[1])):
    print("in", flush=True)
    sys.stdin.read()
"""


def test_a_folder_is_claimed_by_one_training(tmp_path):
    """Another process is refused while the block runs, and not any more once it has ended or was killed."""
    with started("-c", CLAIMING, tmp_path, stdin=subprocess.PIPE) as other:
        assert other.stdout.readline() == "in\n"
        with pytest.raises(InputError, match="another run"), model_folder.claimed(tmp_path):
            pass
        other.kill()
    with model_folder.claimed(tmp_path):
        assert list(tmp_path.iterdir())
    assert not list(tmp_path.iterdir())
    (tmp_path / ".lock").mkdir()
    with pytest.raises(InputError, match=r"\.lock: expected a file.*remove it"), model_folder.claimed(tmp_path):
        pass


def test_prepare_refuses_before_training(tmp_path):
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "model"):
        with pytest.raises(InputError, match=r"expected a folder that can be written .*; choose another"):
            model_folder.prepare_folder(folder)

    with full_disk(0):
        refusal(lambda: model_folder.prepare_folder(tmp_path / "model"), "expected a folder that can be written")
    assert not list((tmp_path / "model").iterdir())


def test_default_model_path_is_new_each_time():
    first, second = model_folder.default_model_path(), model_folder.default_model_path()
    assert first != second
    assert first.parent == Path("output") and len(first.name) == 10


def test_the_light_of_a_model_is_what_its_training_says(tmp_path):
    """Else that of the photographs."""
    save_gaussians(model_folder.ply_path(tmp_path, 3), SplatFile(some_splats(3)))
    scene = SimpleNamespace(linear=True)
    assert Finished(tmp_path).is_linear(scene) and not Finished(tmp_path).is_linear(None)
    model_folder.write_cfg_args(tmp_path, {"linear_light": False})
    assert not Finished(tmp_path).is_linear(scene)


@pytest.mark.parametrize("mark", [False, True])
def test_open_model(tmp_path, mark, monkeypatch, fails, ran):
    """cfg_args goes before the file's own mark of antialiasing, which goes before nothing; convert does likewise."""
    folder, target = tmp_path / "model", tmp_path / "a.spz"
    for iteration in (3, 20):
        save_gaussians(model_folder.ply_path(folder, iteration), SplatFile(some_splats(iteration), mark))
    iteration, file, options = model_folder.open_model(folder)
    told = {"antialiasing": mark, "linear_light": None}
    assert (iteration, len(file.splats.means), options) == (20, 20, {"eval": True, **told})
    assert model_folder.open_model(model_folder.ply_path(folder, 3))[::2] == (0, options)
    ran("convert", folder, target)
    assert load_gaussians(target).antialiased == mark
    monkeypatch.chdir(write_colmap(tmp_path / "scene"))  # which it was not trained on
    assert "name the scene with -s" in fails("render", "-m", folder)
    trained = {"antialiasing": not mark, "linear_light": True, "white_background": True, "projection": "ellipsoid"}
    model_folder.write_cfg_args(folder, trained | {"eval": False})
    write_coordinates(folder, {"origin": [1.0, 2.0, 3.0]})
    assert model_folder.open_model(folder, 3)[::2] == (3, trained | {"eval": False})
    monkeypatch.chdir(model_folder.ply_path(folder, 3).parent)
    assert model_folder.open_model("point_cloud.ply")[::2] == (0, trained | {"eval": False})
    said = ran("convert", folder, target)
    assert load_gaussians(target).antialiased != mark
    for lost in ("in the world", "in linear light", "projection (ellipsoid)", "white background"):
        assert lost in said
    for source in (model_folder.ply_path(folder, 20), folder):
        ran("convert", source, tmp_path / "a.glb")
        assert load_gaussians(tmp_path / "a.glb").coordinates["origin"] == [1.0, 2.0, 3.0]
    drawn = model_folder.open_model(tmp_path / "a.glb")
    assert load_start(str(folder), print)[0].linear  # so that training can warn
    (folder / "coordinates.json").write_text("{")
    assert model_folder.open_model(folder, 3)[0] == 3 and "coordinates.json" in fails("convert", folder, target)
    assert "coordinates.json" in fails("export-html", folder, tmp_path / "a.html")  # it says where up is
    (folder / "coordinates.json").unlink()
    model_folder.write_cfg_args(folder, {"projection": "unscented"})
    assert "not by the unscented one" in ran("export-html", folder, tmp_path / "a.html")
    model_folder.write_cameras(folder, [], [view("1.jpg", 1)])
    assert " 1 cameras" in ran("export-html", "point_cloud.ply", tmp_path / "a.html")
    model_folder.write_cfg_args(folder, {"projection": "fisheye"})
    message = fails("render", "-m", folder)
    assert "cfg_args: expected a projection of affine, ellipsoid, unscented, found 'fisheye'" in message
    assert drawn[1].linear and drawn[1].coordinates["origin"] == [1.0, 2.0, 3.0] and drawn[2]["linear_light"]

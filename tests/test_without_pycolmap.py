"""Where pycolmap has no wheel (Linux on ARM): what trains without it, and what is refused by name."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scene_files import write_colmap, write_image, write_transforms

from warp_splat.config import SfmConfig
from warp_splat.errors import InputError
from warp_splat.inspect.subject import read_subject
from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene
from warp_splat.sfm.command import sfm

ROOT = Path(__file__).parents[1]
HIDE = "import sys; sys.modules['pycolmap'] = None\n"  # then importing it raises ImportError
TRAIN = "import sys; from warp_splat.cli import main; sys.exit(main(['train', '-m', *sys.argv[1:]]))"


@pytest.fixture
def missing(monkeypatch):
    monkeypatch.setattr("warp_splat.scene.colmap_library.pycolmap", None)


def refused(run, *words):
    with pytest.raises(InputError) as caught:
        run()
    sentence = str(caught.value)
    assert sentence.endswith(".") and "\n" not in sentence
    for word in ("pycolmap", "Linux on ARM", *words):
        assert word in sentence


def test_the_embedded_scene_is_the_same_from_both_of_its_files(monkeypatch):
    expected = load_scene(embedded_scene(), resolution=8, eval=True, report=str)
    monkeypatch.setattr("warp_splat.scene.colmap_library.pycolmap", None)
    found = load_scene(embedded_scene(), resolution=8, eval=True, report=str)
    np.testing.assert_array_equal(found.points, expected.points)
    np.testing.assert_array_equal(found.colors, expected.colors)
    for ours, theirs in zip(found.train + found.test, expected.train + expected.test, strict=True):
        assert ours.name == f"images/{theirs.name}"
        np.testing.assert_array_equal(ours.image, theirs.image)
        a, b = ours.camera, theirs.camera
        assert (a.width, a.height, a.fx, a.fy, a.cx, a.cy) == (b.width, b.height, b.fx, b.fy, b.cx, b.cy)
        for name in ("rotation", "translation", "center"):  # of what kernels see, not a bit differs
            np.testing.assert_array_equal(getattr(a, name).astype(np.float32), getattr(b, name).astype(np.float32))


@pytest.mark.slow
def test_the_embedded_scene_trains_to_the_same_bytes(tmp_path):
    models = []
    for name, code in (("with", TRAIN), ("without", HIDE + TRAIN)):
        short = ["--iterations", "3", "-r", "8", "--seed", "1", "--quiet"]
        subprocess.run([sys.executable, "-c", code, tmp_path / name, *short], cwd=ROOT, check=True, capture_output=True)
        models.append((tmp_path / name / "point_cloud" / "iteration_3" / "point_cloud.ply").read_bytes())
    assert models[0] == models[1]


def test_every_room_can_be_imported():
    code = f"{HIDE}import warp_splat.sfm.command, warp_splat.inspect.command, warp_splat.training.command"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


def test_colmap_scenes_are_refused(tmp_path, missing):
    scene = write_colmap(tmp_path / "scene")
    refused(lambda: load_scene(scene, report=str), "COLMAP model", "sparse")
    _, findings = read_subject(scene, "images")
    assert ["pycolmap" in finding.text for finding in findings if finding.level == "error"] == [True]


def test_transforms_with_pinholes_are_read(tmp_path, missing):
    assert len(load_scene(write_transforms(tmp_path), report=str).train) == 2


def test_lenses_with_distortion_are_refused(tmp_path, missing):
    refused(lambda: load_scene(write_transforms(tmp_path, k1=0.1), report=str), "lens OPENCV", "frame 0")


def test_sfm_is_refused_before_it_writes(tmp_path, missing):
    write_image(tmp_path / "photos" / "a.png", np.zeros((32, 32, 3), np.uint8))
    refused(lambda: sfm(SfmConfig(str(tmp_path / "photos"), str(tmp_path / "scene"))), "warp-splat sfm")
    assert not (tmp_path / "scene").exists()

"""Formats of Gaussians: bytes against what their documents say, axes, round trips, what is lost, and renders."""

import errno
import os
import signal
import struct
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from commands import changes_told, forked_process, full_disk, python
from common import picture_of
from hostile import refusal, replace
from scenes import C0
from scipy.spatial.transform import Rotation
from splat_files import ENDINGS, covariances, seen_colors, sigmoid, silent, some_file, some_splats

from warp_splat.cli import main
from warp_splat.compare.scenes import make_camera
from warp_splat.evaluation.metrics import psnr
from warp_splat.formats.exchange import load_gaussians, save_gaussians
from warp_splat.formats.model_folder import ply_path
from warp_splat.formats.splats import SplatFile, frame, turned
from warp_splat.gaussians import GaussianModel
from warp_splat.rendering.changes import losses
from warp_splat.runtime.interrupts import HANGUP

MIRRORS = {"RUB": [1, -1, -1], "LUF": [-1, -1, 1]}  # of our axes, which are right, down, forward


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
@pytest.mark.parametrize("kind", ["half turn", "any turn", "mirror"])
def test_turned_gaussians_look_the_same_from_the_turned_place(kind, coefficients):
    turns = {"half turn": np.diag([1.0, -1, -1]), "mirror": np.diag([1.0, -1, 1])}
    turn = turns.get(kind, Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix())
    shift, scale = np.array([1.0, -2.0, 3.0]), 2.5
    before = some_splats(20, coefficients)
    after = turned(before, turn, shift, scale)
    np.testing.assert_allclose(after.means, scale * before.means @ turn.T + shift, rtol=1e-5, atol=1e-5)
    wanted = scale**2 * turn @ covariances(before) @ turn.T
    np.testing.assert_allclose(covariances(after), wanted, rtol=1e-4, atol=1e-5 * wanted.max())
    directions = np.random.default_rng(1).normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found, expected = seen_colors(after, directions @ turn.T), seen_colors(before, directions)
    np.testing.assert_allclose(found, expected, atol=1e-5, rtol=0)


def test_a_crop_keeps_what_is_in_the_box(tmp_path, ran, fails):
    before = some_splats()
    save_gaussians(tmp_path / "a.ply", SplatFile(before), silent)
    low, high = np.quantile(before.means, 0.2, axis=0), np.quantile(before.means, 0.9, axis=0)
    box = [f"{value:.9g}" for value in (*low, *high)]
    kept = [all(low[k] <= mean[k] <= high[k] for k in range(3)) for mean in before.means]
    ran("convert", tmp_path / "a.ply", tmp_path / "b.ply", "--crop", *box)
    assert 0 < sum(kept) < len(kept)
    np.testing.assert_array_equal(load_gaussians(tmp_path / "b.ply").splats.means, before.means[kept])
    ran("convert", tmp_path / "a.ply", tmp_path / "b.ply", "--crop", "-1e9", "-9.5E+8", "-inf", *box[3:])
    turned_over, away = (box[3:] + box[:3], "the smallest"), ([9] * 3 + [10] * 3, "none")
    for wrong, said in (([], "expected six numbers"), (box[:5], "expected six numbers"), turned_over, away):
        assert said in fails("convert", tmp_path / "a.ply", tmp_path / "c.ply", "--crop", *wrong)


def test_what_lies_far_away_does_not_hide_what_is_lost(tmp_path, ran):
    """A far Gaussian stretches the steps in which a format keeps the others' positions."""
    before = some_splats()
    before.means[0] = 1e30
    save_gaussians(tmp_path / "a.ply", SplatFile(before), silent)
    said = ran("convert", tmp_path / "a.ply", tmp_path / "b.compressed.ply")
    old, new = (np.sort(load_gaussians(tmp_path / name).splats.means[:, 0]) for name in ("a.ply", "b.compressed.ply"))
    assert np.abs(old - new)[:-1].max() > 0.1 and "lost: position up to" in said


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("options", [["--bound"], ["--crop", *"-9e9 -9e9 -9e9 9e9 9e9 9e9".split()]])
def test_none_or_one_are_converted(tmp_path, count, options, ran):
    save_gaussians(tmp_path / "a.ply", some_file(count), silent)
    for ending in (".spz", ".compressed.ply", ".usda"):
        said = ran("convert", tmp_path / "a.ply", tmp_path / f"b{ending}", *options)
        assert ("measured" in said) == (options == ["--bound"] and count == 1)
        assert len(load_gaussians(tmp_path / f"b{ending}", report=silent).splats.means) == count


@pytest.mark.parametrize("ending", ENDINGS)
def test_marks_are_kept_or_said_to_be_lost(tmp_path, ending):
    notes: list[str] = []
    where = {"origin": [1.0, 2.0, 3.0], "axes": "x east, y down, z north", "reference": "here"}
    splats = some_splats(5)
    save_gaussians(tmp_path / f"a{ending}", SplatFile(splats, True, {**where, "residuals": {}}, True), notes.append)
    found = load_gaussians(tmp_path / f"a{ending}", silent)
    for mark, phrase in (("antialiased", "antialiased"), ("coordinates", "in the world"), ("linear", "linear light")):
        assert bool(getattr(found, mark)) != any(phrase in note for note in notes)
    assert found.antialiased or ending == ".splat"
    assert found.coordinates == (None if ending in (".splat", ".spz", ".sog") else where)
    save_gaussians(tmp_path / f"b{ending}", SplatFile(splats), silent)
    plain = load_gaussians(tmp_path / f"b{ending}", silent)
    assert plain.antialiased is False and plain.coordinates is None


@pytest.mark.parametrize("axes", MIRRORS)
def test_half_turns_and_back_give_the_same_bytes(axes):
    before = some_splats()
    after = turned(there := turned(before, frame(axes).T), frame(axes))
    np.testing.assert_array_equal(there.means, before.means * np.float32(MIRRORS[axes]))
    signless = [splats._replace(quats=np.abs(splats.quats)) for splats in (before, after)]
    np.testing.assert_equal(*signless)


def test_splat_bytes_are_the_documented_layout(tmp_path):
    splats = some_splats(7)
    save_gaussians(tmp_path / "a.splat", SplatFile(splats), report=lambda line: None)
    data = (tmp_path / "a.splat").read_bytes()
    assert len(data) == 7 * 32
    for row in range(7):
        values = struct.unpack_from("<6f8B", data, 32 * row)
        np.testing.assert_array_equal(values[:3], splats.means[row])
        np.testing.assert_allclose(values[3:6], np.exp(splats.scales[row]), rtol=1e-6)
        np.testing.assert_allclose(values[6:9], 255 * np.clip(0.5 + C0 * splats.sh[row, 0], 0, 1), atol=0.51)
        assert abs(values[9] - 255 * sigmoid(splats.opacities[row])) < 0.51
        quat = splats.quats[row] / np.linalg.norm(splats.quats[row])
        np.testing.assert_allclose(values[10:], 128 * quat + 128, atol=1.01)


@pytest.mark.parametrize("coefficients", [1, 16])
@pytest.mark.parametrize("ending", ENDINGS)
def test_round_trip_returns_the_scene(tmp_path, ending, coefficients):
    before = save_gaussians(tmp_path / f"a{ending}", some_file(200, coefficients), report=lambda line: None)
    after = load_gaussians(tmp_path / f"a{ending}", report=silent)
    bounds = {".splat": (0, 1e-5, 0.002), ".spz": (1.3e-4, 0.032, 0.002), ".sog": (1e-3, 0.03, 0.002)}
    bounds[".compressed.ply"] = (0.011, 0.004, 0.002)
    bound = bounds.get(ending, (0, 1e-5, 1e-6))
    np.testing.assert_allclose(after.splats.means, before.splats.means, atol=bound[0], rtol=0)
    np.testing.assert_allclose(after.splats.scales, before.splats.scales, atol=bound[1], rtol=0)
    assert np.abs(sigmoid(after.splats.opacities) - sigmoid(before.splats.opacities)).max() < bound[2]
    if ending != ".splat":
        for part, step in ((np.s_[:, :1], 1 / 255 / 0.15), (np.s_[:, 1:], 1 / 128)):
            atol = {".spz": 0.501 * step, ".sog": 0.02, ".compressed.ply": 0.017}.get(ending, 0)
            np.testing.assert_allclose(after.splats.sh[part], before.splats.sh[part], atol=atol, rtol=0)
    again = tmp_path / f"b{ending}"
    after = save_gaussians(again, after, report=silent)
    assert "color" not in str(losses(after.splats, load_gaussians(again).splats))  # a second time costs nothing


@pytest.mark.parametrize("left", [-20, 500], ids=["all but its end", "its beginning"])
@pytest.mark.parametrize("ending", ENDINGS)
def test_a_full_disk_leaves_no_part_of_a_file(tmp_path, ending, left):
    write = partial(save_gaussians, tmp_path / f"a{ending}", some_file(200), report=silent)
    write()
    size = max(path.stat().st_size for path in tmp_path.iterdir())
    for path in tmp_path.iterdir():
        path.unlink()
    with full_disk(left % size):
        refusal(write, str(tmp_path), "could not be written")
    assert not list(tmp_path.iterdir())


def ended_while_it_writes(number, *arguments):
    """A command that a signal reaches once its file is written, before that has its name."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's "&" has it ignored
    if HANGUP:
        signal.signal(HANGUP, signal.SIG_DFL)  # as nohup has this
    os.replace = lambda *_: os.kill(os.getpid(), number)
    sys.exit(main([*arguments]))


@pytest.mark.parametrize("number", filter(None, (signal.SIGINT, signal.SIGTERM, HANGUP)))
def test_a_signal_leaves_no_part_of_a_file(tmp_path, number):
    save_gaussians(tmp_path / "a.ply", some_file(9))
    process = forked_process(ended_while_it_writes, number, "convert", f"{tmp_path}/a.ply", f"{tmp_path}/b.ply")
    process.join()
    assert process.exitcode == 130 and [path.name for path in tmp_path.iterdir()] == ["a.ply"]


@pytest.mark.slow
@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_a_name_that_a_terminal_cannot_say(tmp_path, encoding):
    save_gaussians(tmp_path / "a.ply", some_file(9))
    command = ["-m", "warp_splat", "convert", tmp_path / "a.ply", tmp_path / "漢.spz"]
    assert r"\u6f22.spz" in python(*command, PYTHONIOENCODING=encoding).stdout


def test_a_full_disk_leaves_no_buffer_alone(tmp_path, monkeypatch):
    def cut(path, text, **_):
        path.write_bytes(text.encode()[:-1])
        raise OSError(errno.ENOSPC, "no space left")

    monkeypatch.setattr(Path, "write_text", cut)
    refusal(partial(save_gaussians, tmp_path / "a.gltf", some_file(9), report=silent), "no space left")
    assert not list(tmp_path.iterdir())


def test_antialiasing_by_the_comments_of_others(tmp_path):
    save_gaussians(tmp_path / "a.ply", some_file(3, antialiased=True))
    data = (tmp_path / "a.ply").read_bytes()
    for comment, wanted in (("SplatRenderMode: default", False), ("antialiased 1", True), ("antialiased 0", False)):
        (tmp_path / "b.ply").write_bytes(data.replace(b"SplatRenderMode: mip", comment.encode()))
        assert load_gaussians(tmp_path / "b.ply").antialiased is wanted


def test_convert_says_what_is_lost(tmp_path, ran):
    file = some_file(40, antialiased=True)
    file.splats.sh[3, 0, 1], file.splats.scales[5, 2], file.splats.sh[7, 4, 0] = 5.0, -20.0, 3.0
    save_gaussians(tmp_path / "a.ply", file)
    said = {}
    for ending in ENDINGS[1:]:
        first, said[ending] = ran("convert", tmp_path / "a.ply", tmp_path / f"b{ending}").splitlines()
        assert first == f"{tmp_path / f'b{ending}'}: 40 Gaussians, SH degree {0 if ending == '.splat' else 3}"
        assert "nothing lost" in ran("convert", tmp_path / f"b{ending}", tmp_path / "c.ply")
    assert said[".glb"] == said[".gltf"] == "  nothing lost but rounding of float32"
    for part in ("SH degree 3 became 0", "the mark that", "opacity up to 0.00", "color of 1 of 40", "rotation up to"):
        assert part in said[".splat"]
    clipped = [f"{name} of 1 of" for name in ("log scale", "harmonics", "color coefficient")]
    assert all(part in said[".spz"] for part in ("position up to 0.00012", *clipped))


@pytest.mark.parametrize(
    ("source", "target", "sentence"),
    [
        ("a.ply", "b.obj", f"expected a name that ends in {', '.join(ENDINGS)}, found '.obj'"),
        ("a.ply", "b", "found 'no ending'"),
        ("none.spz", "b.ply", "none.spz: no such file"),
        ("a.spz", "b.ply", "a.spz: expected an SPZ file of version 2, 3 or 4, found a file that begins with b'ply"),
        ("a.ply", "a.ply", "expected another file than the model"),
        (".", "point_cloud/iteration_7/point_cloud.ply", "expected another file than the model"),
        *(("empty.ply", target, "there are no Gaussians") for target in ("b.splat", "b.glb", "b.sog")),
    ],
)
def test_convert_refuses_in_one_sentence(tmp_path, fails, source, target, sentence):
    save_gaussians(ply_path(tmp_path, 7), some_file(3))
    save_gaussians(tmp_path / "a.ply", some_file(3))
    save_gaussians(tmp_path / "empty.ply", some_file(0))
    (tmp_path / "a.spz").write_bytes((tmp_path / "a.ply").read_bytes())
    before = sorted(tmp_path.rglob("*"))
    assert sentence in fails("convert", tmp_path / source, tmp_path / target)
    assert sorted(tmp_path.rglob("*")) == before


def test_glb_has_a_largest_size_and_one_version(tmp_path, monkeypatch):
    path = tmp_path / "a.glb"
    with monkeypatch.context() as patch:
        patch.setattr("warp_splat.formats.gltf.GLB_BYTES", 10_000)
        refusal(partial(save_gaussians, path, some_file()), match=r"a\.glb: \d+ bytes are more than a \.glb file can")
    assert not list(tmp_path.iterdir())
    save_gaussians(path, some_file(3), report=silent)
    replace(path, b"glTF\2", b"glTF\1")
    refusal(lambda: load_gaussians(path), match=r"a\.glb: .*version 1")


def test_an_older_gltf_keeps_its_data(tmp_path):
    """The .bin file of another scene has another name, so a crash between two writes breaks nothing."""
    save_gaussians(tmp_path / "a.gltf", some_file(seed=1))
    older = (tmp_path / "a.gltf").read_text()
    save_gaussians(tmp_path / "a.gltf", some_file(seed=2))
    (tmp_path / "a.gltf").write_text(older)
    np.testing.assert_array_equal(load_gaussians(tmp_path / "a.gltf").splats.means, some_splats(seed=1).means)


@pytest.mark.parametrize(("ending", "least"), [(".ply", 90), (".glb", 80), (".spz", 38), (".sog", 38), (".splat", 30)])
def test_renders_of_the_converted_file(tmp_path, ending, least):
    """Against renders of the original, from a camera in general position; .splat without its missing harmonics."""
    file = some_file(300, 1 if ending == ".splat" else 16, seed=3)
    camera = make_camera(96, 80, seed=5)
    seen = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 5], (300, 3))
    in_front = seen @ camera.rotation + camera.center
    splats = file.splats._replace(means=in_front.astype(np.float32), scales=file.splats.scales / 2 - 2)
    splats.sh[:] /= 3
    save_gaussians(tmp_path / f"a{ending}", SplatFile(splats), report=silent)
    images = []
    for one in (splats, load_gaussians(tmp_path / f"a{ending}").splats):
        images.append(picture_of(GaussianModel.from_splats(one))(camera))
    assert images[0].std() > 20 and psnr(images[1], images[0]) > least


@pytest.mark.parametrize("ending", [".spz", ".splat"])
def test_convert_bounds_what_pictures_lose(tmp_path, ran, ending):
    save_gaussians(tmp_path / "a.ply", some_file(100, seed=3), report=silent)
    measured, bound = changes_told(ran("convert", tmp_path / "a.ply", tmp_path / f"b{ending}", "--bound"))
    assert 0.0 < measured <= bound

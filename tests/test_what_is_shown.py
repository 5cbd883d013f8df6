"""What a training and a rendering show: videos, sheets, tables, event files, a configuration that repeats itself."""

import json
import shutil
import struct
import sys
from pathlib import Path

import av
import numpy as np
import pytest

from warp_splat.cli import main
from warp_splat.evaluation.metrics import METRICS, psnr
from warp_splat.formats.model_folder import ply_path
from warp_splat.formats.png import load_png

SCENE = Path(__file__).parents[1] / "assets" / "still_life"
SHORT = "--eval -r 65 --iterations 20 --densify_from_iter 5 --densification_interval 5".split()  # an odd size


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """A model whose views were rendered again after its training; the sheet of the training is kept aside."""
    folder = tmp_path_factory.mktemp("model")
    assert main(["train", "-s", str(SCENE), "-m", str(folder), *SHORT, "--tensorboard"]) == 0
    (folder / "contact_sheet.png").rename(folder / "before.png")
    assert main(["render", "-m", str(folder)]) == 0
    return folder


def decode(path):
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


@pytest.mark.parametrize(("video", "opposite"), [("orbit", 6), ("spiral", 3), ("path", 6)])
def test_video(told, capsys, video, opposite):
    """Of an even size, and it moves; twelve frames, as asked for."""
    assert main(["render", "-m", str(told), "--video", video, "--frames", "12", "--quiet"]) == 0
    assert capsys.readouterr().out.strip() == f"frames in {told / video}.mp4"
    film = decode(told / f"{video}.mp4")
    assert len(film) == 12 and film[0].shape == (62, 66, 3) and film[0].std() > 5
    assert psnr(film[0], film[opposite]) < 25


@pytest.mark.slow
def test_frames_of_a_video(told, tmp_path, capsys):
    """A folder gets the frames that the film shows, as H.264 keeps them; the first is the first photograph's."""
    for output in (tmp_path / "frames", tmp_path / "film.mp4"):
        options = ["--video", "path", "--frames", "11", "--orbit_output", str(output), "--quiet"]
        assert main(["render", "-m", str(told), *options]) == 0
    frames = [load_png(path) for path in sorted((tmp_path / "frames").iterdir())]
    few = ["--video", "path", "--frames", "9", "--video_output", str(tmp_path / "frames")]
    assert main(["render", "-m", str(told), *few]) == 0
    assert "2 older frames are in" in capsys.readouterr().out
    assert psnr(frames[0], load_png(told / "train" / "ours_20" / "renders" / "00000.png")) > 60
    for decoded, frame in zip(decode(tmp_path / "film.mp4"), frames, strict=True):
        assert frame.shape == (61, 65, 3) and psnr(np.ascontiguousarray(decoded[:61, :65]), frame) > 30


@pytest.mark.slow
def test_render_says_that_the_scene_is_another(told, tmp_path, capsys):
    shutil.copytree(SCENE, tmp_path / "other")
    options = ["-m", str(told), "--video", "orbit", "--frames", "2", "--video_output", str(tmp_path / "a.mp4")]
    for source, said in ((tmp_path / "other", True), (SCENE, False)):
        assert main(["render", "-s", str(source), *options]) == 0
        assert (f"the model was trained on {SCENE}" in capsys.readouterr().out) == said


def test_options_of_a_video(told, capsys):
    for options, sentence in (
        (["--orbit", "--video", "path"], "expected one of them"),
        (["--video_output", "a.mp4"], "expected --video or --orbit"),
        (["--video", "path", "--frames", "0"], "--frames: expected at least 1"),
        (["--frames", "3"], "--frames 3: expected --video"),
        (["--orbit", "--video_output", "a.AVI"], "expected .mp4 or a folder, found .avi"),
    ):
        assert main(["render", "-m", str(told), *options]) == 1
        assert sentence in capsys.readouterr().err


def test_numbers_of_every_view(told):
    """FLIP stands beside the others in all files; the table names the photographs."""
    results = json.loads((told / "results.json").read_text())["ours_20"]
    views = json.loads((told / "per_view.json").read_text())["ours_20"]
    assert set(views) == {*METRICS, "FLIP"}
    assert results["FLIP"] == pytest.approx(np.mean(list(views["FLIP"].values())))
    lines = (told / "per_view.md").read_text().splitlines()
    assert lines[0] == "7 test views after 20 iterations:" and "FLIP" in lines[2] and len(lines) == 4 + 7
    first = [cell.strip() for cell in lines[4].split("|")[1:-1]]
    assert first[0] == "view_000.png" and f"{views['PSNR']['00000.png']:.2f}" in first


def test_render_draws_the_sheet_of_training_again(told):
    assert load_png(told / "before.png").shape[1] == 1600
    assert (told / "contact_sheet.png").read_bytes() == (told / "before.png").read_bytes()


def test_configuration_that_was_written_trains_the_same_bytes(told, tmp_path, capsys):
    """Given back alone, it repeats the training; ``--quiet`` prints the summary and no more."""
    assert main(["train", "--config", str(told / "config.toml"), "-m", str(tmp_path), "--quiet"]) == 0
    assert ply_path(tmp_path, 20).read_bytes() == ply_path(told, 20).read_bytes()
    words = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert words == ["Model", "Done", "pictures", "views", "curves", "numbers"]
    quiet = (told / "config.toml").read_text().replace("quiet = false", "quiet = true")
    assert (tmp_path / "config.toml").read_text() == quiet


def test_event_files_hold_every_loss(told):
    """Records of TFRecord: length, a checksum of it, an event, a checksum of that."""
    event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2")
    (file,) = told.glob("events.out.tfevents.*")
    found, rest = {}, file.read_bytes()
    while rest:
        (length,) = struct.unpack_from("<Q", rest)
        event = event_pb2.Event.FromString(rest[12 : 12 + length])
        rest = rest[16 + length :]
        for value in event.summary.value:
            found.setdefault(value.tag, {})[event.step] = value.simple_value
    history = json.loads((told / "history.json").read_text())
    assert list(found["train/loss"]) == list(range(1, 21))
    assert found["train/loss"][1] == pytest.approx(history[0]["loss"])
    assert found["gaussians"] == {record["iteration"]: record["gaussians"] for record in history}
    results = json.loads((told / "results.json").read_text())["ours_20"]
    assert found["test/FLIP"][20] == pytest.approx(results["FLIP"])


def test_what_a_flag_needs_is_said_before_training(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    for options, sentence in (
        (["--tensorboard"], "pip install tensorboardX"),
        (["--lpips_weights", "none.pth"], "none.pth: no such file"),
    ):
        assert main(["train", "-s", str(SCENE), "-m", str(tmp_path / "m"), *SHORT, *options]) == 1
        assert sentence in capsys.readouterr().err and not (tmp_path / "m").exists()

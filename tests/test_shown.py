"""What is shown: sheets, curves, films and tables by themselves, and those of a training and a rendering."""

import json
import shutil
import struct
import sys
from functools import partial

import av
import numpy as np
import pycolmap
import pytest
from commands import SCENE, full_disk
from hostile import refusal
from splat_files import some_file

from warp_splat.cli import main
from warp_splat.errors import InputError
from warp_splat.evaluation import report
from warp_splat.evaluation.metrics import METRICS, psnr
from warp_splat.formats.checkpoint import LAST, save_checkpoint
from warp_splat.formats.model_folder import ply_path
from warp_splat.formats.ply import save_ply
from warp_splat.formats.png import load_png, save_png, save_video
from warp_splat.text import format_table, table_of
from warp_splat.training.tensorboard import EventLog


@pytest.fixture(scope="module", autouse=True)
def sharp():
    """Pictures as users see them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "DPI", 200)
        yield


def view(name="0001.jpg", height=60, width=80, gap=8):
    photo = np.zeros((height, width, 3), np.uint8)
    return name, photo, photo + np.uint8(gap), "30.00 dB"


def sheet_of(folder, sections, name="sheet.png", **options):
    report.contact_sheet(folder / name, sections, **options)
    return load_png(folder / name)


@pytest.mark.parametrize(("count", "columns"), [(1, 1), (3, 1), (5, 2), (7, 3), (2, 4)])
def test_contact_sheet_size(tmp_path, count, columns):
    sheet = sheet_of(tmp_path, {"": [view()] * count}, columns=columns)
    assert sheet.shape[1] == 1600
    lines = -(-count // columns)
    cell_height = 1600 / (3 * columns) * 60 / 80
    assert lines * cell_height < sheet.shape[0] < lines * (cell_height + 60) + 132  # two lines at its head


@pytest.mark.parametrize(("height", "width"), [(40, 1), (1, 40)])
def test_contact_sheet_of_strips_stays_small(tmp_path, height, width):
    """At the width of its cell, each would be 21,000 pixels high; a strip of 5,000 pixels took all memory."""
    assert sheet_of(tmp_path, {"": [view(height=height, width=width)] * 2}).shape[0] < 5000


def test_contact_sheet_shows_the_amplified_difference(tmp_path):
    name, photo, _, said = view()
    render = photo.copy()
    render[:, :40] = 255
    sheet = sheet_of(tmp_path, {"": [(name, photo, render, said)]}).astype(int)
    middle = sheet[sheet.shape[0] // 2]
    photo_at, render_left, render_right, difference_left, difference_right = middle[[250, 600, 950, 1150, 1450]]
    assert photo_at.sum() == 0 and render_left.sum() == 765 and render_right.sum() == 0
    assert difference_left.sum() > 500 and difference_right.sum() < 10


def test_scale_of_a_sheet_has_the_colors_of_its_errors(tmp_path):
    """The bar at the head runs from the color of no error to that of one of 64 or more, past that of 32."""
    photo = np.zeros((60, 90, 3), np.uint8)
    render = photo.copy()
    render[:, 30:60], render[:, 60:] = 32, 64
    rows = [("", photo, render, "")]
    sheet = sheet_of(tmp_path, {"a": rows, "b": rows}).astype(int)
    heading = sheet[15:40, 1000:]
    row, left, right = next(
        (line, columns[0], columns[-1])
        for line in heading
        if len(columns := np.flatnonzero(np.ptp(line, axis=1) > 60)) > 100
    )
    error = sheet[300, [1150, 1300, 1480]]
    assert np.abs(row[left - 20] - error[0]).max() < 8 and np.abs(row[right - 1] - error[2]).max() < 8
    halfway = np.abs(row[left:right] - error[1]).max(axis=1)
    assert 0.4 < np.argmin(halfway) / (right - left) < 0.6 and halfway.min() < 12
    assert sheet.shape[0] == sheet_of(tmp_path, {"a": rows * 2}).shape[0] + 52  # another heading


def test_contact_sheet_takes_mixed_sizes_strange_names_and_jpeg(tmp_path):
    """In names with dollars there is no mathematics."""
    rows = [view("a/very/long/folder/" * 5 + "0001.jpg"), view("$^$.png", 80, 60), view("$1_$2_.png", 1, 1)]
    assert sheet_of(tmp_path, {"$^$": rows}, "sheet.jpg", columns=2).shape[1] == 1600


@pytest.mark.parametrize(
    "history",
    [
        [{"iteration": 1, "loss": 0.3}],
        [{"iteration": 100 * index, "psnr": 20.0, "seconds": 0.1 * index} for index in range(1, 9)],
        [{"iteration": 500 * index, "psnr": 20.0 + index} for index in range(1, 4)],
        [{"iteration": index, "loss": 1 / index, "gaussians": 10**5 * index} for index in range(1, 200)],
        [{"iteration": 100, "loss": 0.2, "psnr": 20.0, "gaussians": 1000}, {"iteration": 200, "loss": 0.1}],
    ],
)
def test_plot_training_draws_what_was_recorded(tmp_path, history):
    pictures = []
    for split in ("test", "train"):
        report.plot_training(tmp_path / f"{split}.png", history, split)
        pictures.append(load_png(tmp_path / f"{split}.png"))
    assert pictures[0].shape == pictures[1].shape == (500, 1600, 3)
    assert (pictures[0] != pictures[1]).any() == any("psnr" in record for record in history)  # which it names


def test_plot_profile(tmp_path):
    report.plot_profile(tmp_path / "profile.png", {"project": 1.0, "blend": 20.0, "never ran": 0.0})
    assert load_png(tmp_path / "profile.png").shape[1] == 1600


def test_nothing_to_draw_is_said(tmp_path):
    nothing = {report.contact_sheet: {}, report.plot_training: [{"iteration": 1}], report.plot_profile: {}}
    for draw, given in nothing.items():
        refusal(partial(draw, tmp_path / "a.png", given), "expected")
    name, photo, render, said = view()
    wrong = {"": [(name, photo, render[1:], said)]}
    refusal(lambda: report.contact_sheet(tmp_path / "a.png", wrong), "expected a render of shape")
    assert not list(tmp_path.iterdir())


def test_running_mean_keeps_constants_and_slopes():
    np.testing.assert_allclose(report._smooth(np.full(100, 3.0)), 3.0)
    line = np.arange(400.0)
    np.testing.assert_allclose(report._smooth(line)[10:-10], line[10:-10])


def test_table_of_records():
    """A template or a function for each column; what is missing is a dash, also where several numbers are asked for."""
    records = [{"a": 1.25, "b": None}, {"a": float("nan")}, {"a": 2, "b": "x"}]
    table = table_of(records, {"one": "{a:.1f}", "both": "{a}, {b}", "keys": len})
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
    assert cells[2:] == [["1.2", "-", "2"], ["-", "-", "1"], ["2.0", "2, x", "2"]]


def test_format_table():
    table = format_table(["view", "PSNR", "note"], [["0012.jpg", 24.1, "a|b"], ["z", "-", ""]])
    assert table.splitlines() == [
        "| view     | PSNR | note |",
        "| -------- | ---: | ---- |",
        "| 0012.jpg | 24.1 | a\\|b |",
        "| z        |    - |      |",
    ]
    assert format_table(["a"], []).splitlines() == ["| a   |", "| --- |"]
    refusal(lambda: format_table(["a", "b"], [["only one"]]), "expected 2 cells")


@pytest.mark.parametrize(("height", "width"), [(48, 64), (47, 63), (1, 1)])
def test_video_plays_everywhere(tmp_path, height, width):
    colors = np.array([[200, 30, 30], [30, 200, 30], [30, 30, 200]], np.uint8)
    save_video(tmp_path / "a.mp4", (np.full((height, width, 3), color, np.uint8) for color in colors), fps=24)
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt, stream.average_rate) == ("h264", "yuv420p", 24)
        assert (stream.width, stream.height) == (width + width % 2, height + height % 2)
        frames = [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(stream)]
    assert len(frames) == 3
    for frame, color in zip(frames, colors, strict=True):
        assert np.abs(frame - color).max() <= 4
    data = (tmp_path / "a.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")


def test_video_errors_leave_no_file(tmp_path):
    frame = np.zeros((8, 8, 3), np.uint8)
    for frames, sentence in (([], "at least one"), ([frame, frame[:4]], "each, got"), ([frame[0]], "image: expected")):
        refusal(partial(save_video, tmp_path / "a.mp4", frames, fps=10), sentence)
    assert not list(tmp_path.iterdir())


def test_full_disk_keeps_the_older_files(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (128, 128, 3)).astype(np.uint8)
    writers = {
        "a.png": lambda path: save_png(path, noise),
        "b.png": lambda path: report.contact_sheet(path, {"": [("a", noise, noise, "")]}),
        "c.mp4": lambda path: save_video(path, [noise] * 3, fps=10),
        "d.ply": lambda path: save_ply(path, some_file()),
        "e.safetensors": lambda path: save_checkpoint(path, {"a": noise}, {"count": 2}),
    }
    for name, write in writers.items():
        (tmp_path / name).write_text("older")
        with full_disk(2000), pytest.raises(InputError, match=f"{name}: could not be written .* is untouched"):
            write(tmp_path / name)
        assert (tmp_path / name).read_text() == "older"
    assert len(list(tmp_path.iterdir())) == len(writers)


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
def test_video(told, ran, video, opposite):
    """Of an even size, and it moves; twelve frames, as asked for."""
    said = ran("render", "-m", told, "--video", video, "--frames", 12, "--quiet")
    assert said.strip() == f"frames in {told / video}.mp4"
    film = decode(told / f"{video}.mp4")
    assert len(film) == 12 and film[0].shape == (62, 66, 3) and film[0].std() > 5
    assert psnr(film[0], film[opposite]) < 25


@pytest.mark.slow
def test_frames_of_a_video(told, tmp_path, ran):
    """A folder gets the frames that the film shows, as H.264 keeps them; the first is the first photograph's."""
    words = "render", "-m", told, "--video", "path", "--frames"
    for output in (tmp_path / "frames", tmp_path / "film.mp4"):
        ran(*words, 11, "--orbit_output", output, "--quiet")
    frames = [load_png(path) for path in sorted((tmp_path / "frames").iterdir())]
    assert "2 older frames are in" in ran(*words, 9, "--video_output", tmp_path / "frames")
    assert psnr(frames[0], load_png(told / "train" / "ours_20" / "renders" / "00000.png")) > 60
    for decoded, frame in zip(decode(tmp_path / "film.mp4"), frames, strict=True):
        assert frame.shape == (61, 65, 3) and psnr(np.ascontiguousarray(decoded[:61, :65]), frame) > 30


@pytest.mark.slow
def test_render_says_that_the_scene_is_another(told, tmp_path, ran):
    shutil.copytree(SCENE, tmp_path / "other")
    words = "render", "-m", told, "--video", "orbit", "--frames", 2, "--video_output", tmp_path / "a.mp4", "-s"
    for source, said in ((tmp_path / "other", True), (SCENE, False)):
        assert (f"the model was trained on {SCENE}" in ran(*words, source)) == said


@pytest.mark.slow
def test_photographs_that_were_trained_on_test_nothing(told, tmp_path, fails, ran):
    """One photograph less, and every eighth is another; what was measured stays."""
    scene, before = shutil.copytree(SCENE, tmp_path / "scene"), (told / "results.json").read_bytes()
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    model.deregister_frame(model.find_image_with_name("view_000.png").frame_id)
    model.write(scene / "sparse" / "0")
    words = "render", "-m", told, "-s", scene, "--quiet"
    assert "found 7 that were trained on, such as view_001.png; name the scene of then" in fails(*words)
    said = ran("simplify", told, "-s", scene, "--keep", 0.5, "-o", tmp_path / "a.ply")
    assert "7 photographs that are held out now, such as view_001.png, were trained on" in said
    said = ran("train", "-s", scene, "-m", tmp_path / "new", "--start_ply", told, *SHORT, "--iterations", 1)
    assert f"Warning: {told} was trained on 7 of 7 images that are held out." in said
    for more in (["--skip_test"], ["--video", "orbit", "--frames", 2, "--video_output", tmp_path / "a.mp4"]):
        ran(*words, *more)
    assert (told / "results.json").read_bytes() == before


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


def test_configuration_that_was_written_trains_the_same_bytes(told, tmp_path, ran):
    """Given back alone, it repeats the training; ``--quiet`` prints the summary and no more."""
    said = ran("train", "--config", told / "config.toml", "-m", tmp_path, "--quiet")
    assert ply_path(tmp_path, 20).read_bytes() == ply_path(told, 20).read_bytes()
    words = [line.split()[0] for line in said.splitlines()]
    assert words == ["Model", "Done", "pictures", "views", "curves", "numbers"]
    quiet = (told / "config.toml").read_text().replace("quiet = false", "quiet = true")
    assert (tmp_path / "config.toml").read_text() == quiet


def curves(folder):
    """Curves as TensorBoard shows them: where a session starts, what others logged from that step on is purged.

    A file holds records of TFRecord: length, a checksum of it, an event, a checksum of that.
    """
    event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2")
    found = {}
    for file in sorted(folder.glob("events.out.tfevents.*")):
        rest = file.read_bytes()
        while rest:
            (length,) = struct.unpack_from("<Q", rest)
            event = event_pb2.Event.FromString(rest[12 : 12 + length])
            rest = rest[16 + length :]
            if event.session_log.status == event_pb2.SessionLog.START:
                found = {tag: [at for at in curve if at[0] < event.step] for tag, curve in found.items()}
            for value in event.summary.value:
                found.setdefault(value.tag, []).append((event.step, value.simple_value))
    return found


def test_event_files_hold_every_loss(told):
    found = curves(told)
    history = json.loads((told / "history.json").read_text())
    steps, losses = zip(*found["train/loss"], strict=True)
    assert steps == tuple(range(1, 21))
    assert np.mean(losses) == pytest.approx(np.mean([record["loss"] for record in history]))
    assert found["gaussians"] == [(record["iteration"], record["gaussians"]) for record in history]
    results = json.loads((told / "results.json").read_text())["ours_20"]
    assert dict(found["test/FLIP"])[20] == pytest.approx(results["FLIP"])


@pytest.mark.slow
def test_curves_go_on_from_a_checkpoint(told, tmp_path):
    """Losses that were not yet written with it are written again, in place of what the stopped run wrote later."""
    folder = tmp_path / "model"
    options = ["--tensorboard", "--quiet", "--checkpoint_iterations", "7", "--test_iterations", "20"]
    assert main(["train", "-s", str(SCENE), "-m", str(folder), *SHORT, *options]) == 0
    (file,) = folder.glob("events.out.tfevents.*")
    file.rename(file.with_name("events.out.tfevents.0"))  # files of one second bear one name
    ply_path(folder, 20).unlink()  # as if killed before the end
    (folder / "chkpnt7.safetensors").rename(folder / LAST)
    assert main(["train", "--resume", str(folder)]) == 0
    assert curves(folder)["train/loss"] == curves(told)["train/loss"]


def test_curves_end_where_the_disk_is_full(tmp_path, capsys):
    """And do not keep the training waiting for a thread that has died."""
    pytest.importorskip("tensorboardX")
    log = EventLog(tmp_path)
    with full_disk(2000):
        for _ in range(9):
            log.write((step, "train/loss", 0.5) for step in range(99))
    assert capsys.readouterr().err == "warning: --tensorboard: no more curves are written (File too large).\n"
    (file,) = tmp_path.iterdir()
    assert file.stat().st_size == 2000


@pytest.mark.parametrize(
    ("options", "sentence"),
    [("--tensorboard", "pip install tensorboardX"), ("--lpips_weights none.pth", "none.pth: no such file")],
)
def test_what_a_flag_needs_is_said_before_training(tmp_path, monkeypatch, fails, options, sentence):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    assert sentence in fails("train", "-s", SCENE, "-m", tmp_path / "m", *SHORT, *options.split())
    assert not (tmp_path / "m").exists()

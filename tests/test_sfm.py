"""Photographs and videos to scenes, against the cameras that took them."""

import ctypes
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from types import SimpleNamespace

import av
import numpy as np
import pycolmap
import pytest
import room
from commands import python, started
from hostile import refusal
from scene_files import texture, write_blender, write_image
from scipy.ndimage import gaussian_filter

from warp_splat.cli import main
from warp_splat.config import SfmConfig
from warp_splat.formats.png import save_video
from warp_splat.scene import load_scene
from warp_splat.scene.images import read_pixels
from warp_splat.sfm import matching, stages
from warp_splat.sfm.command import _claim, scene_for, sfm
from warp_splat.sfm.video import sample_frames

COUNT = 6
FILES = ["cameras.bin", "images.bin", "points3D.bin"]


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """A folder of photographs, and the centers of their cameras."""
    folder = tmp_path_factory.mktemp("room") / "photos"
    return folder, room.write_photos(folder, COUNT)


@pytest.fixture(scope="module")
def scene(photos):
    folder = photos[0].parent / "scene"
    assert main(["sfm", str(photos[0]), str(folder), "--quiet"]) == 0
    return folder


def model_bytes(scene):
    return [(scene / "sparse" / "0" / name).read_bytes() for name in FILES]


def start(photos, scene):
    """What shells start in the background ignores SIGINT, and passes that on; a handler is not passed on."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return started("-u", "-m", "warp_splat", "sfm", photos, scene, stderr=subprocess.STDOUT)
    finally:
        signal.signal(signal.SIGINT, before)


def test_the_cameras_are_found(photos, scene):
    loaded, truth = load_scene(scene, report=pytest.fail), photos[1]
    views = loaded.train
    assert {view.name for view in views} == set(truth)
    found = np.array([view.camera.center for view in views])
    expected = np.array([truth[view.name] for view in views])
    fitted = pycolmap.estimate_sim3d(found, expected)
    errors = np.linalg.norm([fitted * one - other for one, other in zip(found, expected, strict=True)])
    assert errors.max() < 0.01  # the camera goes along 2 units
    for view in views:
        assert abs(view.camera.fx / room.FOCAL - 1) < 0.01 and abs(view.camera.fy / room.FOCAL - 1) < 0.01
    seen = [(view.camera, loaded.tracks[view.name].points) for view in views]
    depths = [points @ camera.rotation[2] + camera.translation[2] for camera, points in seen]
    assert np.median(np.concatenate(depths)) == pytest.approx(5.0, rel=0.01)  # whatever the mapper's scale was


def test_features_are_compared_without_blas(scene, monkeypatch):
    """pycolmap's has no locks, and gives two threads the same memory now and then; else it takes one thread."""
    library = ctypes.CDLL(sys.modules["pycolmap._core"].__file__)
    assert ctypes.c_int.in_dll(library, "_ZN5faiss31distance_compute_blas_thresholdE").value == 2**31 - 1
    assert matching.avoid_blas()
    monkeypatch.setattr(matching, "FAISS_THRESHOLD", "no_such_name")
    assert not matching.avoid_blas()


def test_a_lens_is_each_groups_own_where_a_run_goes_on(photos, tmp_path):
    """Of a run that was killed between photographs of one lens; those of the next get another."""
    names = sorted(path.name for path in photos[0].iterdir())
    config = SfmConfig(str(photos[0]), str(tmp_path), quiet=True)
    for groups in ([names[:1]], [names[:2], names[2:4]]):
        stages.extract(tmp_path / "database.db", photos[0], groups, config)
    with pycolmap.Database.open(tmp_path / "database.db") as connection:
        lenses = [connection.read_image_with_name(name).camera_id for name in names[:4]]
    assert lenses[0] == lenses[1] != lenses[2] == lenses[3]


@pytest.mark.parametrize("why", ["asked", "alpha", "light"])
def test_photographs_keep_their_lens(photos, scene, tmp_path, capsys, why):
    """If that is asked, or undistortion would take something of them; then training undistorts them."""
    root, linear = tmp_path / "photos", [("oiio:ColorSpace", "lin_rec709")] * (why == "light")
    for path in photos[0].iterdir():
        pixels = read_pixels(path, 0.0).color
        pixels = np.dstack([pixels, pixels[..., :1] > 0.5]) if why == "alpha" else pixels
        write_image(root / path.name, (65535 * pixels**1.5).astype(np.uint16), linear)
    write_image(tmp_path / "opaque.png", texture(channels=4) | np.uint8(255))
    assert not stages._is_more_than_bytes(tmp_path / "opaque.png")
    config = SfmConfig(str(root), str(tmp_path), keep_lens=why == "asked")
    stages.write_scene(scene / "sfm" / "models" / "0", root, tmp_path, tmp_path / "part", COUNT, config)
    assert ("photo_0.png, photo_1.png" in capsys.readouterr().out) == (why != "asked")
    lines, loaded = [], load_scene(tmp_path)
    assert (loaded.linear, loaded.train[0].alpha is not None) == (why == "light", why == "alpha")
    assert loaded.train[0].camera.lens is None and (len(np.unique(loaded.train[0].image)) > 256) == (why == "light")
    views = load_scene(tmp_path, lens="native", report=lines.append).train
    assert len(views) == COUNT and all(view.camera.lens for view in views) and "Keeping" in lines[-1]
    for view in views:
        assert (tmp_path / "images" / view.name).read_bytes() == (root / view.name).read_bytes()


def test_the_scene_is_said_to_be_complete(photos, scene, tmp_path, capsys):
    before = {path: path.stat().st_mtime_ns for path in (scene / "sparse").rglob("*")}
    assert sfm(SfmConfig(str(photos[0]), str(scene))) == 0
    text = capsys.readouterr().out
    summary = json.loads((scene / "sfm" / "summary.json").read_text())
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    assert "complete already" in text and f"{COUNT} of {COUNT} photographs registered" in text
    assert summary["registered"] == model.num_reg_images() == COUNT
    assert summary["points"] == model.num_points3D() > 100
    assert 0 < summary["reprojection_error_px"] < 1
    assert {path: path.stat().st_mtime_ns for path in (scene / "sparse").rglob("*")} == before
    assert sorted(path.name for path in scene.iterdir()) == ["images", "sfm", "sparse"]
    places = tmp_path / "places.csv"
    places.write_text("name,x,y,z\na.jpg,1,2,3\n")
    words = ("--coordinates", "has those of none", "sparse/")
    again = SfmConfig(str(photos[0]), str(scene), coordinates=os.path.relpath(places))
    refusal(lambda: sfm(again), *words)
    older = {name: value for name, value in summary.items() if name != "coordinates"}
    for told in (older, {**summary, "coordinates": str(places)}):
        (scene / "sfm" / "summary.json").write_text(json.dumps(told))
        assert sfm(again) == 0
    (scene / "sfm" / "summary.json").write_text(json.dumps(summary))
    assert sfm(SfmConfig(str(photos[0]), str(scene), coordinates="none")) == 0  # there are none
    kept = shutil.move(scene / "sfm" / "summary.json", tmp_path)  # as if the run had been killed right before
    assert sfm(SfmConfig(str(photos[0]), str(scene))) == 0
    shutil.move(kept, scene / "sfm" / "summary.json")


@pytest.mark.parametrize(
    ("number", "times"),
    [
        pytest.param(signal.SIGINT, 2, marks=pytest.mark.slow),
        *(pytest.param(number, 6, marks=pytest.mark.long) for number in (signal.SIGINT, signal.SIGKILL)),
    ],
)
def test_a_stopped_run_goes_on_and_finds_the_same(photos, scene, tmp_path, number, times):
    stopped = 0
    for delay in np.linspace(0.0, 4.0, times):
        run = start(photos[0], tmp_path / "scene")
        first = run.stdout.readline()  # it has begun
        time.sleep(delay)
        run.send_signal(number)
        text = first + run.communicate()[0]
        stopped += run.returncode != 0
        assert run.returncode in (0, 130, -number), text
        assert "Traceback" not in text
        assert not (tmp_path / "scene" / "sparse").exists() or run.returncode in (0, -number)
    assert stopped
    assert main(["sfm", str(photos[0]), str(tmp_path / "scene"), "--quiet"]) == 0
    assert model_bytes(tmp_path / "scene") == model_bytes(scene)


def test_ctrl_c_inside_pycolmap_stays_one(scene, tmp_path):
    """Python that runs inside it may be interrupted; pycolmap takes whatever that raises for a wrong argument."""

    class Interrupted(type(tmp_path)):
        def __fspath__(self):
            raise KeyboardInterrupt

    database = shutil.copy(scene / "sfm" / "database.db", tmp_path)
    with pytest.raises(TypeError):
        pycolmap.Database.open(Interrupted(database))
    stages.rename(Interrupted(database), stages.HIDING)
    assert matching.fitting(Interrupted(database)) == matching.fitting(database)


def test_ctrl_c_while_pycolmap_loads_stays_one(tmp_path):
    """There it becomes an ImportError of C++, of which pycolmap makes its own advice."""
    (tmp_path / "pycolmap.py").write_text(
        "import os, signal\n"
        "try:\n    os.kill(os.getpid(), signal.SIGINT)\n"
        "except KeyboardInterrupt as error:\n    raise RuntimeError('install it') from error\n"
    )
    heard = "import signal, sys; signal.signal(2, signal.default_int_handler); "  # in the background, too
    program = f"{heard}sys.path.insert(0, {str(tmp_path)!r}); import warp_splat.scene.colmap_library"
    assert python("-c", program, check=False).stderr.strip().endswith("KeyboardInterrupt")


def test_ctrl_c_ends_a_trial_at_once_and_leaves_nothing(tmp_path):
    (tmp_path / "trial").mkdir()
    done = python("-c", TRIAL.format(str(tmp_path / "trial")), check=False)
    assert done.returncode == 130 and not list(tmp_path.iterdir()), done.stderr


TRIAL = """
import os, signal, threading, time
from warp_splat.sfm.stages import run_watched
threading.Timer(1, os.kill, (os.getpid(), signal.SIGINT)).start()
run_watched({!r}, "", 1, lambda: time.sleep(300), int, True, stops=False)
"""


@pytest.mark.parametrize("free", [[], [stages.ROOM, stages.ROOM]], ids=["before", "meanwhile"])
def test_a_full_disk_ends_a_stage_with_a_sentence(tmp_path, monkeypatch, free):
    """Before pycolmap, whose thread would abort, finds it so."""
    begun = []

    def work(cancellation_token):
        begun.append(True)
        while not cancellation_token.is_cancelled:
            time.sleep(0.01)

    told = iter([*free, 0])
    rest = [stages.ROOM]  # what was removed meanwhile does not make the stage whole
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=next(told, *rest)))
    refusal(lambda: stages.run_watched(tmp_path, "", 1, work, int, quiet=True), str(tmp_path), "64 MiB")
    assert bool(begun) == bool(free)


@pytest.mark.slow
def test_photographs_that_cannot_be_read_are_left_out(photos, tmp_path, capsys):
    folder = tmp_path / "photos"
    for index, name in enumerate(photos[1]):
        data = (photos[0] / name).read_bytes()
        (folder / "a b").mkdir(parents=True, exist_ok=True)
        (folder / "a b" / name).write_bytes(data[: len(data) // 2] if index == 0 else data)
    (folder / "notes.txt").write_text("not a photograph")
    assert sfm(SfmConfig(str(folder), str(tmp_path / "scene"))) == 0
    text = capsys.readouterr().out
    assert "leaving out" in text and "unreadable: a b/photo_0.png" in text
    assert len(load_scene(tmp_path / "scene", report=print).train) == COUNT - 1


def flat_photos(folder, count=4, keep=None):
    """Photographs of one color each, or of each file its first bytes."""
    for index in range(count):
        path = folder / f"{index}.png"
        write_image(path, np.full((64, 64, 3), 40 * index, np.uint8))
        path.write_bytes(path.read_bytes()[:keep])


def holding(*names):
    """Makes a folder of files that are no photographs."""

    def make(folder):
        folder.mkdir()
        for name in names:
            (folder / name).write_bytes(b"x")

    return make


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda folder: None, ["found nothing"]),
        (lambda folder: folder.write_text("x"), ["expected a folder of photographs or a video"]),
        (holding(), ["found none", "check the path"]),
        (holding("IMG_1.HEIC"), ["IMG_1.HEIC", "convert"]),
        (holding("a.mp4"), ["name the video itself", "a.mp4"]),
        (lambda folder: flat_photos(folder, 2), ["at least 3 readable photographs", "found 2"]),
        (lambda folder: flat_photos(folder, keep=60), ["at least 3 readable photographs", "found 0"]),
        (flat_photos, ["0 of 4 photographs could be registered", "overlap"]),
    ],
    ids=["missing", "a file", "empty", "heic", "video inside", "two", "broken", "without texture"],
)
def test_bad_photographs_get_one_sentence(tmp_path, make, words):
    make(tmp_path / "photos")
    refusal(lambda: sfm(SfmConfig(str(tmp_path / "photos"), str(tmp_path / "scene"), quiet=True)), "photos", *words)
    assert (tmp_path / "scene").exists() == (make is flat_photos)  # of which there are features


def test_a_folder_in_use_stays_as_it_is(photos, scene, tmp_path):
    other = write_blender(tmp_path / "other")
    before = sorted(other.rglob("*"))
    refusal(lambda: sfm(SfmConfig(str(photos[0]), str(other))), "other", "in use")
    assert sorted(other.rglob("*")) == before
    refusal(lambda: sfm(SfmConfig(str(photos[0]), str(photos[0]))), "another folder")
    refusal(lambda: sfm(SfmConfig(str(photos[0]), str(scene), seed=1)), "begun with others")
    flat_photos(tmp_path / "a" / "images")
    for source, target in (("a/images", "a"), ("a", "a/images")):
        words = "does not hold the photographs", "written over", f"{tmp_path / target}_scene"
        config = SfmConfig(str(tmp_path / source), str(tmp_path / target))
        refusal(partial(sfm, config), *words)


def test_photographs_of_one_size_that_were_exchanged_are_others(tmp_path):
    """Uncompressed ones; a folder of before, which has no marks, goes by sizes."""
    config, files = SfmConfig(str(tmp_path / "a"), str(tmp_path / "b")), [tmp_path / "a" / f"{k}.tif" for k in (0, 1)]
    for file, image in zip(files, (texture(), 255 - texture()), strict=True):
        write_image(file, image)
    assert len({file.stat().st_size for file in files}) == 1
    work = _claim(tmp_path / "a", tmp_path / "b", config)
    assert _claim(tmp_path / "a", tmp_path / "b", config) == work
    files[0].rename(tmp_path / "c"), files[1].rename(files[0]), (tmp_path / "c").rename(files[1])
    refusal(lambda: _claim(tmp_path / "a", tmp_path / "b", config), "begun with others")
    (work / "marks.json").unlink()
    assert _claim(tmp_path / "a", tmp_path / "b", config) == work
    for missing in (["input.json"], ["input.json", "marks.json"]):  # of a run that was killed while it began
        for name in missing:
            (work / name).unlink()
        (work / ".tmp-1.json").touch()
        assert _claim(tmp_path / "a", tmp_path / "b", config) == work and (work / "marks.json").is_file()


def test_a_damaged_database_gets_one_sentence(photos, scene, tmp_path):
    shutil.copytree(scene / "sfm", tmp_path / "scene" / "sfm")
    (tmp_path / "scene" / "sfm" / "database.db").write_bytes(b"SQLite format 3\0" + bytes(5000))
    refusal(lambda: sfm(SfmConfig(str(photos[0]), str(tmp_path / "scene"), quiet=True)), "sfm", "remove this folder")


def test_training_on_photographs_alone_names_the_command(tmp_path, monkeypatch):
    folder, clip = tmp_path / "my photos", tmp_path / "clip.mp4"
    flat_photos(folder, 4)
    refusal(lambda: load_scene(folder), "4 photographs alone", "--sfm", f"`warp-splat sfm '{folder}' '{folder}_scene'`")
    monkeypatch.chdir(folder)
    refusal(lambda: load_scene("."), f"`warp-splat sfm . '{folder}_scene'`")
    clip.write_bytes(b"x")
    refusal(lambda: load_scene(clip), "a video", f"sfm {clip} {tmp_path / 'clip_scene'}")


@pytest.mark.slow
def test_training_with_sfm_makes_the_scene_once(photos, capsys):
    source, made = str(photos[0]), f"{photos[0]}_scene"
    assert scene_for(source, 1, quiet=True) == made and len(load_scene(made).train) == COUNT
    assert scene_for(made, 1) == made
    refusal(lambda: scene_for(source, 2), "one process", "warp-splat sfm")


def test_the_sharpest_frame_of_each_span_is_taken(tmp_path):
    """12 frames of 6 spans: of each pair one is blurred."""
    textures = room.walls()
    frames = [room.photo(index / 11, textures) for index in range(12)]
    sharp = [0, 3, 4, 6, 9, 11]
    mixed = [frame if index in sharp else gaussian_filter(frame, (2, 2, 0)) for index, frame in enumerate(frames)]
    save_video(tmp_path / "clip.mp4", mixed, 25)
    (tmp_path / "frames").mkdir()
    shares = []
    config = SfmConfig("", "", frames=6, threads=2)
    written = sample_frames(tmp_path / "clip.mp4", tmp_path / "frames", config, pytest.fail, shares.append)
    taken = sorted(int(re.search(r"\d+", path.name)[0]) for path in (tmp_path / "frames").iterdir())
    assert written == 6 and taken == sharp and shares == sorted(shares)


@pytest.mark.parametrize(("keep", "said"), [(1.0, ""), (0.5, "pictures end after")])
def test_a_video_that_is_cut_off_is_told(tmp_path, keep, said):
    """Of Matroska the rest is a video, a shorter one."""
    with av.open(str(tmp_path / "clip.mkv"), "w") as container:
        stream = container.add_stream("mpeg4", rate=25, width=64, height=64)
        for frame in np.random.default_rng(0).integers(0, 256, (40, 64, 64, 3), np.uint8):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    data, told = (tmp_path / "clip.mkv").read_bytes(), []
    (tmp_path / "clip.mkv").write_bytes(data[: int(keep * len(data))])
    config = SfmConfig("", "", frames=2, threads=1)
    sample_frames(tmp_path / "clip.mkv", tmp_path, config, told.append, lambda share: None)
    assert said in "".join(told) and len(told) == bool(said)


@pytest.mark.slow
def test_a_video_becomes_a_scene(tmp_path, capsys):
    textures = room.walls()
    save_video(tmp_path / "clip.mp4", [room.photo(index / 11, textures) for index in range(12)], 25)
    assert sfm(SfmConfig(str(tmp_path / "clip.mp4"), str(tmp_path / "scene"), frames=COUNT)) == 0
    assert "6 sharp frames" in capsys.readouterr().out
    assert len(load_scene(tmp_path / "scene", report=print).train) == COUNT


@pytest.mark.parametrize(("keep", "words"), [(0, ["FFmpeg"]), (0.2, ["clip.mp4"])])
def test_a_video_that_cannot_be_decoded_gets_one_sentence(tmp_path, keep, words):
    save_video(tmp_path / "clip.mp4", [texture(64, 64)] * 12, 25)
    data = (tmp_path / "clip.mp4").read_bytes()
    (tmp_path / "clip.mp4").write_bytes(data[: int(len(data) * keep)] or b"nothing of a video")
    config = SfmConfig(str(tmp_path / "clip.mp4"), str(tmp_path / "scene"), quiet=True)
    refusal(lambda: sfm(config), *words)


def test_png_files_can_be_written_after_pycolmap_was_loaded(tmp_path):
    """The libraries in pycolmap's wheel clash with those in OpenImageIO's if they are loaded first."""
    code = "import sys, warp_splat.scene.colmap_library, numpy, OpenImageIO as oiio; picture = numpy.zeros((8, 8, 3)); "
    python("-c", code + "assert oiio.ImageBuf(picture).write(sys.argv[1], 'uint8')", tmp_path / "a.png")


@pytest.mark.skipif(sys.platform == "win32", reason="no such signals")
def test_kill_prints_no_stack_of_a_library():
    words = "import os, signal, warp_splat.scene.colmap_library; os.kill(os.getpid(), signal.SIGTERM)"
    done = python("-c", words, check=False)
    assert done.returncode == -signal.SIGTERM and done.stderr == ""

"""Whole runs from the command line, on the embedded scene made small: what they write, repeat, and survive."""

import importlib
import json
import re
import signal
import sys
import time

import numpy as np
import pytest
import torch
from commands import FOX, PATIENCE, SCENE, SHORT, no_space, python, started, train
from splat_files import some_file

from warp_splat.cli import main
from warp_splat.config import CORES
from warp_splat.evaluation.metrics import psnr
from warp_splat.formats.checkpoint import load_checkpoint
from warp_splat.formats.exchange import load_gaussians, save_gaussians
from warp_splat.formats.model_folder import ply_path, read_cfg_args
from warp_splat.formats.ply import load_ply, save_ply_parts
from warp_splat.formats.png import load_png
from warp_splat.gaussians import GaussianModel
from warp_splat.raster.drivers import CPU
from warp_splat.training.loss import image_loss
from warp_splat.training.optimizer import Optimizer


def learns(folder):
    """Whether PSNR rose before the opacities were reset, and again after."""
    quality = {record["iteration"]: record["psnr"] for record in json.loads((folder / "history.json").read_text())}
    return quality[9] > quality[3] + 0.2 and quality[60] > quality[33] + 0.5


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("model")
    assert train(folder, *"--test_iterations 3 9 30 33".split(), "--save_iterations", "40", "--profile", "20") == 0
    return folder


def test_output_folder(trained):
    for name in ("cfg_args", "cameras.json", "input.ply", "results.json", "per_view.json", "contact_sheet.png"):
        assert (trained / name).is_file()
    for name in ("training.png", "profile.png", "preview.png"):
        assert load_png(trained / name).std() > 1
    assert ply_path(trained, 40).is_file() and ply_path(trained, 60).is_file()
    assert len(load_ply(ply_path(trained, 60)).splats.means) > 4500 and learns(trained)
    entry = json.loads((trained / "results.json").read_text())["ours_60"]
    assert entry["iterations"] == 60 and entry["split"] == "test" and entry["seconds"] > 0
    assert entry["dropped"] == {"pixels": 0, "gradients": 0, "gaussians": 0, "prunings": 0}
    assert read_cfg_args(trained)["sh_degree"] == 3


def test_render_repeats_the_pictures_of_training(trained, ran):
    before = {path.name: path.read_bytes() for path in (trained / "test" / "ours_60" / "renders").iterdir()}
    ran("render", "-m", trained, "--quiet")
    after = {path.name: path.read_bytes() for path in (trained / "test" / "ours_60" / "renders").iterdir()}
    assert after == before
    assert len(list((trained / "train" / "ours_60" / "gt").iterdir())) == 43
    ran("render", "-m", trained, "--iteration", 40, "--skip_train", "--quiet")
    assert json.loads((trained / "results.json").read_text())["ours_60"]["seconds"] > 0  # what training said stays
    assert set(json.loads((trained / "results.json").read_text())) == {"ours_40", "ours_60"}
    said = ran("render", "-m", trained, "--skip_train", "--skip_test", "--quiet")
    assert said == "Nothing to draw: 43 images to train on, 7 held out.\n"


@pytest.mark.slow
def test_render_of_converted_files(trained, tmp_path, ran):
    """Held-out views of files in other formats against those of the PLY file: a file needs no model folder."""
    pictures = {}
    for ending, decibels in ((".ply", 90), (".glb", 75), (".spz", 45)):
        file = tmp_path / f"a{ending}"
        ran("convert", ply_path(trained, 60), file)
        ran("render", "-m", file, "-s", SCENE, "--skip_train", "--quiet")
        folder = tmp_path / f"a{ending}.renders"
        assert json.loads((folder / "results.json").read_text())["ours_0"]["split"] == "test"
        pictures[ending] = [load_png(path) for path in sorted((folder / "test" / "ours_0" / "renders").iterdir())]
        assert len(pictures[ending]) == 7
        for ours, reference in zip(pictures[ending], pictures[".ply"], strict=True):
            assert reference.std() > 5 and psnr(ours, reference) > decibels


@pytest.mark.slow
def test_orbit(trained, tmp_path, ran):
    options = ("--orbit", "--orbit_center", "focus", "--orbit_output", tmp_path / "orbit", "--quiet")
    assert "frames per second" in ran("render", "-m", trained, *options)
    frames = sorted((tmp_path / "orbit").iterdir())
    first, half = load_png(frames[0]), load_png(frames[50])
    assert len(frames) == 100 and first.shape == (545, 980, 3) and first.std() > 5 and (first != half).mean() > 0.3


def test_one_seed_one_result_for_any_number_of_threads(trained, tmp_path):
    """Byte-identical PLY files: a second run, in a fresh process, with another number of threads."""
    digest = json.loads((trained / "results.json").read_text())["ours_60"]["sha256"]
    options = ("--threads", 1 + CORES % 2, "--verify", digest[:16])
    python("train.py", "-s", SCENE, "-m", tmp_path, *SHORT, *options)
    assert ply_path(tmp_path, 60).read_bytes() == ply_path(trained, 60).read_bytes()


@pytest.mark.slow
@pytest.mark.usefixtures("laid_out")
def test_another_seed_is_another_result(trained, tmp_path, capsys):
    digest = json.loads((trained / "results.json").read_text())["ours_60"]["sha256"]
    assert train(tmp_path, "--seed", "1", "--verify", digest) == 1
    assert f"begins with {digest}, got " in capsys.readouterr().err
    assert ply_path(tmp_path, 60).read_bytes() != ply_path(trained, 60).read_bytes()


@pytest.mark.parametrize(
    "options",
    [
        ("--optimizer_type", "sparse_adam"),
        pytest.param(("--antialiasing", "--sh_degree", "1"), marks=pytest.mark.slow),
        pytest.param(("--max_gaussians", "5000"), marks=pytest.mark.slow),
        pytest.param(("--random_background",), marks=pytest.mark.slow),
        pytest.param(("--white_background", "--sh_degree", "0"), marks=pytest.mark.slow),
        pytest.param(("--prune_screen_size", "20"), marks=pytest.mark.slow),
        pytest.param(("--no-eval", "--lambda_dssim", "0"), marks=pytest.mark.slow),
    ],
    ids=" ".join,
)
def test_options(options, tmp_path):
    assert train(tmp_path, *options) == 0
    results = json.loads((tmp_path / "results.json").read_text())["ours_60"]
    assert learns(tmp_path)
    assert results["gaussians"] <= 5000 or options[0] != "--max_gaussians"


@pytest.mark.slow
def test_ctrl_c_saves_the_model_and_says_how_to_continue(tmp_path, capsys):
    steps = ["--iterations", "100000", "--test_iterations", "9"]
    process, end = started("train.py", "-s", SCENE, "-r", "8", "--eval", "-m", tmp_path, *steps), time.time() + PATIENCE
    while not (tmp_path / "preview.png").exists() and process.poll() is None and time.time() < end:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert "Interrupted after" in out and "Traceback" not in err
    (saved,) = (tmp_path / "point_cloud").glob("*/point_cloud.ply")
    assert str(saved) in out and len(load_ply(saved).splats.means) >= 4500
    reached, continued = re.search(r"^To continue after iteration (\d+): (.*)$", out, re.MULTILINE).groups()
    assert continued == f"{sys.executable} train.py --resume {tmp_path}"
    assert main(["train", *continued.split()[2:], "--iterations", f"{int(reached) + 5}"]) == 0
    assert f"Done after {int(reached) + 5} iterations" in capsys.readouterr().out


def test_the_end_of_a_settled_training_is_written_again(tmp_path):
    """Also where that is in the middle of its last step."""
    assert train(tmp_path, "--views", "4", "--settle_from_iter", "9", "--cooldown", "5", "-r", "8") == 0
    assert ply_path(tmp_path, 16).exists() and main(["train", "--resume", str(tmp_path)]) == 0


def test_resume_without_the_points_that_were_near_cameras(scene, tmp_path):
    """They made the extent smaller, which the checkpoint knows."""
    centers = np.stack([view.camera.center + 0.3 * view.camera.forward for view in scene.train])
    means = np.repeat(centers, 60, 0).astype(np.float32)
    start, folder = tmp_path / "start.ply", tmp_path / "model"
    GaussianModel.from_points(means, np.zeros(means.shape, np.uint8), 0).save(start)
    options = "-r", "8", "--iterations", "2", "--start_ply", str(start)
    assert train(folder, *options) == 0
    assert load_checkpoint(folder).facts["extent"] < scene.extent
    start.unlink()
    assert main(["train", "--resume", str(folder), "--iterations", "4", "--quiet"]) == 0


def test_first_step_loads_only_what_it_needs():
    code = (
        "import sys, warp_splat.training.command\n"
        "from warp_splat.scene import load_scene\n"
        "from warp_splat.scene.embedded import embedded_scene\n"
        "from warp_splat.training.options import TrainConfig\n"
        "from warp_splat.training.trainer import Trainer\n"
        "trainer = Trainer(load_scene(embedded_scene(), resolution=8), TrainConfig(device='cpu'))\n"
        "trainer.warm_up()\n"
        "trainer.differentiate(1)\n"
        "assert not {'matplotlib', 'sympy', 'scipy.optimize', 'viser'} & set(sys.modules)"
    )
    python("-c", code)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("-m", str(SCENE)), ("another folder than the scene's",)),
        (("-m", str(SCENE / "images" / "model")), ("another folder than the scene's or its images'",)),
        (("-m", str(SCENE / "sparse" / "0")), ("another folder than the scene's or its images'",)),
        (("--config", "/no/such/file"), ("/no/such/file", "TOML", "(No such file or directory)")),
        (("--device", "cpu", "--data_device", "cuda"), ("--data_device cuda", "GPU")),
        (("--start_checkpoint", "x.pth"), ("x.pth", "can run code")),
        (("--iteratons", "5"), ("--iteratons: no such flag", "--iterations")),
        (("scene",), ("scene: an argument too many",)),
        (("--verify", "abc"), ("--verify", "sha256", "abc")),
        (("--verify", "0" * 65), ("--verify", "sha256", "000")),
        (("--verify", ""), ("--verify", "a hash", "empty")),
        (("-s", "/no/such/scene"), ("/no/such/scene",)),
    ],
    ids=" ".join,
)
def test_bad_options(options, words, tmp_path, fails):
    message = fails("train", "-s", SCENE, "-m", tmp_path / "model", *options)
    assert all(word in message for word in words)
    assert not (tmp_path / "model").exists()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("merge a --folder b", "--folder: no such flag; warp-splat merge --help"),  # arguments have no flags
        ("simplify a --kep 0.5", "did you mean --keep?"),
        ("convert a b.ply -1", "-1: an argument too many"),
        ("view no/such/folder", "found no such folder"),
        ("view no/such.ply", "no/such.ply"),
        ("render", "-m"),
        ("render -m folder", "folder: "),
        ("render -m nope", "nope: expected the folder of a trained model"),
        ("render -m empty.ply --video path", "expected a Gaussian to film"),
        (
            "render -m full.ply --video path --video_output full.ply/a.mp4",
            "full.ply: expected a folder that can be written",
        ),
        ("render -m full.ply --orbit --video path", "expected one of them"),
        ("render -m full.ply --video_output a.mp4", "expected --video or --orbit"),
        ("render -m full.ply --video path --frames 0", "--frames: expected at least 1"),
        ("render -m full.ply --frames 3", "--frames 3: expected --video"),
        ("render -m full.ply --of ideal", "--of ideal: expected --tolerance or --bound"),
        ("render -m full.ply --orbit --video_output a.AVI", "expected .mp4 or a folder, found .avi"),
        ("render -m full.ply --orbit --bound", "--bound: expected views"),
        (
            "render -m full.ply --video path --orbit_center origin",
            "--orbit_center origin: expected --orbit or --video orbit",
        ),
        ("render -m full.ply --device cpu", "name the scene with -s"),
        ("render -m full.ply --iteration 7", "expected a model folder for iteration 7, found a file"),
    ],
)
def test_what_cannot_be(words, sentence, tmp_path, monkeypatch, fails):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    for name, count in (("empty.ply", 0), ("full.ply", 5)):
        save_gaussians(name, some_file(count))
    assert sentence in fails(*words.split(), *(["-s", SCENE] if "--video" in words else []))


def test_output_folder_that_cannot_be_written(tmp_path, fails):
    (tmp_path / "file").write_text("in the way")
    for scene in (SCENE, tmp_path / "no scene"):  # said before the scene is loaded
        message = fails("train", "-s", str(scene), "-m", str(tmp_path / "file" / "model"))
        assert f"{tmp_path / 'file'} is no folder" in message


def test_a_full_disk_does_not_lose_the_model(tmp_path, monkeypatch, capsys):
    """The save fails; the model goes to the folder for temporary files instead."""

    def full(path, *arrays, **options):
        (no_space if tmp_path / "model" in path.parents else save_ply_parts)(path, *arrays, **options)

    monkeypatch.setattr("warp_splat.gaussians.save_ply_parts", full)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert train(tmp_path / "model", "--iterations", "5", "--antialiasing") == 1
    (saved,) = tmp_path.glob("warp_splat-*/point_cloud/iteration_5/point_cloud.ply")
    assert load_gaussians(saved).antialiased
    assert str(saved.parent) in capsys.readouterr().err.splitlines()[-1] and len(load_ply(saved).splats.means) == 4500


def test_what_is_written_is_told_if_the_disk_is_full_at_the_end(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("warp_splat.training.record.show_views", no_space)
    (tmp_path / "contact_sheet.png").write_bytes(b"of an older training")
    assert train(tmp_path, "--iterations", "5") == 1
    told = capsys.readouterr().out
    assert f"numbers   {tmp_path / 'results.json'}" in told and "contact_sheet.png" not in told


def test_a_failing_preview_or_save_does_not_end_training(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("warp_splat.training.loop.save_png", no_space)
    warm_up = lambda self: (tmp_path / "point_cloud").write_text("in the way")  # noqa: E731
    monkeypatch.setattr("warp_splat.training.loop.Trainer.warm_up", warm_up)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "spare"))
    (tmp_path / "spare").mkdir()
    assert train(tmp_path, "--save_iterations", "20", "--iterations", "25") == 1
    saved = sorted(path.parent.name for path in (tmp_path / "spare").glob("*/point_cloud/*/point_cloud.ply"))
    assert saved == ["iteration_20", "iteration_25"]
    errors = capsys.readouterr().err
    assert "preview.png" in errors and "point_cloud" in errors and "Traceback" not in errors


def fail_at(monkeypatch, target, call, error):
    """Let a function, or one of the CPU's driver, raise ``error`` when it is called for the ``call``-th time."""
    module, name = target.rsplit(".", 1)
    function, calls = getattr(CPU if module == "driver" else importlib.import_module(module), name), []

    def failing(*arguments, **options):
        calls.append(0)
        if len(calls) == call:
            raise error
        return function(*arguments, **options)

    if module == "driver":
        monkeypatch.setattr(CPU, name, failing)
    else:
        monkeypatch.setattr(target, failing)


LOSS = "warp_splat.training.trainer.image_loss"


def test_an_error_while_training_saves_the_model_first(tmp_path, monkeypatch):
    fail_at(monkeypatch, LOSS, 11, RuntimeError("planted"))  # the first call warms up
    with pytest.raises(RuntimeError, match="planted"):
        train(tmp_path)
    assert len(load_ply(ply_path(tmp_path, 9)).splats.means) == 4500


@pytest.mark.parametrize(
    ("target", "error", "where"),
    [
        ("driver.bin", MemoryError(), "in stage 'bin'"),
        ("driver.bin", RuntimeError("Failed to allocate 8 bytes on device 'cuda:0'"), "'bin'"),
        ("driver.adjoint", torch.OutOfMemoryError("CUDA out of memory."), "'adjoint of blend'"),
        (LOSS, RuntimeError("[enforce fail] . not enough memory: you"), "between two stages"),
    ],
)
def test_memory_that_runs_out_is_explained_once_the_model_is_saved(target, error, where, tmp_path, monkeypatch, capsys):
    fail_at(monkeypatch, target, 6, error)  # of steps one to three there is an evaluation of seven views
    assert train(tmp_path) == 1
    text = capsys.readouterr()
    (saved,) = tmp_path.glob("point_cloud/*/point_cloud.ply")
    assert len(load_ply(saved).splats.means) == 4500 and str(saved) in text.out
    assert where in text.err and "4500 Gaussians on" in text.err and "Traceback" not in text.err
    assert "--max_gaussians" in text.err and "-r" in text.err


@pytest.mark.parametrize(("table", "torn"), [("means", False), ("quats", True)])
def test_memory_that_runs_out_while_the_set_grows_saves_no_torn_model(tmp_path, monkeypatch, capsys, table, torn):
    """Some of its tables would have other rows than others."""
    put = Optimizer._put

    def failing(optimizer, name, *tables):
        if name == table:
            raise torch.OutOfMemoryError("out of memory")
        put(optimizer, name, *tables)

    monkeypatch.setattr(Optimizer, "_put", failing)
    assert train(tmp_path) == 1
    text = capsys.readouterr()
    assert "in stage 'densify'" in text.err and "To continue after iteration" in text.out
    assert ("Model after" in text.out) != torn and len([*tmp_path.glob("point_cloud/*/*.ply")]) == 1 - torn


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ((), torch.OutOfMemoryError("CUDA out of memory."), ("in stage 'bin'", " on 66 x 62 px;", "(-r)")),
        (("--orbit",), RuntimeError("Failed to allocate 8 bytes on device 'cuda:0'"), ("'bin'", " on 980 x 545 px;")),
    ],
)
def test_memory_that_runs_out_while_rendering_is_explained(options, error, words, trained, monkeypatch, fails):
    fail_at(monkeypatch, "driver.bin", 3, error)
    message = fails("render", "-m", str(trained), *options)
    count = len(load_ply(ply_path(trained, 60)).splats.means)
    assert all(word in message for word in (*words, f"Out of memory on cpu in stage 'bin', with {count} Gaussians"))
    assert "--max_gaussians" in message and "\n" not in message


def test_gradients_that_are_not_finite_are_dropped_and_reported(tmp_path, monkeypatch, capsys):
    """NaN from the loss in one pixel of one step: the run goes on and says so at its end."""
    steps = []

    def poisoned(image, *arguments, **options):
        steps.append(0)
        if len(steps) == 20 and image.requires_grad:
            image.register_hook(lambda grad: grad.index_fill(0, torch.tensor([3]), float("nan")))
        return image_loss(image, *arguments, **options)

    monkeypatch.setattr(LOSS, poisoned)
    assert train(tmp_path, "--iterations", "25") == 0
    assert "66 pixels" in capsys.readouterr().out
    assert json.loads((tmp_path / "results.json").read_text())["ours_25"]["dropped"]["pixels"] == 66
    assert np.isfinite(load_ply(ply_path(tmp_path, 25)).splats.means).all()


@pytest.mark.long
def test_the_embedded_scene_reaches_its_quality(tmp_path):
    assert main(["train", "-m", str(tmp_path), "--quiet"]) == 0
    assert json.loads((tmp_path / "results.json").read_text())["ours_3000"]["PSNR"] > 25


@pytest.mark.long
@pytest.mark.skipif(not FOX.is_dir(), reason="the photographs of data/fox may not be shipped; set WARP_SPLAT_FOX")
def test_real_photographs(tmp_path):
    """The best CPU trainer known reaches 23.3 dB after 500 steps of this scene at half size."""
    options = ["-s", str(FOX), "-m", str(tmp_path), "--eval", "-r", "2", "--iterations", "500", "--quiet"]
    assert main(["train", *options]) == 0
    assert json.loads((tmp_path / "results.json").read_text())["ours_500"]["PSNR"] > 23.3

"""Options: from TOML files, in the order in which they count, their help; presets, and training from coarse to fine."""

import re
import tomllib

import numpy as np
import pytest
from commands import SCENE
from hostile import refusal

from warp_splat.cli import COMMANDS, main, make_parser, parse
from warp_splat.flags import flags_of
from warp_splat.presets import EMBEDDED_DEFAULTS, PRESETS
from warp_splat.scene import View, load_scene
from warp_splat.scene.types import Decoded
from warp_splat.training.config_file import OF_ONE_RUN, read_config, write_config
from warp_splat.training.options import TrainConfig
from warp_splat.training.parts import PARTS
from warp_splat.training.photographs import shares_of_size, shrink_at
from warp_splat.training.trainer import Trainer


def test_flags_go_before_the_file_which_goes_before_presets(tmp_path):
    file = tmp_path / "a.toml"
    file.write_text('preset = "fast"\nopacity_lr = 0.125\niterations = 77\nsource_path = "x"\n')
    config = parse(["train", "--config", str(file), "--iterations", "88"])
    learn = config.learn
    assert (learn.iterations, learn.opacity_lr, learn.coarse, config.data.source_path) == (88, 0.125, 4, "x")
    assert config.model.sh_degree == TrainConfig().model.sh_degree


def test_every_option_survives_the_file(tmp_path):
    """Also texts that need escapes, and floats; read by the standard library alone."""
    numbers = {"opacity_lr": 1.0 / 3.0, "position_lr_final": 1e-300, "checkpoint_iterations": [3, 5], "seed": 2**62}
    strange = TrainConfig(source_path='a "quoted"\\path\n\x7f\x01 é 😀', quiet=True, **numbers)
    write_config(tmp_path, strange)
    expected = {name: value for name, value in strange.flat().items() if name not in OF_ONE_RUN}
    assert tomllib.loads((tmp_path / "config.toml").read_text(encoding="utf-8")) == expected
    assert read_config(tmp_path / "config.toml") == expected


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--parts random_background --no-random_background", "got --parts random_background; leave one of them out"),
        ("--parts auto --no-random_background", "got --parts auto; name the parts to use"),
        ("--parts floaters,floaters", "--parts floaters,floaters: expected each part once, got floaters twice"),
        ("--parts random_background,weather", f"--parts: expected auto, or some of {', '.join(PARTS)} between commas"),
        ("--port 0", "--port: expected 1 to 65535, got 0."),
        ("--lambda_dssim 1.5", "--lambda_dssim: expected a finite number, 0 to 1, got 1.5."),
        ("--opacity_lr inf", "--opacity_lr: expected a finite number, at least 0, got inf."),
        ("--save_iterations 5 0", "--save_iterations: expected numbers of steps, at least 1, got 0."),
        ("--iterations 0", "--iterations: expected 1 to 2147483647, got 0."),
        ("--disable_viewer", "unless --viewer asks"),
        ("view model --host 0.0.0.0", "--host: the viewer is served to this machine only"),
        ("audit x --command p --limit 0", "--limit: expected a finite number, at least 0.1, got 0.0."),
        ("merge no/such", "no/such: expected only folders of ended trainings by --block, found no such folder"),
        ("--minutes 0", "--minutes: expected more than 0, got 0; leave it out to train by --iterations."),
        ("--minutes nan", "--minutes: expected more than 0, got nan"),
        ("--minutes inf", "--minutes: expected a finite number"),
        ("--minutes 3 --iterations 100", "--minutes: expected no --iterations beside it, since it plans the steps"),
        ("--minutes 3 --densify_until_iter 100", "--minutes: expected no --densify_until_iter beside it"),
        ("--depth_l1_weight_final=0 --parts depth", "--depth_l1_weight_final: expected a positive number"),
        ("--pose_lr=-1", "--pose_lr: expected"),
        ("--opacity_reg=nan", "--opacity_reg: expected a finite number, at least 0, got nan."),
        ("view model --port 65536", "--port: expected 1 to 65535, got 65536."),
        ("render -m model --threads -1", "--threads: expected at least 0, got -1."),
        ("sfm photos scene --frames 2", "--frames: expected at least 3, got 2."),
    ],
)
def test_what_cannot_be_is_refused(arguments, message, fails):
    command = ["train"] if arguments.startswith("-") else []
    assert message in fails(*command, *arguments.split())


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("iteratons = 3", "iteratons: no such option; did you mean iterations?"),
        ("xyzzy = 3", "xyzzy: no such option; warp-splat train --help"),
        ('config = "a.toml"', "config: no such option"),
        ('iterations = "3"', "iterations: expected a whole number, found '3'"),
        ("iterations = true", "iterations: expected a whole number, found True"),
        ("eval = 1", "eval: expected true or false, found 1"),
        ("source_path = 1979-05-27", "source_path: expected a text"),
        ('source_path = "a\\u0000b"', "source_path: expected a text"),
        ("save_iterations = [1.5]", "save_iterations: expected a list of numbers"),
        ('preset = "slow"', "preset: expected one of '', 'fast', found 'slow'"),
        ("[train]\niterations = 3", "train: no such option"),
        ("iterations = ", "expected a TOML file"),
        ("a = " + "[" * 5000, "expected a TOML file"),
        ("\udcff = 1", "expected a TOML file"),
    ],
)
def test_files_that_are_wrong(tmp_path, fails, text, sentence):
    file = tmp_path / "a.toml"
    file.write_text(text, errors="surrogateescape")
    assert fails("train", "--config", file).startswith(f"warp-splat: error: --config {file}: {sentence}")


def test_a_file_may_begin_with_the_mark_of_its_order_of_bytes(tmp_path):
    (tmp_path / "a.toml").write_text("iterations = 3", encoding="utf-8-sig")
    assert read_config(tmp_path / "a.toml") == {"iterations": 3}


def test_help_begins_with_the_flags_that_matter(capsys):
    with pytest.raises(SystemExit):
        make_parser().parse_args(["train", "--help"])
    first, *rest = re.split(r"\n\n(?=\S)", capsys.readouterr().out.split("options:\n", 1)[1])
    flags = re.findall(r"^  (-.*?)(?:  |$)", first, re.MULTILINE)
    names = {name for line in flags for name in re.findall(r"--(\w+)", line) if not name.startswith("no")}
    expected = "help source_path model_path sfm eval resolution preset iterations minutes max_gaussians resume quiet"
    assert names == {*expected.split(), "start_checkpoint"}
    listed = set(re.findall(r"^  (?:-\w[^-]*, )?--(\w+)", "\n".join(rest), re.MULTILINE))
    others = {item.name for item in flags_of(TrainConfig) if item.metadata["group"]}
    assert len(others) > 30 and others <= listed | names


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_each_command_is_short_at_its_head(command, capsys):
    with pytest.raises(SystemExit):
        make_parser().parse_args([command, "--help"])
    assert capsys.readouterr().out.index("\n\n") < 80


@pytest.fixture(scope="module")
def scene():
    return load_scene(SCENE, resolution=4, report=str)


def test_flags_go_before_the_preset_and_the_preset_before_defaults():
    assert parse(["train", "-s", "x"]) == TrainConfig(source_path="x")
    fast = {"preset": "fast", **PRESETS["fast"]}
    assert parse(["train", "-s", "x", "--preset", "fast"]) == TrainConfig(source_path="x", **fast)
    assert parse(["train", "-s", "x", "--preset", "fast", "--coarse", "2"]).learn.coarse == 2
    embedded = parse(["train", "--preset", "fast", "--sh_interval", "7"])
    assert embedded.learn.sh_interval == 7 and embedded.data.eval
    assert embedded.learn.coarse == PRESETS["fast"]["coarse"]
    assert embedded.learn.iterations == EMBEDDED_DEFAULTS["fast"]["iterations"]


@pytest.mark.parametrize("flag", ["-s", "-m", "--resume", "--config", "--start_ply", "--lpips_weights", "-o"])
def test_empty_paths_are_refused(flag):
    refusal(lambda: parse([*(["simplify", "x"] if flag == "-o" else ["train"]), flag, ""]), "a path", "an empty one")


def test_presets_are_made_of_documented_flags():
    documented = {item.name for item in flags_of(TrainConfig) if item.metadata["help"]}
    for values in (*EMBEDDED_DEFAULTS.values(), *PRESETS.values()):
        assert set(values) <= documented


def test_images_grow_to_their_full_size(scene):
    trainer = Trainer(scene, TrainConfig(device="cpu", coarse=4, coarse_until_iter=10))
    view = scene.train[0]
    shrinks = []
    for iteration in range(1, 12):
        camera, photograph = trainer.photographs.at_size(view, iteration)
        assert photograph.image.shape == (camera.height, camera.width, 3)
        assert camera.fx / camera.width == pytest.approx(view.camera.fx / view.camera.width)
        assert camera.cy / camera.height == pytest.approx(view.camera.cy / view.camera.height)
        shrinks.append(view.camera.width // camera.width)
    assert shrinks == [4] * 4 + [2] * 5 + [1] * 2
    assert camera is view.camera and np.array_equal(photograph.image.numpy(), view.image)


def test_a_size_lasts_as_long_as_its_share_of_the_detail():
    """White noise has as much in every frequency; a wave has all of it in one."""
    learn = TrainConfig(coarse=4, coarse_by="detail", coarse_until_iter=1000).learn
    camera = load_scene(SCENE, resolution=8, report=str).train[0].camera
    noise = np.repeat(np.random.default_rng(0).integers(0, 256, (240, 320, 1), dtype=np.uint8), 3, 2)
    wave = np.broadcast_to(np.rint(127 + 100 * np.sin(2 * np.pi * 16 * np.arange(80) / 80)), (240, 80))  # 0.2 per px
    wave = np.repeat(wave[..., None], 3, 2).astype(np.uint8)
    even = np.full((240, 320, 3), 9, np.uint8)
    for image, expected, margin in ((noise, (1 / 16, 1 / 4), 0.02), (wave, (0.0, 1.0), 0.05), (even, (0.25, 0.5), 0.0)):
        shares = shares_of_size(learn, [View("a", camera, Decoded(image), camera)])
        assert shares == pytest.approx(expected, abs=margin)
        steps = [shrink_at(learn, shares, step) for step in range(1001)]
        assert steps == sorted(steps, reverse=True) and steps.count(4) == pytest.approx(1000 * shares[0], abs=1)
        assert steps[-1] == 1 and steps.count(1) == pytest.approx(1000 * (1 - shares[1]) + 1, abs=1)


def test_a_coarse_photograph_holds_the_means_of_the_fine_one(scene):
    image = np.random.default_rng(0).integers(0, 256, (40, 48, 3), dtype=np.uint8)
    camera = scene.train[0].camera.resized(48, 40)
    trainer, view = Trainer(scene, TrainConfig(device="cpu", coarse=4)), View("a", camera, Decoded(image), camera)
    _, photograph = trainer.photographs.at_size(view, 1)
    means = image.reshape(10, 4, 12, 4, 3).mean((1, 3))
    assert np.abs(photograph.image.numpy() - means).max() <= 0.5 + 1e-3


def test_a_coarse_step_trains_on_a_coarse_image(scene):
    trainer = Trainer(scene, TrainConfig(device="cpu", coarse=4, coarse_until_iter=100))
    for iteration, shrink in ((1, 4), (60, 2)):
        trainer.differentiate(iteration)
        sizes = [(photo.image.shape[0], view.image.shape[0]) for view, photo in trainer.photographs.kept.items()]
        assert sizes and all(small == whole // shrink for small, whole in sizes)


@pytest.mark.parametrize(("rank", "times"), [("0", 1), ("1", 0)])
def test_what_all_processes_of_a_machine_refuse_is_said_once(rank, times, monkeypatch, capsys):
    monkeypatch.setenv("LOCAL_RANK", rank)
    assert main(["train", "--lambda_dssim", "2"]) == 1
    assert capsys.readouterr().err.count("--lambda_dssim: expected") == times

"""Options from a TOML file, the order in which they count, and the help that a newcomer reads first."""

import re
import tomllib

import pytest

from warp_splat.cli import COMMANDS, main, make_parser, parse
from warp_splat.errors import InputError
from warp_splat.flags import flags_of
from warp_splat.training.config_file import OF_ONE_RUN, read_config, write_config
from warp_splat.training.options import TrainConfig


def test_flags_go_before_the_file_which_goes_before_presets(tmp_path):
    file = tmp_path / "a.toml"
    file.write_text('preset = "fast"\nopacity_lr = 0.125\niterations = 77\nsource_path = "x"\n')
    config = parse(["train", "--config", str(file), "--iterations", "88"])
    learn = config.learn
    assert (learn.iterations, learn.opacity_lr, learn.coarse, config.data.source_path) == (88, 0.125, 4, "x")
    assert config.model.sh_degree == TrainConfig().model.sh_degree


def test_every_option_survives_the_file(tmp_path):
    """Also texts that need escapes, and floats; read by the standard library alone."""
    strange = TrainConfig(
        source_path='a "quoted"\\path\n\x7f\x01 é 😀', opacity_lr=1.0 / 3.0, position_lr_final=1e-300, quiet=True
    ).changed(checkpoint_iterations=[3, 5], seed=2**62)
    write_config(tmp_path, strange)
    expected = {name: value for name, value in strange.flat().items() if name not in OF_ONE_RUN}
    assert tomllib.loads((tmp_path / "config.toml").read_text(encoding="utf-8")) == expected
    assert read_config(tmp_path / "config.toml") == expected


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        ("--parts random_background --no-random_background", "got --parts random_background; leave one of them out"),
        ("--parts auto --no-random_background", "got --parts auto; name the parts to use"),
        ("--parts floaters,floaters", "--parts floaters,floaters: expected each part once, got floaters twice"),
    ],
)
def test_parts_that_contradict_each_other(capsys, flags, sentence):
    assert main(["train", *flags.split()]) == 1
    assert sentence in capsys.readouterr().err


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
        ("save_iterations = [1.5]", "save_iterations: expected a list of numbers"),
        ('preset = "slow"', "preset: expected one of '', 'fast', found 'slow'"),
        ("[train]\niterations = 3", "train: no such option"),
        ("iterations = ", "expected a TOML file"),
        ("a = " + "[" * 5000, "expected a TOML file"),
        ("\udcff = 1", "expected a TOML file"),
    ],
)
def test_files_that_are_wrong(tmp_path, capsys, text, sentence):
    file = tmp_path / "a.toml"
    file.write_text(text, errors="surrogateescape")
    assert main(["train", "--config", str(file)]) == 1
    message = capsys.readouterr().err
    assert message.startswith(f"warp-splat: error: --config {file}: {sentence}") and message.count("\n") == 1


def test_no_file():
    with pytest.raises(InputError, match="No such file"):
        read_config("none.toml")


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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("train --port 0", "--port: expected 1 to 65535, got 0."),
        ("train --lambda_dssim 1.5", "--lambda_dssim: expected a finite number, 0 to 1, got 1.5."),
        ("train --opacity_lr nan", "--opacity_lr: expected a finite number, at least 0, got nan."),
        ("train --opacity_lr inf", "--opacity_lr: expected a finite number, at least 0, got inf."),
        ("train --save_iterations 5 0", "--save_iterations: expected numbers of steps, at least 1, got 0."),
        ("train --iterations 0", "--iterations: expected at least 1, got 0."),
        (
            "train --parts random_background,weather",
            "--parts: expected auto, or some of random_background, sky, exposure, pose, depth, floaters between commas",
        ),
        ("view model --port 65536", "--port: expected 1 to 65535, got 65536."),
        ("render -m model --threads -1", "--threads: expected at least 0, got -1."),
        ("sfm photos scene --frames 2", "--frames: expected at least 3, got 2."),
    ],
)
def test_numbers_out_of_bounds_are_refused(arguments, message, capsys):
    assert main(arguments.split()) == 1
    assert message in capsys.readouterr().err

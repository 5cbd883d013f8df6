"""Nothing is lost: a run that stops and resumes ends in the same bytes, kill -9 leaves a loadable file."""

import itertools
import json
import multiprocessing
import os
import random
import shutil
import sys
import time
from contextlib import nullcontext, suppress
from dataclasses import replace

import numpy as np
import pytest
import safetensors.numpy
import torch
from commands import ROOT, SCENE, SHORT, forked_process, interrupt, no_space, together, train
from hostile import refusal
from scene_files import pose, write_colmap
from splat_files import some_splats
from trainings import SCHEDULE, Pretended, begin, check_same, resumed, state_of, stepped, steps

from warp_splat.cli import main, parse
from warp_splat.errors import InputError
from warp_splat.formats.checkpoint import LAST, load_checkpoint, save_checkpoint
from warp_splat.formats.curve import along_curve
from warp_splat.formats.exchange import save_gaussians
from warp_splat.formats.model_folder import ply_path
from warp_splat.formats.ply import load_ply
from warp_splat.formats.splats import SplatFile
from warp_splat.training.command import train as command_train
from warp_splat.training.config_file import load_options
from warp_splat.training.options import TrainConfig
from warp_splat.training.record import finish, keep, restore, save_model
from warp_splat.training.trainer import Trainer

SLOW, LONG = pytest.mark.slow, pytest.mark.long
STOP = 33  # of 60; densification has added Gaussians and the opacities were reset


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"optimizer_type": "sparse_adam", "random_background": True, "coarse": 4, "coarse_until_iter": 40},
        {"white_background": True, "prune_screen_size": 20, "antialiasing": True, "sh_degree": 1},
        {"max_gaussians": 5000, "sh_degree": 0, "seed": 7, "half_moments": True},
        {"growth": "budget", "max_gaussians": 7000},
        {"growth": "mcmc", "max_gaussians": 4900, "opacity_lr": 0.3},
    ],
    ids=str,
)
def test_a_run_that_stops_again_and_again_ends_in_the_same_bytes(options, scene, tmp_path):
    """At the start, after one step, where the set is about to change and opacities to be reset, and in between."""
    expected = resumed(scene, tmp_path, [50], **options)
    check_same(resumed(scene, tmp_path, [0, 1, 20, 37, 50], **options), expected)
    assert len(expected[0].model) not in (4500, 0) or options.get("max_gaussians")


ALL = {"parts": "sky,exposure,pose,depth,surface,floaters", "vignetting": True}
POSE = {"parts": "pose", "pose_from_iter": 5}


@pytest.mark.parametrize(
    ("options", "learned"),
    [
        ({"parts": "floaters", "opacity_reg": 0.5}, ""),
        ({"parts": "floaters", "opacity_reg": 0.5, "optimizer_type": "sparse_adam"}, ""),
        ({**ALL, "exposure": "bilateral"}, "exposure vignetting pose"),
        *(
            pytest.param({**ALL, "exposure": kind}, "exposure vignetting pose", marks=pytest.mark.slow)
            for kind in ("gain", "affine")
        ),
        ({**POSE, "pose_intrinsics": ""}, "pose"),
        *(({**POSE, "pose_intrinsics": lens}, "pose lens") for lens in ("focal", "all")),
    ],
    ids=str,
)
def test_what_parts_learn_is_kept(options, learned, scene, tmp_path):
    """Also where the file that a run with poses started from has gone."""
    trainer, run = expected = resumed(scene, tmp_path, [34], **options)
    state, _ = state_of(trainer, run)
    found = [name for name in ("exposure", "vignetting", "pose", "lens") if f"parameters.{name}" in state]
    assert found == learned.split()
    assert all(state[f"parameters.{name}"] != state[f"gradients.{name}"] for name in found)
    then = replace(scene, points=scene.points[::3]) if options["parts"] == "pose" else None
    check_same(resumed(scene, tmp_path, [3, 20, 34], then, **options), expected)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that was never stopped."""
    folder = tmp_path_factory.mktemp("whole")
    assert train(folder, "--threads", "2") == 0
    return folder


def results(folder):
    """What a run has measured, without times."""
    history = json.loads((folder / "history.json").read_text())
    entry = json.loads((folder / "results.json").read_text())["ours_60"]
    timed = ("seconds", "spent", "iterations_per_second", "peak_memory_mb")
    return [{k: v for k, v in item.items() if k not in timed} for item in (*history, entry)]


def files_of(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_ctrl_c_and_resume(whole, tmp_path, monkeypatch, capsys, fails):
    """Through the command line, with another number of threads; then beyond the end, and what is refused."""
    folder = tmp_path / "model"
    with monkeypatch.context() as patch:
        interrupt(patch, STOP)
        assert train(folder, "--threads", "2", "--checkpoint_iterations", "20") == 130
    out = capsys.readouterr().out
    assert f"To continue after iteration {STOP}: warp-splat train --resume {folder}\n" in out
    checkpoint, model = load_checkpoint(folder), load_ply(ply_path(folder, STOP)).splats
    means = checkpoint.arrays["parameters.means"]
    order = along_curve(torch.tensor(means)).numpy()  # that of the file
    assert np.array_equal(means[order], model.means)
    assert safetensors.numpy.load_file(folder / LAST)["parameters.scales"][order].tobytes() == model.scales.tobytes()
    named = folder / "chkpnt20.safetensors"
    assert {path.name for path in folder.glob("*.safetensors")} == {LAST, named.name}
    (folder / ".tmp-0123456789ab.safetensors").write_bytes(b"left by a process that was killed")

    assert main(["train", "--resume", str(folder), "--threads", "1"]) == 0
    assert ply_path(folder, 60).read_bytes() == ply_path(whole, 60).read_bytes()
    assert results(folder) == results(whole)
    assert not list(folder.glob(".tmp-*")) and "To continue" not in capsys.readouterr().out

    before = files_of(folder)
    assert "already holds" in fails("train", "-s", str(SCENE), "-m", str(folder))
    assert f"--resume {folder}" in fails("train", "--resume", str(named))
    assert "expected at least 60, as in" in fails("train", "--resume", str(folder), "--iterations", "59")
    others = {"sh_degree": "2", "optimizer_type": "sparse_adam", "seed": "1", "preset": "fast", "start_ply": "a.ply"}
    others |= {"projection": "ellipsoid"}
    for option, value in others.items():
        assert f"--{option} {value}: expected" in fails("train", "--resume", str(folder), f"--{option}", value)
    for flag in ("antialiasing", "white_background"):
        assert f"--{flag} True: expected False" in fails("train", "--resume", str(folder), f"--{flag}")
    assert files_of(folder) == before


def test_an_evaluation_that_fails_loses_no_history(scene, tmp_path, monkeypatch):
    def fail(*arguments):
        raise InputError("no room for pictures.")

    trainer, run = begin(scene, tmp_path)
    run.history = [{"iteration": n, "loss": 0.1, "psnr": 9.0, "gaussians": 5, "seconds": 1.0} for n in (1, 2)]
    run.saved, run.seconds = save_model(trainer, run), 1.0
    monkeypatch.setattr("warp_splat.training.record.evaluate_views", fail)
    refusal(lambda: finish(trainer, run, print), match="no room")
    assert json.loads((tmp_path / "history.json").read_text()) == run.history
    assert (tmp_path / "training.png").is_file()


def test_another_arithmetic_is_refused(tmp_path, monkeypatch, fails):
    """By the flag, and by the environment that this program was started in."""
    for name, portable in (("with", True), ("without", False)):
        options = TrainConfig(source_path=str(SCENE), portable=portable).flat()
        save_checkpoint(tmp_path / name / LAST, {}, {"options": options, "iteration": 3})
    sentence = fails("train", "--resume", str(tmp_path / "without"), "--portable")
    assert "--portable True: expected False, as in" in sentence
    monkeypatch.setattr("warp_splat.training.opening.PORTABLE", True)
    sentence = fails("train", "--resume", str(tmp_path / "without"))
    assert "WARP_SPLAT_PORTABLE: expected it unset, as in" in sentence
    monkeypatch.setattr("warp_splat.training.opening.PORTABLE", False)
    with pytest.raises(InputError, match="WARP_SPLAT_PORTABLE: expected it 1, as in"):  # --resume alone would set it
        command_train(TrainConfig(source_path=str(SCENE), start_checkpoint=str(tmp_path / "with")))


@pytest.mark.slow
def test_at_the_end_and_into_another_folder(whole, tmp_path):
    """Resuming at the end writes again what is missing; from an earlier checkpoint, another folder is filled."""
    folder = tmp_path / "model"
    assert train(folder, "--checkpoint_iterations", "20") == 0
    ply_path(folder, 60).unlink()  # as if killed after the last checkpoint
    assert main(["train", "--resume", str(folder)]) == 0
    assert ply_path(folder, 60).read_bytes() == ply_path(whole, 60).read_bytes() and results(folder) == results(whole)
    before, branch = files_of(folder), tmp_path / "branch"
    assert main(["train", "--start_checkpoint", str(folder / "chkpnt20.safetensors"), "-m", str(branch), *SHORT]) == 0
    assert ply_path(branch, 60).read_bytes() == ply_path(whole, 60).read_bytes()
    assert files_of(folder) == before


@pytest.mark.slow
def test_resume_past_the_end_is_a_longer_run(whole, tmp_path):
    """And with other options, while Gaussians that an earlier end has left settle."""
    whole = shutil.copytree(whole, tmp_path / "whole")  # other tests go on from the first
    assert train(tmp_path / "longer", "--iterations", "90") == 0
    assert main(["train", "--resume", str(whole), "--iterations", "90", "--quiet"]) == 0
    assert ply_path(tmp_path / "longer", 90).read_bytes() == ply_path(whole, 90).read_bytes()
    options = "--iterations 120 -r 8 --adjoint stepwise --densify_until_iter 110 --max_gaussians 40000"
    assert main(["train", "--resume", str(whole), *options.split()]) == 0
    config = parse(["train", "--resume", str(whole)])
    assert (config.data.resolution, config.model.adjoint, config.grow.max_gaussians) == (8, "stepwise", 40000)
    assert config.learn.sh_interval == 15
    assert len(load_ply(ply_path(whole, 120)).splats.means) <= 40000


def test_a_process_that_torchrun_starts_again_goes_on_from_its_own_checkpoint(tmp_path, monkeypatch):
    options = TrainConfig(source_path=str(SCENE), iterations=50, shard=True).flat()
    save_checkpoint(tmp_path / LAST, {}, {"options": options, "iteration": 3})
    words = ["train", "-s", str(SCENE), "-m", str(tmp_path), "--iterations", "50", "--shard"]
    goes_on = lambda: parse(words).data.start_checkpoint == str(tmp_path)  # noqa: E731
    assert not goes_on()
    monkeypatch.setenv("TORCHELASTIC_RESTART_COUNT", "1")
    assert not goes_on()  # somebody set it by hand
    monkeypatch.setenv("TORCHELASTIC_MAX_RESTARTS", "1")
    monkeypatch.chdir(tmp_path)
    assert goes_on() and parse(words).learn.iterations == 50
    assert parse([*words, "--verify", "01234567"]).report.verify == "01234567"
    with pytest.raises(InputError, match="-m: expected a folder, from which torchrun's --max-restarts could go on"):
        parse(["train", "-s", str(SCENE)])
    os.utime(tmp_path / LAST, (0, 0))  # of an older training, which the next step of the program refuses to overwrite
    assert not goes_on()


@pytest.mark.parametrize("gone", [False, True], ids=["the file is there", "the file has gone"])
def test_resume_of_a_start_from_a_file(gone, tmp_path, monkeypatch, capsys):
    """Of a scene without points; stopped before the first evaluation, resumed to there, and on to the same bytes.

    All cameras stand at one place, where the extent is that of the points, unless these have gone.
    """
    monkeypatch.chdir(tmp_path)
    if not gone:
        monkeypatch.setattr("scene_files.pose", lambda index: (pose(index)[0], pose(index)[0] @ (0.0, 0.0, 5.0)))
    root = write_colmap(tmp_path / "scene", points=())
    save_gaussians("start.ply", SplatFile(some_splats(50)))
    begin = ["train", "-s", str(root), "--start_ply", "start.ply", "--viewer", "--port", "1234", "-m"]
    monkeypatch.setattr("warp_splat.training.command.watched", lambda *_: nullcontext())
    assert main([*begin, "whole", "--iterations", "6"]) == 0
    with monkeypatch.context() as patch:
        interrupt(patch, 1)
        assert main([*begin, "parts", "--iterations", "60"]) == 130
    before = (tmp_path / "parts" / "input.ply").read_bytes()
    assert (load_options("parts")["viewer"], load_options("parts")["port"]) == (False, TrainConfig().report.port)
    if gone:
        (tmp_path / "start.ply").unlink()
    capsys.readouterr()
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    for end in ("1", "6"):
        assert main(["train", "--resume", "../parts", "--iterations", end]) == 0
    said = capsys.readouterr()
    assert "random ones" not in said.out + said.err and "curves" not in said.out.split("Done")[1]
    assert (tmp_path / "parts" / "input.ply").read_bytes() == before
    models = [ply_path(tmp_path / folder, 6).read_bytes() for folder in ("whole", "parts")]
    assert models[0] == models[1]


def test_another_scene_is_refused(whole, tmp_path, fails):
    options = ["--resume", whole, "--iterations", "70", "-m", tmp_path / "a"]
    said = fails("train", *options, "--no-eval")
    assert "training views" in said and "7 more, 0 fewer, such as view_000" in said
    assert str(tmp_path) in fails("train", *options, "-s", tmp_path)
    before = files_of(whole)
    fails("train", *options[:4], "--no-eval")
    assert files_of(whole) == before


def test_another_order_is_refused(scene, stopped, tmp_path):
    """What belongs to each photograph is kept by its place."""
    other, _ = begin(replace(scene, train=scene.train[::-1]), tmp_path / "other")
    refusal(lambda: other.restore(load_checkpoint(tmp_path)), "in another order", "name the scene")


@pytest.fixture
def stopped(scene, tmp_path):
    """A trainer and its run, which have kept a checkpoint."""
    trainer, run = stepped(scene, tmp_path, STOP)
    keep(trainer, run)
    return trainer, run


def test_resume_on(device, scene, stopped, tmp_path):
    """A checkpoint of a CPU goes on where one is: the same parameters, then another step."""
    trainer, run = stopped
    other, continued = begin(scene, tmp_path, device=device)
    restore(other, continued, load_checkpoint(tmp_path))
    assert all(leaf.device.type == device for leaf in other.model.parameters.values())
    moments = [moment for table in other.optimizer.tables.values() for moment in table.moments]
    assert moments and all(moment.device.type == device for moment in moments)
    steps(trainer, run, STOP + 2)
    steps(other, continued, STOP + 2)
    assert [float(loss) for loss in continued.losses] == pytest.approx([float(loss) for loss in run.losses], rel=1e-3)


def test_other_numbers_of_processes(scene, stopped, tmp_path):
    """Statistics are sums over the processes; steps of Adam are counted in images."""
    (trainer, _), checkpoint = stopped, load_checkpoint(tmp_path)
    config = TrainConfig(**SCHEDULE)
    pair = [Trainer(scene, config, Pretended(rank, 2)) for rank in (0, 1)]
    for one in pair:
        one.restore(checkpoint)
        assert one.optimizer.tables["means"].steps * 2 == len([i for i in range(1, STOP) if i % 10 or i <= 10])
    assert torch.equal(pair[0].growth.gradient, trainer.growth.gradient)
    assert not pair[1].growth.gradient.any() and len(pair[1].growth.gradient) == len(trainer.model)
    rows = {name: np.repeat(checkpoint.arrays[f"statistics.{name}"], 3, 0) for name in ("gradient", "views", "radius")}
    arrays = {**checkpoint.arrays, **{f"statistics.{name}": values for name, values in rows.items()}}
    save_checkpoint(tmp_path / LAST, arrays, checkpoint.facts)
    other, _ = begin(scene, tmp_path)
    other.restore(load_checkpoint(tmp_path))
    assert torch.allclose(other.growth.gradient, 3 * trainer.growth.gradient, rtol=1e-6)
    assert torch.equal(other.growth.views, 3 * trainer.growth.views)
    assert torch.equal(other.growth.radius, trainer.growth.radius)


@pytest.mark.long
def test_two_processes_stop_and_resume(tmp_path):
    """The same bytes as without a stop; one process goes on as well."""
    begin = ["-s", SCENE, *SHORT, "-m"]
    runs = [[*begin, tmp_path / "whole"], [*begin, tmp_path / "parts", "--iterations", "34"]]
    for run in [*runs, ["--resume", tmp_path / "parts", "--iterations", "60"]]:
        assert together(2, ROOT / "train.py", *run)[0] == [0, 0]
    assert ply_path(tmp_path / "parts", 60).read_bytes() == ply_path(tmp_path / "whole", 60).read_bytes()
    assert main(["train", "--resume", str(tmp_path / "parts"), "--iterations", "65", "--quiet"]) == 0
    assert ply_path(tmp_path / "parts", 65).is_file()


#: Processes that have loaded torch are forked.
forked = pytest.mark.skipif(not hasattr(os, "fork"), reason="there are no forks")


def keep_writing(path, told):
    for count in itertools.count():
        save_checkpoint(path, {"a": np.full(500_000, count, np.float32)}, {"count": count})
        told.send(count)


@forked
@pytest.mark.parametrize("moments", [5, pytest.param(50, marks=pytest.mark.long)])
def test_a_writer_that_is_killed_leaves_a_whole_checkpoint(moments, tmp_path):
    path, moment = tmp_path / LAST, random.Random(0)
    for _ in range(moments):
        heard, told = multiprocessing.Pipe(duplex=False)
        process = forked_process(keep_writing, path, told)
        told.close()
        last = heard.recv()
        time.sleep(moment.uniform(0, 0.1))
        process.kill()
        process.join()
        with suppress(EOFError):
            while True:
                last = heard.recv()
        checkpoint = load_checkpoint(path)
        count = checkpoint.count("count")
        assert count in (last, last + 1) and (checkpoint.arrays["a"] == count).all()


def run_main(arguments):
    sys.exit(main(arguments))


@pytest.mark.parametrize(("most", "end"), [pytest.param(4, 60, marks=SLOW), pytest.param(50, 300, marks=LONG)])
@forked
def test_a_training_that_is_killed_again_and_again_ends_in_the_same_bytes(most, end, tmp_path):
    """Killed at random moments, from first line to last picture; a checkpoint is written after every step."""
    options = [*SHORT, "--iterations", str(end), "--checkpoint_interval", "0.00001"]
    assert train(tmp_path / "whole", *options) == 0
    moment, kills, runs, reached = random.Random(0), 0, 0, 0
    while True:
        folder = tmp_path / f"model{runs}"
        start = ["--resume", folder] if (folder / LAST).exists() else ["-s", SCENE, "-m", folder, *options]
        process = forked_process(run_main, ["train", *map(str, start)])
        process.join(moment.uniform(0.0, 2.5) if kills < most else None)
        if process.exitcode is None:
            process.kill()
            process.join()
            kills += 1
            if (folder / LAST).exists():
                before, reached = reached, load_checkpoint(folder).count("iteration")
                assert reached >= before
            continue
        assert process.exitcode == 0
        assert ply_path(folder, end).read_bytes() == ply_path(tmp_path / "whole", end).read_bytes()
        if kills == most:
            break
        runs, reached = runs + 1, 0


@pytest.mark.slow
def test_a_disk_that_is_full_costs_the_checkpoint_only(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("warp_splat.training.record.save_checkpoint", no_space)
    assert train(tmp_path / "model", "--iterations", "5", "--checkpoint_iterations", "3") == 0
    assert capsys.readouterr().err.count("no space left") == 3  # at the start, after iteration 3, at the end
    assert ply_path(tmp_path / "model", 5).is_file()

    monkeypatch.setattr("warp_splat.evaluation.report.contact_sheet", no_space)
    assert train(tmp_path / "other", "--iterations", "5") == 1
    assert "Done after 5 iterations" in capsys.readouterr().out

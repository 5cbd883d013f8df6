"""Nothing is lost: a run that stops and resumes ends in the same bytes, kill -9 leaves a loadable file."""

import json
import multiprocessing
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from contextlib import nullcontext

import numpy as np
import pytest
import safetensors.numpy
import torch
from scene_files import pose, write_colmap
from splat_files import some_splats
from test_distributed import Pretended, torchrun
from test_train import ROOT, SCENE, SHORT, fails, train

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
from warp_splat.training.record import Run, finish, keep, restore, save_model
from warp_splat.training.trainer import Trainer

STOP = 33  # of 60; densification has added Gaussians and the opacities were reset
#: Densifies, prunes, resets opacities and raises the SH degree within 50 steps.
SCHEDULE = {
    "device": "cpu",
    "iterations": 50,
    "densify_from_iter": 10,
    "densification_interval": 10,
    "densify_until_iter": 45,
    "opacity_reset_interval": 20,
    "sh_interval": 15,
    "densify_grad_threshold": 0.00005,
}


def begin(scene, folder, **options):
    """A trainer and its run, as :func:`warp_splat.training.command.train` starts them."""
    return Trainer(scene, TrainConfig(**{**SCHEDULE, **options})), Run(folder, time.perf_counter())


def steps(trainer, run, end):
    """Train until the loss of iteration ``end`` is differentiated, which is where models and checkpoints are saved."""
    for iteration in range(run.iteration + 1, end + 1):
        if run.iteration:
            trainer.update(run.iteration)
        run.losses.append(trainer.differentiate(iteration))
        run.iteration = iteration


def state_of(trainer, run):
    """All that the state holds, as bytes and values."""
    tensors, facts = trainer.state()
    tensors["losses"] = torch.stack(run.losses)
    return {name: (tensor.dtype, tensor.shape, tensor.numpy().tobytes()) for name, tensor in tensors.items()}, facts


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
    trainer, run = begin(scene, tmp_path, **options)
    steps(trainer, run, 50)
    expected, facts = state_of(trainer, run)
    trainer, run = begin(scene, tmp_path, **options)
    for stop in (0, 1, 20, 37):
        steps(trainer, run, stop)
        keep(trainer, run)
        trainer, run = begin(scene, tmp_path, **options)
        trainer.warm_up()
        restore(trainer, run, load_checkpoint(tmp_path))
        assert run.iteration == stop
    steps(trainer, run, 50)
    found, found_facts = state_of(trainer, run)
    assert found_facts == facts and found.keys() == expected.keys()
    assert [name for name in expected if found[name] != expected[name]] == []
    assert expected["parameters.means"][1][0] not in (4500, 0) or options.get("max_gaussians")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that was never stopped."""
    folder = tmp_path_factory.mktemp("whole")
    assert train(folder, "--threads", "2") == 0
    return folder


def interrupt(monkeypatch, iteration):
    """Send SIGINT, as Ctrl-C does, while ``iteration`` is computed."""
    differentiate = Trainer.differentiate

    def interrupted(self, number):
        if number == iteration:
            os.kill(os.getpid(), signal.SIGINT)
        return differentiate(self, number)

    monkeypatch.setattr(Trainer, "differentiate", interrupted)


def results(folder):
    """What a run has measured, without times."""
    history = json.loads((folder / "history.json").read_text())
    entry = json.loads((folder / "results.json").read_text())["ours_60"]
    timed = ("seconds", "spent", "iterations_per_second", "peak_memory_mb")
    return [{k: v for k, v in item.items() if k not in timed} for item in (*history, entry)]


def test_ctrl_c_and_resume(whole, tmp_path, monkeypatch, capsys):
    """Through the command line, with another number of threads; then beyond the end, and what is refused."""
    folder = tmp_path / "model"
    with monkeypatch.context() as patch:
        interrupt(patch, STOP)
        assert train(folder, "--threads", "2", "--checkpoint_iterations", "20") == 130
    out = capsys.readouterr().out
    assert f"To continue after iteration {STOP}: warp-splat train --resume {folder}\n" in out
    checkpoint, model = load_checkpoint(folder), load_ply(ply_path(folder, STOP)).splats
    means = checkpoint.arrays["parameters.means"]
    order = along_curve(torch.from_numpy(means)).numpy()  # that of the file
    assert np.array_equal(means[order], model.means)
    assert safetensors.numpy.load_file(folder / LAST)["parameters.scales"][order].tobytes() == model.scales.tobytes()
    named = folder / "chkpnt20.safetensors"
    assert {path.name for path in folder.glob("*.safetensors")} == {LAST, named.name}
    (folder / ".tmp-0123456789ab.safetensors").write_bytes(b"left by a process that was killed")

    assert main(["train", "--resume", str(folder), "--threads", "1"]) == 0
    assert ply_path(folder, 60).read_bytes() == ply_path(whole, 60).read_bytes()
    assert results(folder) == results(whole)
    assert not list(folder.glob(".tmp-*")) and "To continue" not in capsys.readouterr().out

    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert "already holds" in fails(capsys, "train", "-s", str(SCENE), "-m", str(folder))
    assert f"--resume {folder}" in fails(capsys, "train", "--resume", str(named))
    assert "expected at least 60, as in" in fails(capsys, "train", "--resume", str(folder), "--iterations", "59")
    for option, value in (("sh_degree", "2"), ("optimizer_type", "sparse_adam"), ("seed", "1"), ("preset", "fast")):
        assert f"--{option} {value}: expected" in fails(capsys, "train", "--resume", str(folder), f"--{option}", value)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_an_evaluation_that_fails_loses_no_history(scene, tmp_path, monkeypatch):
    def fail(*arguments):
        raise InputError("no room for pictures.")

    trainer, run = begin(scene, tmp_path)
    run.history = [{"iteration": n, "loss": 0.1, "psnr": 9.0, "gaussians": 5, "seconds": 1.0} for n in (1, 2)]
    run.saved, run.seconds = save_model(trainer, run), 1.0
    monkeypatch.setattr("warp_splat.training.record.evaluate_views", fail)
    with pytest.raises(InputError, match="no room"):
        finish(trainer, run, print)
    assert json.loads((tmp_path / "history.json").read_text()) == run.history
    assert (tmp_path / "training.png").is_file()


def test_another_arithmetic_is_refused(tmp_path, monkeypatch, capsys):
    """By the flag, and by the environment that this program was started in."""
    for name, portable in (("with", True), ("without", False)):
        options = TrainConfig(source_path=str(SCENE), portable=portable).flat()
        save_checkpoint(tmp_path / name / LAST, {}, {"options": options, "iteration": 3})
    sentence = fails(capsys, "train", "--resume", str(tmp_path / "without"), "--portable")
    assert "--portable True: expected False, as in" in sentence
    monkeypatch.setattr("warp_splat.training.opening.PORTABLE", True)
    sentence = fails(capsys, "train", "--resume", str(tmp_path / "without"))
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
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}

    branch = tmp_path / "branch"
    assert main(["train", "--start_checkpoint", str(folder / "chkpnt20.safetensors"), "-m", str(branch), *SHORT]) == 0
    assert ply_path(branch, 60).read_bytes() == ply_path(whole, 60).read_bytes()
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


@pytest.mark.slow
def test_resume_past_the_end_is_a_longer_run(whole, tmp_path):
    """And with other options, while Gaussians that an earlier end has left settle."""
    whole = shutil.copytree(whole, tmp_path / "whole")  # other tests go on from the first
    assert train(tmp_path / "longer", "--iterations", "90") == 0
    assert main(["train", "--resume", str(whole), "--iterations", "90", "--quiet"]) == 0
    assert ply_path(tmp_path / "longer", 90).read_bytes() == ply_path(whole, 90).read_bytes()
    options = (
        "--iterations 120 -r 8 --adjoint stepwise --densify_until_iter 110 --max_gaussians 40000 --white_background"
    )
    assert main(["train", "--resume", str(whole), *options.split()]) == 0
    config = parse(["train", "--resume", str(whole)])
    assert (config.data.resolution, config.model.adjoint, config.grow.max_gaussians) == (8, "stepwise", 40000)
    assert config.learn.sh_interval == 15
    assert len(load_ply(ply_path(whole, 120)).splats.means) <= 40000


@pytest.mark.parametrize("gone", [False, True], ids=["the file is there", "the file has gone"])
def test_resume_of_a_start_from_a_file(gone, tmp_path, monkeypatch, capsys):
    """Of a scene without points; stopped before the first evaluation, resumed to there, and on to the same bytes.

    All cameras stand at one place, where the extent is that of the points, unless these have gone.
    """
    monkeypatch.chdir(tmp_path)
    if not gone:
        monkeypatch.setattr("scene_files.pose", lambda index: (pose(index)[0], pose(index)[0] @ (0.0, 0.0, 5.0)))
    root = write_colmap(tmp_path / "scene")
    (root / "sparse" / "0" / "points3D.txt").write_text("# none\n")
    save_gaussians("start.ply", SplatFile(some_splats(50)))
    begin = ["train", "-s", str(root), "--start_ply", "start.ply", "--viewer", "--port", "1234", "-m"]
    monkeypatch.setattr("warp_splat.training.command._watched", lambda *_: nullcontext())
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


def test_another_scene_is_refused(whole, tmp_path, capsys):
    options = ["--resume", str(whole), "--iterations", "70", "-m", str(tmp_path / "a")]
    assert "training views" in fails(capsys, "train", *options, "--no-eval")
    message = fails(capsys, "train", *options, "-s", str(tmp_path))
    assert str(tmp_path) in message
    before = {path: path.read_bytes() for path in whole.iterdir() if path.is_file()}
    fails(capsys, "train", *options[:4], "--no-eval")
    assert {path: path.read_bytes() for path in whole.iterdir() if path.is_file()} == before


def test_resume_on(device, scene, tmp_path):
    """A checkpoint of a CPU goes on where one is: the same parameters, then another step."""
    trainer, run = begin(scene, tmp_path)
    steps(trainer, run, STOP)
    keep(trainer, run)
    other, continued = begin(scene, tmp_path, device=device)
    restore(other, continued, load_checkpoint(tmp_path))
    assert all(leaf.device.type == device for leaf in other.model.parameters.values())
    moments = [moment for table in other.optimizer.tables.values() for moment in table.moments]
    assert moments and all(moment.device.type == device for moment in moments)
    steps(trainer, run, STOP + 2)
    steps(other, continued, STOP + 2)
    assert [float(loss) for loss in continued.losses] == pytest.approx([float(loss) for loss in run.losses], rel=1e-3)


def test_other_numbers_of_processes(scene, tmp_path):
    """Statistics are sums over the processes; steps of Adam are counted in images."""
    trainer, run = begin(scene, tmp_path)
    steps(trainer, run, STOP)
    keep(trainer, run)
    checkpoint = load_checkpoint(tmp_path)
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

    program = ROOT / "train.py"
    torchrun(program, "-s", SCENE, "-m", tmp_path / "whole", *SHORT)
    torchrun(program, "-s", SCENE, "-m", tmp_path / "parts", *SHORT, "--iterations", "34")
    torchrun(program, "--resume", tmp_path / "parts", "--iterations", "60")
    assert ply_path(tmp_path / "parts", 60).read_bytes() == ply_path(tmp_path / "whole", 60).read_bytes()
    assert main(["train", "--resume", str(tmp_path / "parts"), "--iterations", "65", "--quiet"]) == 0
    assert ply_path(tmp_path / "parts", 65).is_file()


WRITER = """
import itertools, sys, numpy as np
from warp_splat.formats.checkpoint import save_checkpoint
for count in itertools.count():
    save_checkpoint(sys.argv[1], {"a": np.full(500_000, count, np.float32)}, {"count": count})
    print(count, flush=True)
"""


@pytest.mark.parametrize("moments", [5, pytest.param(50, marks=pytest.mark.long)])
def test_a_writer_that_is_killed_leaves_a_whole_checkpoint(moments, tmp_path):
    path, moment = tmp_path / LAST, random.Random(0)
    for _ in range(moments):
        command = [sys.executable, "-c", WRITER, path]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": ROOT})
        assert process.stdout.readline() == "0\n"
        time.sleep(moment.uniform(0, 0.1))
        process.kill()
        said = [0, *map(int, process.communicate()[0].split())]
        checkpoint = load_checkpoint(path)
        count = checkpoint.count("count")
        assert count in (said[-1], said[-1] + 1) and (checkpoint.arrays["a"] == count).all()


def run_main(arguments):
    sys.exit(main(arguments))


@pytest.mark.parametrize(
    ("most", "iterations"),
    [pytest.param(4, 60, marks=pytest.mark.slow), pytest.param(50, 300, marks=pytest.mark.long)],
)
@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes that have loaded torch are forked")
def test_a_training_that_is_killed_again_and_again_ends_in_the_same_bytes(most, iterations, tmp_path):
    """Killed at random moments, from first line to last picture; a checkpoint is written after every step."""
    options = [*SHORT, "--iterations", str(iterations), "--checkpoint_interval", "0.00001"]
    assert train(tmp_path / "whole", *options) == 0
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["warp_splat.training.command"])
    moment, kills, runs, reached = random.Random(0), 0, 0, 0
    while True:
        folder = tmp_path / f"model{runs}"
        start = ["--resume", folder] if (folder / LAST).exists() else ["-s", SCENE, "-m", folder, *options]
        process = processes.Process(target=run_main, args=(["train", *map(str, start)],))
        process.start()
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
        assert ply_path(folder, iterations).read_bytes() == ply_path(tmp_path / "whole", iterations).read_bytes()
        if kills == most:
            break
        runs, reached = runs + 1, 0


@pytest.mark.long
def test_the_command_that_is_printed_continues(tmp_path):
    command = [sys.executable, "train.py", "-s", SCENE, "-m", tmp_path, "-r", "8", "--iterations", "100000"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    for line in process.stderr:
        if "it/s" in line:
            break
    process.send_signal(signal.SIGINT)
    out = process.communicate(timeout=120)[0]
    line = next(line for line in out.splitlines() if line.startswith("To continue after iteration "))
    reached, continued = line.removeprefix("To continue after iteration ").split(": ", 1)
    end = str(int(reached) + 5)
    run = subprocess.run(
        f"{continued} --iterations {end}", shell=True, check=True, capture_output=True, text=True, cwd=ROOT
    )
    assert f"Done after {end} iterations" in run.stdout


def test_a_disk_that_is_full_costs_the_checkpoint_only(tmp_path, monkeypatch, capsys):
    path = tmp_path / LAST
    save_checkpoint(path, {"a": np.zeros(3, np.float32)}, {"count": 1})
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**20, limits[1]))
    try:
        with pytest.raises(InputError, match=r"checkpoint.safetensors: could not be written .* is untouched"):
            save_checkpoint(path, {"a": np.zeros(2**20, np.float32)}, {"count": 2})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert load_checkpoint(path).count("count") == 1 and os.listdir(tmp_path) == [LAST]

    def full(path, *rest):
        raise InputError(f"{path}: could not be written (no space left on device).")

    monkeypatch.setattr("warp_splat.training.record.save_checkpoint", full)
    assert train(tmp_path / "model", "--iterations", "5", "--checkpoint_iterations", "3") == 0
    assert capsys.readouterr().err.count("no space left") == 3  # at the start, after iteration 3, at the end
    assert ply_path(tmp_path / "model", 5).is_file()

"""Two processes, started as torchrun does: the same model in both, the step of their mean gradient, how they end."""

import json
import math
import os
import re
import signal
import time

import numpy as np
import psutil
import pytest
import torch
from commands import ROOT, SCENE, python, started, together
from torchrun_steps import CONFIG, STEPS
from trainings import Pretended

from warp_splat.errors import InputError
from warp_splat.formats.model_folder import ply_path
from warp_splat.formats.ply import load_ply
from warp_splat.runtime.distributed import ALONE, GroupError, Processes, join
from warp_splat.training.options import TrainConfig
from warp_splat.training.trainer import Trainer

SLOW, LONG = pytest.mark.slow, pytest.mark.long
TORCHRUN = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]


def gradients_of_ranks(trainers, iteration):
    """Each rank's gradients and loss, all from the model of the first trainer."""
    found = []
    for trainer in trainers:
        for name, leaf in trainers[0].model.parameters.items():
            trainer.model.parameters[name].data = leaf.detach().clone()
            trainer.model.parameters[name].grad = None
        loss = trainer.differentiate(iteration)
        found.append({"loss": loss, **{name: leaf.grad for name, leaf in trainer.model.parameters.items()}})
    return found


@pytest.mark.parametrize("kind", [pytest.param("default", marks=SLOW), pytest.param("sparse_adam", marks=LONG)])
def test_a_step_of_two_processes_is_one_of_their_mean_gradient(kind, scene, tmp_path):
    """Against one process that differentiates both views, averages, and steps by Adam with the rates written out."""
    assert together(2, ROOT / "tests" / "torchrun_steps.py", tmp_path, SCENE, kind)[0] == [0, 0]
    load = lambda rank, step, what: dict(np.load(tmp_path / f"rank{rank}_step{step}_{what}.npz"))  # noqa: E731
    config = TrainConfig(optimizer_type=kind, **CONFIG)
    trainers = [Trainer(scene, config, Pretended(rank, 2)) for rank in (0, 1)]
    moments = dict.fromkeys(trainers[0].model.NAMES, (0.0, 0.0))
    for step in range(1, STEPS + 1):
        before = {name: leaf.detach().clone() for name, leaf in trainers[0].model.parameters.items()}
        first, second = gradients_of_ranks(trainers, 2 * step)
        assert not torch.equal(first["means"], second["means"])  # other views
        for rank in (0, 1):
            found = load(rank, step, "gradients")
            assert set(before) - set(found) == ({"sh_rest"} if 2 * step < CONFIG["sh_interval"] else set())
            for name, gradient in found.items():
                assert np.array_equal(gradient, ((first[name] + second[name]) / 2).numpy()), (rank, step, name)
        models = [load(rank, step, "model") for rank in (0, 1)]
        for name in before:
            assert models[0][name].tobytes() == models[1][name].tobytes()
        if step == STEPS:  # densified: both saw each statistic
            assert len(models[0]["means"]) > len(before["means"])
            break
        shown = (trainers[0]._radii > 0) | (trainers[1]._radii > 0)
        for name, value in before.items():
            mean = torch.zeros_like(value) if first[name] is None else (first[name] + second[name]) / 2
            expected, moments[name] = adam(config, scene.extent, step, name, value, mean.double(), moments[name], shown)
            np.testing.assert_allclose(models[0][name], expected, rtol=1e-5, atol=1e-7)
        for name, value in models[0].items():
            trainers[0].model.parameters[name].data = torch.from_numpy(value)
    errors = [(tmp_path / f"rank{rank}_error").read_text() for rank in (0, 1)]
    assert all("same model" in error and "after 6 iterations" in error for error in errors)


def adam(config, extent, step, name, value, gradient, moments, shown):
    """A step in float64 for a batch of two: rates times sqrt(2), betas squared, epsilon over sqrt(2)."""
    decay = 0.01 ** (2 * step / 30_000)  # of the means' rate, in images
    rates = {"means": 0.00016 * extent * decay, "sh_dc": 0.0025, "sh_rest": 0.0025 / 20, "opacities": 0.025}
    rates |= {"scales": 0.005, "quats": 0.001}
    beta1, beta2, sparse = 0.9**2, 0.999**2, config.learn.optimizer_type == "sparse_adam"
    mean = beta1 * moments[0] + (1 - beta1) * gradient
    square = beta2 * moments[1] + (1 - beta2) * gradient**2
    bias1, bias2 = (1.0, 1.0) if sparse else (1 - beta1**step, 1 - beta2**step)
    update = math.sqrt(2) * rates[name] * (mean / bias1) / ((square / bias2).sqrt() + 1e-15 / math.sqrt(2))
    if sparse:
        rows = shown.view(-1, *[1] * (value.dim() - 1))
        update, mean, square = rows * update, torch.where(rows, mean, moments[0]), torch.where(rows, square, moments[1])
    return (value.double() - update).numpy(), (mean, square)


def start(folder, *options):
    """torchrun on a run that would take hours, once it has saved a model; the processes by rank."""
    command = [*TORCHRUN, ROOT / "train.py", "-s", SCENE, "-m", folder, "-r", "8", "--eval", "--iterations", "1000000"]
    run = started(*command, "--save_iterations", "20", "--densify_from_iter", "10000000", *options)
    deadline = time.monotonic() + 120
    while not ply_path(folder, 20).exists() and run.poll() is None and time.monotonic() < deadline:
        time.sleep(0.1)
    children = [child for child in psutil.Process(run.pid).children() if "RANK" in child.environ()]
    return run, {int(child.environ()["RANK"]): child for child in children}


@pytest.mark.parametrize("killed", [pytest.param(0, marks=LONG), pytest.param(1, marks=SLOW)])
def test_when_a_process_is_killed_the_other_saves_and_stops(killed, tmp_path):
    run, ranks = start(tmp_path)
    ranks[killed].kill()
    out, err = run.communicate(timeout=120)  # torchrun waits for 30 s at most
    assert run.returncode != 0
    assert f"Process {1 - killed}: expected an answer from all 2 processes, but one has ended" in err
    assert err.count("warp-splat: error:") == 1 and "warp_splat/" not in err  # no traceback of ours
    saved = list(tmp_path.glob("point_cloud/*/point_cloud.ply"))
    assert all(len(load_ply(path).splats.means) == 4500 for path in saved)
    assert ply_path(tmp_path, 20) in saved and re.search(r"Model after \d+ iterations: (.*)", out)[1] in map(str, saved)
    assert not list(tmp_path.rglob(".tmp-*"))


#: Training in which process 1 fails in step 29 (warming up is the first call); 0 gives up on it after 3 seconds.
FAILING = """
import datetime, os, signal, sys
from warp_splat.runtime import distributed
from warp_splat.training import trainer
from warp_splat.cli import main
loss, calls = trainer.image_loss, []
def failing(*arguments, **options):
    calls.append(0)
    if len(calls) == 30 and os.environ["RANK"] == "1":
        FAIL
    return loss(*arguments, **options)
trainer.image_loss = failing
distributed.PATIENCE = datetime.timedelta(seconds=3)
sys.exit(main(["train", *sys.argv[1:]]))
"""


@pytest.mark.parametrize(
    ("failure", "said"),
    [
        ("raise MemoryError", ["Out of memory on cpu", "Process 0: expected an answer", "but one has ended"]),
        ("os.kill(os.getpid(), signal.SIGSTOP)", ["Process 0: expected an answer", "but one was silent"]),
    ],
)
@pytest.mark.long  # the gate kills one
def test_when_a_process_fails_or_hangs_the_other_saves_and_stops(failure, said, tmp_path):
    script = tmp_path / "failing.py"
    script.write_text(FAILING.replace("FAIL", failure))
    options = ["-s", SCENE, "-m", tmp_path, "-r", "8", "--iterations", "1000000", "--test_iterations"]
    run = python(*TORCHRUN, script, *options, check=False)
    assert run.returncode != 0 and all(words in run.stderr for words in said)
    assert len(load_ply(ply_path(tmp_path, 56)).splats.means) == 4500
    assert str(ply_path(tmp_path, 56)) in run.stdout and "warp_splat/" not in run.stderr


@pytest.mark.slow
def test_ctrl_c_stops_all_after_the_same_step(tmp_path):
    run, _ = start(tmp_path)
    run.send_signal(signal.SIGINT)
    out, err = run.communicate(timeout=120)
    (entry,) = json.loads((tmp_path / "results.json").read_text()).values()
    assert f"Interrupted after {entry['iterations']} iterations" in out and "warp-splat: error" not in err
    assert len(load_ply(ply_path(tmp_path, entry["iterations"])).splats.means) == 4500


#: Training in which process 1 has options of its own.
OTHERS = """
import os, sys
from warp_splat.cli import main
sys.exit(main(["train", *sys.argv[1:], *(OPTIONS if os.environ["RANK"] == "1" else [])]))
"""


@pytest.mark.parametrize(
    ("options", "found"),
    [
        pytest.param(["--seed", "3"], "the same seed as of process 0, 0, got 3", marks=SLOW),
        pytest.param(["--no-shard"], "the same shard as of process 0, True, got False", marks=LONG),
        pytest.param(["-r", "4"], "the same resolution as of process 0, 8, got 4", marks=LONG),
        pytest.param(["--save_iterations", "5"], "the same save_iterations as", marks=LONG),
    ],
)
def test_other_options_of_a_process_are_told_before_the_first_step(options, found, tmp_path):
    """With --shard, models cannot be compared."""
    script = tmp_path / "others.py"
    script.write_text(OTHERS.replace("OPTIONS", str(options)))
    given = ["--shard", "-s", SCENE, "-m", tmp_path / "model", "-r", "8", "--iterations", "20", "--quiet"]
    ends, said = together(2, script, *given)
    assert all(ends) and f"Process 1: expected {found}" in said
    assert not list((tmp_path / "model").rglob("*"))


@pytest.mark.slow
def test_a_whole_run_of_two_processes(tmp_path):
    """The options of test_train.py's short run, and every part that learns; after every densification the models, and
    what the parts learned, are checked to be identical."""
    options = "--eval -r 8 --iterations 59 --densify_from_iter 10 --densification_interval 10 --densify_until_iter 50 "
    options += "--profile 10 --parts sky,exposure,pose,depth,floaters --exposure affine --vignetting "
    options += "--pose_intrinsics focal --opacity_reset_interval 40 --sh_interval 15 --densify_grad_threshold 0.00005"
    options += " --test_iterations 2 38"
    ends, said = together(2, ROOT / "train.py", "-s", SCENE, "-m", tmp_path, *options.split())
    assert ends == [0, 0] and said.count("Done after 60 iterations") == 1 and "all-reduce" in said
    entry = json.loads((tmp_path / "results.json").read_text())["ours_60"]  # 59 rounded up to whole steps
    assert entry["processes"] == 2 and entry["gaussians"] > 4500
    quality = {record["iteration"]: record["psnr"] for record in json.loads((tmp_path / "history.json").read_text())}
    assert max(quality.values()) > quality[min(quality)] + 1


def test_each_view_once_before_any_comes_again(scene):
    """And never twice in a step, where one deck ends and the next begins."""
    count, views = 4, len(scene.train)
    assert views % count != 0
    trainer = Trainer(scene, TrainConfig(device="cpu"), Pretended(0, count))
    steps = [[view.name for view in trainer.deck.deal(count)] for _ in range(3 * views)]
    assert all(len(set(step)) == count for step in steps)
    dealt = [name for step in steps for name in step]
    seen = [dealt[: views * n].count(view.name) for n in (1, 5, 12) for view in scene.train]
    assert {*seen[views * 2 :]} == {12} and all(4 <= times <= 6 for times in seen[views : 2 * views])


def test_more_processes_than_views(scene):
    with pytest.raises(InputError, match=r"--nproc-per-node.*50 training views, got 51"):
        Trainer(scene, TrainConfig(device="cpu"), Pretended(0, 51))


def test_several_views_a_step_in_one_process_are_the_mean_of_their_gradients(scene):
    """Bit for bit those of as many trainers with one view each, summed in the order of the views."""
    config = TrainConfig(device="cpu", random_background=True, parts="floaters", sh_interval=1)
    trainers = [Trainer(scene, config, Pretended(rank, 4)) for rank in range(4)]
    alone = Trainer(scene, config, Processes(images=4))
    for iteration in (4, 8):
        parts, loss = gradients_of_ranks(trainers, iteration), alone.differentiate(iteration)
        for name, found in {"loss": loss, **{key: leaf.grad for key, leaf in alone.model.parameters.items()}}.items():
            expected = (((parts[0][name] + parts[1][name]) + parts[2][name]) + parts[3][name]) / 4
            assert torch.equal(found, expected), (iteration, name)
        assert torch.equal(alone._radii, torch.stack([trainer._radii for trainer in trainers]).amax(0))
        alone.optimizer.zero_grad()


def test_schedules_count_images(scene):
    """For any number of processes: what is due after n images happens in the step that reaches them."""
    for count in (1, 2, 3, 7):
        group = Pretended(0, count)
        ends = range(count, 1000, count)
        due = [-(-mark // count) * count for mark in (100, 550)]
        assert [end for end in ends if group.reaches(end, [100, 550])] == due
    config = TrainConfig(device="cpu", densify_from_iter=50, densification_interval=100, densify_until_iter=700)
    for count in (1, 2, 3, 7):
        densifier, due = Trainer(scene, config, Pretended(0, count)).growth, []
        densifier._densify = lambda prune_large, due=due: due.append(0)
        calls = [(end, len(due)) for end in range(count, 1000, count) if densifier.update(end) is None]
        rises = [end for (end, now), (_, before) in zip(calls[1:], calls, strict=False) if now > before]
        assert rises == [end for mark in range(100, 700, 100) if (end := -(-mark // count) * count) < 700]


def test_without_torchrun_a_process_is_alone(monkeypatch):
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE"):
        monkeypatch.delenv(name, raising=False)
    with join("cpu") as processes:
        assert processes is ALONE
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(InputError, match=r"WORLD_SIZE.*RANK.*torchrun"), join("cpu"):
        pass


def test_errors_of_nccl_are_raised_where_they_happen(monkeypatch):
    """Set before the group is made; without it a thread of NCCL's ends the process, and nobody saves."""
    for name, value in (("RANK", "0"), ("WORLD_SIZE", "2"), ("LOCAL_RANK", "0"), ("LOCAL_WORLD_SIZE", "2")):
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("TORCH_NCCL_BLOCKING_WAIT", "")
    monkeypatch.delenv("TORCH_NCCL_BLOCKING_WAIT")
    for name, value in (("is_available", True), ("device_count", 2), ("set_device", None)):
        monkeypatch.setattr(torch.cuda, name, lambda *_, value=value: value)
    monkeypatch.setattr(torch.distributed, "is_nccl_available", lambda: True)

    def meet(backend, timeout):
        raise RuntimeError(f"{backend} {os.environ['TORCH_NCCL_BLOCKING_WAIT']}")

    monkeypatch.setattr(torch.distributed, "init_process_group", meet)
    with pytest.raises(InputError, match="cuda:nccl 1"), join("cuda"):
        pass


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ("ncclRemoteError: A call failed possibly due to a network error or a remote process exiting", "has ended"),
        ("Watchdog caught collective operation timeout", "was silent"),
    ],
)
def test_what_nccl_says_is_told_as_what_gloo_says(said, told):
    def collective(tensor, operation):
        raise torch.distributed.DistBackendError(said)

    processes = Processes(0, 2)
    with pytest.raises(GroupError, match=told):
        processes._exchange(collective, torch.zeros(1), None)
    assert processes.lost

"""Gaussians in blocks on several processes: every answer is that of the whole, to the bit, and so is the model."""

import math
import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from commands import ROOT, SCENE, together
from hostile import refusal
from scene_files import write_colmap

from warp_splat.cli import main
from warp_splat.errors import InputError
from warp_splat.formats.checkpoint import load_own, save_checkpoint, save_in_blocks
from warp_splat.formats.curve import along_curve, keys_of
from warp_splat.runtime import watch
from warp_splat.runtime.distributed import ALONE, Processes
from warp_splat.runtime.shards import Shards
from warp_splat.scene import load_scene
from warp_splat.training.options import TrainConfig
from warp_splat.training.trainer import Trainer

SCHEDULE = (
    "-r 8 --eval --seed 0 --views 4 --densify_from_iter 10 --densification_interval 20 --opacity_reset_interval 60 "
    "--sh_interval 30 --densify_grad_threshold 0.00005 --test_iterations"
)
GROWTHS = {
    "reference": "--prune_screen_size 40",
    "mcmc": "--growth mcmc --max_gaussians 5500 --optimizer_type sparse_adam",
    "budget": "--growth budget --max_gaussians 6000 --parts sky,exposure,depth,floaters --random_background",
}


class Threads(Shards):
    """Processes that are threads of this one: what each sends lies on a table."""

    def __init__(self, rank, table, barrier):
        super().__init__(rank, len(table))
        self.table, self.barrier = table, barrier

    def _sent(self, value):
        self.table[self.rank] = value
        self.barrier.wait(10)
        found = list(self.table)
        self.barrier.wait(10)
        return found

    def sum(self, tensor):
        tensor.copy_(torch.stack(self._sent(tensor.clone())).sum(0))

    def gather(self, tensor):
        return torch.stack(self._sent(tensor.clone()))

    def first(self, value):
        return self._sent(value)[0]

    def exchange(self, rows):
        return [sent[self.rank].clone() for sent in self._sent(list(rows))]


def of_blocks(question, count):
    """The answers of ``count`` processes."""
    table, barrier = [None] * count, threading.Barrier(count)
    with ThreadPoolExecutor(count) as pool:
        found = [pool.submit(question, Threads(rank, table, barrier)) for rank in range(count)]
        return [one.result() for one in found]


@pytest.mark.parametrize("count", [1, 2, 3, 5])
@pytest.mark.parametrize("levels", [3, 1000])  # many ties, few
def test_answers_are_those_of_the_whole(count, levels):
    rng, whole = np.random.default_rng(count), ALONE
    values = torch.from_numpy(rng.integers(-levels, levels, 101).astype(np.float32) / 7)
    values[5:9] = torch.tensor([0.0, -0.0, torch.inf, -torch.inf])
    for most in (0, 1, 40, 101, 200):
        found = of_blocks(lambda rows, most=most: rows.lowest(values[rows.own(101)], most), count)
        assert torch.equal(torch.cat(found), whole.lowest(values, most))
    points = torch.from_numpy(rng.integers(0, levels, (101, 3)).astype(np.float32))
    for rows in of_blocks(lambda rows: rows.between(points[rows.own(101)], 7), count):
        assert all(map(torch.equal, rows, whole.between(points, 7)))
    weights = rng.uniform(size=101)
    sums = [one for _, one, _ in of_blocks(lambda rows: rows.running_sums(weights[rows.own(101)]), count)]
    assert np.array_equal(np.concatenate(sums), np.cumsum(weights))


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_pieces_are_sorted_and_drawn_for_as_those_of_the_whole(count, monkeypatch):
    """Two pieces of rows, unevenly on the processes: all first ones come before all second ones, at equal keys, too."""
    monkeypatch.setattr("warp_splat.runtime.shards.AT_ONCE", 7)
    rng = np.random.default_rng(count)
    sizes = rng.integers(0, 30, (2, count))
    pieces = [torch.from_numpy(rng.integers(0, 4, (size.sum(), 3)).astype(np.float32)) for size in sizes]
    starts = np.cumsum(sizes, 1) - sizes

    def own(tensors, rank):
        return torch.cat([t[b[rank] : b[rank] + n[rank]] for t, b, n in zip(tensors, starts, sizes, strict=True)])

    def sort(rows):
        numbers = torch.arange(sizes.sum()).split(sizes.sum(1).tolist())
        keys = keys_of(own(pieces, rows.rank), rows)
        return rows.sorting(keys, sizes[:, rows.rank].tolist())(own(numbers, rows.rank))

    found = of_blocks(sort, count)
    assert torch.equal(torch.cat(found), along_curve(torch.cat(pieces)))
    assert max(map(len, found)) - min(map(len, found)) <= 1

    def draw(rows):
        return rows.draw(torch.Generator().manual_seed(5), 100, sizes[:, rows.rank].tolist())

    drawn = ALONE.draw(torch.Generator().manual_seed(5), 100, sizes.sum(1).tolist()).split(sizes.sum(1).tolist())
    for rank, some in enumerate(of_blocks(draw, count)):
        assert torch.equal(some, own(drawn, rank))


def train(folder, count, options):
    """The model of a training by ``count`` processes, of which each holds a block; of one, that holds it all."""
    command = ["train", "-m", str(folder), *options.split()]
    if count > 1:
        ends, said = together(count, ROOT / "train.py", *command[1:], "--shard", "--viewer")
        assert ends == [0] * count, said
    else:
        assert main([*command, "--no-shard"]) == 0
    (model,) = folder.glob("point_cloud/*/point_cloud.ply")
    return model.read_bytes()


@pytest.mark.parametrize(
    ("growth", "counts", "iterations"),
    [
        pytest.param("reference", [2], 80, marks=pytest.mark.slow),
        pytest.param("reference", [3], 80, marks=pytest.mark.long),
        pytest.param("mcmc", [2], 80, marks=pytest.mark.long),
        pytest.param("budget", [3], 80, marks=pytest.mark.long),
        *(pytest.param(growth, [2, 3, 4], 800, marks=pytest.mark.long) for growth in GROWTHS),
    ],
)
def test_the_model_is_the_same_bytes_on_any_number_of_processes(growth, counts, iterations, tmp_path):
    options = f"-s {SCENE} {SCHEDULE} --iterations {iterations} {GROWTHS[growth]}"
    expected = train(tmp_path / "whole", 1, options)
    half = iterations // 2
    for count in counts:
        assert train(tmp_path / str(count), count, f"{options} --checkpoint_iterations {half}") == expected, count
        resume = f"--resume {tmp_path / str(count) / f'chkpnt{half}.safetensors'}"
        assert train(tmp_path / f"resumed{count}", count - 1, resume) == expected, count


@pytest.mark.parametrize(("count", "growth"), [(5, {}), (2, {"growth": "mcmc", "max_gaussians": 5})])
def test_views_may_show_nothing_of_a_process(count, growth, tmp_path):
    """So many Gaussians in three blocks, of which cameras see two; a block may be empty."""
    points = np.array([[0.02, 0.3, -0.7], [0.3, -0.2, 0.1], *np.outer([1e3, 2e3, 3e3], [0.0, 0.0, -1.0])])[:count]
    scene = load_scene(write_colmap(tmp_path / "scene", points=points), report=str)
    schedule = {"iterations": 12, "densify_from_iter": 3, "densification_interval": 3}
    config = TrainConfig(device="cpu", views=3, **schedule, **growth)

    def train(processes):
        processes.images = 3
        trainer = Trainer(scene, config, processes)
        for iteration in (3, 6, 9, 12):
            trainer.advance(iteration)
        trainer.lead(lambda: trainer.save(tmp_path / f"{processes.count}.ply"))

    train(Processes())
    for count in (2, 3):  # processes
        of_blocks(train, count)
        assert (tmp_path / f"{count}.ply").read_bytes() == (tmp_path / "1.ply").read_bytes()


def test_blocks_are_a_checkpoint_of_any_number_of_processes(tmp_path):
    """Also where they are written anew, and one of the others fails: the one before stays."""
    rng, path = np.random.default_rng(0), tmp_path / "checkpoint.safetensors"
    rows = {"parameters.means": (10, 3), "radii": (10,), "statistics.views": (1, 10), "losses": (4,)}
    arrays = {name: rng.uniform(size=shape).astype(np.float32) for name, shape in rows.items()}

    def part(rows):
        own = {n: a[..., rows.own(10)] if n[0] == "s" else a[rows.own(10)] for n, a in arrays.items()}
        return {**own, "losses": arrays["losses"]}

    def check():
        for count in (1, 2, 4):
            for rows in [ALONE] if count == 1 else [Shards(rank, count) for rank in range(count)]:
                found, expected = load_own(tmp_path, rows).arrays, part(rows)
                assert found.keys() == expected.keys()
                assert all(np.array_equal(found[name], array) for name, array in expected.items())

    def save(iteration):
        return lambda rows: save_in_blocks(rows, path, part(rows), {"iteration": iteration})

    save_checkpoint(path, arrays, {"iteration": 1})
    check()
    for iteration, count in ((2, 11), (2, 3), (3, 2)):  # of eleven, one is empty
        of_blocks(save(iteration), count)
        assert len(list(tmp_path.glob("*"))) == 1 + count  # the older ones are gone
        check()
    refusal(lambda: load_own(path, Shards(0, 11)), "one of 10 Gaussians, fewer than there are processes")
    (tmp_path / "checkpoint-4-1-of-2.safetensors").mkdir()
    refusal(lambda: of_blocks(save(4), 2), "process 1 could not write its block")
    assert load_own(path, ALONE).facts["iteration"] == 3
    check()
    (tmp_path / "checkpoint-3-1-of-2.safetensors").write_bytes(b"")
    refusal(lambda: load_own(path, ALONE), match=r"checkpoint-3-1-of-2.*damaged")
    (tmp_path / "checkpoint-3-1-of-2.mine.safetensors").write_bytes(b"")
    save_checkpoint(path, arrays, {"iteration": 5})
    left = {found.name for found in tmp_path.iterdir() if found.is_file()}
    assert left == {path.name, "checkpoint-3-1-of-2.mine.safetensors"}


@pytest.mark.parametrize("options", [{"half_moments": True}, {"parts": "pose"}])
def test_what_needs_whole_models_is_refused(options, scene):
    with pytest.raises(InputError, match="--shard: expected a training without --"):
        Trainer(scene, TrainConfig(device="cpu", **options), Shards(0, 1))


def test_a_process_that_hangs_beside_this_one_is_killed(monkeypatch):
    """And none that has another parent: its number is that of another machine."""
    one = watch.Watch(0, 2, None, math.inf)
    hung = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    try:
        hung.send_signal(signal.SIGSTOP)
        for rank, sign in enumerate((b"", f"{hung.pid} 7".encode())):
            one.signs[rank] = sign
            one.kill(rank)
        assert hung.poll() is None
        monkeypatch.setattr(os, "getppid", os.getpid)
        one.kill(1)
        assert hung.wait(10) == -signal.SIGKILL
    finally:
        hung.kill()


@pytest.mark.slow
def test_a_process_without_signs_is_named(monkeypatch):
    """Of three, the last leaves no sign, and the second one has left as it should."""
    monkeypatch.setattr(watch, "GONE", 1.5)
    store = torch.distributed.HashStore()
    for name, sign in {"sign/0": "0", "sign/1": watch.LEFT, "sign/2": "5"}.items():
        store.set(name, sign)
    one = watch.Watch(0, 3, store, math.inf)
    threads = [threading.Thread(target=run, daemon=True) for run in (one.look, one.judge)]
    for thread in threads:
        thread.start()
    assert one.silent() == [2]
    one.stopped.set()
    for thread in threads:
        thread.join(5)


def test_an_error_of_all_processes_of_a_machine_is_told_once(monkeypatch, capsys):
    """Two machines with two processes each; that of one process alone is told, too."""
    store, said = torch.distributed.HashStore(), []
    monkeypatch.setattr(torch.distributed.distributed_c10d, "_get_default_store", lambda: store)
    for rank in range(4):
        monkeypatch.setenv("GROUP_RANK", str(rank // 2))
        error = OSError(28, "No space left", "model") if rank == 3 else InputError("scene: expected a folder.")
        with pytest.raises(SystemExit, match="1"), watch.watching(rank, 4, ends=True):
            raise error
        said.append(capsys.readouterr().err)
    scene = "warp-splat: error: scene: expected a folder.\n"
    assert said == [scene, "", scene, "warp-splat: error: model: No space left.\n"]

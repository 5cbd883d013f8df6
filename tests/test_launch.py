"""Launches: one on a GPU, blocks of threads where they are made of fibers, memory that torch owns."""

import gc
import subprocess
import sys
import weakref

import numpy as np
import pytest
import torch
import warp as wp

from warp_splat.runtime import launch, pool

DEVICES = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]


@wp.kernel
def add_index(first: int, values: wp.array[float], sums_out: wp.array[float]):
    i = first + wp.tid()
    sums_out[i] = values[i] + float(i)


@pytest.mark.parametrize("device", DEVICES)
def test_every_index_once(device):
    values, sums = torch.rand(5000, device=device), torch.zeros(5000, device=device)
    for bounds in (None, [0, 1, 1, 4000, 5000]):
        launch.launch(
            add_index,
            5000,
            [launch.view(values, wp.float32)],
            [launch.view(sums, wp.float32)],
            bounds=bounds,
            device=device,
        )
        assert torch.equal(sums, values + torch.arange(5000.0, device=device))


FIRST_LAUNCH = """
import torch, warp as wp
from warp_splat.runtime import launch

def stream_from_torch(stream):
    assert wp._src.context.runtime is not None, "Warp is not initialized"

wp.stream_from_torch = stream_from_torch
torch.cuda.current_stream = lambda device: "stream"
launch._stream("cuda")
"""
FIRST_ARRAY = 'from warp_splat.runtime import launch; launch.empty(3, float, "cpu")'


@pytest.mark.parametrize("code", [FIRST_LAUNCH, FIRST_ARRAY])
def test_the_first_call_of_a_process_finds_warp_initialized(code):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_gpu_gets_one_launch_on_the_stream_of_torch(monkeypatch):
    calls = []
    monkeypatch.setattr(launch, "_stream", lambda device: f"stream of {device}")
    monkeypatch.setattr(wp, "launch", lambda kernel, **options: calls.append(options))
    monkeypatch.setattr(wp, "launch_tiled", lambda kernel, **options: calls.append(options))
    launch.launch(add_index, 9000, ["in"], ["out"], bounds=[0, 4000, 9000], device=torch.device("cuda", 1))
    launch.launch(add_index, 7, ["in"], ["out"], device="cuda", adj_inputs=["grad"], adj_outputs=["up"])
    launch.launch_blocks(add_index, 12, ["in"], ["out"], torch.device("cuda", 1))
    launch.launch(add_index, 0, ["in"], ["out"], device="cuda")
    launch.launch_blocks(add_index, 0, ["in"], ["out"], "cuda")
    assert not any(options.pop("record_tape") for options in calls)
    whole, adjoint, blocks = calls
    assert whole == {"dim": 9000, "inputs": [0, "in"], "outputs": ["out"], "stream": "stream of cuda:1"}
    assert adjoint["adjoint"] and adjoint["adj_inputs"] == [None, "grad"] and adjoint["adj_outputs"] == ["up"]
    assert blocks == {"dim": [12], "inputs": ["in"], "outputs": ["out"], "block_dim": 256, "stream": "stream of cuda:1"}


def test_helpers_keep_nothing_alive():
    """What they worked on last goes when the caller lets it go, though they know of the next job only when it comes."""
    threads = pool.get_threads()
    pool.set_threads(4)
    try:
        for _ in range(20):
            tensor = torch.zeros(64)
            pool.in_slices(lambda low, high, tensor=tensor: tensor[low:high].add_(1.0), list(range(65)))
            assert (tensor == 1.0).all()
            alive = weakref.ref(tensor)
            del tensor
            assert alive() is None
    finally:
        pool.set_threads(threads)


@pytest.mark.parametrize("device", DEVICES)
def test_blocks_of_threads(device, monkeypatch):
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)

    @wp.kernel(module="unique", module_options={"enable_backward": False, "block_dim": 256})
    def total(values: wp.array[float], sums_out: wp.array[float]):
        block, thread = wp.tid()
        value = values[block * 256 + thread] + 0.0
        wp.tile_store(sums_out, wp.tile_sum(wp.tile(value)), offset=block)

    values, sums = torch.arange(3 * 256.0, device=device), torch.zeros(3, device=device)
    launch.launch_blocks(total, 3, [launch.view(values, wp.float32)], [launch.view(sums, wp.float32)], device)
    assert torch.equal(sums, values.view(3, 256).sum(1))


@pytest.mark.parametrize("device", DEVICES)
def test_memory_lives_as_long_as_its_array(device):
    array = launch.empty(1000, wp.vec3, device)
    array.fill_(7.0)
    gc.collect()
    others = [torch.zeros(3000, device=device) for _ in range(20)]
    assert array.shape == (1000,) and array.dtype == wp.vec3 and len(others) == 20
    assert (array.numpy() == np.float32(7)).all()
    assert launch.empty(0, wp.vec3, device).shape == (0,)

"""Devices and launches: which is chosen and why one is refused, the self-test, blocks of fibers, memory of torch's."""

import gc
import weakref

import numpy as np
import pytest
import torch
import warp as wp
from commands import python
from hostile import refusal

from warp_splat import InputError
from warp_splat.config import ADJOINTS
from warp_splat.raster import bin, drivers, selftest
from warp_splat.raster.drivers import CPU
from warp_splat.runtime import devices, launch, pool

HOST = torch.device("cpu")


def machine(monkeypatch, built="13.2", toolkit=(13, 4), driver=(13, 4), available=True, error=None):
    """Pretend: what torch and Warp were built for, the driver's version, whether it shows a GPU, what that answers."""

    def zeros(*arguments, **options):
        if error is not None:
            raise error
        return torch.ones(1)

    monkeypatch.setattr(torch.version, "cuda", built)
    monkeypatch.setattr(wp, "get_cuda_toolkit_version", lambda: toolkit)
    monkeypatch.setattr(wp, "get_cuda_driver_version", lambda: driver)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: available)
    monkeypatch.setattr(wp, "is_cuda_available", lambda: available)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    monkeypatch.setattr(torch, "zeros", zeros)


@pytest.mark.parametrize(
    ("found", "words"),
    [
        ({"built": None}, ("torch", torch.__version__, "without CUDA", "install")),
        ({"toolkit": None}, ("Warp", wp.__version__, "without CUDA", "install")),
        ({"driver": None}, ("no NVIDIA driver", "CUDA 13.2", "CUDA 13.4", "install")),
        ({"driver": (11, 4), "available": False}, ("too old", "11.4", "13.2", "13.4", "update")),
        ({"available": False}, ("shows no GPU", "nvidia-smi", "CUDA_VISIBLE_DEVICES")),
        ({"error": torch.OutOfMemoryError("CUDA out of memory.")}, ("memory is full", "nvidia-smi")),
        ({"error": RuntimeError("no kernel image is available\nmore")}, ("no kernel image is available)", "update")),
    ],
)
def test_why_a_gpu_cannot_be_used_and_what_to_do(found, words, monkeypatch):
    machine(monkeypatch, **found)
    message = refusal(lambda: launch.prepare("cuda", 0), *words)
    assert message.startswith("--device cuda: ") and message.endswith(", or use --device cpu.")
    assert launch.prepare("auto", 0) == HOST


def test_a_gpu_that_answers_is_chosen(monkeypatch):
    machine(monkeypatch)
    assert devices.choose_device("auto") == devices.choose_device("cuda") == torch.device("cuda", 1)
    assert devices.choose_device("cpu") == HOST


def test_memory_that_can_be_had():
    assert launch.available_memory(HOST) > 2**20


@pytest.mark.parametrize("adjoint", ADJOINTS)
def test_self_test(adjoint, device):
    selftest.check_device(torch.device(device), adjoint)


def test_kernels_that_do_nothing_are_found(monkeypatch):
    monkeypatch.setattr(drivers, "bind", lambda *arguments, **options: lambda low, high: None)
    monkeypatch.setattr(torch, "empty", torch.zeros)
    monkeypatch.setattr(torch.Tensor, "new_empty", torch.Tensor.new_zeros)
    refusal(lambda: selftest.check_device(HOST), match=r"cpu: the self-test expected 0\.\d+ as a pixel and found 0: ")


def test_a_gpu_that_fails_gives_way_only_if_nobody_named_it(monkeypatch):
    monkeypatch.setattr(selftest, "check_device", failing(InputError("wrong.")))
    said = []
    monkeypatch.setattr(selftest, "prepare", lambda requested, threads: torch.device("cuda"))
    assert selftest.settle_device("auto", 0, say=said.append) == HOST
    assert "wrong. Going on with the CPU." in said[-1]
    refusal(lambda: selftest.settle_device("cuda", 0, say=said.append))
    monkeypatch.setattr(selftest, "check_device", lambda device, adjoint: None)
    assert selftest.settle_device("auto", 0, say=said.append).type == "cuda"
    monkeypatch.undo()
    assert selftest.settle_device("cpu", 0, say=said.append) == HOST


def failing(error):
    def fail(*arguments):
        raise error

    return fail


def scaled(factor, right=CPU.adjoint):
    def wrong(*arguments):
        slots, adj_background, bad = right(*arguments)
        return factor * slots, adj_background, bad

    return wrong


@pytest.mark.parametrize(
    ("change", "message"),
    [
        *(({"adjoint": scaled(f)}, r"self-test expected \S+ as a gradient") for f in (0.0, 1.001, float("nan"))),
        ({"blend": failing(RuntimeError("CUDA error 700\nmore"))}, r"CUDA error 700\).* or use another device"),
        ({"blend": failing(torch.OutOfMemoryError("x"))}, "not enough memory.* or use another device"),
    ],
)
def test_kernels_that_err_or_cannot_run_are_explained(change, message, monkeypatch):
    for name, function in change.items():
        monkeypatch.setattr(CPU, name, function)
    refusal(lambda: selftest.check_device(HOST), match=f"--device cpu: .*{message}")


def test_lists_that_round_otherwise_when_they_are_written_are_found(monkeypatch):
    def differ(*arguments):
        counts, again = bin.count_twice(*arguments)
        assert torch.equal(counts, again) and counts.max() > 100 and (counts > 0).sum() > 10_000
        again[12_345] += 1
        return counts, again

    monkeypatch.setattr(selftest, "count_twice", differ)
    refusal(lambda: selftest.check_device(HOST), match=r"self-test expected \d+ as a number of tiles and found \d+")


@wp.kernel
def add_index(first: int, values: wp.array[float], sums_out: wp.array[float]):
    i = first + wp.tid()
    sums_out[i] = values[i] + float(i)


def test_every_index_once(device):
    values, sums = torch.rand(5000, device=device), torch.zeros(5000, device=device)
    given = [[launch.view(tensor, wp.float32)] for tensor in (values, sums)]
    for bounds in (None, [0, 1, 1, 4000, 5000]):
        launch.launch(add_index, 5000, *given, bounds=bounds, device=device)
        assert torch.equal(sums, values + torch.arange(5000.0, device=device))


@pytest.mark.parametrize("values", [wp.float64, wp.vec2])
def test_each_launch_is_checked_as_the_first(values):
    """What Warp found out once does not let an array of another type through."""
    right, sums = (wp.zeros(10, dtype=wp.float32, device="cpu") for _ in range(2))
    launch.launch(add_index, 10, [right], [sums])
    with pytest.raises(RuntimeError, match="expects an array with dtype"):
        launch.launch(add_index, 10, [wp.zeros(10, dtype=values, device="cpu")], [sums])
    assert sums.numpy().tolist() == list(range(10))


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


@pytest.mark.parametrize("code", [FIRST_LAUNCH, pytest.param(FIRST_ARRAY, marks=pytest.mark.slow)])
def test_the_first_call_of_a_process_finds_warp_initialized(code):
    python("-c", code)


def test_a_gpu_gets_one_launch_on_the_stream_of_torch(monkeypatch):
    calls = []
    monkeypatch.setattr(launch, "_stream", lambda device: f"stream of {device}")
    named = lambda dim, inputs, outputs, **more: {"dim": dim, "inputs": inputs, "outputs": outputs, **more}  # noqa: E731
    monkeypatch.setattr(wp, "launch", lambda kernel, *given, **more: calls.append(named(*given, **more)))
    monkeypatch.setattr(wp, "launch_tiled", lambda kernel, **options: calls.append(options))
    launch.launch(add_index, 9000, ["in"], ["out"], bounds=[0, 4000, 9000], device=torch.device("cuda", 1))
    launch.launch(add_index, 7, ["in"], ["out"], device="cuda", adj_inputs=["grad"], adj_outputs=["up"])
    launch.launch_blocks(add_index, 12, ["in"], ["out"], torch.device("cuda", 1))
    launch.launch(add_index, 0, ["in"], ["out"], device="cuda")
    launch.launch_blocks(add_index, 0, ["in"], ["out"], "cuda")
    assert not any(options.pop("record_tape") for options in calls)
    whole, adjoint, blocks = calls
    assert not blocks.pop("adjoint")
    assert whole == {"dim": 9000, "inputs": [0, "in"], "outputs": ["out"], "stream": "stream of cuda:1"}
    assert adjoint["adjoint"] and adjoint["adj_inputs"] == [None, "grad"] and adjoint["adj_outputs"] == ["up"]
    assert blocks == {"dim": [12], "inputs": ["in"], "outputs": ["out"], "block_dim": 256, "stream": "stream of cuda:1"}


def test_helpers_keep_nothing_alive(threads):
    """What they worked on last goes when the caller lets it go, though they know of the next job only when it comes."""
    threads(4)
    for _ in range(20):
        tensor = torch.zeros(64)
        pool.in_slices(lambda low, high, tensor=tensor: tensor[low:high].add_(1.0), list(range(65)))
        assert (tensor == 1.0).all()
        alive = weakref.ref(tensor)
        del tensor
        assert alive() is None


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


def test_memory_lives_as_long_as_its_array(device):
    array = launch.empty(1000, wp.vec3, device)
    array.fill_(7.0)
    gc.collect()
    others = [torch.zeros(3000, device=device) for _ in range(20)]
    assert array.shape == (1000,) and array.dtype == wp.vec3 and len(others) == 20
    assert (array.numpy() == np.float32(7)).all()
    assert launch.empty(0, wp.vec3, device).shape == (0,)

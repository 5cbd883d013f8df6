"""Which device is chosen, why a GPU is refused, and a self-test that finds one that computes nothing, or wrongly."""

import pytest
import torch
import warp as wp

from warp_splat import InputError
from warp_splat.config import ADJOINTS
from warp_splat.raster import bin, drivers, selftest
from warp_splat.raster.drivers import CPU
from warp_splat.runtime import devices, launch

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
    with pytest.raises(InputError) as error:
        launch.prepare("cuda", 0)
    message = str(error.value)
    assert message.startswith("--device cuda: ") and message.endswith(", or use --device cpu.")
    assert all(word in message for word in words) and "\n" not in message
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
    monkeypatch.setattr(drivers, "launch", lambda *arguments, **options: None)
    monkeypatch.setattr(torch, "empty", torch.zeros)
    monkeypatch.setattr(torch.Tensor, "new_empty", torch.Tensor.new_zeros)
    with pytest.raises(InputError, match=r"--device cpu: the self-test expected 0\.\d+ as a pixel and found 0: "):
        selftest.check_device(HOST)


def test_a_gpu_that_fails_gives_way_only_if_nobody_named_it(monkeypatch):
    def fail(device, adjoint):
        raise InputError("wrong.")

    monkeypatch.setattr(selftest, "check_device", fail)
    said = []
    assert selftest.settle_device(torch.device("cuda"), "auto", say=said.append) == HOST
    assert "wrong. Going on with the CPU." in said[-1]
    with pytest.raises(InputError):
        selftest.settle_device(torch.device("cuda"), "cuda", say=said.append)
    assert selftest.settle_device(HOST, "cpu", say=said.append) == HOST
    monkeypatch.setattr(selftest, "check_device", lambda device, adjoint: None)
    assert selftest.settle_device(torch.device("cuda"), "auto", say=said.append).type == "cuda"


@pytest.mark.parametrize("factor", [0.0, 1.001, float("nan")])
def test_a_wrong_gradient_is_found(factor, monkeypatch):
    right = CPU.adjoint

    def wrong(*arguments):
        slots, adj_background, bad = right(*arguments)
        return factor * slots, adj_background, bad

    monkeypatch.setattr(CPU, "adjoint", wrong)
    with pytest.raises(InputError, match=r"self-test expected \S+ as a gradient"):
        selftest.check_device(HOST)


def test_lists_that_round_otherwise_when_they_are_written_are_found(monkeypatch):
    def differ(*arguments):
        counts, again = bin.count_twice(*arguments)
        assert torch.equal(counts, again) and counts.max() > 100 and (counts > 0).sum() > 10_000
        again[12_345] += 1
        return counts, again

    monkeypatch.setattr(selftest, "count_twice", differ)
    with pytest.raises(InputError, match=r"self-test expected \d+ as a number of tiles and found \d+"):
        selftest.check_device(HOST)


@pytest.mark.parametrize(
    ("error", "words"),
    [(RuntimeError("CUDA error 700\nmore"), r"CUDA error 700\)"), (torch.OutOfMemoryError("x"), "not enough memory")],
)
def test_kernels_that_cannot_run_are_explained(error, words, monkeypatch):
    def fail(*arguments):
        raise error

    expected = pytest.raises(InputError, match=f"--device cpu: .*{words}.* or use another device")
    monkeypatch.setattr(CPU, "blend", fail)
    with expected:
        selftest.check_device(HOST)

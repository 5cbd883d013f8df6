"""What ``benchmarks/gpu.py`` measures is right, as far as a machine without a GPU can tell: its kernels in fibers."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import warp as wp

from warp_splat import RasterOptions
from warp_splat.config import ADJOINTS
from warp_splat.errors import InputError
from warp_splat.gsplat import rasterization
from warp_splat.raster.api import render
from warp_splat.raster.blend import Blending, blend
from warp_splat.raster.data import Gaussians, Splats2D
from warp_splat.raster.drivers import CPU, CUDA, using
from warp_splat.raster.project import project

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))

import gpu  # noqa: E402
import gpu_blends  # noqa: E402
import gpu_results  # noqa: E402
import gpu_training  # noqa: E402
import made_up  # noqa: E402


@pytest.fixture
def fibers(monkeypatch):
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)


def test_atomics_and_slots_give_the_gradients_of_the_product(fibers):
    """Against autograd through the CPU's driver, which shares no kernel with them."""
    gaussians = Gaussians(*(tensor.detach() for tensor in made_up.make_gaussians(3000, "cpu").activated()))
    camera = made_up.cameras(60, 40, 1)[0]
    blends = gpu_blends.Blends(gaussians, camera)
    blends.into_slots()
    found = {"slots": blends.gather(), "atomics": blends.by_gaussian(blends.by_atomics()).split([2, 3, 1, 3], 1)}
    splats, options = project(gaussians, camera, RasterOptions()), RasterOptions()
    leaves = [tensor.detach().requires_grad_() for tensor in splats[:4]]
    splats = Splats2D(*leaves, *splats[4:])
    image = blend(splats, torch.zeros(3), Blending(CPU.bin(splats, camera, options), camera, options, CPU)).image
    expected = torch.autograd.grad(image.sum(), leaves)
    assert (blends.image - image).abs().max() < 1e-6 and len(blends.slots) > 1500
    for way, gradients in found.items():
        for gradient, exact in zip(gradients, expected, strict=True):
            assert (gradient.reshape(exact.shape) - exact).norm() < 1e-5 * exact.norm(), way


def test_operations_of_the_card_are_counted_as_they_are_done():
    values = torch.zeros(3, 4)
    arguments = [gpu_blends.view(values, wp.vec4)]
    gpu_blends.launch(gpu_blends.multiply_add, 3, [2, 1.0], arguments)
    assert (values == 2 * gpu_blends.UNROLLED).all() and values.shape[1] == gpu_blends.CHAINS


def test_trainer_of_the_benchmark_trains():
    trainer = made_up.make_trainer(500, 64, 48, "cpu")
    before = {name: tensor.detach().clone() for name, tensor in trainer.model.parameters.items()}
    for iteration in range(10, 13):
        trainer.differentiate(iteration)
        trainer.update(iteration)
    assert len(trainer.model) == 500 and trainer.degree == 3 and int(trainer.growth.views.max()) == 3
    assert all((trainer.model.parameters[name] != tensor).any() for name, tensor in before.items())


@pytest.mark.slow
@pytest.mark.parametrize("kinds", [(), ("linear",), ("composited",)])
def test_steps_of_training_are_those_of_the_cpu(kinds):
    """Loss and gradients of three steps, from the photographs to Adam, by the driver of a GPU in fibers."""
    found = []
    for driver in (CPU, CUDA):
        with using(driver):
            trainer = made_up.make_trainer(500, 64, 48, "cpu", kinds)
            for iteration in range(10, 13):
                loss = trainer.differentiate(iteration)
                gradients = {name: leaf.grad.clone() for name, leaf in trainer.model.parameters.items()}
                trainer.update(iteration)
        found.append((loss, gradients))
    (loss, gradients), (other, others) = found
    assert abs(other - loss) < 1e-6
    for name, gradient in gradients.items():
        assert (others[name] - gradient).norm() < 1e-5 * gradient.norm(), name


def test_rows_survive_what_comes_after_them(tmp_path, capsys):
    results = gpu.Results(tmp_path, "cpu", seconds=60)

    def fail(error):
        raise error

    results.attempt("orbit", lambda: results.add("Orbit", [("9 x 9", 5, "none", "7.0")]), needs=1)
    results.attempt("much", lambda: fail(torch.OutOfMemoryError("CUDA out of memory.\nmore")), needs=1)
    results.attempt("stored", lambda: fail(InputError("too large.")), needs=1)
    results.attempt("long", lambda: fail(AssertionError("was run")), needs=61)
    with pytest.raises(RuntimeError, match="illegal address"):
        results.attempt("wrong", lambda: fail(RuntimeError("illegal address")), needs=1)
    tables = json.loads((tmp_path / "gpu.json").read_text())["tables"]
    assert tables["Orbit"] == [{"size": "9 x 9", "Gaussians": 5, "loop cap": "none", "frames per second": "7.0"}]
    why = {row["what"]: row["why"] for row in tables["Left out"]}
    assert why == {"much": "CUDA out of memory.", "stored": "too large.", "long": "no time left"}
    assert "| 9 x 9 |" in (tmp_path / "gpu.md").read_text()


@pytest.mark.parametrize("wrong", [None, "image", "sh"])
def test_a_device_that_errs_is_found(wrong):
    case = (300, 40, 30)
    expected = gpu.expectation(None, case)
    if wrong:
        expected[wrong] = expected[wrong] * 1.001
    results = gpu.Results(None, "cpu", seconds=60)
    gpu.check(results, "cpu", case, expected)
    assert len(results.tables["Checks"]) == 4 * (1 + len(gpu.NAMES))
    assert results.wrong == [f"{mode}: {wrong} against the CPU" for mode in ADJOINTS if wrong]
    assert sum(found.startswith("WRONG") for _, found in results.tables["Checks"]) == len(results.wrong)


def test_an_attempt_in_a_process_of_its_own_ends_no_other():
    program = 'import sys; print(\'rows: ["Checks", [["this", "WRONG: 1"]]]\'); sys.exit(\'illegal address\')'
    results = gpu.Results(None, "cpu", seconds=60, apart=[sys.executable, "-c", program])
    results.attempt("that", lambda: pytest.fail("was run here"), needs=1)
    assert results.tables["Checks"] == [["this", "WRONG: 1"], ("that", "WRONG: illegal address")]
    assert results.wrong == ["this", "that"]


def test_what_is_stored_is_what_the_cpu_says():
    stored, found = gpu.expectation(gpu.EXPECTED, gpu.STORED), gpu.expectation(None, gpu.STORED)
    for name, tensor in stored.items():
        assert (tensor - found[name]).norm() < 1e-5 * tensor.norm(), name


def test_gsplat_gets_the_same_scene(monkeypatch):
    """By our function of the same arguments, in its place: the same image."""
    images = []

    def spying(*arguments, **options):
        found = rasterization(*arguments, **options)
        images.append(found[0].detach()[0])
        return found

    monkeypatch.setattr(gpu_training, "_gsplat", lambda device: spying)
    rows = gpu_training.measure_gsplat(500, 64, 40, "cpu", 1)
    assert [row[2] for row in rows] == ["ours", "gsplat"]
    gaussians = Gaussians(*(tensor.detach() for tensor in made_up.make_gaussians(500, "cpu").activated()))
    expected = render(gaussians, made_up.cameras(64, 40, 1)[0], torch.zeros(3), RasterOptions()).image
    assert (images[0] - expected).abs().max() < 0.02 and expected.max() > 0.5  # alpha is clamped to another value


def test_lines_of_ncu():
    names = ",".join(f'"{name}"' for name in ("ID", "Kernel Name", *gpu_training.METRICS))
    lines = ["==PROF== x", names, '"","","ns","%","%","%"', '"0","short","1,500","1.0","2.0","3.0"',
             '"1","long","2,000,000","50.4","9.6","25.0"']  # fmt: skip
    rows = gpu_training.rows_of_ncu("\n".join(lines))
    assert rows == [["long", "2.000", "50", "10", "25"], ["short", "0.002", "1", "2", "3"]]
    assert gpu_training.rows_of_ncu("nothing") == []


@pytest.mark.slow
def test_dry_run(tmp_path):
    command = [sys.executable, ROOT / "benchmarks/gpu.py", "--device", "cpu", "--out", tmp_path]
    subprocess.run(command, check=True, capture_output=True)
    tables = json.loads((tmp_path / "gpu.json").read_text())["tables"]
    assert set(tables) == set(gpu_results.HEADERS) - {"Left out", "Kernels of a step", "Kernels by ncu"}
    assert {row["size"] for row in tables["Training step"]} == {"64 x 64", "98 x 54", "192 x 108"}

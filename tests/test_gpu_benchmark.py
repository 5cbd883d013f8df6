"""What ``benchmarks/gpu.py`` and ``gpu_model.py`` measure and count is right, as far as the CPU can tell: in fibers."""

import json
import sys

import gpu
import gpu_blends
import gpu_counts
import gpu_model
import gpu_results
import gpu_training
import made_up
import numpy as np
import pytest
import torch
import warp as wp
from commands import ROOT, python
from common import using
from gpu_counts import LAUNCHES, OPERATIONS, REST, WAITS
from made_up import cameras, make_gaussians

from warp_splat import RasterOptions
from warp_splat.config import ADJOINTS
from warp_splat.errors import InputError
from warp_splat.gsplat import rasterization
from warp_splat.raster.api import render
from warp_splat.raster.blend import Blending, blend
from warp_splat.raster.data import Gaussians, Splats2D
from warp_splat.raster.drivers import CPU, CUDA
from warp_splat.raster.project import project

PRETENDING = {"cuda": f"{ROOT / 'tests/pretend_cuda'}:{ROOT}", "cpu": str(ROOT)}


def test_atomics_and_slots_give_the_gradients_of_the_product(monkeypatch):
    """Against autograd through the CPU's driver, which shares no kernel with them."""
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
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
    gpu_blends.launch(gpu_blends.multiply_add, 3, [2, 1.0], [values])
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


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_a_program_that_fails_says_so_in_its_last_line(stream, capsys):
    results, code = gpu.Results(None, "cpu", seconds=60), f"import sys; print('FAILED a\\n1 failed', file=sys.{stream})"
    gpu.run_checked(results, "tests", [sys.executable, "-c", f"{code}; raise SystemExit(1)"])
    assert results.tables == {"Checks": [("tests", "WRONG: 1 failed")]} and "FAILED a" in capsys.readouterr().out


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
    assert results.wrong == [f"{mode}: {wrong} against the CPU, 300 Gaussians" for mode in ADJOINTS if wrong]
    assert sum(found.startswith("WRONG") for _, found in results.tables["Checks"]) == len(results.wrong)


def test_an_attempt_in_a_process_of_its_own_ends_no_other():
    program = 'import sys; print(\'rows: ["Checks", [["this", "WRONG: 1"]]]\'); sys.exit(\'illegal address\')'
    results = gpu.Results(None, "cpu", seconds=60, apart=[sys.executable, "-c", program])
    results.attempt("that", lambda: pytest.fail("was run here"), needs=1)
    assert results.tables["Checks"] == [["this", "WRONG: 1"], ("that", "WRONG: illegal address")]
    assert results.wrong == ["this", "that"]
    end = [sys.executable, "-c", "raise SystemExit('illegal address')"]
    results.attempt("tests", lambda: gpu.run_checked(results, "tests", end), needs=1, starts=True)
    assert results.tables["Checks"][2:] == [("tests", "WRONG: illegal address")]


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
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.long)])
def test_dry_run(device, tmp_path):
    """All of it, at small sizes: on a GPU that is pretended, or with its kernels in fibers."""
    python("benchmarks/gpu.py", "--device", device, "--dry", "--out", tmp_path, path=PRETENDING[device])
    found = json.loads((tmp_path / "gpu.json").read_text())
    tables = found["tables"]
    assert set(tables) == set(gpu_results.HEADERS) - {"Left out", "Kernels of a step", "Kernels by ncu"} or (
        device == "cuda" and {row["what"] for row in tables["Left out"]} == {*gpu.TOOLS}
    )
    assert {row["size"] for row in tables["Training step"]} == {"64 x 64", "98 x 54", "192 x 108"}
    assert next(iter(tables)) == "Checks" and tables["Checks"][0]["check"] == "first call"
    assert all(0 < float(row["share"].split()[0]) for row in tables["Longest tile"])
    assert f"torch {torch.__version__} (CUDA {torch.version.cuda})" in found["where"] and "driver" in found["where"]


@pytest.mark.slow
def test_operations_and_waits():
    counts, x = gpu_counts.np.zeros(3), torch.arange(12.0).view(3, 4)
    with gpu_counts.Operations(counts):
        x[1:].T + x[:2].T.expand(4, 2)
    assert counts[[OPERATIONS, WAITS]].tolist() == [1, 0]
    for waits in (lambda: x.sum().item(), lambda: x[x > 3], lambda: int(x[0, 0]), x.nonzero):
        before = counts[WAITS]
        with gpu_counts.Operations(counts):
            waits()
        assert counts[WAITS] > before


def test_lines_of_pixels():
    """Of blocks of 4 x 4, block by block, to lines of 16."""
    tile = torch.arange(256.0).view(16, 16)
    blocks = tile.view(4, 4, 4, 4).permute(0, 2, 1, 3).reshape(1, 16, 16)
    assert torch.equal(gpu_counts.in_lines(blocks).view(16, 16), tile)


def test_scene():
    """A warp that blends has a pixel or 32 that do; what is walked is listed; and the same as by torch."""
    scene = gpu_counts.count_scene(make_gaussians(2000, "cpu"), cameras(80, 48, 1)[0])
    assert scene.tiles == 15 and scene.pixels == 80 * 48 and scene.gaussians == 2000
    assert 0 < scene.walked <= scene.instances and scene.warps <= scene.pairs <= 32 * scene.warps
    assert scene.warps <= 8 * scene.walked and scene.blocks <= 8 * scene.walked
    assert scene.pairs <= 32 * scene.blocks  # they hold every pixel that is blended into
    assert scene.halves <= min(2 * scene.walked, scene.blocks) and scene.blocks <= 4 * scene.halves


NO_TILES = np.zeros((0, 3))


def test_a_card_of_twice_the_rates_takes_half_the_time():
    scene = gpu_counts.Scene(1000, 900, 5000, 20, 3000, 2500, 9000, 3500, 8000, 40_000, NO_TILES)
    card = gpu_model.CARDS["H200"]
    twice = card._replace(clock=2 * card.clock, bandwidth=2 * card.bandwidth)
    slow, fast = (gpu_model.times(scene, one) for one in (card, twice))
    assert set(slow) == set(gpu_model.STAGES) and all(max(pair) > 0 for pair in slow.values())
    for stage, pair in slow.items():
        assert pair == pytest.approx([2 * value for value in fast[stage]])


def test_warps_that_share_a_multiprocessor_end_when_they_should():
    card = gpu_model.CARDS["H200"]
    slots, cycle = gpu_model.RESIDENT * card.processors, 1 / (1e3 * card.clock)
    for warps, cycles, expected in [
        (np.full(slots, 800), 2, 3200),  # four instructions a cycle for sixteen warps
        (np.full(slots + 1, 800), 4, 6400),  # another wave of one, at its own pace
        (np.full(card.processors, 800), 4, 3200),  # one on each
        (np.r_[np.full(slots - card.processors, 400), np.full(card.processors, 800)], 2, 1600 + 800),
    ]:
        assert gpu_model.last_end(warps, card, cycles) == pytest.approx(expected * cycle)


def test_measured_stages_stand_beside_the_model(tmp_path):
    listed, blocks = [1_300_000] * 2, (3_000_000, 1_600_000)
    scene = gpu_counts.Scene(1_000_000, 900_000, 534_100, 2170, *listed, *blocks, 3_000_000, 40_000_000, NO_TILES)
    row = {f"{stage} ms": "2.0" for stage in gpu_model.STAGES} | {"size": "980 x 545", "Gaussians": 1_000_000}
    (tmp_path / "gpu.json").write_text(json.dumps({"tables": {"Training step": [row, row | {"Gaussians": 5}]}}))
    rows = gpu_model.measured_rows(tmp_path / "gpu.json", gpu_model.CARDS["H200"], {"ball": scene})
    assert [stage for _, stage, *_ in rows] == list(gpu_model.STAGES)
    assert all(float(ratio) == pytest.approx(2.0 / float(least), rel=0.3) for *_, least, ratio in rows)


@pytest.mark.slow
def test_step():
    """Every launch of a step is in one of its stages, and the host waits for nothing."""
    counts = gpu_counts.count_step()
    assert set(counts) == {*gpu_model.STAGES, REST}
    assert not any(here[WAITS] for here in counts.values())
    assert all(counts[stage][LAUNCHES] for stage in gpu_model.STAGES)

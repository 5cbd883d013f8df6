"""The comparison: what it measures is right, and it measures what it says."""

import json
from dataclasses import asdict

import compare_plots
import knobs
import numpy as np
import pytest
import torch
import warp as wp
from commands import python
from common import using
from scenes import SCENES

from warp_splat import RasterOptions, cli
from warp_splat.compare import adjoints, oracle, truth, workloads
from warp_splat.compare.plots import plot_errors
from warp_splat.compare.stability import cases
from warp_splat.config import ADJOINTS
from warp_splat.kernels.cpu.blend import BLOCKS
from warp_splat.kernels.cpu.taped import make_walk
from warp_splat.kernels.simd import LANES, vec16
from warp_splat.kernels.splat import BlendVariant
from warp_splat.raster.data import alphas_of
from warp_splat.raster.drivers import CPU, CUDA
from warp_splat.raster.project import project
from warp_splat.runtime.launch import launch, view

PLAIN = RasterOptions()
WITHOUT_GPU = pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is accepted where there is one")


def workload(name="degree1"):
    """A test scene as the comparison takes it; every pixel is looked at."""
    scene = SCENES[name]()
    pixels = torch.cartesian_prod(torch.arange(scene.camera.height), torch.arange(scene.camera.width))
    return workloads.Workload(name, scene.gaussians(), scene.camera, scene.background, PLAIN, pixels)


@pytest.mark.parametrize("mode", ["reversible", "stored", "generated"])
def test_what_is_differentiated_is_the_blend(mode):
    """The loop whose adjoint Warp generates computes the colors and transmittances of the forward kernel."""
    given = workload("dense_tile")
    bins = CPU.bin(project(given.gaussians, given.camera, PLAIN), given.camera, PLAIN)
    (image, _, _), (final, count, _, kept) = CPU.blend(bins, given.camera, torch.zeros(3), PLAIN, False)
    lists, steps = bins.view(), count.amax((1, 2)).int()
    if mode == "generated":
        lists.splats = wp.array(bins.splats.numpy()[bins.instances.numpy()], dtype=bins.splats.dtype, device="cpu")
    color, behind = torch.zeros(len(final), 3 * BLOCKS, LANES), torch.zeros_like(final)
    slots = torch.zeros(len(bins.instances), 9)
    states = [view(state, vec16) for state in (final, count, kept)]
    inputs = [lists, alphas_of(PLAIN), *states, view(steps, wp.int32), view(slots, wp.float32)]
    launch(make_walk(mode, BlendVariant()), len(final), inputs, [view(color, vec16), view(behind, vec16)])
    assert torch.allclose(behind, final, rtol=1e-6, atol=0)
    height, width, _ = image.shape
    for tile in range(len(final)):
        row, column = 16 * (tile // bins.tiles_x), 16 * (tile % bins.tiles_x)
        # [block y, block x, channel, y, x] to [y, x, channel]
        pixels = color[tile].view(4, 4, 3, 4, 4).permute(0, 3, 1, 4, 2).reshape(16, 16, 3)
        shown = image[row : row + 16, column : column + 16]
        assert (pixels[: height - row, : width - column] - shown).abs().max() < 1e-6


def test_generated_is_right_and_plain_is_not():
    given = workload()
    exact = truth.compute_truth(given)
    for mode, low, high in (("generated", 0.0, 1e-5), ("plain", 0.5, 10.0)):
        _, found = truth.gradients_of(given, exact, mode)
        worst = max(error.relative for name, error in truth.errors_of(found, exact).items() if name != "background")
        assert low <= worst < high, mode


def test_truth_at_some_pixels_is_that_of_the_image():
    given = workload()
    scene = SCENES["degree1"]().to("cpu", torch.float64)
    whole = oracle.exact_render(*scene.parameters(), scene.camera, scene.background)
    few = given.pixels[::7]
    some = oracle.exact_render(*scene.parameters(), scene.camera, scene.background, pixels=few)
    rows, columns = few.T
    assert torch.allclose(some.image, whole.image[rows, columns], rtol=0, atol=1e-14)
    assert torch.equal(some.fragile, whole.fragile[rows, columns])


def test_error_measures():
    exact = torch.tensor([3.0, -4.0], dtype=torch.float64)
    error = truth.error_of(torch.tensor([3.3, -3.6]), exact)
    assert error.relative == pytest.approx(0.1, rel=1e-5) and error.largest == pytest.approx(0.1, rel=1e-5)
    assert error.cosine == pytest.approx((9.9 + 14.4) / (5 * np.hypot(3.3, 3.6)), rel=1e-5)
    assert error.bias == pytest.approx(0.35 / 3.5, rel=1e-5)
    assert np.isnan(truth.error_of(torch.tensor([1e-7]), torch.zeros(1, dtype=torch.float64)).relative)


def test_layered_scenes_are_as_deep_as_they_say():
    given = workloads.layered(100)
    bins = CPU.bin(project(given.gaussians, given.camera, PLAIN), given.camera, PLAIN)
    assert (bins.ranges[:, 1] - bins.ranges[:, 0] > 90).all()


def test_measuring_writes_tables_and_plots(tmp_path, monkeypatch):
    monkeypatch.setattr(adjoints, "REPEATS", 2)
    monkeypatch.setattr(knobs, "KNOBS", {"t_min": (1e-2, 1e-4), "alpha_min": (1 / 255, 0.0)})
    scenes = [workloads.layered(10), workload()]
    measured, lines = adjoints.run_adjoints(scenes, ["stepwise"], lambda _: None), []
    rows = adjoints.records(measured)
    modes = {"manual", "stepwise", "generated", "plain", "tape"}
    assert {row["variant"] for row in rows} >= modes | {"cap 128", "central differences"}
    by_name = {(row["scene"], row["variant"], row["parameter"]): row for row in rows}
    assert by_name["degree1", "stepwise", "means"]["relative_error"] < 2e-4
    for parameter in ("means", "sh", "background"):
        errors = {name: by_name["degree1", name, parameter]["relative_error"] for name in ("manual", "tape")}
        assert errors["tape"] == errors["manual"], parameter
    assert by_name["degree1", "stepwise", "means"]["cosine"] == pytest.approx(1, abs=1e-6)
    assert by_name["degree1", "central differences", "opacities"]["relative_error"] < 0.05
    assert by_name["degree1", "central differences", "opacities"]["note"].endswith("extrapolated")
    lines += adjoints.adjoint_table(measured).splitlines()
    plot_errors(tmp_path / "errors.png", measured)
    written = json.loads(json.dumps([asdict(item) for item in measured]))
    compare_plots.plot_memory(tmp_path / "memory.png", written)
    compare_plots.plot_stages(tmp_path / "stages.png", written)
    turned = knobs.run_knobs(scenes, lambda _: None)
    knobs.plot_knobs(tmp_path / "knobs.png", turned)
    lines += knobs.knob_table(turned).splitlines()
    assert len({len(line) for line in lines}) == 2  # two tables, every line as long as its header
    exact = {item.variant: item.image_error for item in turned if item.scene == "degree1"}
    assert exact["alpha_min 0"] < 1e-5 < exact["alpha_min 0.003922 *"] and exact["t_min 0.0001 *"] < 1e-3
    assert len(list(tmp_path.glob("*.png"))) == 4


@pytest.mark.slow
def test_on_a_gpu_the_same_is_measured_by_the_kernels_of_a_gpu(monkeypatch):
    """Its kernels run in fibers, its memory is told by a stub; all else is what a card would see."""
    monkeypatch.setattr(workloads, "LAYERED_SIZE", 16)
    monkeypatch.setattr(workloads.Workload, "device", torch.device("cuda"))
    for name, value in (("memory_allocated", 3), ("max_memory_allocated", 10), ("reset_peak_memory_stats", None)):
        monkeypatch.setattr(torch.cuda, name, lambda device, value=value: value)
    monkeypatch.setattr(adjoints, "REPEATS", 2)
    said = []
    with using(CUDA):
        measured = adjoints.run_adjoints([workloads.layered(10)], ADJOINTS, said.append)
    names = [item.variant for item in measured]
    assert names == [*ADJOINTS, adjoints.TAPE, *(f"cap {cap}" for cap in adjoints.CAPS), "central differences"]
    assert "Left out: generated, plain" in said[0]
    for item in measured[:-1]:
        assert item.worst[1] < 1e-5 and item.image_error < 1e-5, item.variant
        assert item.memory == (None if item.variant == adjoints.TAPE else 7)
        assert len(item.forward) == len(item.backward) == 2
    assert adjoints.adjoint_table(measured).count("\n") == 1 + len(measured)


def test_stored_that_does_not_fit_is_a_row(monkeypatch):
    monkeypatch.setattr("warp_splat.runtime.launch.available_memory", lambda device: 2**10)
    monkeypatch.setattr(adjoints, "REPEATS", 2)
    measured = adjoints.run_adjoints([workload()], ["stored"], lambda _: None)
    row = next(item for item in measured if item.variant == "stored")
    assert "transmittances" in row.note and not row.backward
    assert "stored" in adjoints.adjoint_table(measured)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--threads -1", "--threads: expected at least 0, got -1."),
        ("--modes newton", "--modes: expected some of manual, stepwise, reversible, stored, got newton."),
        ("--modes", "got none"),
        ("--scene nowhere", "nowhere"),
        pytest.param("--device cuda", "--device cuda", marks=WITHOUT_GPU),
        ("--device cuda --stability", "--device cuda: --stability computes on the CPU only"),
        ("--stability --scene nowhere", "--scene: expected none with --stability"),
    ],
)
def test_bad_input_is_one_sentence(arguments, message, tmp_path, fails):
    assert message in fails("compare", *arguments.split(), "--out", tmp_path)


@pytest.mark.parametrize(("failed", "code"), [(2, 1), (0, 0)])
def test_command_runs_the_catalog(failed, code, tmp_path, monkeypatch):
    """Which has its own tests; here it says a line and how many verdicts failed."""
    monkeypatch.setattr(cases, "run_cases", lambda *given: given[-1](f"cases in {given[0]}") or failed)
    assert cli.main(["compare", "--stability", "--out", str(tmp_path)]) == code
    text = (tmp_path / "stability.txt").read_text()
    assert text.startswith(f"cases in {tmp_path}\n")
    assert "Measured on" in text and len(list(tmp_path.iterdir())) == 1


@pytest.mark.long
@pytest.mark.parametrize(
    ("command", "files"),
    [
        ("benchmarks/volume.py", "volume.txt volume.csv volume.json volume_stiff.png volume_maps.png"),
        ("benchmarks/footprints.py", "cameras.txt cameras.csv cameras_gradients.csv cameras.png"),
        ("-m warp_splat.compare --stability --modes manual", "stability.txt stability.csv stability.json"),
    ],
)
def test_whole_commands(command, files, tmp_path):
    """At their default size; 0: no verdict failed."""
    python(*command.split(), "--out", tmp_path)
    assert all((tmp_path / name).stat().st_size > 0 for name in files.split())

"""What ``benchmarks/step.py``, ``savings.py``, ``blend.py`` and ``derivatives.py`` count and compare is right."""

import blend
import derivatives
import gpu_steps
import limits
import made_up
import numpy as np
import pytest
import savings
import serial
import step
import torch
import warp as wp
import work

from warp_splat import RasterOptions
from warp_splat.config import ADJOINTS, ALPHA_MIN, T_MIN
from warp_splat.raster.data import Gaussians
from warp_splat.raster.project import project
from warp_splat.runtime import launch, pool


@pytest.fixture
def two_threads(threads):
    threads(2)


def test_pairs_are_those_of_a_loop_over_all_gaussians_at_all_pixels():
    gaussians = Gaussians(*(tensor.detach() for tensor in made_up.make_gaussians(3000, "cpu").activated()))
    # pixels stop
    gaussians = gaussians._replace(scales=3.0 * gaussians.scales, opacities=gaussians.opacities.clamp_min(0.5))
    camera = made_up.cameras(40, 30, 1)[0]
    found = work.count(gaussians, camera, RasterOptions())
    means, conics, opacities, _, depths, _, radii = project(gaussians, camera, RasterOptions())
    drawn = np.flatnonzero(radii.numpy() > 0)
    order = drawn[np.argsort(depths.numpy()[drawn], kind="stable")]
    y, x = np.mgrid[:32, :48] + 0.5  # of whole tiles
    t, running, pairs, skipped, blocks = np.ones((32, 48)), np.ones((32, 48), bool), 0, 0, 0
    for i in order:
        dx, dy = means[i, 0].item() - x, means[i, 1].item() - y
        xx, xy, yy = conics[i].tolist()
        alpha = np.minimum(opacities[i].item() * np.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy), 0.99)
        seen = alpha >= ALPHA_MIN
        running &= ~(seen & (t * (1 - alpha) < T_MIN))
        t = np.where(seen & running, t * (1 - alpha), t)
        pairs += np.count_nonzero((seen & running)[:30, :40])
        blocks += np.count_nonzero((seen & running).reshape(8, 4, 12, 4).any((1, 3)))
        skipped += np.count_nonzero(seen & ~running)
    assert skipped > 0.1 * pairs  # else the test would not see whether stopped pixels count
    assert found.pairs == pytest.approx(pairs, rel=1e-4)  # a pair at the threshold may round to either side
    assert found.by_adjoint == 16 * blocks
    assert found.pairs < found.by_adjoint < found.looked_at < 16 * found.pairs
    assert (found.gaussians, found.drawn, found.pixels, found.coefficients) == (3000, len(order), 1200, 16)


def test_derivative_lines_are_counted_for_every_mode():
    counts = {mode: derivatives.derivative_lines(mode) for mode in (*ADJOINTS, "generated", "plain")}
    assert all(rules > 0 and plumbing > 0 for rules, plumbing in counts.values())
    assert counts["stepwise"][0] < counts["manual"][0]


@pytest.mark.long  # half a minute to compile
def test_multiply_adds_are_done_as_they_are_counted(two_threads):
    values = torch.zeros(3, limits.CHAINS, limits.LANES)
    launch.launch(limits.multiply_add, 3, [2, 1.0], [launch.view(values, limits.vec16)])
    assert (values == 2 * limits.UNROLLED).all()


def test_floor_is_the_larger_of_its_two_parts():
    limit = limits.Limits(bandwidth=100.0, rate=2.0)
    assert limit.floor(300.0, 16.0) == 3.0 and limit.floor(100.0, 160.0) == 5.0
    # 2 Gaussians of degree 0, one of which is drawn, on 10 pixels: by hand
    counted = {"instances": 3, "pairs": 7, "looked_at": 32, "by_adjoint": 16}
    counts = work.Counts(gaussians=2, coefficients=1, drawn=1, pixels=10, **counted)
    found = work.work_of(counts)
    assert found["project"] == (2 * 48 + 60, 240) and found["blend"] == (12 + 48 + 240, 7 * 31)
    assert found["Adam"][0] == 2 * 14 * 4 * 7 and found["host"] == (0, 0)


def test_table_of_a_small_step(two_threads):
    trainer = step.synthetic(500, 64, 48)
    before = {name: tensor.detach().clone() for name, tensor in trainer.model.parameters.items()}
    times = step.time_steps(trainer, 1)
    assert all(torch.equal(trainer.model.parameters[name], tensor) for name, tensor in before.items())
    parts = {stage: seconds for stage, seconds in times[2].items() if stage != "whole step"}
    assert sum(parts.values()) == pytest.approx(times[2]["whole step"]) and set(parts) == set(work.work_of(COUNTS))
    rows, data = step.rows_of("small", times, COUNTS, dict.fromkeys((1, 2), limits.Limits(1e9, 1e9)))
    assert [row[1] for row in rows] == [*parts, "whole step"] and rows[-1][2] == f"{1e3 * times[1]['whole step']:.2f}"
    assert data["floors"][1]["whole step"] == pytest.approx(sum(data["floors"][1][stage] for stage in parts))


COUNTS = work.Counts(500, 16, 400, 64 * 48, 900, 9000, 20000, 15000)


def test_what_is_left_out_changes_nothing(two_threads):
    """Of those that should not: image and gradients are compared, and the comparison can tell."""
    trainer = step.synthetic(1500, 64, 48)
    trainer.deck.views = trainer.scene.train[:1]
    before = {name: tensor.detach().clone() for name, tensor in trainer.model.parameters.items()}
    changes = {case.name: savings.difference(trainer, case) for case in savings.CASES}
    same = {name for name, change in changes.items() if change == "same image, same gradients"}
    assert len(same) >= 6, changes
    assert "image" in changes["what lies behind saturated pixels"]
    assert all(torch.equal(trainer.model.parameters[name], tensor) for name, tensor in before.items())
    assert all(leaf.requires_grad for leaf in trainer.model.parameters.values())


def test_inactive_degrees_get_no_gradient_and_the_same_bytes():
    """Steps at degree 0 and then 3, against Adam fed with gradients of zero."""
    scene, gaussians = made_up.make_scene(48, 32), made_up.make_gaussians(300, "cpu")
    trainers = [made_up.trainer_on(scene, gaussians, "cpu", sh_interval=4) for _ in range(2)]
    for iteration in range(1, 14):
        for trainer, fills in zip(trainers, (False, True), strict=True):
            trainer.differentiate(iteration)
            rest = trainer.model.parameters["sh_rest"]
            assert (rest.grad is None) == (iteration < 4)
            if fills and rest.grad is None:
                rest.grad = torch.zeros_like(rest)
            trainer.update(iteration)
    torch.testing.assert_close(*(trainer.model.parameters for trainer in trainers), rtol=0, atol=0)
    assert trainers[0].optimizer.tables["sh_rest"].steps == 13


def test_degree_rises_without_a_compilation(monkeypatch, capsys):
    """``warm_up`` has compiled and loaded all that a higher degree needs: Warp says so when it loads a module."""
    monkeypatch.setattr(wp.config, "log_level", wp.LOG_INFO)
    scene, gaussians = made_up.make_scene(48, 32), made_up.make_gaussians(300, "cpu")
    trainer = made_up.trainer_on(scene, gaussians, "cpu", sh_interval=2)
    trainer.warm_up()
    work.count_pairs.module.unload()
    wp.load_module(work.count_pairs.module, device="cpu")
    assert "Module" in capsys.readouterr().out  # what the test looks for is there
    degrees = set()
    for iteration in range(1, 9):
        trainer.advance(iteration)
        degrees.add(trainer.degree)
    assert degrees == {0, 1, 2, 3} and "Module" not in capsys.readouterr().out


def test_serial_time_is_what_slices_do_not_share(two_threads):
    """Spans by hand; and a step, of which no stage is longer in serial than it is."""
    assert serial.shared([(0.0, 2.0, 1), (1.0, 4.0, 2), (1.5, 1.75, 3), (6.0, 7.0, 1)], 0.5, 6.5) == pytest.approx(1.0)
    assert serial.shared([(0.0, 2.0, 1), (1.0, 4.0, 2), (1.0, 4.0, 2)], 1.5, 3.0) == pytest.approx(0.5)
    assert serial.shared([], 0.0, 1.0) == 0.0
    job = pool._Job
    seconds, alone = serial.measure(made_up.steps_of(made_up.make_trainer(3000, 64, 48, "cpu")), 2)
    assert pool._Job is job
    assert all(0.0 <= alone[stage] <= seconds[stage] for stage in (*gpu_steps.STAGES, "whole step"))


def test_blends_in_lanes_agree_with_those_of_one_pixel_each():
    scene = made_up.blend_scene(count=300, width=64, height=48)
    upstream = torch.from_numpy(np.random.default_rng(1).normal(size=(48, 64, 3)).astype(np.float32))
    drivers = [blend.Lanes(scene, upstream), blend.Scalar(scene, upstream)]
    for driver in drivers:
        driver.forward()
        driver.adjoint()
    blend.compare(*drivers)  # raises if they do not

"""The catalog of extreme cases, one test for each case and adjoint, and the parts that could be wrong themselves."""

import csv
import json
from dataclasses import replace
from fractions import Fraction

import compare_plots
import numpy as np
import pytest
import rounding
import torch

from warp_splat.compare import scenes
from warp_splat.compare.stability import arithmetic, cases, pixel_loop, verdict
from warp_splat.config import ADJOINTS, BLUR

VERDICTS = [(case, mode) for case in cases.CASES for mode in cases.modes_of(case, ADJOINTS)]


@pytest.mark.parametrize(
    ("case", "mode"), VERDICTS, ids=[f"{case.name}-{mode}" if mode else case.name for case, mode in VERDICTS]
)
def test_case(case, mode, record_property):
    outcome = case.run(mode)
    record_property("error", (outcome.value_error, outcome.gradient_error))
    assert not outcome.failures


def test_names_are_unique():
    names = [case.name for case in cases.CASES]
    assert len(set(names)) == len(names)


def small_truth():
    return verdict.truth(pixel_loop.ordinary)


def broken(monkeypatch, change):
    """The failures of the ordinary case when ``change`` is done to the renderer's output."""
    draw = verdict.draw_case

    def drawn(*arguments):
        out = draw(*arguments)
        change(out)
        return out

    monkeypatch.setattr(verdict, "draw_case", drawn)
    return verdict.judge(small_truth(), "manual").failures


@pytest.mark.parametrize("value", [2e-4, float("nan"), float("inf")])
def test_a_wrong_pixel_fails(monkeypatch, value):
    def change(out):
        line, column = (~small_truth().out.fragile).nonzero()[0].tolist()
        out.image = out.image.clone()
        out.image[line, column, 1] += value

    assert broken(monkeypatch, change)


@pytest.mark.parametrize("name", ["invalid", "dropped"])
def test_a_wrong_count_fails(monkeypatch, name):
    def change(out):
        out.invalid_count += name == "invalid"
        out.dropped.gaussian_count += name == "dropped"

    failures = broken(monkeypatch, change)
    assert len(failures) == 1 and name in failures[0]


def test_a_wrong_gradient_fails(monkeypatch):
    differentiate, truth = verdict.gradients_by_name, small_truth()

    def scaled(*arguments):
        return {name: value * (1.001 if name == "scales" else 1) for name, value in differentiate(*arguments).items()}

    monkeypatch.setattr(verdict, "gradients_by_name", scaled)
    failures = verdict.judge(truth, "manual").failures
    assert len(failures) == 1 and "scales" in failures[0]


def test_a_gaussian_that_should_be_left_out_fails():
    truth = small_truth()
    drawn = int(truth.out.touches.nonzero()[0])
    stated = truth._replace(problem=replace(truth.problem, left_out=(drawn,)))
    assert any("left out" in failure for failure in verdict.judge(stated, "manual").failures)


def test_the_condition_of_an_ordinary_problem_is_within_the_usual_limits():
    """So that asking for it loosens nothing where nothing is extreme."""
    truth = verdict.truth(lambda: replace(pixel_loop.ordinary(), conditioned=True))
    assert truth.image_limit == verdict.IMAGE_LIMIT
    assert set(truth.gradient_limits.values()) == {verdict.GRADIENT_LIMIT}


def test_the_exact_determinant_is_that_of_the_matrix():
    a1, a2 = (np.array([row], dtype=np.float32) for row in ([3, -1, 2], [0.5, 4, -7]))
    rows = np.concatenate([a1, a2]).astype(np.float64)
    expected = np.linalg.det(rows @ rows.T + float(np.float32(BLUR)) * np.eye(2))
    (exact,) = rounding.exact_determinant(a1, a2)
    assert isinstance(exact, Fraction) and float(exact) == pytest.approx(expected, rel=1e-12)
    for formula in (rounding.usual_determinant, rounding.our_determinant):
        assert formula(a1, a2)[0] == pytest.approx(expected, rel=1e-5)


@pytest.mark.slow
def test_ours_keeps_the_digits_of_needles_and_of_long_chains():
    """A few roundings at every angle and ratio, where the usual formula has none left; T like the number of layers."""
    ours, usual = (max(rounding.determinant_errors()[name]) for name in ("ours", "usual"))
    assert ours < 16 * verdict.EPS and usual > 1
    assert all(rounding.recovery_error(n) < 4 * n * verdict.EPS for n in rounding.LAYERS)


def test_exact_loss_of_equal_images_is_zero():
    image = torch.rand(13, 17, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert arithmetic.exact_loss(image, image).item() == pytest.approx(0, abs=1e-12)


def test_exact_loss_in_one_window():
    """A 1 x 1 image: the window holds the pixel and zeros, so that moments are known."""
    x, y = 0.6, 0.2
    bell = np.exp(-((np.arange(11) - 5.0) ** 2) / 4.5)
    w = (bell[5] / bell.sum()) ** 2
    var, cov = w * (x * x + y * y) - w * w * (x * x + y * y), w * x * y - w * w * x * y
    ssim = (2 * w * w * x * y + 1e-4) * (2 * cov + 9e-4) / ((w * w * (x * x + y * y) + 1e-4) * (var + 9e-4))
    pictures = (torch.full((1, 1, 3), value, dtype=torch.float64) for value in (x, y))
    assert arithmetic.exact_loss(*pictures).item() == pytest.approx(0.8 * 0.4 + 0.2 * (1 - ssim), rel=1e-12)


def test_exact_adam_is_torchs():
    parameter = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    adam = torch.optim.Adam([parameter], lr=0.01, eps=arithmetic.ADAM_EPS)
    for _ in range(arithmetic.STEPS):
        parameter.grad = torch.full_like(parameter, 0.3)
        adam.step()
    assert arithmetic.exact_adam(0.3, 0.01, sparse=False) == pytest.approx(parameter.item(), rel=1e-12)


def test_needles_point_where_they_are_asked_to():
    camera = scenes.make_camera(20, 16)
    angles, tilts = np.linspace(0, np.pi, 9, endpoint=False), np.linspace(0, 1.5, 9)
    quats = torch.from_numpy(scenes.facing(camera, angles, tilts))
    axis = verdict.oracle.rotation_matrices(quats)[:, :, 0].numpy() @ camera.rotation.T
    expected = np.stack([np.cos(tilts) * np.cos(angles), np.cos(tilts) * np.sin(angles), np.sin(tilts)], 1)
    assert np.abs(axis - expected).max() < 1e-12


def test_a_point_is_placed_at_its_pixel():
    camera = scenes.look(30, 20, fov=70, seed=3)
    pixels, depth = np.array([[4.5, 17.0], [29.0, 0.5]]), np.array([2.0, 7.0])
    points = scenes.at_pixels(pixels, depth, camera) @ camera.rotation.T + camera.translation
    shown = points[:, :2] / points[:, 2:] * camera.fx + [camera.cx, camera.cy]
    assert np.abs(shown - pixels).max() < 1e-9 and np.abs(points[:, 2] - depth).max() < 1e-9


def test_run_writes_and_counts(tmp_path, monkeypatch):
    """With few cases: the table, the files, and the number of failed verdicts."""
    chains = [case for case in cases.CASES if case.name.startswith("chain_1")]
    wrong = verdict.Case("wrong", "none", "fails", lambda _mode: failing, modal=False)
    failing = verdict.Outcome("nothing", 1.0, None, 0.0, "-", ("stated, and not so",))
    monkeypatch.setattr(cases, "CASES", (*chains, wrong))
    lines = []
    assert cases.run_cases(tmp_path / "out", ["manual"], lines.append) == 1
    assert "FAIL" in lines[0] and any("stated, and not so" in line for line in lines)
    written = json.loads((tmp_path / "out/stability.json").read_text())
    verdicts = written["verdicts"]
    with (tmp_path / "out/stability.csv").open(newline="") as file:
        assert [line["case"] for line in csv.DictReader(file)] == [verdict["case"] for verdict in verdicts]
    assert len(verdicts) == len(chains) + 1
    compare_plots.plot_stability(tmp_path / "stability.png", written)
    assert (tmp_path / "stability.png").stat().st_size > 10_000


def test_a_verdict_names_the_modes_that_failed():
    good = verdict.Outcome("nothing", 0.0, None, 0.0, "-", ())
    bad = good._replace(failures=("wrong",))
    outcomes = ({"manual": first, "stored": second} for first, second in ((good, good), (good, bad), (bad, bad)))
    verdicts = [cases.Row(cases.CASES[0], each).verdict for each in outcomes]
    assert verdicts == ["pass", "FAIL stored", "FAIL"]

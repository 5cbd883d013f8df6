"""Trainings by every adjoint, knob and cap: they are what they say, and their benchmark writes every file."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import training_adjoints as trained

from warp_splat.config import ADJOINTS
from warp_splat.presets import EMBEDDED_DEFAULTS
from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene

STEPS = 24
SCHEDULE = {**trained.SHORT, "iterations": STEPS, "densify_from_iter": 10, "densification_interval": 12}


@pytest.fixture(scope="module")
def scene():
    """Half of the points; 33 x 31 pixels; two views held out."""
    whole = load_scene(embedded_scene(), eval=True, resolution=8, report=str)
    return replace(whole, test=whole.test[:2], points=whole.points[::2], colors=whole.colors[::2])


@pytest.fixture
def tiny(monkeypatch):
    monkeypatch.setattr(trained, "SHORT", SCHEDULE)
    monkeypatch.setattr(trained, "SEEDS", (0, 1))
    monkeypatch.setattr(trained, "EVALUATIONS", 4)


def test_short_schedule_is_whole_within_its_steps():
    assert set(EMBEDDED_DEFAULTS[""]) < set(trained.SHORT)
    assert trained.SHORT["iterations"] == trained.SHORT["position_lr_max_steps"] == 300
    assert trained.COMPARED[-1] < 2 * trained.SHORT["densification_interval"] < trained.SHORT["densify_until_iter"]


@pytest.mark.slow
def test_run_writes_its_files(tiny, scene, tmp_path):
    said = []
    results = trained.run_trainings(tmp_path / "new", ["manual", "stepwise"], {"embedded": scene}, say=said.append)
    assert set(json.loads((tmp_path / "new/training.json").read_text())) == set(results)
    assert results["schedule"]["iterations"] == STEPS
    with open(tmp_path / "new/training.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    columns = "scene variant seed psnr ssim gaussians longest_list lists_cut iterations_per_second refused".split()
    assert list(rows[0]) == columns
    late = [f"cap {cap}, rendering only" for cap in trained.CAPS]
    further = [*(f"cap {cap}" for cap in trained.CAPS), "ellipsoid"]
    names = [(row["variant"], row["seed"]) for row in rows]
    assert names[:6] == [(name, "0") for name in ["manual", "stepwise", *further]]
    assert names[6:8] == [("manual", "1"), ("stepwise", "1")]
    assert names[8:] == [(name, seed) for seed in "01" for name in late]
    assert [record["variant"] for record in results["summary"]] == ["manual", "stepwise", *further, *late]
    for name, magic in (("training_modes.png", b"\x89PNG"), ("training_cap.jpg", b"\xff\xd8")):
        assert (tmp_path / "new" / name).read_bytes().startswith(magic)
    text = "\n".join(said)
    assert "against manual" in text and "seeds do: the standard deviation" in text
    assert {d["steps"] for d in results["equality"]["embedded"]["parameters"]} == {1, 10}
    of = {row["variant"]: row for row in rows if row["seed"] == "0"}
    assert float(of["manual"]["longest_list"]) < 2048  # a cap that no list reaches changes nothing
    assert of["cap 2048"]["psnr"] == of["cap 2048, rendering only"]["psnr"] == of["manual"]["psnr"]
    assert float(of["cap 128"]["lists_cut"]) > 0


def test_modes_train_alike(scene, monkeypatch):
    monkeypatch.setattr(trained, "EVALUATIONS", STEPS)
    monkeypatch.setattr(trained, "COMPARED", ())
    losses = []
    for mode in ADJOINTS:
        trainer = trained.make_trainer(scene, {**SCHEDULE, "densify_until_iter": 0}, 0, adjoint=mode)
        list(trained.train_run(trainer, result := trained.Trained("", mode, 0), {}))
        losses.append([record["loss"] for record in result.history])
    assert np.mean(losses[0][-5:]) < 0.9 * np.mean(losses[0][:5])
    np.testing.assert_allclose(losses[1:], [losses[0]] * 3, rtol=1e-3)


def test_cap_of_one_entry_costs_quality(scene):
    qualities = []
    for cap in (None, 1):
        trainer = trained.make_trainer(scene, SCHEDULE, 0, max_steps=cap)
        list(trained.train_run(trainer, result := trained.Trained("", "", 0), {}))
        qualities.append(result.history[-1]["psnr"])
    assert qualities[1] < qualities[0] - 1


@pytest.mark.slow
def test_refusal_is_a_row(tiny, scene, tmp_path, monkeypatch):
    monkeypatch.setattr("warp_splat.runtime.launch.available_memory", lambda device: 0)
    said = []
    scenes = {"embedded": scene, "other": scene}
    results = trained.run_trainings(tmp_path, ["manual", "stored"], scenes, say=said.append)
    assert {record["scene"] for record in results["summary"]} == {"embedded", "other"}
    record = results["summary"][1]
    assert record["variant"] == "stored" and "take" in record["refused"]
    assert "stored (refused)" in "\n".join(said)
    assert json.loads((tmp_path / "training.json").read_text())["summary"][1]["psnr"] is None
    assert results["equality"] == {"embedded": {}, "other": {}}  # one mode is compared with none

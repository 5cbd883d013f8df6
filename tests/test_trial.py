"""What auto tries: verdicts by short trainings on photographs held back, the same ones again, which disturb nothing."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from commands import train

from warp_splat.camera import Camera
from warp_splat.formats.model_folder import ply_path
from warp_splat.runtime.distributed import ALONE
from warp_splat.scene.horizon import few_photographs
from warp_splat.training import trial
from warp_splat.training.config_file import read_config
from warp_splat.training.options import TrainConfig
from warp_splat.training.parts import floaters
from warp_splat.training.plan import RATES
from warp_splat.training.seams import Verdict

CONFIG = TrainConfig(parts="auto", device="cpu", iterations=300)


@pytest.mark.parametrize(
    ("given", "taken"),
    [
        ([(20.2, 0.8), (21.3, 0.7)], True),
        ([(20.2, 0.8), (21.05, 0.8)], False),  # too little in one round
        ([(20.9, 0.9), (21.9, 0.6999)], False),  # less alike in one round
        ([(np.nan, 0.9), (21.9, 0.9)], False),
    ],
)
def test_each_round_has_to_be_better_and_none_less_alike(given, taken):
    verdict = trial.judged(Verdict(True, "it looks so"), [(20.0, 0.8), (21.0, 0.7)], given)
    assert verdict.needed == taken and verdict.sentence.startswith("it looks so; on photographs held back")


def test_trials_are_the_same_again_and_see_no_photograph_of_the_test(scene, monkeypatch):
    seen = {view.name for view in scene.train[0::5]}
    made = []

    class Watched(trial.Trainer):
        def __init__(self, scene, config):
            super().__init__(scene, config)
            made.append({view.name for view in scene.test})
            assert not made[-1] & {view.name for view in scene.train} and len(scene.train) > 30

    monkeypatch.setattr(trial, "Trainer", Watched)
    first, again = (trial.quality(CONFIG, scene, ["floaters"], 12, 0) for _ in range(2))
    assert first == again and made == [seen, seen]
    assert trial.quality(CONFIG, scene, ["floaters"], 12, 1) != first and not made[-1] & seen


@pytest.mark.parametrize(
    ("views", "shortest", "sentence"),
    [
        (3, 1, "but could not be tried: 3 photographs are too few to hold some back"),
        (20, 10**6, "but could not be tried: this training is too short"),
    ],
)
def test_what_cannot_be_tried_is_left_out_and_said(views, shortest, sentence, scene, monkeypatch):
    monkeypatch.setattr(trial, "SHORTEST", shortest)
    config, told = trial.settle_parts(CONFIG, replace(scene, train=scene.train[:views]), ALONE, str)
    assert config.model.parts == "" and any(line.startswith("Part floaters: left out") for line in told)
    assert any(sentence in line for line in told)


def test_the_count_of_steps_is_a_tenth_of_the_work(scene):
    """Against a sum by hand: 10 trainings, sizes that double at half and at all of the steps."""
    config = CONFIG.changed(iterations=4000, coarse=4, coarse_until_iter=2000)
    pixels = scene.train[0].camera.width * scene.train[0].camera.height
    whole = 999 * (pixels / 16 + 30_000) + 1000 * (pixels / 4 + 30_000) + 2001 * (pixels + 30_000)
    expected = int(0.1 * whole / (pixels / 16 + 30_000) / 10) - -(-len(scene.train) // 5)
    assert trial.steps_of(config, scene, 10) == expected


def test_trials_have_the_rates_of_the_training(scene):
    short = trial._shortened(CONFIG, scene, 30).learn
    assert [getattr(short, name) for name in RATES] == [getattr(CONFIG.learn, name) for name in RATES]


def test_points_that_all_photographs_show_are_said_to_be():
    camera = Camera(9, 9, 9.0, 9.0, 4.5, 4.5, np.eye(3), np.zeros(3))
    views = [SimpleNamespace(name=str(place), camera=camera) for place in range(3)]
    scene = SimpleNamespace(train=views, tracks={"0": None}, points=np.float32([[0, 0, 5]] * 4))
    assert few_photographs(scene, 25) == (True, "half of its points lie in all 3 photographs (limit 25)")


@pytest.mark.slow
@pytest.mark.parametrize("gain", [-99.0, 99.0])
def test_a_training_is_the_same_as_with_the_parts_that_auto_names(gain, tmp_path, monkeypatch, capsys):
    """And goes on with them, without another trial."""
    monkeypatch.setattr(trial, "SHORTEST", 5)
    monkeypatch.setattr(trial, "steps_of", lambda *_: 5)
    monkeypatch.setattr(trial, "GAIN", gain)
    monkeypatch.setattr(floaters, "FEW", 1000)
    if gain < 0:
        monkeypatch.setattr(trial, "judged", lambda verdict, *_: Verdict(True, verdict.sentence))
    flags = "--iterations 60 --no-quiet -r 8 --seed 3".split()
    assert train(tmp_path / "auto", *flags, "--parts", "auto") == 0
    out = "".join(capsys.readouterr())
    parts = "floaters" if gain < 0 else ""
    assert "Trying floaters: 4 trainings of" in out and f"Part floaters: {'taken' if parts else 'left out'}" in out
    assert read_config(tmp_path / "auto" / "config.toml")["parts"] == parts
    assert train(tmp_path / "named", *flags, "--parts", parts) == 0
    files = [ply_path(tmp_path / name, 60).read_bytes() for name in ("auto", "named")]
    assert files[0] == files[1]

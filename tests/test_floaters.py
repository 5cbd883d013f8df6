"""The price on opacity: its gradient against the formula, one sum in any order, the same bytes after a resume."""

import math
from dataclasses import replace

import pytest
import torch
from test_checkpoints import begin, state_of, steps
from test_train import SCENE, fails

from warp_splat.formats.checkpoint import load_checkpoint
from warp_splat.runtime.distributed import ALONE
from warp_splat.training.options import TrainConfig
from warp_splat.training.record import keep, restore
from warp_splat.training.trial import settle_parts, weigh


def differentiated(scene, folder, **options):
    """A trainer after the loss of its first view, and that loss."""
    trainer, _ = begin(scene, folder, **options)
    return trainer, float(trainer.differentiate(1))


def test_it_adds_the_mean_opacity_and_its_gradient(scene, tmp_path):
    """To every Gaussian's logit, in view or not, and to nothing else."""
    (plain, loss), (priced, with_price) = (differentiated(scene, tmp_path, parts=parts) for parts in ("", "floaters"))
    opacities = torch.sigmoid(plain.model.parameters["opacities"].detach().double())
    assert with_price == pytest.approx(loss + 0.05 * float(opacities.mean()), abs=1e-7)
    for name, leaf in plain.model.parameters.items():
        if name != "opacities" and leaf.grad is not None:
            assert torch.equal(priced.model.parameters[name].grad, leaf.grad), name
    before, after = (trainer.model.parameters["opacities"].grad.double() for trainer in (plain, priced))
    expected = 0.05 / len(opacities) * opacities * (1.0 - opacities)
    unseen = before == 0
    assert unseen.any() and not unseen.all()
    torch.testing.assert_close(after[unseen], expected[unseen], rtol=1e-6, atol=0.0)
    torch.testing.assert_close(after, before + expected, rtol=1e-6, atol=1e-12)


def test_the_sum_is_the_same_in_any_order_and_leaves_out_what_is_not_finite(scene, tmp_path):
    trainer, _ = begin(scene, tmp_path, parts="floaters")
    out = trainer.look(scene.train[0].camera)
    opacities = torch.rand(100_001, generator=torch.Generator().manual_seed(0)).square().requires_grad_()
    losses = []
    for order in (slice(None), torch.arange(100_000, -1, -1), torch.randperm(100_001)):
        out.gaussians = out.gaussians._replace(opacities=opacities[order])
        losses.append(trainer.parts[0].loss(torch.zeros(()), out, None))
    assert losses[0] == losses[1] == losses[2]
    exact = 0.05 * math.fsum(opacities.tolist()) / 100_001
    assert losses[0].item() == pytest.approx(exact, abs=0.05 * 2**-24, rel=1e-7)
    (gradient,) = torch.autograd.grad(losses[2], opacities)
    assert torch.equal(gradient, torch.full_like(gradient, 0.05 / 100_001))  # rounded once
    out.gaussians = out.gaussians._replace(opacities=torch.tensor([0.5, float("nan")]))
    assert float(trainer.parts[0].loss(torch.zeros(()), out, None)) == pytest.approx(0.0125)


@pytest.mark.parametrize("optimizer_type", ["default", "sparse_adam"])
def test_it_resumes_to_the_same_bytes(optimizer_type, scene, tmp_path):
    options = {"parts": "floaters", "opacity_reg": 0.5, "optimizer_type": optimizer_type}
    trainer, run = begin(scene, tmp_path, **options)
    steps(trainer, run, 34)
    expected, _ = state_of(trainer, run)
    trainer, run = begin(scene, tmp_path, **options)
    steps(trainer, run, 20)
    keep(trainer, run)
    trainer, run = begin(scene, tmp_path, **options)
    restore(trainer, run, load_checkpoint(tmp_path))
    steps(trainer, run, 34)
    found, _ = state_of(trainer, run)
    assert found.keys() == expected.keys() and [name for name in found if found[name] != expected[name]] == []


def test_without_it_nothing_changes(scene, tmp_path):
    assert settle_parts(TrainConfig(), scene, ALONE, str) == (TrainConfig(), [])
    config, told = settle_parts(TrainConfig(opacity_reg=9.0), scene, ALONE, str)
    assert not config.used_parts
    assert told == ["Warning: the part floaters is not used, without which --opacity_reg will change nothing."]
    states = []
    for options in ({}, {"opacity_reg": 9.0}):
        trainer, run = begin(scene, tmp_path, **options)
        steps(trainer, run, 12)
        states.append(state_of(trainer, run)[0])
    assert states[0] == states[1]


@pytest.mark.parametrize("value", ["-1", "nan", "inf"])
def test_bad_weights_are_refused(value, tmp_path, capsys):
    command = ["train", "-s", str(SCENE), "-m", str(tmp_path / "m"), "--parts", "floaters", f"--opacity_reg={value}"]
    assert f"--opacity_reg: expected a finite number, at least 0, got {float(value)}." in fails(capsys, *command)


def test_verdict(scene):
    assert not weigh(TrainConfig(), scene)["floaters"].needed
    few = replace(scene, train=scene.train[::2])
    assert weigh(TrainConfig(), few)["floaters"] == (True, "half of its points lie in 22 photographs or fewer")
    assert not weigh(TrainConfig(), replace(few, find_tracks=dict))["floaters"].needed

"""Growth as a Markov chain: what a crowd leaves as it was, how far the faint move, and what opacity and size cost."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from test_checkpoints import SCHEDULE
from test_train import SCENE, fails

from warp_splat.gaussians import GaussianModel
from warp_splat.runtime.distributed import ALONE
from warp_splat.training.growth.mcmc import Mcmc, crowds
from warp_splat.training.optimizer import Optimizer
from warp_splat.training.options import TrainConfig
from warp_splat.training.seams import Setting
from warp_splat.training.trainer import Trainer


def growth_on(count, budget, iterations=1000, **raw):
    """A growth of equal Gaussians; of ``raw``, parameters before activation."""
    rows = {"means": [0.0] * 3, "scales": [0.0] * 3, "quats": [1.0, 0, 0, 0], "opacities": 0.0}
    rows = {name: torch.tensor(value).repeat(count, *[1] * np.ndim(value)) for name, value in rows.items()}
    rows |= {"sh_dc": torch.arange(3.0 * count).view(count, 1, 3), "sh_rest": torch.zeros(count, 0, 3)}
    rows |= {name: torch.as_tensor(value, dtype=torch.float32).expand_as(rows[name]) for name, value in raw.items()}
    model, config = GaussianModel(rows), TrainConfig(growth="mcmc")
    setting = Setting(SimpleNamespace(extent=1.0), model, torch.zeros(3), ALONE, 0, budget, iterations)
    return model, Mcmc(config.plugins["mcmc"], setting, Optimizer(model, config.learn, 1.0))


@pytest.mark.parametrize("count", [1, 2, 3, 7, 60])
@pytest.mark.parametrize("opacity", [0.006, 0.3, 0.9, 0.999])
def test_a_crowd_is_as_opaque_as_the_one(count, opacity):
    """In the middle, and summed up along a line (SciPy's quadrature); for few by the paper's sum, too."""
    logit = math.log(opacity / (1 - opacity))
    model, _ = growth_on(3, 3, opacities=logit, scales=[0.5, -1.0, 2.0])
    raw = {name: tensor.detach() for name, tensor in model.parameters.items()}
    crowd = crowds(raw, torch.tensor([0, 2]), torch.tensor([count, 1]))
    assert len(crowd["means"]) == count + 1 and set(crowd["sh_dc"][:, 0, 0].tolist()) == {0.0, 6.0}
    b = torch.sigmoid(crowd["opacities"].double()).numpy()
    assert (1 - b[0]) ** count == pytest.approx(1 - opacity, abs=2e-7)  # float32 near 1
    assert b[count] == pytest.approx(opacity, abs=2e-7)
    shrink = np.exp((crowd["scales"] - torch.tensor([0.5, -1.0, 2.0])).double().numpy())
    assert np.allclose(shrink[count], 1, atol=1e-6) and np.ptp(shrink[0]) < 1e-6
    covered = quad(lambda x: 1 - (1 - b[0] * math.exp(-((x / shrink[0, 0]) ** 2) / 2)) ** count, -40, 40, limit=200)[0]
    assert covered == pytest.approx(opacity * math.sqrt(2 * math.pi), rel=2e-5)
    if count <= 7:
        series = sum(
            math.comb(i - 1, k) * (-1) ** k * b[0] ** (k + 1) / math.sqrt(k + 1)
            for i in range(1, count + 1)
            for k in range(i)
        )
        assert shrink[0, 0] == pytest.approx(opacity / series, rel=2e-5)


def test_faint_ones_move_by_their_covariance_and_others_stay():
    """Against the covariance of the paper's displacement, from 40,000 of them."""
    quat, scales = [0.3, -0.5, 0.7, 0.2], np.array([-3.0, -2.0, -1.0])
    count, opacity = 40_000, 0.012
    logit = math.log(opacity / (1 - opacity))
    model, growth = growth_on(count + 1, count + 1, quats=quat, scales=scales, opacities=logit)
    with torch.no_grad():
        model.parameters["opacities"][-1] = 0.0
    before = model.parameters["means"].detach().clone()
    growth.optimizer.set_iteration(0)
    growth.after_step(1)
    moved = (model.parameters["means"].detach() - before).double().numpy()
    turned = Rotation.from_quat(quat, scalar_first=True).as_matrix()
    covariance = turned @ np.diag(np.exp(2 * scales)) @ turned.T
    size = 5e5 * 0.00016 / (1 + math.exp(100 * (opacity - 0.005)))
    expected = size**2 * covariance @ covariance
    assert not moved[-1].any()
    assert np.abs(np.cov(moved[:-1].T) - expected).max() < 0.03 * np.abs(expected).max()
    assert np.abs(moved[:-1].mean(0)).max() < 0.03 * np.sqrt(np.abs(expected).max())


def test_prices_on_opacity_and_size():
    model, growth = growth_on(5, 5, scales=[-1.0, 0.0, 1.0])
    gaussians = model.activated()
    for leaf in (gaussians.opacities, gaussians.scales):
        leaf.retain_grad()
    loss = growth.loss(torch.zeros((), requires_grad=True) + 2.0, SimpleNamespace(gaussians=gaussians), None)
    loss.backward()
    assert loss.item() == pytest.approx(2 + 0.01 * 0.5 + 0.01 * (math.exp(-1) + 1 + math.e) / 3)
    assert torch.allclose(gaussians.opacities.grad, torch.tensor(0.01 / 5))
    assert torch.allclose(gaussians.scales.grad, torch.tensor(0.01 / 15))


def test_the_dead_go_to_the_living_as_often_as_these_are_opaque():
    """1,000 of 1,003 are dead; two of the rest are equally opaque, one is half as much."""
    model, growth = growth_on(1003, 1003)
    with torch.no_grad():
        model.parameters["opacities"][:] = -9.0
        model.parameters["opacities"][[5, 500, 1000]] = torch.tensor([0.0, 0.0, math.log(0.25 / 0.75)])
        model.parameters["scales"][7, 1] = math.nan
    change = growth.update(600)
    assert (change.cloned, change.split, change.pruned) == (1000, 0, 1000) and len(model) == 1003
    colors = model.parameters["sh_dc"].detach()[:, 0, 0]
    shares = [int((colors == 3.0 * row).sum()) for row in (5, 500, 1000)]
    assert sum(shares) == 1003 and np.abs(np.array(shares) - [400, 400, 200]).max() < 60  # four standard deviations
    assert all(torch.isfinite(tensor).all() for tensor in model.parameters.values())


def test_all_dead_is_refused():
    model, growth = growth_on(5, 9, opacities=-9.0)
    assert growth.update(600).refused and len(model) == 5


def test_a_twentieth_more_until_the_limit(scene):
    config = {**SCHEDULE, "growth": "mcmc", "max_gaussians": 4800, "densification_interval": 5}
    trainer, found = Trainer(scene, TrainConfig(**config)), []
    for iteration in range(1, 51):
        if iteration > 1:
            trainer.update(iteration - 1)
        trainer.differentiate(iteration)
        found.append(len(trainer.model))
    assert found[14:16] == [4500, 4725] and found[20] == found[-1] == 4800


def test_it_needs_a_limit(capsys, tmp_path):
    command = ["train", "-s", str(SCENE), "-r", "8", "-m", str(tmp_path / "a"), "--growth", "mcmc"]
    assert "--max_gaussians 0: expected the number of Gaussians that --growth mcmc ends with" in fails(capsys, *command)

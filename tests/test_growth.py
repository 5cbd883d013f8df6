"""Growth to a budget and as a Markov chain: exact numbers, what a split or a crowd leaves as it was, what is priced."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from commands import SCENE
from scenes import SCENES
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from splat_files import covariances
from trainings import Pretended, begin, steps

from warp_splat.config import RasterOptions
from warp_splat.gaussians import GaussianModel
from warp_splat.raster.api import render
from warp_splat.runtime.distributed import ALONE
from warp_splat.training.growth.budget import SMALLER, Budget, halves
from warp_splat.training.growth.mcmc import EXTENT, Mcmc, crowds
from warp_splat.training.growth.reference import Reference
from warp_splat.training.optimizer import Optimizer
from warp_splat.training.options import TrainConfig
from warp_splat.training.seams import Setting

POINTS = 4500  # of the scene


def count_steps(scene, budget, **options):
    """A training of 50 steps, and the Gaussians after each."""
    trainer, run = begin(scene, None, **{"growth": "budget", "max_gaussians": budget, **options})
    found = []
    steps(trainer, run, 50, lambda: found.append(len(trainer.model)))
    return trainer, found


@pytest.mark.parametrize(("budget", "until"), [(POINTS, 45), (5017, 45), (12_000, 45), (9001, 10**6), (1001, 45)])
def test_it_ends_with_exactly_as_many_as_asked_for(budget, until, scene):
    _, found = count_steps(scene, budget, densify_until_iter=until, opacity_lr=0.3)  # some fade away meanwhile
    assert found[-1] == budget and found == sorted(found, reverse=budget < POINTS) and found[19] == POINTS
    shares = [(step / (min(until, 50) - 10)) ** 0.5 if budget > POINTS else 1 for step in (10, 20)]
    due = [round(POINTS + (budget - POINTS) * share) for share in shares]
    assert [found[20], found[30]] == due


@pytest.mark.slow
@pytest.mark.parametrize("growth", ["budget", "mcmc"])
def test_any_number_of_threads_makes_the_same_bytes(growth, scene, threads):
    found = []
    for count in (1, 3):
        threads(count)
        trainer, counts = count_steps(scene, 5500, growth=growth, opacity_lr=0.3)
        found.append([counts, *(tensor.detach().numpy().tobytes() for tensor in trainer.model.parameters.values())])
    assert found[0] == found[1] and found[0][0][-1] > POINTS


@pytest.mark.parametrize("flags", ["--growth budget", "--preset fast --max_gaussians 0", "--growth mcmc"])
def test_a_budget_has_to_be_named(flags, fails, tmp_path):
    growth, least = ("mcmc", POINTS) if "mcmc" in flags else ("budget", 1)
    sentence = f"--max_gaussians 0: expected the number of Gaussians that --growth {growth} ends with, at least {least}"
    assert sentence in fails("train", "-s", SCENE, "-r", "8", "-m", tmp_path / "a", *flags.split())


@pytest.mark.parametrize(
    ("budget", "until", "sentence"),
    [
        (POINTS, 45, ""),
        (2 * POINTS, 21, ""),
        (4000, 45, f"Of {POINTS} Gaussians, --max_gaussians 4000 are left at the first densification."),
        (9001, 21, "--max_gaussians 9001 will not be reached, since 1 densifications double 4500 to 9000 at most."),
        (9001, 11, f"Warning: no densification before step 11, so {POINTS} Gaussians stay; take a later --dens"),
    ],
)
def test_what_a_budget_makes_is_told(budget, until, sentence, scene):
    trainer, found = count_steps(scene, budget, densify_until_iter=until)
    assert sentence in " ".join(trainer.told) and bool(trainer.told) == bool(sentence)
    assert found[-1] == (POINTS if until == 11 else min(budget, 2 * POINTS))


def growth_on(model, budget=None, processes=ALONE, iterations=2000):
    """A growth of a model."""
    config, scene = TrainConfig(growth="budget", densify_until_iter=iterations), SimpleNamespace(extent=1.0)
    setting = Setting(scene, model, torch.zeros(3), processes, 0, budget or len(model), iterations)
    return Budget(config.plugins["budget"], setting, Optimizer(model, config.learn, 1.0))


def test_any_budget_is_reached_in_two_billion_steps():
    model = GaussianModel.from_points(np.zeros((3, 3)), np.zeros((3, 3), np.uint8), 0)
    assert not growth_on(model, 10**8, iterations=2**31 - 1).told()


@pytest.mark.parametrize(("due", "pruned", "split"), [(50, 52, 2), (100, 3, 3), (102, 1, 3), (106, 0, 6), (199, 0, 99)])
def test_the_faintest_make_room(due, pruned, split):
    """So many that three of a hundred are split where the set grows by less."""
    model = GaussianModel.from_points(np.random.default_rng(0).normal(size=(100, 3)), np.zeros((100, 3), np.uint8), 0)
    change = growth_on(model, due)._grow(due)
    assert (change.pruned, change.split, len(model)) == (pruned, split, due)


def test_a_later_end_takes_no_gaussian_away():
    """As a training that goes on may have; the plan would have fewer by now."""
    model = GaussianModel.from_points(np.zeros((100, 3)), np.zeros((100, 3), np.uint8), 0)
    growth = growth_on(model, 120, iterations=4000)
    growth.start = 50
    assert [growth._due(iteration) for iteration in (600, 3000, 3900)] == [100, 109, 120]


def test_what_pulls_most_is_split():
    """By the mean over the views that showed it; what goes are the faintest."""
    model = GaussianModel.from_points(np.random.default_rng(0).normal(size=(100, 3)), np.zeros((100, 3), np.uint8), 0)
    means, growth = model.parameters["means"].detach().clone(), growth_on(model)
    model.parameters["opacities"].detach().copy_(torch.linspace(1.0, 2.0, 100))[[7, 40, 41]] = 0.0
    growth.views[:], growth.views[50] = 1.0, 4.0
    growth.gradient[[7, 11, 12, 13, 50]] = torch.tensor([9.0, 3.0, 2.0, 1.0, 7.0])
    change = growth._grow(100)
    assert (change.split, change.pruned, len(model)) == (3, 3, 100)
    left = model.parameters["means"].detach()
    gone = [row for row in range(100) if not bool((left == means[row]).all(1).any())]
    assert gone == [7, 11, 12, 40, 41, 50]


def some_splits():
    """Parameters before activation, of Gaussians in the view of a camera."""
    scene = SCENES["degree1"]()
    raw = {"means": scene.means, "sh_dc": scene.sh[:, :1], "sh_rest": scene.sh[:, 1:], "quats": scene.quats}
    raw |= {"opacities": torch.logit(scene.opacities), "scales": torch.log(scene.scales)}
    return scene, raw


def test_halves_have_the_moments_of_the_whole():
    _, raw = some_splits()
    raw["opacities"][:3] = torch.tensor([30.0, -30.0, 0.0])  # opaque, clear
    count, both = len(raw["means"]), halves(raw, torch.arange(len(raw["means"])))
    shapes = lambda rows: covariances(SimpleNamespace(quats=rows["quats"].numpy(), scales=rows["scales"].numpy()))  # noqa: E731
    means, middle = both["means"].double().numpy().reshape(2, count, 3), raw["means"].double().numpy()
    inner = shapes(both).reshape(2, count, 3, 3) / np.exp(2 * SMALLER)
    spread = np.einsum("hni,hnj->nij", means - middle, means - middle) / 2
    whole = shapes(raw)
    assert np.allclose(means.mean(0), middle, atol=1e-6)
    assert np.allclose(inner.mean(0) + spread, whole, atol=1e-3 * np.abs(whole).max((1, 2)).max())
    a, b = (torch.sigmoid(rows["opacities"].double()).numpy() for rows in (raw, both))
    assert np.allclose((1 - b[:count]) * (1 - b[count:]), 1 - a, atol=2e-6)
    assert all(torch.isfinite(rows).all() for rows in both.values())


def test_a_split_leaves_the_picture_about_as_it_was():
    """All Gaussians at once, against the two samples of each that the reference takes."""
    scene, raw = some_splits()
    everything = torch.arange(len(raw["means"]))

    def picture(rows):
        with torch.no_grad():
            return render(GaussianModel(rows).activated(), scene.camera, scene.background, RasterOptions()).image

    samples = SimpleNamespace(random=torch.Generator().manual_seed(0), processes=ALONE)
    split = (halves(raw, everything), Reference._children(samples, raw, everything))
    changes = [float((picture(rows) - picture(raw)).abs().mean()) for rows in split]
    assert changes[0] < 0.5 * changes[1] and changes[0] < 0.03


def test_processes_add_what_they_saw(monkeypatch):
    """Two that saw half each split the same ones as one that saw all."""
    model = GaussianModel.from_points(np.random.default_rng(0).normal(size=(50, 3)), np.zeros((50, 3), np.uint8), 0)
    alone, first = (growth_on(GaussianModel(model.parameters), 70) for _ in range(2))
    values = {name: torch.rand(2, 50, generator=torch.Generator().manual_seed(1)) for name in alone.statistics()}
    for name, rows in alone.statistics().items():
        rows.copy_(values[name].sum(0).to(rows.dtype))
    for name, rows in first.statistics().items():
        rows.copy_(values[name][0].to(rows.dtype))
    shared = Pretended(0, 1)
    other = {rows.data_ptr(): values[name][1] for name, rows in first.statistics().items()}
    monkeypatch.setattr(shared, "merge", lambda rows: rows.add_(other[rows.data_ptr()]))
    first.processes = shared
    assert alone._grow(70) == first._grow(70)
    torch.testing.assert_close(alone.model.parameters, first.model.parameters, rtol=0, atol=0)


def mcmc_on(count, budget, iterations=1000, extent=EXTENT, **raw):
    """A growth of equal Gaussians; of ``raw``, parameters before activation."""
    rows = {"means": [0.0] * 3, "scales": [0.0] * 3, "quats": [1.0, 0, 0, 0], "opacities": 0.0}
    rows = {name: torch.tensor(value).repeat(count, *[1] * np.ndim(value)) for name, value in rows.items()}
    rows |= {"sh_dc": torch.arange(3.0 * count).view(count, 1, 3), "sh_rest": torch.zeros(count, 0, 3)}
    rows |= {name: torch.as_tensor(value, dtype=torch.float32).expand_as(rows[name]) for name, value in raw.items()}
    model, config = GaussianModel(rows), TrainConfig(growth="mcmc")
    setting = Setting(SimpleNamespace(extent=extent), model, torch.zeros(3), ALONE, 0, budget, iterations)
    return model, Mcmc(config.plugins["mcmc"], setting, Optimizer(model, config.learn, extent / EXTENT))


@pytest.mark.parametrize("count", [1, 2, 3, 7, 60])
@pytest.mark.parametrize("opacity", [0.006, 0.3, 0.9, 0.999])
def test_a_crowd_is_as_opaque_as_the_one(count, opacity):
    """In the middle, and summed up along a line (SciPy's quadrature); for few by the paper's sum, too."""
    logit = math.log(opacity / (1 - opacity))
    model, _ = mcmc_on(3, 3, opacities=logit, scales=[0.5, -1.0, 2.0])
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
        pairs = [(i, k) for i in range(1, count + 1) for k in range(i)]
        series = sum(math.comb(i - 1, k) * (-1) ** k * b[0] ** (k + 1) / math.sqrt(k + 1) for i, k in pairs)
        assert shrink[0, 0] == pytest.approx(opacity / series, rel=2e-5)


def test_faint_ones_move_by_their_covariance_and_others_stay(driver):
    """Against the covariance of the paper's displacement, from 40,000 of them."""
    quat, scales = [0.3, -0.5, 0.7, 0.2], np.array([-3.0, -2.0, -1.0])
    count, opacity = 40_000, 0.012
    logit = math.log(opacity / (1 - opacity))
    model, growth = mcmc_on(count + 1, count + 1, quats=quat, scales=scales, opacities=logit)
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


def test_the_unit_of_length_does_not_matter():
    """Of a scene 64 times as large, noise is 64 times as large, and prices are the same."""
    found = []
    for times in (1.0, 64.0):
        scales = np.array([-3.0, -2.0, -1.0]) + np.log(times)
        model, growth = mcmc_on(5, 5, extent=times * EXTENT, scales=scales, opacities=-4.4)
        growth.optimizer.set_iteration(0)
        price = growth.price(model.activated()).item()
        growth.after_step(1)
        found.append([price, *(model.parameters["means"].detach() / times).ravel().tolist()])
    assert found[1] == pytest.approx(found[0], rel=1e-5) and found[0][1] != 0


def test_prices_on_opacity_and_size():
    model, growth = mcmc_on(5, 5, scales=[-1.0, 0.0, 1.0])
    gaussians = model.activated()
    for leaf in (gaussians.opacities, gaussians.scales):
        leaf.retain_grad()
    price = growth.price(gaussians)
    price.backward()
    assert price.item() == pytest.approx(0.01 * 0.5 + 0.01 * (math.exp(-1) + 1 + math.e) / 3)
    assert torch.allclose(gaussians.opacities.grad, torch.tensor(0.01 / 5))
    assert torch.allclose(gaussians.scales.grad, torch.tensor(0.01 / 15))


def test_the_dead_go_to_the_living_as_often_as_these_are_opaque():
    """1,000 of 1,003 are dead; two of the rest are equally opaque, one is half as much."""
    model, growth = mcmc_on(1003, 1003)
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
    model, growth = mcmc_on(5, 9, opacities=-9.0)
    assert growth.update(600).refused and len(model) == 5


def test_a_twentieth_more_until_the_limit(scene):
    _, found = count_steps(scene, 4800, growth="mcmc", densification_interval=5)
    assert found[14:16] == [4500, 4725] and found[20] == found[-1] == 4800

"""Growth to a budget: exact numbers, what a split leaves as it was, and the error that a Gaussian carries."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scenes import SCENES
from scipy.spatial.transform import Rotation
from test_checkpoints import SCHEDULE
from test_distributed import Pretended
from test_train import SCENE, fails

from warp_splat.config import RasterOptions
from warp_splat.gaussians import GaussianModel
from warp_splat.raster.api import render
from warp_splat.runtime import pool
from warp_splat.runtime.distributed import ALONE
from warp_splat.training.growth.budget import SMALLER, Budget, halves
from warp_splat.training.growth.reference import Reference
from warp_splat.training.optimizer import Optimizer
from warp_splat.training.options import TrainConfig
from warp_splat.training.seams import Setting
from warp_splat.training.trainer import Trainer

POINTS = 4500  # of the scene


def count_steps(scene, budget, **options):
    """A training of 50 steps, and the Gaussians after each."""
    config = TrainConfig(**{**SCHEDULE, "growth": "budget", "max_gaussians": budget, **options})
    trainer, found = Trainer(scene, config), []
    for iteration in range(1, 51):
        if iteration > 1:
            trainer.update(iteration - 1)
        trainer.differentiate(iteration)
        found.append(len(trainer.model))
    return trainer, found


@pytest.mark.parametrize(("budget", "until"), [(POINTS, 45), (5017, 45), (12_000, 45), (9001, 10**6), (1001, 45)])
def test_it_ends_with_exactly_as_many_as_asked_for(budget, until, scene):
    _, found = count_steps(scene, budget, densify_until_iter=until, opacity_lr=0.3)  # some fade away meanwhile
    assert found[-1] == budget and found == sorted(found, reverse=budget < POINTS) and found[19] == POINTS
    due = [round(POINTS + (budget - POINTS) * (step / (min(until, 50) - 10)) ** 0.5) for step in (10, 20)]
    assert [found[20], found[30]] == due


@pytest.mark.slow
@pytest.mark.parametrize("growth", ["budget", "mcmc"])
def test_any_number_of_threads_makes_the_same_bytes(growth, scene):
    before, found = pool.get_threads(), []
    for threads in (1, 3):
        pool.set_threads(threads)
        trainer, counts = count_steps(scene, 5500, growth=growth, opacity_lr=0.3)
        found.append([counts, *(tensor.detach().numpy().tobytes() for tensor in trainer.model.parameters.values())])
    pool.set_threads(before)
    assert found[0] == found[1] and found[0][0][-1] > POINTS


@pytest.mark.parametrize("flags", ["--growth budget", "--preset fast --max_gaussians 0"])
def test_a_budget_has_to_be_named(flags, capsys, tmp_path):
    command = ["train", "-s", str(SCENE), "-r", "8", "-m", str(tmp_path / "a"), *flags.split()]
    sentence = "--max_gaussians 0: expected the number of Gaussians that --growth budget ends with, at least 1"
    assert sentence in fails(capsys, *command)


@pytest.mark.parametrize(
    ("budget", "until", "sentence"),
    [
        (POINTS, 45, ""),
        (2 * POINTS, 21, ""),
        (4000, 45, f"The faintest of {POINTS} Gaussians go, until there are --max_gaussians 4000."),
        (
            9001,
            21,
            f"--max_gaussians 9001 will not be reached, since 1 densifications double {POINTS} to 9000 at most.",
        ),
        (9001, 11, f"Warning: no densification before step 11: there will be {POINTS} Gaussians as now."),
    ],
)
def test_what_a_budget_makes_is_told(budget, until, sentence, scene):
    trainer, found = count_steps(scene, budget, densify_until_iter=until)
    assert sentence in " ".join(trainer.told) and bool(trainer.told) == bool(sentence)
    assert found[-1] == (POINTS if until == 11 else min(budget, 2 * POINTS))


def growth_on(model, budget=None, processes=ALONE):
    """A growth of a model."""
    config, scene = TrainConfig(growth="budget"), SimpleNamespace(extent=1.0)
    setting = Setting(scene, model, torch.zeros(3), processes, 0, budget or len(model), 2000)
    return Budget(config.plugins["budget"], setting, Optimizer(model, config.learn, 1.0))


def test_where_it_is_full_the_faintest_make_room():
    """Two of a hundred; what is split is what pulled most at its place in the views that showed it."""
    model = GaussianModel.from_points(np.random.default_rng(0).normal(size=(100, 3)), np.zeros((100, 3), np.uint8), 0)
    means, growth = model.parameters["means"].detach().clone(), growth_on(model)
    model.parameters["opacities"].detach().copy_(torch.linspace(1.0, 2.0, 100))[[7, 40]] = 0.0
    growth.views[:], growth.views[50] = 1.0, 4.0
    growth.gradient[[7, 11, 12, 13, 50]] = torch.tensor([9.0, 3.0, 2.0, 1.0, 7.0])
    change = growth._grow(100)
    assert (change.split, change.pruned, len(model)) == (2, 2, 100)
    left = model.parameters["means"].detach()
    assert [row for row in range(100) if not bool((left == means[row]).all(1).any())] == [7, 11, 12, 40]


def some_splits():
    """Parameters before activation, of Gaussians in the view of a camera."""
    scene = SCENES["degree1"]()
    opacities = scene.opacities
    raw = {
        "means": scene.means,
        "sh_dc": scene.sh[:, :1],
        "sh_rest": scene.sh[:, 1:],
        "opacities": torch.log(opacities / (1 - opacities)),
        "scales": torch.log(scene.scales),
        "quats": scene.quats,
    }
    return scene, raw


def test_halves_have_the_moments_of_the_whole():
    _, raw = some_splits()
    raw["opacities"][:3] = torch.tensor([30.0, -30.0, 0.0])  # opaque, clear
    count, both = len(raw["means"]), halves(raw, torch.arange(len(raw["means"])))

    def covariances(rows):
        turned = Rotation.from_quat(rows["quats"].double().numpy(), scalar_first=True).as_matrix()
        return np.einsum("nij,nj,nkj->nik", turned, np.exp(2 * rows["scales"].double().numpy()), turned)

    means, middle = both["means"].double().numpy().reshape(2, count, 3), raw["means"].double().numpy()
    inner = covariances(both).reshape(2, count, 3, 3) / np.exp(2 * SMALLER)
    spread = np.einsum("hni,hnj->nij", means - middle, means - middle) / 2
    whole = covariances(raw)
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

    samples = SimpleNamespace(random=torch.Generator().manual_seed(0))
    changes = [
        float((picture(rows) - picture(raw)).abs().mean())
        for rows in (halves(raw, everything), Reference._children(samples, raw, everything))
    ]
    assert changes[0] < 0.5 * changes[1] and changes[0] < 0.03


def test_processes_add_what_they_saw(scene, monkeypatch):
    """Two that saw half each split the same ones as one that saw all."""
    model = GaussianModel.from_points(np.random.default_rng(0).normal(size=(50, 3)), np.zeros((50, 3), np.uint8), 0)
    alone, first = (growth_on(GaussianModel(model.parameters), 70) for _ in range(2))
    first.processes = first.setting.processes
    values = {name: torch.rand(2, 50, generator=torch.Generator().manual_seed(1)) for name in alone.statistics()}
    for name, rows in alone.statistics().items():
        rows.copy_(values[name].sum(0).to(rows.dtype))
    for name, rows in first.statistics().items():
        rows.copy_(values[name][0].to(rows.dtype))
    shared = Pretended(0, 1)
    other = {rows.data_ptr(): values[name][1] for name, rows in first.statistics().items()}
    monkeypatch.setattr(shared, "sum", lambda rows: rows.add_(other[rows.data_ptr()]))
    first.processes = shared
    assert alone._grow(70) == first._grow(70)
    for name, tensor in alone.model.parameters.items():
        assert torch.equal(tensor, first.model.parameters[name])

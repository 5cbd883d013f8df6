"""Growing, pruning and Adam's moments, against what the reference prescribes (torch's own Adam where it decides)."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from common import using
from scipy.spatial.transform import Rotation

from warp_splat.errors import InputError
from warp_splat.formats.curve import along_curve
from warp_splat.gaussians import GaussianModel
from warp_splat.raster.drivers import CPU, CUDA
from warp_splat.runtime.distributed import ALONE
from warp_splat.training import adam_step
from warp_splat.training.adam_step import HALF, move
from warp_splat.training.growth.reference import Reference, rotate
from warp_splat.training.optimizer import BETAS, Optimizer
from warp_splat.training.options import TrainConfig
from warp_splat.training.seams import Setting, Step

EXTENT = 10.0


def setup(count=6, rows=None, **options):
    """A model, with these ``rows`` of its parameters; its optimizer and its growth."""
    rng = np.random.default_rng(0)
    config = TrainConfig(**options)
    model = GaussianModel.from_points(rng.uniform(-1, 1, (count, 3)), rng.integers(0, 255, (count, 3)), sh_degree=1)
    with torch.no_grad():
        for name, values in (rows or {}).items():
            table = model.parameters[name]
            table[:] = torch.as_tensor(values, dtype=torch.float32).reshape(table.shape)
    optimizer = Optimizer(model, config.learn, EXTENT)
    background = torch.full((3,), float(config.data.white_background))
    scene: Any = SimpleNamespace(extent=EXTENT)
    setting = Setting(scene, model, background, ALONE, config.learn.seed, config.grow.max_gaussians, 1)
    return model, optimizer, Reference(config.plugins["reference"], setting, optimizer)


def observe(densifier, gradients, width=100, height=50):
    """One view in which Gaussian i has the 2D gradient (gradients[i], 0) and is drawn where that is not None."""
    drawn = torch.tensor([value is not None for value in gradients])
    grad = torch.tensor([[value or 0.0, 0.0] for value in gradients])
    image = torch.empty(height, width, 3)
    out = SimpleNamespace(means2d=SimpleNamespace(grad=grad), radii=drawn.int() * 7, image=image)
    densifier.observe(out, Step(1, None))


def test_initial_scale_is_the_distance_to_three_neighbors():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [50, 50, 50]], dtype=np.float32)
    model = GaussianModel.from_points(points, np.full((5, 3), 128, np.uint8), sh_degree=3)
    _, quats, scales, opacities, sh_dc, sh_rest = model.activated()
    assert torch.allclose(scales[0], torch.tensor(((1 + 4 + 9) / 3) ** 0.5).expand(3))
    assert torch.allclose(opacities, torch.tensor(0.1)) and (quats == torch.tensor([1.0, 0, 0, 0])).all()
    assert torch.allclose(0.28209479 * sh_dc + 0.5, torch.tensor(128 / 255)) and sh_rest.shape == (5, 15, 3)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_scene_of_few_points_starts(count):
    model = GaussianModel.from_points(np.eye(3, dtype=np.float32)[:count], np.zeros((count, 3), np.uint8), 0)
    assert all(torch.isfinite(tensor).all() for tensor in model.activated())


def test_gradients_are_averaged_over_views_in_ndc_units():
    _, _, densifier = setup(3)
    threshold = 0.0002 / 50  # px of an image 100 wide
    observe(densifier, [1.9 * threshold, 0.9 * threshold, 1.1 * threshold])
    observe(densifier, [0.0, 0.9 * threshold, None])
    assert densifier._choose().tolist() == [2]


def test_small_ones_are_cloned_and_large_ones_split():
    scales = [[-4.0] * 3, [1.0, -2, -2], [-4.0] * 3, [1.0] * 3]
    model, _, densifier = setup(4, {"scales": scales, "opacities": [0.0] * 4})
    means, sh = model.parameters["means"].detach().clone(), model.parameters["sh_dc"].detach().clone()
    observe(densifier, [1.0, 1.0, 0.0, 0.0])
    change = densifier.update(600)
    assert (change.cloned, change.split, change.pruned) == (1, 1, 0)
    raw = {name: tensor.detach() for name, tensor in model.parameters.items()}
    of = [(raw["sh_dc"] == color).flatten(1).all(1) for color in sh]  # which are of each of the four
    assert [int(rows.sum()) for rows in of] == [2, 2, 1, 1]
    assert all((raw["means"][of[i]] == means[i]).all() for i in (0, 2, 3))
    assert torch.allclose(raw["scales"][of[1]], torch.tensor([1.0, -2, -2]) - np.log(1.6))
    offsets = (raw["means"][of[1]] - means[1]).abs()
    assert (offsets > 0).all() and (offsets[:, 1:] < 5 * np.exp(-2)).all()


def test_faint_ones_are_pruned_and_large_ones_only_after_a_reset():
    rows = {"opacities": [-6.0, 0, 0, 0], "scales": [[-3.0] * 3, [0.1] * 3, [-3.0] * 3, [-3.0] * 3]}
    model, _, densifier = setup(4, rows)
    assert densifier.update(600).pruned == 1 and len(model) == 3
    assert densifier.update(3100).pruned == 1 and len(model) == 2  # exp(0.1) > 0.1 x extent


def test_pruning_never_empties_the_scene():
    model, _, densifier = setup(5, {"opacities": [-9.0] * 5})
    change = densifier.update(600)
    assert change.refused and change.pruned == 0 and len(model) == 5


def test_a_gaussian_that_is_not_finite_is_pruned():
    scales = [[-3.0] * 3, [-3.0] * 3, [-3.0, np.nan, -3.0], [-3.0] * 3]
    model, _, densifier = setup(4, {"opacities": [0.0] * 4, "scales": scales})
    densifier.update(600)
    assert len(model) == 3 and all(torch.isfinite(tensor).all() for tensor in model.parameters.values())


@pytest.mark.parametrize(("limit", "pruned"), [(0, 0), (6, 2), (7, 0)])
def test_screen_size_prunes_only_on_request(limit, pruned):
    rows = {"opacities": [0.0] * 3, "scales": [[-3.0] * 3] * 3}
    model, _, densifier = setup(3, rows, prune_screen_size=limit)
    observe(densifier, [0.0, 0.0, None])  # radius 7 where drawn
    densifier.radius[2] = 1
    assert densifier.update(3100).pruned == pruned and len(model) == 3 - pruned


def test_growth_stops_at_the_limit_with_the_largest_gradients():
    model, _, densifier = setup(6, {"scales": [[-4.0] * 3] * 6, "opacities": [0.0] * 6}, max_gaussians=8)
    means = model.parameters["means"].detach().clone()
    observe(densifier, [1.0, 5.0, 2.0, 4.0, 3.0, 0.0])
    densifier.update(600)
    grown = model.parameters["means"].detach()
    assert [int((grown == mean).all(1).sum()) for mean in means] == [1, 2, 1, 2, 1, 1]


def test_schedule():
    _, _, densifier = setup(4)
    assert densifier.update(500) is None and densifier.update(650) is None and densifier.update(15_000) is None
    assert densifier.update(700) is not None


@pytest.mark.parametrize(("iteration", "white"), [(3000, False), (500, True)])
def test_opacities_are_reset(iteration, white):
    """Over white, also before the set begins to grow."""
    model, _, densifier = setup(4, {"opacities": [2.0] * 4}, white_background=white)
    densifier.update(iteration)
    assert torch.allclose(torch.sigmoid(model.parameters["opacities"].detach()), torch.tensor(0.01))


def step(model, optimizer, gradients, radii=None):
    """One with a gradient for each Gaussian, all of whose numbers have the same."""
    column = torch.as_tensor(gradients, dtype=torch.float32).expand(len(model))[:, None]
    for tensor in model.parameters.values():
        tensor.grad = torch.empty_like(tensor)
        tensor.grad.view(len(model), -1)[:] = column
    optimizer.step(torch.ones(len(model), dtype=torch.int32) if radii is None else radii)


def test_moments_follow_their_gaussians():
    """A survivor moves on exactly as in a run where the set never changed; a new one starts from zero moments."""
    model, optimizer, _ = setup(5)
    alone, other, _ = setup(5)
    for _ in range(3):
        step(model, optimizer, [0.1, 0.2, -0.3, 0.4, 0.5])
        step(alone, other, [0.1, 0.2, -0.3, 0.4, 0.5])
    added = {name: tensor.detach()[:1].clone() for name, tensor in model.parameters.items()}
    optimizer.replace(torch.tensor([1, 4]), added)
    step(model, optimizer, -0.25)
    step(alone, other, -0.25)
    for name, tensor in model.parameters.items():
        assert torch.equal(tensor.detach()[:2], alone.parameters[name].detach()[[1, 4]])
        moment = optimizer.tables[name].moments[0][2]
        assert torch.allclose(moment, torch.full_like(moment, 0.1 * -0.25))


def test_moments_follow_when_rows_are_arranged():
    model, optimizer, _ = setup(5)
    alone, other, _ = setup(5)
    order, gradients = torch.tensor([3, 0, 4, 1, 2]), torch.tensor([0.1, 0.2, -0.3, 0.4, 0.5])
    step(model, optimizer, gradients)
    step(alone, other, gradients)
    optimizer.arrange(lambda rows: rows[order])
    for name, tensor in model.parameters.items():
        assert torch.equal(tensor.detach(), alone.parameters[name].detach()[order])
        pairs = zip(optimizer.tables[name].moments, other.tables[name].moments, strict=True)
        assert all(torch.equal(moment, expected[order]) for moment, expected in pairs)


def test_densification_arranges_the_set_along_a_curve():
    model, _, densifier = setup(50, {"scales": [[-4.0] * 3] * 50, "opacities": [0.0] * 50})
    observe(densifier, [1.0] * 50)
    densifier.update(600)
    means = model.parameters["means"].detach()
    assert len(means) == 100 and torch.equal(along_curve(means), torch.arange(100))


def test_a_curve_keeps_neighbors_together():
    """Along the curve the next one is far nearer than a random one; cells by hand for the corners of a cube."""
    corners = torch.tensor([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
    assert corners[along_curve(corners)].tolist() == [
        [0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1],
    ]  # fmt: skip
    points = torch.randn(3000, 3, generator=torch.Generator().manual_seed(0))
    points[7] = 1e30
    order = along_curve(points)
    assert sorted(order.tolist()) == list(range(3000))
    near = points[order[order != 7]].diff(dim=0).norm(dim=1).median()
    assert near < 0.2 * points[points[:, 0] < 1e3].diff(dim=0).norm(dim=1).median()


@pytest.mark.parametrize("value", [0.0, float("nan"), float("inf"), -float("inf"), 3e38])
@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_a_curve_takes_all_points(count, value):
    points = torch.linspace(-3e38, 3e38, 3 * count).reshape(count, 3)
    points[: count // 2] = value
    assert sorted(along_curve(points).tolist()) == list(range(count))


def test_reset_forgets_the_opacities_moments_only():
    model, optimizer, _ = setup(4)
    step(model, optimizer, 0.5)
    optimizer.reset_opacities(0.01)
    for name in model.parameters:
        assert ((optimizer.tables[name].moments[0] == 0) == (name == "opacities")).all()


def test_rate_of_the_means_decays_exponentially():
    _, optimizer, _ = setup(2, position_lr_init=1e-2, position_lr_final=1e-4, position_lr_max_steps=100)
    for iteration, rate in ((0, 1e-2), (50, 1e-3), (100, 1e-4), (200, 1e-4)):
        optimizer.set_iteration(iteration)
        assert optimizer.tables["means"].rate == pytest.approx(rate * EXTENT)


def test_all_rates_fall_to_a_tenth_in_the_end():
    _, optimizer, _ = setup(2, iterations=100, cooldown=20, position_lr_init=1e-2, position_lr_final=1e-2)
    optimizer.set_iteration(0)
    start = [table.rate for table in optimizer.tables.values()]
    for iteration, share in ((80, 1.0), (90, 0.1**0.5), (100, 0.1)):
        optimizer.set_iteration(iteration)
        assert [table.rate for table in optimizer.tables.values()] == pytest.approx([share * lr for lr in start])


def test_sparse_adam_moves_only_what_was_drawn():
    """Against the formula in float64: no bias correction, rows out of view keep value and moments."""
    model, optimizer, _ = setup(4, optimizer_type="sparse_adam")
    start = {name: tensor.detach().clone() for name, tensor in model.parameters.items()}
    for gradient, radii in ((0.5, [3, 0, 1, 0]), (-0.2, [3, 3, 0, 0])):
        step(model, optimizer, gradient, torch.tensor(radii, dtype=torch.int32))
    moved = model.parameters["scales"].detach() - start["scales"]
    change = {}
    for history in ((0.5, -0.2), (-0.2,), (0.5,)):
        m = v = total = 0.0
        for g in history:
            m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
            total -= 0.005 * m / (v**0.5 + 1e-15)
        change[history] = total
    expected = torch.tensor([change[0.5, -0.2], change[-0.2,], change[0.5,], 0.0])
    assert torch.allclose(moved, expected[:, None].expand(4, 3), atol=1e-6)


@pytest.mark.parametrize("leaf", [torch.zeros(3, dtype=torch.float64), torch.zeros(4, 2).T, torch.zeros(())])
def test_what_a_part_learns_is_dense_float32(leaf):
    model = GaussianModel.from_points(np.eye(3), np.zeros((3, 3), np.uint8), 0)
    with pytest.raises(InputError, match=r"expected dense float32 \[N, ...\], got gain of torch\.float"):
        Optimizer(model, TrainConfig().learn, EXTENT, parts=[{"name": "gain", "params": [leaf], "lr": 0.1}])


def test_rotation_against_scipy():
    rng = np.random.default_rng(1)
    quats, vectors = rng.normal(size=(20, 4)), rng.normal(size=(20, 3))
    expected = Rotation.from_quat(quats, scalar_first=True).apply(vectors)
    assert np.allclose(rotate(torch.tensor(quats), torch.tensor(vectors)).numpy(), expected)


RATE, EPS = 0.01, 1e-15
WIDTHS = (3, 45)


def tables_of(rows, kind):
    """Values, gradients and moments of two tables; gradients of many sizes."""
    random = torch.Generator().manual_seed(0)
    values = [torch.randn(rows, width, generator=random) for width in WIDTHS]
    grads = [value * 10.0 ** torch.randint(-9, 1, value.shape, generator=random) for value in values]
    zeros = [[torch.zeros_like(value, dtype=kind) for _ in range(2)] for value in values]
    return [[value.clone(), grad, *moments] for value, grad, moments in zip(values, grads, zeros, strict=True)]


def steps(tables, count, radii=None):
    for step in range(1, count + 1):
        bias1, bias2 = (1.0 - beta**step for beta in BETAS)
        betas = [number for beta in BETAS for number in (beta, 1.0 - beta)]
        numbers = [[RATE / bias1, EPS, bias2**-0.5, *betas]] * len(tables)
        move(tables, numbers, len(tables[0][0]), radii, step)


def bytes_of(tables):
    return b"".join(tensor.view(torch.uint8).numpy().tobytes() for table in tables for tensor in table)


def test_it_learns_as_with_32_bits():
    """Against float64 over steps in which the second moment changes by less than half of what 16 bits tell apart."""
    tables = tables_of(203, HALF)
    start = [value.double() for value, *_ in tables]
    steps(tables, 200)
    for before, (value, grad, first, second) in zip(start, tables, strict=True):
        exact = grad.double()
        mean, square = (1 - BETAS[0] ** 200) * exact, (1 - BETAS[1] ** 200) * exact * exact
        assert ((value - before) / (-RATE * 200 * exact.sign()) - 1.0)[exact != 0].abs().max() < 0.05
        for found, expected in ((first, mean), (second, square)):
            ratio = found.double()[expected != 0] / expected[expected != 0]
            assert (ratio - 1.0).abs().max() < 0.12 and ratio.mean() == pytest.approx(1.0, abs=2e-3)


def test_the_mean_is_kept_and_what_fits_stays():
    """Of 60,000 numbers between two of 16 bits, each rounded to either."""
    value = 1.0 + 2.0**-7 * 0.3
    rows = 20_000
    tables = [[torch.zeros(rows, 3), torch.full((rows, 3), value), *(torch.zeros(rows, 3, dtype=HALF) for _ in "12")]]
    move(tables, [[0.0, 1.0, 1.0, 0.0, 1.0, 0.0, 1.0]], rows, None, 7)
    first = tables[0][2].double().numpy()
    assert set(np.unique(first)) == {1.0, 1.0 + 2.0**-7}
    assert (first > 1.0).mean() == pytest.approx(0.3, abs=0.01)
    second, before = tables[0][3].double(), tables[0][2].clone()
    assert second.mean() == pytest.approx(value * value, abs=1e-4)
    move(tables, [[0.0, 1.0, 1.0, 1.0, 0.0, 1.0, 0.0]], rows, None, 8)
    assert torch.equal(tables[0][2], before)


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize("kind", [HALF, torch.float32])
def test_the_same_bytes_on_any_driver_and_number_of_threads(sparse, kind, monkeypatch, threads):
    """And however many numbers a GPU takes in a launch."""
    found, row = set(), torch.arange(2603, dtype=torch.int32)
    radii = torch.where(row // 16 % 3 < 2, row // 16 % 3, row % 3) if sparse else None  # none, all, some of sixteen
    for driver, count, most in ((CPU, 1, None), (CPU, 3, None), (CUDA, 1, adam_step.MOST), (CUDA, 1, 50_000)):
        threads(count)
        monkeypatch.setattr(adam_step, "MOST", most)
        tables = tables_of(2603, kind)
        with using(driver):
            steps(tables, 3, radii)
        found.add(bytes_of(tables))
    assert len(found) == 1

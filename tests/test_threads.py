"""What the threads of the CPU share of torch's work is what one of them computes alone, bit for bit."""

import hashlib
import threading
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from commands import python
from made_up import make_trainer

from warp_splat import Camera, RasterOptions, rasterize
from warp_splat.gaussians import GaussianModel
from warp_splat.kernels.project.quarantine import quarantine
from warp_splat.raster import bin, project
from warp_splat.raster.data import Dropped, Gaussians
from warp_splat.runtime import launch, pool
from warp_splat.runtime.distributed import ALONE
from warp_splat.training.growth.reference import Reference
from warp_splat.training.optimizer import EPS, Optimizer
from warp_splat.training.options import TrainConfig
from warp_splat.training.seams import Setting, Step

COUNT = 5003  # no multiple of what any processor computes at once


@pytest.fixture(params=[1, 2, 3])
def threads(request, monkeypatch, threads):
    """So many of ours, and one of torch's: with more it shares its work by itself."""
    of_torch = torch.get_num_threads()
    monkeypatch.setattr(pool, "SMALLEST_OF_TORCH", 1024)
    threads(request.param)
    torch.set_num_threads(1)
    yield request.param
    torch.set_num_threads(of_torch)


@pytest.fixture
def model():
    generator = torch.Generator().manual_seed(0)
    shapes = {"means": (3,), "sh_dc": (1, 3), "sh_rest": (15, 3), "opacities": (), "scales": (3,), "quats": (4,)}
    return GaussianModel({name: torch.randn(COUNT, *shape, generator=generator) for name, shape in shapes.items()})


def test_slices_cover_everything_in_whole_widths(threads):
    for count in (0, 1, 63, 64, 65, 2047, 2048, 2049, COUNT, 10**6):
        bounds = pool.torch_slices(count)
        assert bounds[0] == 0 and bounds[-1] == count and bounds == sorted(bounds) and len(bounds) <= threads + 1
        assert all(bound % pool.WIDTH == 0 for bound in bounds[:-1])
    assert len(pool.torch_slices(10**6)) == threads + 1
    assert pool.torch_slices(10**6, "cuda") == [0, 10**6]
    torch.set_num_threads(2)
    assert pool.torch_slices(10**6) == [0, 10**6]


def test_shares_fall_and_the_first_leaves_something_to_each_thread(threads):
    for work in (0, 1, 4095, 9000, 20_000, 50_000, 10**6):
        sizes = np.diff(shares := pool.falling_shares(work))
        assert shares[0] == 0.0 and shares[-1] == 1.0 and (np.diff(sizes) < 1e-12).all()
        assert len(sizes) == 1 or sizes[0] <= max(1.0 / len(sizes), 0.4 / threads) + 1e-12
        assert len(sizes) <= threads or len(sizes) >= 2 * threads  # else some take two slices, the others one
        assert threads == 1 or work < 10**6 or sizes[-1] < 0.1 * sizes[0]


def test_steps_are_those_of_adam_in_torch(threads, model):
    """The coefficients of higher degrees get no gradients at first: zeros to torch."""
    optimizer = Optimizer(model, TrainConfig().learn, extent=2.0)
    copies = {name: tensor.detach().double().requires_grad_() for name, tensor in model.parameters.items()}
    groups = [{"params": [copies[name]], "lr": table.rate} for name, table in optimizer.tables.items()]
    expected = torch.optim.Adam(groups, eps=EPS)
    generator = torch.Generator().manual_seed(1)
    for iteration in range(4):
        for name, tensor in model.parameters.items():
            grad = torch.randn(tensor.shape, generator=generator)
            with_rest = name != "sh_rest" or iteration > 1
            tensor.grad = grad if with_rest else None
            copies[name].grad = grad.double() if with_rest else torch.zeros_like(copies[name])
        optimizer.step(torch.ones(COUNT, dtype=torch.int32))
        expected.step()
    for name, tensor in model.parameters.items():
        assert torch.allclose(tensor.double(), copies[name], rtol=2e-7, atol=1e-7) and tensor.grad is None
        table, known = optimizer.tables[name], expected.state[copies[name]]
        assert table.steps == known["step"]
        for key, moment in zip(("exp_avg", "exp_avg_sq"), table.moments, strict=True):
            assert torch.allclose(moment.double(), known[key], rtol=1e-6, atol=1e-7)


def test_activations_are_those_of_torch(threads, model):
    """In float64."""
    with torch.no_grad():
        model.parameters["scales"][:3] = torch.tensor([[90.0], [-200.0], [float("nan")]])
    raw = {name: model.parameters[name].detach().double().requires_grad_() for name in ("scales", "opacities")}
    expected = torch.exp(raw["scales"].clamp_max(88.0)), torch.sigmoid(raw["opacities"])
    found = model.activated()[2:4]
    upstream = [torch.randn(tensor.shape, generator=torch.Generator().manual_seed(2)) for tensor in expected]
    torch.autograd.backward(found, upstream)
    torch.autograd.backward(expected, [tensor.double() for tensor in upstream])
    for name, one, other in zip(raw, found, expected, strict=True):
        assert torch.allclose(one.double(), other, rtol=2e-7, atol=2e-38, equal_nan=True)
        assert torch.allclose(model.parameters[name].grad.double(), raw[name].grad, rtol=4e-7, atol=1e-7)


@pytest.mark.parametrize("mode", [torch.inference_mode, torch.no_grad, torch.enable_grad])
def test_activations_in_any_mode_of_torch(threads, model, mode):
    expected = [tensor.detach() for tensor in model.activated()]
    with mode():
        found = model.activated()
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))


def test_statistics_are_those_of_all_rows(threads, model):
    config = TrainConfig()
    setting = Setting(SimpleNamespace(extent=1.0), model, torch.zeros(3), ALONE, seed=0, max_gaussians=0, iterations=1)
    densifier = Reference(config.plugins["reference"], setting, Optimizer(model, config.learn, 1.0))
    grad = torch.randn(COUNT, 2, generator=torch.Generator().manual_seed(3))
    grad[7] = torch.inf
    radii = (grad[:, 0] > 0).int()
    out = SimpleNamespace(means2d=SimpleNamespace(grad=grad), radii=radii, image=torch.empty(50, 100, 3))
    densifier.observe(out, Step(1, None))
    norms = torch.hypot(50.0 * grad[:, 0].double(), 25.0 * grad[:, 1].double())
    norms[7] = 0.0
    assert torch.allclose(densifier.gradient.double(), norms, rtol=2e-7)
    assert torch.equal(densifier.views, radii.float())


def test_rows_are_taken_and_put(threads):
    rng = np.random.default_rng(0)
    order, values = rng.permutation(COUNT).astype(np.int32), rng.integers(0, 10**9, COUNT).astype(np.int32)
    assert (bin._taken(values, order) == values[order]).all()
    assert (bin._put(values.astype(np.int64), order)[order] == values).all()
    assert len(bin._taken(values, order[:0])) == len(bin._put(values[:0], order[:0])) == 0


def test_every_slice_runs_once(threads):
    done = []
    for bounds in ([0, 0], [0, 5], [0, 1, 2, 3, 4, 5]):
        pool.in_slices(lambda low, high: done.extend(range(low, high)), bounds)
    assert sorted(done) == sorted([*range(5)] * 2)


def test_who_gets_no_more_threads_does_with_those_there_are(threads, monkeypatch):
    def refuse(_):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(pool, "_helpers", [])
    monkeypatch.setattr(threading.Thread, "start", refuse)
    done = []
    for _ in range(2):
        pool.in_slices(lambda low, high: done.extend(range(low, high)), [0, 2, 3, 5])
    assert sorted(done) == sorted([*range(5)] * 2) and not pool._helpers


def test_one_call_goes_beside_slices(threads):
    done = []
    assert pool.with_slices(lambda: "alone", lambda low, high: done.extend(range(low, high)), [0, 2, 2, 5]) == "alone"
    assert sorted(done) == [*range(5)]
    for bounds in ([0, 0], [0]):  # nothing to share
        assert pool.with_slices(lambda: 7, done.append, bounds) == 7


def test_slices_share_their_own_work(threads):
    done = []

    def share(first: int, _last: int) -> None:
        pool.in_slices(lambda low, high: done.extend(range(low, high)), [first, first + 2, first + 5])

    pool.in_slices(share, [0, 5, 10, 15])
    assert sorted(done) == [*range(15)]


@pytest.mark.parametrize(("rows", "value"), [([], 0.0), ([COUNT - 1], torch.nan), ([0, COUNT - 1], torch.inf)])
def test_gradients_that_are_not_finite_are_found_in_every_slice(threads, model, rows, value):
    given = Gaussians(*(tensor.detach().requires_grad_() for tensor in model.activated()))
    given.sh_rest.data.zero_()
    given.sh_dc.data.fill_(1.0)  # no color is clamped
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(3), np.array([0.0, 0.0, 9.0]))
    seen, dropped = project.project(given, camera, RasterOptions(), dropped=(found := Dropped())), [False] * COUNT
    upstream = torch.ones_like(seen.colors)
    for row, sign in zip(rows, (1.0, -1.0), strict=False):
        assert seen.radii[row] > 0
        upstream[row], dropped[row] = sign * value, True
    seen.colors.backward(upstream)
    assert found.gaussians == len(rows) and torch.isfinite(given.sh_dc.grad).all()
    assert not given.sh_dc.grad[dropped].any() and given.sh_dc.grad[(seen.radii > 0) & ~torch.tensor(dropped)].all()


def test_a_sum_that_overflows_drops_nothing():
    """All is finite, though no sum says so."""
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(3), np.zeros(3))
    grid = torch.cartesian_prod(torch.linspace(-0.8, 0.8, 20), torch.linspace(-0.6, 0.6, 20))
    means = torch.cat([grid, torch.full((400, 1), 2.0)], 1).requires_grad_()
    quats, scales = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(400, 1), torch.full((400, 3), 0.03)
    sh = torch.zeros(400, 1, 3).requires_grad_()
    out = rasterize(means, quats, scales, torch.full((400,), 0.9), sh, camera)
    out.image.backward(torch.full_like(out.image, 1e36))
    assert torch.isinf(sh.grad.sum()) and torch.isfinite(sh.grad).all() and (sh.grad > 1e35).all()
    assert torch.isfinite(means.grad).all() and means.grad.any() and out.dropped.gaussians == 0


def test_warming_up_loads_what_only_a_bad_gradient_needs(monkeypatch):
    trainer = make_trainer(100, 64, 48, "cpu")
    quarantine.module.unload()
    monkeypatch.setattr("warp_splat.training.trainer.load", launch.load.__wrapped__)  # not only once
    trainer.warm_up()
    assert quarantine.module.execs


def state_after_steps() -> str:
    """All that four steps leave, from degree 0 to degree 3."""
    trainer = make_trainer(COUNT, 64, 48, "cpu")
    digest = hashlib.sha256()
    for iteration in range(4):
        trainer.differentiate(iteration)
        trainer.update(iteration)
    for name, tensor in trainer.state()[0].items():
        digest.update(name.encode() + tensor.numpy().tobytes())
    return digest.hexdigest()


def test_a_training_is_the_same_on_any_number_of_threads(threads):
    found = state_after_steps()
    pool.set_threads(1)
    assert found == state_after_steps()


IN_DEBUG_MODE = """
import sys, warp
sys.path += ["tests", "benchmarks"]
import test_threads
warp.config.mode, warp.config.enable_backward, test_threads.pool.SMALLEST_SLICE = "debug", False, 256
print(test_threads.state_after_steps())
"""


@pytest.mark.slow
def test_in_debug_mode_warp_finds_no_index_out_of_bounds_and_no_byte_changes():
    """There, a process ends at the first such index, and threads of ours would meet in Warp's own memory.

    Where a program wants no adjoints of its own kernels (``enable_backward``), ours have them.
    """
    assert python("-c", IN_DEBUG_MODE).stdout.split()[-1] == state_after_steps()


def test_an_error_in_a_slice_reaches_the_caller(threads):
    def fail(low: int, high: int) -> None:
        if low == 0:
            raise ValueError("of a slice")

    with pytest.raises(ValueError, match="of a slice"):
        pool.in_slices(fail, [0, 1, 2, 3])

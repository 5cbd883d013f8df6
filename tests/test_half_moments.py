"""Adam with moments in 16 bits: rounding keeps the mean, so that it learns as with 32; the same bytes everywhere."""

import numpy as np
import pytest
import torch

from warp_splat.raster.drivers import CPU, CUDA, using
from warp_splat.runtime import pool
from warp_splat.training import adam_step
from warp_splat.training.adam_step import HALF, move
from warp_splat.training.optimizer import BETAS

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
def test_the_same_bytes_on_any_driver_and_number_of_threads(sparse, kind, monkeypatch):
    """And however many numbers a GPU takes in a launch."""
    found, threads = set(), pool.get_threads()
    radii = torch.arange(2603, dtype=torch.int32) % 3 if sparse else None
    try:
        for driver, count, most in ((CPU, 1, None), (CPU, 3, None), (CUDA, 1, adam_step.MOST), (CUDA, 1, 50_000)):
            pool.set_threads(count)
            monkeypatch.setattr(adam_step, "MOST", most)
            tables = tables_of(2603, kind)
            with using(driver):
                steps(tables, 3, radii)
            found.add(bytes_of(tables))
    finally:
        pool.set_threads(threads)
    assert len(found) == 1

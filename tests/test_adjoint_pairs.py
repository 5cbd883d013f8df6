"""Every piece `f` of the mathematics that has an `adj_f` beside it, against central differences.

Pieces run in Python, without a compiler, where they can.
"""

import inspect
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from warp_splat.config import ALPHA_MIN, T_MIN
from warp_splat.kernels import falloff, splat
from warp_splat.kernels.simd import vec16

PAIRS = {
    name: (getattr(splat, name), getattr(splat, f"adj_{name}")) for name in dir(splat) if hasattr(splat, f"adj_{name}")
}


def test_pairs_are_found():
    assert set(PAIRS) == {"alpha_of"}


@pytest.mark.parametrize("name", PAIRS)
def test_against_central_differences(name):
    forward, adjoint = PAIRS[name]
    step = 1e-3
    for value in (0.001, 0.1, 0.5, 0.97, 1.5):  # below the cut, between, above the clamp
        slope = (forward(value + step, ALPHA_MIN) - forward(value - step, ALPHA_MIN)) / (2 * step)
        assert adjoint(value, ALPHA_MIN, 2.5) == pytest.approx(2.5 * slope, abs=1e-3)


def test_a_blended_pixel_against_float64():
    """Forward recursion and its inverse on one pixel: color, transmittance, dL/dalpha from the recovered states."""
    rng = np.random.default_rng(0)
    alphas, colors, up = rng.uniform(0.02, 0.5, 12), rng.uniform(0, 1, 12), 0.7

    def pixel(values):
        front = np.concatenate([[1.0], np.cumprod(1 - values)])
        return (values * front[:-1] * colors).sum(), front[-1]

    t = 1.0
    total = 0.0
    for alpha, color in zip(alphas, colors, strict=True):
        after = splat.advance(t, float(alpha), T_MIN)
        total += splat.weight(t, float(alpha), after) * color
        t = after
    assert (total, t) == pytest.approx(pixel(alphas), rel=1e-5)
    behind = 0.0
    for k in reversed(range(12)):
        odds = splat.odds_of(float(alphas[k]))
        t = t + t * odds
        lit = float(colors[k] * up)
        found = splat.adj_alpha_blend(t, odds, behind, lit)
        behind += float(alphas[k]) * t * lit
        nudge = np.where(np.arange(12) == k, 1e-6, 0.0)
        expected = up * (pixel(alphas + nudge)[0] - pixel(alphas - nudge)[0]) / 2e-6
        assert found == pytest.approx(expected, rel=1e-4, abs=1e-5)


def test_a_pixel_stops_before_the_gaussian_that_would_darken_it():
    t = splat.advance(2e-4, 0.6, T_MIN)
    assert t == pytest.approx(-2e-4) and splat.weight(2e-4, 0.6, t) == 0.0
    assert splat.advance(t, 0.5, T_MIN) == pytest.approx(-2e-4) and splat.weight(t, 0.5, t) == 0.0


@pytest.mark.parametrize(("degree", "allowed"), [(3, 8e-5), (4, 4e-6), (5, 1e-6), (6, 1e-6), (None, 1e-6)])
def test_exp(degree, allowed):
    exp2_minus = falloff.make_exp(degree)

    @wp.kernel(module="unique")
    def evaluate(z: wp.array[float], scalar_out: wp.array[float], lanes_out: wp.array[vec16]):
        i = wp.tid()
        scalar_out[i] = exp2_minus(z[i])
        lanes_out[i] = exp2_minus(vec16(z[i]))

    z = np.concatenate([np.linspace(0, 12, 4001), np.linspace(12, 125, 500), [1e3, 1e38, np.inf]]).astype(np.float32)
    scalar, lanes = wp.empty(len(z), dtype=float, device="cpu"), wp.empty(len(z), dtype=vec16, device="cpu")
    wp.launch(evaluate, len(z), [wp.array(z, dtype=float, device="cpu")], [scalar, lanes], device="cpu")
    truth = np.exp2(-z.astype(np.float64))
    error = np.abs(scalar.numpy() - truth) / truth.clip(2.0**-125)
    assert error[z <= 12].max() < allowed and error[z <= 125].max() < max(allowed, 1e-5)
    assert scalar.numpy()[z > 125].max() < 1.001 * 2.0**-125
    # the compiler may fuse multiplications and additions here and not there
    assert np.abs(lanes.numpy() - scalar.numpy()[:, None]).max() < 1e-7


def test_log():
    log_of = falloff.log_of

    @wp.kernel(module="unique")
    def evaluate(x: wp.array[float], out: wp.array[float]):
        i = wp.tid()
        out[i] = log_of(x[i])

    near = 1.0 + np.linspace(-1e-3, 1e-3, 1001)
    x = np.concatenate([np.exp(np.linspace(-87, 88.7, 100001)), near, [1.0, 0.0, -1.0, np.inf]]).astype(np.float32)
    out = wp.empty(len(x), dtype=float, device="cpu")
    wp.launch(evaluate, len(x), [wp.array(x, dtype=float, device="cpu")], [out], device="cpu")
    found, truth = out.numpy(), np.log(x[:-3].astype(np.float64))
    assert (np.abs(found[:-3] - truth) <= 3e-7 * np.abs(truth)).all()
    assert found[-3:] == pytest.approx([-88.03, -88.03, 88.72], abs=0.01)


def test_adjoint_stands_behind_its_forward():
    source = Path(inspect.getfile(splat)).read_text()
    for name in PAIRS:
        after = source[source.index(f"def {name}(") :].split("\ndef ")[1]
        assert after.startswith(f"adj_{name}(")

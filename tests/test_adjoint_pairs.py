"""Every derivative by hand that there is in the kernels, found by itself, against central differences."""

import ast
import inspect
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

from warp_splat.config import ALPHA_MAX, ALPHA_MIN, T_MIN
from warp_splat.kernels import falloff, simd, splat
from warp_splat.kernels.angle import angle
from warp_splat.kernels.columns import columns, rows
from warp_splat.kernels.falloff import exp2_known, make_exp
from warp_splat.kernels.inline import defined
from warp_splat.kernels.simd import vec16
from warp_splat.kernels.step import opaque

KERNELS = Path(splat.__file__).parent
#: Why derivatives are nothing on purpose, and of what.
CONSTANT = {
    "constants": "fill",
    "votes of a warp": "ballot",
    "the place of a bit": "lowest",
    "where a blend sees something": "mark marked",
    "part of an adjoint": "folded folded_eight",
    "part of loops whose adjoint is by hand": "offset_in_lanes farther",
    "computes nothing": "forget",
    "masks": "less equal some covers_pixel",
    "whole numbers, or of them": "whole real rounded_up rounded_down",
    "nobody asks for the camera's rotation": "turn",
    "where the lens is learned, its numbers are not the camera's": "of_lens",
    "chooses a factor that normalization takes out again": "largest",
    "extents choose tiles": "support",
    "wp.grad(weigh) is asked for the direction alone": "value_of",
    "in front of everything, the transmittance is 1": "begin",
    "brings memory into the cache": "ask",
    "random numbers": "noise",
    "moments, which have no gradient": "widened rounded",
    "only states are recovered by it": "odds_of",
    "sums of gradients": "lane_sum",
    "exp2_known has the derivative": "fall_value by_instruction",
}
#: Derivatives that are right only together, in the loop that Warp replays, and adjoints of whole steps: against
#: differences of the image in test_gradcheck, in every mode.
OF_A_LOOP = {"front_of", "behind_of", "spread", "collect", "read", "step", "geometry"}
#: In tests of their own, below; the activations' in test_threads.
ALONE = {"alpha_of", "alpha_blend", "everywhere", "exp", "logistic"}
LOW, HIGH = 0.3, 2.0  # of the numbers that pieces are tried with


def adjoints():
    """Names of the functions that have a derivative by hand, and of those whose derivative is nothing."""
    found = {True: set(), False: set()}
    for path in KERNELS.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and not any("kernel" in ast.unparse(d) for d in node.decorator_list):
                decorators = [ast.unparse(d) for d in node.decorator_list]
                of = [ast.unparse(d.args[0]) for d in node.decorator_list if "func_grad" in ast.unparse(d)]
                if of or node.name.startswith("adj_"):
                    found[isinstance(node.body[-1], ast.Pass)].add((of or [node.name.removeprefix("adj_")])[0])
                without = any("without_gradient" in d for d in decorators)
                if without or any("func_native" in d or "in_lanes" in d for d in decorators):  # in C++
                    found[not any("adj_ret" in d for d in decorators)].add(node.name)
    return found[False], found[True]


@wp.func
def mixed(x: Any, y: Any, z: Any):
    a, b, c = columns(rows(x, y, z))
    return simd.times(a, simd.times(b, b)) + c


#: Text of the pieces in the kernels' language, of x, y, z; and the same in float64, of which differences are taken.
PIECES = {
    "times": ("simd.times(x, y)", lambda x, y, z: x * y),
    "fma": ("simd.fma(x, y, z)", lambda x, y, z: x * y + z),
    "over": ("simd.over(x, y)", lambda x, y, z: x / y),
    "where_less": ("simd.where_less(y, z, x, simd.times(y, z))", lambda x, y, z: np.where(y < z, x, y * z)),
    "smaller": ("simd.smaller(simd.times(x, y), z)", lambda x, y, z: np.minimum(x * y, z)),
    "fraction": ("simd.fraction(x, simd.whole(y))", lambda x, y, z: x - np.trunc(y)),
    "negative": ("simd.negative(x)", lambda x, y, z: -x),
    "inverse": ("simd.inverse(x)", lambda x, y, z: 1 / x),
    "root": ("simd.root(x)", lambda x, y, z: np.sqrt(x)),
    "halved": ("simd.halved(x, simd.whole(y))", lambda x, y, z: x * 0.5 ** np.trunc(y)),
    "pick": (
        "simd.pick(simd.less(x, simd.fill(1.0, x)), simd.times(y, y), simd.times(z, x))",
        lambda x, y, z: np.where(x < 1, y * y, z * x),
    ),
    "columns": ("mixed(x, y, z)", lambda x, y, z: x * y * y + z),
    "angle": ("angle(x, y)", lambda x, y, z: np.arctan2(x, y)),
    "exp2_known": ("exp2_known(x, y)", lambda x, y, z: np.exp2(-x)),  # what it was given is the value itself
    "opaque": (
        "opaque(x, wp.vec2(ALPHA_MIN, ALPHA_MAX), y, z)",
        lambda x, y, z: np.where(y < z, np.where(x < ALPHA_MIN, 0, np.minimum(x, ALPHA_MAX)), 0),
    ),
}
#: What the texts speak of.
KNOWN = {"simd": simd, "wp": wp, "angle": angle, "exp2_known": exp2_known, "opaque": opaque, "mixed": mixed}
KNOWN |= {"ALPHA_MIN": ALPHA_MIN, "ALPHA_MAX": ALPHA_MAX}
COVERED = {*PIECES, "rows"}  # rows are made where columns are taken


def make_piece(name, number):
    """A kernel of x, y, z that calls the piece ``name``."""
    source = f"def piece(x: number, y: number, z: number):\n    return {PIECES[name][0]}\n"
    piece = wp.func(defined("piece", source, {**KNOWN, "number": number}))

    @wp.kernel(module="unique")
    def evaluate(x: wp.array[number], y: wp.array[number], z: wp.array[number], values_out: wp.array[number]):
        i = wp.tid()
        values_out[i] = piece(x[i], y[i], z[i])

    return evaluate


def test_every_derivative_by_hand_is_tested():
    some, none = adjoints()
    assert len(some) > 12
    assert some - OF_A_LOOP - ALONE == COVERED
    assert none <= set(" ".join(CONSTANT.values()).split())


@pytest.mark.parametrize("lanes", [1, simd.LANES])
@pytest.mark.parametrize("name", PIECES)
def test_against_differences(name, lanes):
    number, truth = simd.TYPES[lanes].number, PIECES[name][1]
    given = np.random.default_rng(0).uniform(LOW, HIGH, (3, 50, lanes))
    given = given[:, (np.abs(given[0] - 1) > 0.02).all(1) & (np.abs(given[1] - given[2]) > 0.02).all(1)]
    if name == "exp2_known":
        given[1] = np.exp2(-given[0])
    kept = {"dtype": number, "device": "cpu", "requires_grad": True}
    arrays = [wp.array(values.astype(np.float32).squeeze(), **kept) for values in given]
    values = wp.zeros(len(given[0]), **kept)
    with wp.Tape() as tape:
        wp.launch(make_piece(name, number), len(values), arrays, [values], device="cpu")
    tape.backward(grads={values: wp.full_like(values, number(1.0))})
    np.testing.assert_allclose(values.numpy().squeeze(), truth(*given).squeeze(), rtol=1e-5)
    for index, array in enumerate(arrays):
        nudge = 1e-6 * (np.arange(3) == index)[:, None, None]
        slope = (truth(*(given + nudge)) - truth(*(given - nudge))) / 2e-6
        np.testing.assert_allclose(array.grad.numpy().squeeze(), slope.squeeze(), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("lanes", [1, simd.LANES])
def test_a_number_everywhere_gets_the_sum_of_what_is_finite(lanes):
    number = simd.TYPES[lanes].number

    @wp.kernel(module="unique")
    def evaluate(x: wp.array[float], y: wp.array[number], values_out: wp.array[number]):
        i = wp.tid()
        values_out[i] = simd.times(simd.everywhere(x[i], y[i]), y[i])

    weights = np.random.default_rng(0).uniform(LOW, HIGH, (3, lanes)).astype(np.float32)
    weights[1, lanes // 2], weights[2, 0] = np.inf, np.nan
    kept = {"device": "cpu", "requires_grad": True}
    x, y = wp.array([2.0, 3.0, 4.0], dtype=float, **kept), wp.array(weights.squeeze(), dtype=number, **kept)
    values = wp.zeros(3, dtype=number, **kept)
    with wp.Tape() as tape:
        wp.launch(evaluate, 3, [x, y], [values], device="cpu")
    tape.backward(grads={values: wp.full_like(values, number(1.0))})
    np.testing.assert_array_equal(values.numpy().reshape(3, lanes), weights * x.numpy()[:, None])
    np.testing.assert_allclose(x.grad.numpy(), np.where(np.isfinite(weights), weights, 0).sum(1), rtol=1e-6)


def test_opacity_against_central_differences():
    alphas = wp.vec2(ALPHA_MIN, ALPHA_MAX)
    for value in (0.001, 0.1, 0.5, 0.97, 1.5):  # below the cut, between, above the clamp
        slope = (splat.alpha_of(value + 1e-3, alphas) - splat.alpha_of(value - 1e-3, alphas)) / 2e-3
        assert splat.adj_alpha_of(value, alphas, 2.5) == pytest.approx(2.5 * slope, abs=1e-3)


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
    exp2_minus = make_exp(degree)

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
    assert (lanes.numpy() == scalar.numpy()[:, None]).all()


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
    after = source[source.index("def alpha_of(") :].split("\ndef ")[1]
    assert after.startswith("adj_alpha_of(")

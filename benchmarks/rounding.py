"""What float32 loses outside of the pixel loop: the determinant of needles by two formulas, and T recovered.

python benchmarks/rounding.py [--out docs/compare]
"""

import functools
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import numpy as np
from common import parse, transcribe

from warp_splat.compare.stability.verdict import EPS
from warp_splat.config import ALPHA_MAX, BLUR
from warp_splat.formats.files import write_csv
from warp_splat.text import table_of

LAYERS = (10, 100, 1_000, 10_000, 100_000)
RATIOS = tuple(10.0**power for power in np.arange(0, 8.5, 0.5))
SHORT = 0.1  # px, short axis
ANGLES = 37  # of the needle in the image, and as many to it
RATIONAL = np.frompyfunc(lambda number: Fraction(float(number)), 1, 1)  # of an array
COLUMNS = {"what": "{what}", "of": "{of:g}", "error": "{error:.1e}", "bound": "{bound:.1e}"}


def needle_rows(ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows a1, a2 [A, 3] (float32, px) of J W R S for a needle at every angle in and to the image."""
    angle, tilt = np.meshgrid(np.linspace(0, np.pi, ANGLES), np.radians(np.linspace(0, 89, ANGLES)))
    c, s, up, out = np.cos(angle), np.sin(angle), np.cos(tilt), np.sin(tilt)
    scales = SHORT * np.array([ratio, 1.0, 1.0])
    a1 = np.stack([up * c, -s, -out * c], -1).reshape(-1, 3) * scales
    a2 = np.stack([up * s, c, -out * s], -1).reshape(-1, 3) * scales
    return a1.astype(np.float32), a2.astype(np.float32)


def usual_determinant(a1: np.ndarray, a2: np.ndarray) -> np.ndarray:
    """(a1.a1 + e) (a2.a2 + e) - (a1.a2)^2 in the precision of its arguments [A, 3], px^4."""
    blur = RATIONAL(np.float32(BLUR)) if a1.dtype == object else a1.dtype.type(BLUR)
    xx, yy, xy = (np.sum(left * right, -1, dtype=a1.dtype) for left, right in ((a1, a1), (a2, a2), (a1, a2)))
    return (xx + blur) * (yy + blur) - xy * xy


def our_determinant(a1: np.ndarray, a2: np.ndarray) -> np.ndarray:
    """|a1 x a2|^2 + e (|a1|^2 + |a2|^2) + e^2, as ``kernels.project`` computes it, px^4."""
    blur = a1.dtype.type(BLUR)
    area = np.cross(a1, a2)
    sharp, xx, yy = (np.sum(row * row, -1, dtype=a1.dtype) for row in (area, a1, a2))
    return sharp + blur * (xx + yy) + blur * blur


def exact_determinant(a1: np.ndarray, a2: np.ndarray) -> np.ndarray:
    """The same by the usual formula in rational numbers: no rounding at all."""
    return usual_determinant(RATIONAL(a1), RATIONAL(a2))


@functools.cache
def determinant_errors() -> dict[str, list[float]]:
    """Largest relative error over all angles for each of ``RATIOS``, by formula, in float32."""
    errors: dict[str, list[float]] = {"usual": [], "ours": []}
    for ratio in RATIOS:
        rows = needle_rows(ratio)
        exact = exact_determinant(*rows)
        for name, formula in (("usual", usual_determinant), ("ours", our_determinant)):
            found = formula(*rows).astype(np.float64)
            errors[name].append(max(float(abs(Fraction(v) / truth - 1)) for v, truth in zip(found, exact, strict=True)))
    return errors


@functools.cache
def recovery_error(layers: int) -> float:
    """|T - 1| after a chain of ``layers`` and its inverse, by the pieces of the kernels in float32 on 64 pixels.

    Opacities are random and small enough that T falls to about 0.01.
    """
    rng, one = np.random.default_rng(layers), np.float32(1.0)
    alphas = rng.uniform(0.0, 9.0 / layers, (layers, 64)).clip(0.0, ALPHA_MAX).astype(np.float32)
    t = np.ones(64, dtype=np.float32)
    for alpha in alphas:
        t = t - alpha * t
    for alpha in alphas[::-1]:
        t = t + t * (alpha / (one - alpha))
    return float(np.abs(t - one).max())


def measure(out: Path, say: Callable[[str], None]) -> None:
    """T after a chain and its inverse, two roundings a step each way; our determinant and the usual one, by ratio."""
    rows = [
        {"what": "T recovered, by layers", "of": n, "error": recovery_error(n), "bound": 4 * n * EPS} for n in LAYERS
    ]
    for name, bound in (("ours", 16 * EPS), ("usual", np.nan)):
        errors = zip(RATIOS, determinant_errors()[name], strict=True)
        rows += [{"what": f"determinant, {name}, by ratio", "of": r, "error": e, "bound": bound} for r, e in errors]
    say(table_of(rows, COLUMNS))
    write_csv(out / "rounding.csv", rows)


def main() -> None:
    transcribe("rounding", parse(__doc__).out, measure)


if __name__ == "__main__":
    main()

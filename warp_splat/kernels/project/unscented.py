"""Splatting by an unscented transform (Wu et al. 2025, 3DGUT): no derivative of the lens, but seven points seen by it.

The points are the mean and, along each axis of the Gaussian, sqrt(3) standard deviations to either side. What a lens
makes of them has the mean and the covariance of the splat. With alpha = 1, beta = 2 and kappa = 0, the mean of the
Gaussian weighs 0 in the one and 2 in the other, each other point 1/6:

    mean  m = sum p_i / 6
    covariance  sum d_a d_a' / 3 + sum b_a b_a' / 3 + 2 (p_0 - m) (p_0 - m)'

with half the difference d_a of the two points along an axis, and b_a from the mean to their middle. The first sum is
what the affine projection has. The others are of second order, and together sum c_a c_a' / 3, where c_a goes from p_0
to the middle, and by (sqrt(8) - 2) (m - p_0) / 2 beyond. So the determinant is again a sum of squares: of the products
of each two of the six vectors, over 9 (Cauchy and Binet).
"""

import itertools

import numpy as np
import warp as wp

from warp_splat.kernels.compiler import once
from warp_splat.kernels.formula import Notes, Number, write_function
from warp_splat.kernels.project import COEFFICIENTS, Projection
from warp_splat.kernels.project.lens import NOWHERE, OUTLINE, image_of
from warp_splat.lenses.formulas import PINHOLE, Family

STEP = 3.0**0.5  # standard deviations
BEYOND = (8.0**0.5 - 2.0) / 2.0  # of the mean: its weight of 2 comes with the middles
LEAST = 1.0e-30  # px^2 or px^4, of what has a root


@once
def make_identity(lanes: int) -> wp.Function:
    """The camera's own axes: the outline, not the lens, makes an image of them."""
    notes = Notes()
    turns = [notes.number("turn", "camera", row, column) for row in range(2) for column in range(3)]
    return write_function("identity", notes, "xyz", [Number(notes, "x"), Number(notes, "y"), *turns], lanes)


@once
def through(family: Family, learned: bool = False) -> Projection:
    """For the lenses of a family; ``learned`` as in :mod:`.lens`."""

    @once
    def make_outline(lanes: int) -> wp.Function:
        notes = Notes()
        given = {name: Number(notes, name) for name in OUTLINE}
        center = [given[name] for name in ("px", "py", "z")]
        axes = [
            [STEP * given[f"a1{axis}"], STEP * given[f"a2{axis}"], STEP * given[f"t{axis}"] * given["s" + "xyz"[axis]]]
            for axis in range(3)
        ]
        (px, py), _, seen = image_of(notes, family, *center, linear=False, learned=learned)

        def offset(sign: int, axis: list[Number]) -> list[Number]:
            """From the mean's image to that of a point; none to one that is not seen."""
            x, y, z = (middle + sign * part for middle, part in zip(center, axis, strict=True))
            if not family.wide:
                near = notes.given("camera.near")
                z = np.where(z < near, near, z)
            (qx, qy), _, too = image_of(notes, family, x, y, z, linear=False, learned=learned)
            dx, dy = qx - px, qy - py
            if family.around:
                turn = 2.0 * np.pi * notes.given("camera.focal[0]")
                dx = dx - turn * np.floor(dx / turn + 0.5)
            return [np.where(too, dx, 0.0), np.where(too, dy, 0.0)] if family.wide else [dx, dy]

        pairs = [(offset(1, axis), offset(-1, axis)) for axis in axes]
        halves = [[0.5 * (a - b) for a, b in zip(*pair, strict=True)] for pair in pairs]
        middles = [[0.5 * (a + b) for a, b in zip(*pair, strict=True)] for pair in pairs]
        mean = [(middles[0][axis] + middles[1][axis] + middles[2][axis]) / 3.0 for axis in range(2)]
        bends = [[part + BEYOND * whole for part, whole in zip(middle, mean, strict=True)] for middle in middles]
        vectors = [*halves, *bends]
        xx, xy = (sum(vector[0] * vector[axis] for vector in vectors) / 3.0 for axis in range(2))
        crosses = [v[0] * w[1] - v[1] * w[0] for v, w in itertools.combinations(vectors, 2)]
        sharp = sum(cross * cross for cross in crosses) / 9.0
        across = np.sqrt(_at_least(xx))
        up = np.sqrt(_at_least(sharp)) / across
        none = Number(notes, None)
        rows = [across, none, none, xy / across, up, none]
        drawn, place = given["drawn"], [px + mean[0], py + mean[1]]
        if family.wide:
            drawn, place = drawn * seen, [np.where(seen, number, NOWHERE) for number in place]
        more = COEFFICIENTS if learned else ()
        return write_function(f"{family.formula.__name__}_points", notes, OUTLINE, [*place, *rows, drawn], lanes, more)

    return Projection(make_identity, make_outline, family.wide, learned)


def _at_least(x: Number) -> Number:
    return np.where(LEAST < x, x, LEAST)


PROJECTION = through(PINHOLE)

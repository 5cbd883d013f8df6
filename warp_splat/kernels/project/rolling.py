"""A rolling shutter: each Gaussian where the camera sees it when it reads the row that shows the Gaussian's mean.

The motion (:class:`warp_splat.lenses.shutter.Shutter`) takes a point o, from the camera's center of the middle row, to
E(o, s) = exp(s w) (o - s d), with s from -1/2 at the picture's top to 1/2 at its bottom. A point's own s solves

    s = T(E(o, s)),    T(p) = row that shows p / height - 1/2

by STEPS steps of Newton's method from the middle row. With v = dE/ds and g the gradient of T, the Gaussian's
surroundings go along, each point with a time of its own, to first order:

    dE = (exp(s w) + v h') do,    h = exp(s w)' g / (1 - g v)

So a camera that does not move then sees a Gaussian that has been moved and sheared: all projections and lenses serve.
Rows are those of the lens. Their derivative by the point is written down by forward differentiation, as of any lens.
"""

from collections.abc import Sequence

import numpy as np
import warp as wp

from warp_splat.config import FRUSTUM_MARGIN
from warp_splat.kernels.columns import columns
from warp_splat.kernels.compiler import once
from warp_splat.kernels.formula import Notes, Number, write_function
from warp_splat.kernels.project.camera_view import CameraView
from warp_splat.kernels.project.lens import LIMIT, bent
from warp_splat.kernels.simd import TYPES
from warp_splat.lenses.formulas import Family

STEPS = 2
LATEST = 0.5 * (1.0 + FRUSTUM_MARGIN)  # s; the motion goes on beyond the picture, but not without an end
LEAST_GAIN = 0.25  # 1 - g v; below, the picture moves almost as fast as rows are read
EDGE = 1e-3  # of the cosine where a wide lens ends: rows are asked for no farther out
GIVEN = ("wx", "wy", "wz", "per_slope", "dx", "dy", "dz", "first", "ox", "oy", "oz")
Vector = list[Number]


@once
def make_expose(family: Family, lanes: int, steps: int = STEPS) -> wp.Function:
    """For the lenses of a family: where the camera of the middle row would have to see a Gaussian.

    expose(camera, turns, g, ox, oy, oz):
        turns[g]: behind a quaternion, turn [rad] and per_slope, shift [world units] and first; in the camera's axes.
        T is per_slope times the lens's second coordinate, plus first. o: from the camera's center, in the world.
        -> (ox, oy, oz, n00, .., n22): E, and the matrix that takes the Gaussian's axes along.
    """
    notes = Notes()
    given = {name: Number(notes, name) for name in GIVEN}
    camera = [[notes.number("turn", "camera", row, column) for column in range(3)] for row in range(3)]
    world = [list(column) for column in zip(*camera, strict=True)]
    w, d = (_times(world, [given[f"{name}{axis}"] for axis in "xyz"]) for name in "wd")
    o = [given[f"o{axis}"] for axis in "xyz"]
    s, later = Number(notes, None), []
    for _ in range(steps):
        turned, placed, velocity = _moved(o, w, d, s)
        x, y, z = _times(camera, placed)
        z = _held_in_view(notes, family, x, y, z)
        (_, place), excess, _ = bent(notes, family, x, y, z)
        row = given["per_slope"] * (Number(notes, place.name) * excess) + given["first"]
        slope = _times(world, [given["per_slope"] * Number(notes, part) for part in place.slopes])
        gain = 1.0 - _inner(slope, velocity)
        gain = np.where(gain < LEAST_GAIN, LEAST_GAIN, gain)
        s = s + (row - s) / gain
        free = (-LATEST < s) * (s < LATEST)
        s = np.where(s < -LATEST, -LATEST, np.where(LATEST < s, LATEST, s))
        later = [np.where(free, _inner(column, slope) / gain, 0.0) for column in zip(*turned, strict=True)]
    turned, placed, velocity = _moved(o, w, d, s)
    along = [turned[i][j] + velocity[i] * later[j] for i in range(3) for j in range(3)]
    formula = write_function(f"{family.formula.__name__}_expose_{steps}", notes, GIVEN, [*placed, *along], lanes)
    number, _integer, _row2, _row3, row4 = TYPES[lanes]

    @wp.func
    def expose(camera: CameraView, turns: wp.array2d[row4], g: int, ox: number, oy: number, oz: number):
        wx, wy, wz, per_slope = columns(turns[g, 1])
        dx, dy, dz, first = columns(turns[g, 2])
        return formula(camera, wx, wy, wz, per_slope, dx, dy, dz, first, ox, oy, oz)

    return expose


def _held_in_view(notes: Notes, family: Family, x: Number, y: Number, z: Number) -> Number:
    """Its z, or one at which the lens shows it: another row may show what this one does not."""
    if family.around:
        return z
    if not family.wide:
        near = notes.given("camera.near")
        return np.where(z < near, near, z)
    limit, across = notes.number("of_lens", "camera", LIMIT), x * x + y * y
    inside = limit + EDGE
    unseen = z < inside * np.sqrt(across + z * z)
    return np.where(unseen, inside / np.sqrt(1.0 - inside * inside) * np.sqrt(across), z)


def _moved(o: Vector, w: Vector, d: Vector, s: Number) -> tuple[list[Vector], Vector, Vector]:
    """exp(s w) by its series, E and dE/ds."""
    (x, y, z), square = w, _inner(w, w)
    q = s * s * square
    a = s * (1.0 - q / 6.0 * (1.0 - q / 20.0 * (1.0 - q / 42.0)))
    b = s * s * (0.5 - q / 24.0 * (1.0 - q / 30.0 * (1.0 - q / 56.0)))
    turned = [
        [1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
        [b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x],
        [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)],
    ]
    placed = _times(turned, [here - s * along for here, along in zip(o, d, strict=True)])
    cross = [y * placed[2] - z * placed[1], z * placed[0] - x * placed[2], x * placed[1] - y * placed[0]]
    return turned, placed, [part - along for part, along in zip(cross, _times(turned, d), strict=True)]


def _times(matrix: Sequence[Vector], vector: Vector) -> Vector:
    return [_inner(row, vector) for row in matrix]


def _inner(a: Sequence[Number], b: Sequence[Number]) -> Number:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

"""A lens with distortion: its formula as a projection, and its own derivative where EWA splatting is linear.

Wide lenses show what lies beside and behind the camera, by its distance, up to the angle where they fold or end.
Others show what lies in front of it. Beyond the limit of their field of view they are continued as straight as they are
there: so nothing folds back into the picture, nor grows without bounds, and what is large still reaches in.
"""

import functools
from collections.abc import Sequence

import numpy as np
import warp as wp

from warp_splat.kernels.formula import Notes, Number, write_function
from warp_splat.kernels.project import Projection
from warp_splat.lenses.formulas import Family

LIMIT = 15  # place in CameraView.lens: cosine of the angle where a wide lens ends, tangent of that of another
NOWHERE = -1.0e9  # px, of what a lens does not show: no Gaussian reaches from there


@functools.cache
def through(family: Family) -> Projection:
    """EWA splatting (Zwicker et al. 2001), linearized at the mean by the lens's own derivative."""

    @functools.cache
    def make_lens(lanes: int) -> wp.Function:
        notes = Notes()
        place, slopes = seen_at(notes, family, *(Number(notes, name) for name in "xyz"))
        rows = [
            sum(
                slope * Number(notes, notes.note("turn", "camera", str(axis), str(column), "z"))
                for axis, slope in enumerate(row)
            )
            for row in slopes
            for column in range(3)
        ]
        return write_function(f"{family.formula.__name__}_lens", notes, "xyz", [*place, *rows], lanes)

    return Projection(make_lens, wide=family.wide)


def seen_at(notes: Notes, family: Family, x: Number, y: Number, z: Number) -> tuple[Sequence, Sequence]:
    """Where a point of the camera is seen [px], and the derivative of that [2][3]."""
    limit, one = notes.given(f"camera.lens[{LIMIT}]"), notes.given("1.0")
    if family.wide:
        seen = limit * np.sqrt(x * x + y * y + z * z) < z
        x, y, z = np.where(seen, x, 0.0), np.where(seen, y, 0.0), np.where(seen, z, 1.0)
        held = x, y
    else:
        beyond = limit * limit * (z * z) < x * x + y * y
        shrunk = np.where(beyond, limit * z / np.sqrt(np.where(beyond, x * x + y * y, 1.0)), 1.0)
        held = shrunk * x, shrunk * y
    variables = [
        Number(notes, number.name, tuple(one.name if axis == other else None for other in range(3)))
        for axis, number in enumerate((*held, z))
    ]
    coefficients = [notes.given(f"camera.lens[{index}]") for index in range(family.count)]
    found, slopes = [], []
    for axis, place in enumerate(family.formula(coefficients, *variables)):
        focal, middle = (notes.given(f"camera.{name}[{axis}]") for name in ("focal", "principal"))
        row = [focal * Number(notes, slope) for slope in place.slopes]
        place = focal * Number(notes, place.name) + middle
        if family.wide:
            place = np.where(seen, place, NOWHERE)
        else:
            place = place + row[0] * (x - held[0]) + row[1] * (y - held[1])
        found.append(place)
        slopes.append(row)
    return found, slopes

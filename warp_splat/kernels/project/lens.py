"""A lens with distortion: its formula as a projection, and its own derivative where EWA splatting is linear.

Wide lenses show what lies beside and behind the camera, by its distance, up to the angle where they fold or end.
Others show what lies in front of it. Beyond the limit of their field of view they are continued in proportion: so
nothing folds back into the picture, nor grows without bounds, and what is large still reaches in.

A panorama ends where it begins. A Gaussian near a pole is as wide as the picture or wider. It is held at a width whose
copies, a turn to either side (:mod:`warp_splat.raster.seam`), add up to almost the same at all longitudes.
"""

import numpy as np
import warp as wp

from warp_splat.kernels.compiler import once
from warp_splat.kernels.formula import Notes, Number, write_function
from warp_splat.kernels.project import COEFFICIENTS, Projection
from warp_splat.lenses.formulas import Family

LIMIT = 15  # place in CameraView.lens: cosine of the angle where a wide lens ends, tangent of that of another
NOWHERE = -1.0e9  # px, of what a lens does not show: no Gaussian reaches from there
WIDEST = 0.4  # of a panorama's width, a standard deviation: three copies add up to 1 within 9 %
OUTLINE = ("z", "px", "py", "a10", "a11", "a12", "a20", "a21", "a22", "t0", "t1", "t2", "sx", "sy", "sz", "drawn")


@once
def through(family: Family, learned: bool = False) -> Projection:
    """EWA splatting (Zwicker et al. 2001), linearized at the mean by the lens's own derivative.

    ``learned``: its coefficients are numbers of the kernel that get a gradient, not the camera's.
    """

    @once
    def make_lens(lanes: int) -> wp.Function:
        notes = Notes()
        place, slopes, seen = image_of(notes, family, *(Number(notes, name) for name in "xyz"), learned=learned)
        place = [np.where(seen, number, NOWHERE) for number in place] if family.wide else place
        turns = [[notes.number("turn", "camera", axis, column) for axis in range(3)] for column in range(3)]
        rows = [sum(slope * entry for slope, entry in zip(row, turn, strict=True)) for row in slopes for turn in turns]
        more = COEFFICIENTS if learned else ()
        return write_function(f"{family.formula.__name__}_lens", notes, "xyz", [*place, *rows], lanes, more)

    return Projection(make_lens, make_narrow if family.around else None, family.wide, learned)


def image_of(
    notes: Notes, family: Family, x: Number, y: Number, z: Number, linear: bool = True, learned: bool = False
) -> tuple:
    """Where a point of the camera is seen [px], the derivative of that [2][3] if asked for, and whether it is seen."""
    places, excess, seen = bent(notes, family, x, y, z, linear, learned)
    found, slopes = [], []
    for axis, place in enumerate(places):
        focal, middle = (notes.given(f"camera.{name}[{axis}]") for name in ("focal", "principal"))
        slopes.append([focal * Number(notes, slope) for slope in place.slopes])
        found.append(focal * (Number(notes, place.name) * excess) + middle)
    return found, slopes, seen


def bent(
    notes: Notes, family: Family, x: Number, y: Number, z: Number, linear: bool = True, learned: bool = False
) -> tuple:
    """What the lens makes of a point that it follows, and its slopes if asked for; how much farther out the point is.

    And whether it is seen.
    """
    limit, one = notes.number("of_lens", "camera", LIMIT), notes.given("1.0")
    seen, excess = one, one
    if family.wide:
        seen = limit * np.sqrt(x * x + y * y + z * z) < z
        x, y, z = np.where(seen, x, 0.0), np.where(seen, y, 0.0), np.where(seen, z, 1.0)
    else:
        across = x * x + y * y
        beyond = limit * limit * (z * z) < across
        shrunk = np.where(beyond, limit * z / np.sqrt(np.where(beyond, across, 1.0)), 1.0)
        x, y, excess = shrunk * x, shrunk * y, 1.0 / shrunk
    variables = [
        Number(notes, number.name, tuple(one.name if axis == other else None for other in range(3)) if linear else ())
        for axis, number in enumerate((x, y, z))
    ]
    kinds = (
        ("everywhere", f"coefficients[g, {i}]") if learned else ("of_lens", "camera", i) for i in range(family.count)
    )
    return family.formula([notes.number(*kind) for kind in kinds], *variables), excess, seen


@once
def make_narrow(lanes: int) -> wp.Function:
    """The outline of what a panorama shows: no wider than WIDEST."""
    notes = Notes()
    given = {name: Number(notes, name) for name in OUTLINE}
    row = [given[f"a1{axis}"] for axis in range(3)]
    square, most = sum(a * a for a in row), WIDEST * notes.given("camera.size[0]")
    wider = most * most < square
    shrunk = np.where(wider, most / np.sqrt(np.where(wider, square, 1.0)), 1.0)
    given |= {f"a1{axis}": shrunk * a for axis, a in enumerate(row)}
    return write_function("narrow", notes, OUTLINE, [given[name] for name in (*OUTLINE[1:9], "drawn")], lanes)

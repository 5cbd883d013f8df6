"""From 3D Gaussians to 2D ones: what all projections share, and one file for each of them.

A projection says where a Gaussian's mean lies in the image and how the image moves with it; its outline may be
corrected. :class:`Projection` is what it has to give; all else (reading, culling, rotation, conic, extent,
antialiasing, writing) is :mod:`warp_splat.kernels.project.shared`. Warp derives the adjoint.
"""

from collections.abc import Callable
from typing import NamedTuple

import warp as wp

from warp_splat.errors import InputError

ARGUMENTS = {"lens": 4, "outline": 17}
COEFFICIENTS = ("coefficients: wp.array2d[float]", "g: int")  # what learned ones take besides: variables of the kernel


class Projection(NamedTuple):
    """What one projection does otherwise than another.

    ``lens`` and ``outline`` make a Warp function for a number of lanes. Numbers are of ``TYPES[lanes].number``, and
    written with the words of :mod:`warp_splat.kernels.simd`.

    lens(camera, x, y, z):
        The mean in the camera [world units] -> (px, py, j00, j01, j02, j10, j11, j12): where it is seen [px], and the
        derivative of that by the world's coordinates, two rows of J W [px per world unit].
    outline(camera, z, px, py, a10, a11, a12, a20, a21, a22, t0, t1, t2, sx, sy, sz, drawn):
        a1, a2: rows of J W R S [px]; t: third row of W R, times the scales s the extent along the optical axis; a mask.
        -> (px, py, a10, a11, a12, a20, a21, a22, drawn): the corrected ones. None: all stays as it is.
    wide:
        It sees beside and behind the camera: depth is the distance, and z may be negative.
    learned:
        They may take the lens's coefficients as well (:func:`.shared.make_project`).
    """

    lens: Callable[[int], wp.Function]
    outline: Callable[[int], wp.Function] | None = None
    wide: bool = False
    learned: bool = False

    def functions(self, lanes: int) -> list[wp.Function | None]:
        """Lens and outline for a number of lanes.

        Raises:
            InputError: if a member makes no Warp function of as many arguments.
        """
        found = []
        for (name, count), make in zip(ARGUMENTS.items(), self[:2], strict=True):
            counts = (count, count + len(COEFFICIENTS) * self.learned)
            makes = callable(make) and not isinstance(make, wp.Function)
            made = make(lanes) if makes else make
            fits = makes and isinstance(made, wp.Function) and len(made.input_types) in counts
            if not fits and (make is not None or name == "lens"):
                raise InputError(
                    f"Projection.{name}: expected a function of the lanes that makes a wp.func of {count} arguments, "
                    f"got {f'one that makes {made!r:.80}' if makes else repr(make)}; see docs/extending.md."
                )
            found.append(made)
        return found

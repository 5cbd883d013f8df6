"""Rolling shutter: how a camera moves while its rows are read, and rotations by series."""

import math
from dataclasses import dataclass, fields

import numpy as np

from warp_splat.errors import InputError

ROUNDED = 1e-9  # of a turn that was put together of two poses
MOST_TURN = 1.0  # rad from the first row to the last; kernels' series know no more
TERMS = 16  # of the power series: up to half a turn to the last bit, a whole turn to 3e-11


@dataclass(frozen=True)
class Shutter:
    """How a camera moves from the upper edge of its first row to the lower edge of its last one, steadily.

    At s, from -1/2 to 1/2, it sees ``exp(s turn) (x - s shift)`` of what the pose of its middle sees at x.
    :meth:`warp_splat.Camera.rolling` makes it of two poses.

    Args:
        turn: rotation vector [rad] in the camera's axes, at most 1 long.
        shift: how far the camera's center moves [world units], in the camera's axes at the middle.

    Raises:
        InputError: if either is not three finite numbers, or ``turn`` is too long.
    """

    turn: tuple[float, ...] = (0.0, 0.0, 0.0)
    shift: tuple[float, ...] = (0.0, 0.0, 0.0)

    def __post_init__(self):
        for part in fields(self):
            given = getattr(self, part.name)
            try:
                numbers = tuple(float(number) for number in given)
            except (TypeError, ValueError, OverflowError):
                numbers = ()
            if len(numbers) != 3 or not all(math.isfinite(number) for number in numbers):
                raise InputError(f"Shutter {part.name}: expected three finite numbers, got {given!r:.80}.")
            object.__setattr__(self, part.name, numbers)
        if math.hypot(*self.turn) > MOST_TURN + ROUNDED:
            raise InputError(
                f"Shutter turn: expected at most {MOST_TURN:g} rad from the first row to the last, got "
                f"{math.hypot(*self.turn):.3g}; check the unit and the poses."
            )

    def moved(self, s: float, rotation: np.ndarray, translation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The pose at s, of the pose of the middle."""
        axis = s * np.array(self.turn)[:, None]
        pose = np.concatenate([rotation, (translation - s * np.array(self.shift))[:, None]], 1)
        pose = rotated(pose, axis, 1)
        return pose[:, :3], pose[:, 3]


def rotated(vectors: np.ndarray, axis: np.ndarray, order: int) -> np.ndarray:
    """Vectors [3] or columns [3, M] turned by a rotation vector (``order`` 1), or the mean while it turns them (2)."""
    across = cross(axis, vectors)
    x, y, z = axis.ravel().tolist()
    square = x * x + y * y + z * z
    return vectors + series(square, order) * across + series(square, order + 1) * cross(axis, across)


def series(square: float, order: int) -> float:
    """Sum of (-square)^k / (2 k + order)!: of angle^2, sin(angle) / angle for 1, (1 - cos(angle)) / angle^2 for 2.

    Smooth at 0, and the same on every processor, unlike the library's sine.
    """
    value = 0.0
    for k in reversed(range(TERMS)):
        value = 1.0 / math.factorial(2 * k + order) - square * value
    return value


def rotation_vector(matrix: np.ndarray) -> np.ndarray:
    """Of a rotation [3, 3] by less than a right angle."""
    twice = matrix - matrix.T
    found = sine = 0.5 * np.array([twice[2, 1], twice[0, 2], twice[1, 0]])  # times the axis
    for _ in range(200):  # a contraction by (1 - angle / tan(angle)) a step
        found = sine / series(sum(number * number for number in found.tolist()), 1)
    return found


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of vectors [3] or columns [3, M]."""
    return np.roll(a, -1, 0) * np.roll(b, -2, 0) - np.roll(a, -2, 0) * np.roll(b, -1, 0)

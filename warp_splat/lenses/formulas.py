"""Where a lens shows a point: one formula for each family, and which camera model is of which family.

A formula takes its coefficients and a point in the camera (x right, y down, z forward). It returns where the point is
seen, in focal lengths from the principal point. It is NumPy: the same function answers for arrays, and is written down
for kernels with its derivatives (:mod:`warp_splat.kernels.formula`). So it takes from NumPy only what is listed there,
and chooses by ``np.where``, with harmless numbers where a branch is not taken.

Models, names and the order of the coefficients are COLMAP's.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

SERIES = 0.04  # of r^2 / z^2: below, the angle over r is a power series, which is smooth at r = 0


@dataclass(frozen=True)
class Family:
    """Camera models of one formula.

    Args:
        formula: ``(k, x, y, z) -> (u, v)``.
        count: of the coefficients ``k``; a model's are filled up with zeros.
        wide: it shows what lies beside and behind the camera as well. Depth is then the distance.
        prepare: from the model's coefficients to those of the formula.
        around: a panorama: what leaves the picture at its left comes in at its right, and nothing folds.
    """

    formula: Callable[[Sequence, object, object, object], tuple]
    count: int
    wide: bool
    prepare: Callable[..., tuple[float, ...]] = lambda *coefficients: coefficients
    around: bool = False


def pinhole(_k, x, y, z):
    """Straight lines stay straight."""
    return x / z, y / z


def perspective(k, x, y, z):
    """Radial (a ratio of polynomials) and tangential distortion: Brown (1966), as OpenCV has it."""
    u, v = x / z, y / z
    r2 = u * u + v * v
    radial = radial_of(k, r2)
    return _tangential(u * radial, v * radial, u, v, r2, k[2], k[3])


def radial_of(k, r2):
    """How many times as far from the axis :func:`perspective` shows what a pinhole shows at the square root of r2."""
    k1, k2, _p1, _p2, k3, k4, k5, k6 = k
    return (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))


def fisheye(k, x, y, z):
    """A polynomial of the angle from the axis: Kannala and Brandt (2006), as OpenCV has it."""
    k1, k2, k3, k4 = k
    u, v, r2 = _angles(x, y, z)
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    return u * radial, v * radial


def thin_prism_fisheye(k, x, y, z):
    """Of the angle: radial, tangential, and two coefficients of a thin prism (Weng et al. 1992)."""
    k1, k2, p1, p2, k3, k4, sx, sy = k
    u, v, r2 = _angles(x, y, z)
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    u, v = _tangential(u * radial, v * radial, u, v, r2, p1, p2)
    return u + sx * r2, v + sy * r2


def prism_on_fisheye(k, x, y, z):
    """Of the angle: radial first; tangential and four of a thin prism from what that gives (Project Aria's)."""
    k0, k1, k2, k3, k4, k5, p0, p1, s0, s1, s2, s3 = k
    u, v, r2 = _angles(x, y, z)
    radial = 1 + r2 * (k0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * (k4 + r2 * k5)))))
    u, v = u * radial, v * radial
    r2 = u * u + v * v
    dx, dy = 2 * (p0 * u + p1 * v) * u + p0 * r2, 2 * (p0 * u + p1 * v) * v + p1 * r2
    return u + dx + r2 * (s0 + r2 * s1), v + dy + r2 * (s2 + r2 * s3)


def angular(k, x, y, z):
    """The radius as an angle: Devernay and Faugeras (2001); k: 1 / (2 tan(omega / 2)), 1 / omega."""
    edge, per_omega = k
    u, v = x / z, y / z
    factor = _angle_over_radius(u * u + v * v, edge + 0 * z) * per_omega
    return u * factor, v * factor


def division(k, x, y, z):
    """The undistorted radius is r / (1 + k r^2): Fitzgibbon (2001)."""
    denominator = z + np.sqrt(z * z - 4 * k[0] * (x * x + y * y))
    return 2 * x / denominator, 2 * y / denominator


def enhanced_unified(k, x, y, z):
    """A sphere or ellipsoid between the point and the image: Khomutenko, Garcia and Martinet (2016)."""
    alpha, beta = k
    denominator = alpha * np.sqrt(beta * (x * x + y * y) + z * z) + (1 - alpha) * z
    return x / denominator, y / denominator


def equirectangular(_k, x, y, z):
    """Longitude and latitude. So near to a pole that it makes no difference, the longitude is that of the axis."""
    across, square = x * x + z * z, x * x + y * y + z * z
    z = np.where(across < 1e-6 * square, 1e-3 * np.sqrt(square), z)
    return np.arctan2(x, z), np.arctan2(y, np.sqrt(x * x + z * z))


def ray_at(longitude, latitude):
    """The unit direction that :func:`equirectangular` shows there."""
    across = np.cos(latitude)
    return across * np.sin(longitude), np.sin(latitude), across * np.cos(longitude)


def _tangential(u, v, x, y, r2, p1, p2):
    return u + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), v + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)


def _angles(x, y, z):
    """The direction of (x, y), as long as the angle from the axis; and the square of that."""
    ratio = _angle_over_radius(x * x + y * y, z)
    u, v = x * ratio, y * ratio
    return u, v, u * u + v * v


def _angle_over_radius(r2, z):
    """atan2(r, z) / r."""
    near = r2 < SERIES * (z * z)
    near = np.where(0 < z, near, 0 * z)
    q = np.where(near, r2, 0 * z) / np.where(near, z * z, 1 + 0 * z)
    series = 1 + q * (-1 / 3 + q * (1 / 5 + q * (-1 / 7 + q * (1 / 9 - q / 11))))
    r = np.sqrt(np.where(near, 1 + 0 * z, r2))
    return np.where(near, series / np.where(near, z, 1 + 0 * z), np.arctan2(r, z) / r)


def _angular_of(omega):
    """What :func:`angular` takes; of no angle of view, a pinhole's to 1e-8."""
    omega = max(abs(omega), 1e-4)
    return 0.5 / math.tan(0.5 * omega), 1.0 / omega


PINHOLE = Family(pinhole, 0, False)
PERSPECTIVE = Family(perspective, 8, False)
FISHEYE = Family(fisheye, 4, True)
DIVISION = Family(division, 1, True)
EQUIRECTANGULAR = Family(equirectangular, 0, True, around=True)

#: The family of each model, and how many coefficients the model has.
MODELS: dict[str, tuple[Family, int]] = {
    "SIMPLE_RADIAL": (PERSPECTIVE, 1),
    "RADIAL": (PERSPECTIVE, 2),
    "OPENCV": (PERSPECTIVE, 4),
    "FULL_OPENCV": (PERSPECTIVE, 8),
    "SIMPLE_FISHEYE": (FISHEYE, 0),
    "FISHEYE": (FISHEYE, 0),
    "SIMPLE_RADIAL_FISHEYE": (FISHEYE, 1),
    "RADIAL_FISHEYE": (FISHEYE, 2),
    "OPENCV_FISHEYE": (FISHEYE, 4),
    "THIN_PRISM_FISHEYE": (Family(thin_prism_fisheye, 8, True), 8),
    "RAD_TAN_THIN_PRISM_FISHEYE": (Family(prism_on_fisheye, 12, True), 12),
    "FOV": (Family(angular, 2, False, _angular_of), 1),
    "SIMPLE_DIVISION": (DIVISION, 1),
    "DIVISION": (DIVISION, 1),
    "EUCM": (Family(enhanced_unified, 2, True), 2),
    "EQUIRECTANGULAR": (EQUIRECTANGULAR, 0),
}

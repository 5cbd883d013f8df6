"""Lenses with distortion, as they are: what a camera has besides its focal lengths and principal point."""

import functools
import math
from dataclasses import dataclass

import numpy as np

from warp_splat.errors import InputError
from warp_splat.lenses.formulas import MODELS, Family, ray_at

STEPS = 2048  # of the angle from the axis, in which a lens is looked through
DIRECTIONS = 16  # around the axis
FARTHEST = 1e3  # focal lengths: a wide lens is followed no farther out, nor is any picture so large
SEAM = 1e-4  # of half a panorama's width: its two ends may miss each other by so much


@dataclass(frozen=True)
class Lens:
    """A lens by COLMAP's name of its model.

    Args:
        model: one of ``warp_splat.lenses.formulas.MODELS``, for example OPENCV or OPENCV_FISHEYE.
        coefficients: those that the model has besides focal lengths and principal point, in COLMAP's order.

    Raises:
        InputError: if there is no such model, or the coefficients are not as many finite numbers.
    """

    model: str
    coefficients: tuple[float, ...] = ()

    def __post_init__(self):
        if not isinstance(self.model, str) or self.model not in MODELS:
            raise InputError(f"Lens model: expected one of {', '.join(MODELS)}, got {self.model!r:.80}.")
        count = MODELS[self.model][1]
        try:
            coefficients = tuple(float(number) for number in self.coefficients)
        except (TypeError, ValueError, OverflowError):
            coefficients = ()
        if len(coefficients) != count or not all(math.isfinite(number) for number in coefficients):
            raise InputError(f"Lens {self.model}: expected {count} finite coefficients, got {self.coefficients!r:.99}.")
        object.__setattr__(self, "coefficients", coefficients)

    @property
    def family(self) -> Family:
        """The formula, and what it is like."""
        return MODELS[self.model][0]

    @functools.cached_property
    def numbers(self) -> tuple[float, ...]:
        """The coefficients of the formula."""
        found = self.family.prepare(*self.coefficients)
        return (*found, *[0.0] * (self.family.count - len(found)))

    def distorted(self, rays: np.ndarray) -> np.ndarray:
        """Where directions [..., 3] in the camera are seen, focal lengths from the principal point [..., 2].

        NaN where the lens does not see them: beyond the angle where it folds.
        """
        x, y, z = np.moveaxis(np.asarray(rays, np.float64), -1, 0)
        seen = z > self.least_cosine * np.sqrt(x * x + y * y + z * z)
        u, v = self.family.formula(self.numbers, np.where(seen, x, 0), np.where(seen, y, 0), np.where(seen, z, 1))
        return np.where(seen[..., None], np.stack([u, v], -1), np.nan)

    def undistorted(self, places: np.ndarray) -> np.ndarray:
        """Unit directions [P, 3] in the camera that are seen at ``places`` [P, 2]; NaN where none is.

        By Newton's method on what the lens makes of a ray, from where the lens alone around its axis would see it.
        """
        places = np.asarray(places, np.float64)
        if self.family.around:
            return np.stack(ray_at(*places.T), 1)
        angles, radii = self._profile
        far = np.hypot(*places.T)
        start = np.interp(far, radii, angles) / np.where(far > 0, far, 1)
        bent = places * start[:, None]  # a direction as the angle from the axis, along x and y

        step = 1e-6
        for _ in range(20):
            here = self._shown(bent)
            slopes = [(self._shown(bent + d) - self._shown(bent - d)) / (2 * step) for d in step * np.eye(2)]
            (a, c), (b, d) = (slope.T for slope in slopes)
            ex, ey = (places - here).T
            with np.errstate(all="ignore"):
                move = np.stack([d * ex - b * ey, a * ey - c * ex], -1) / (a * d - b * c)[:, None]
            bent = bent + np.clip(np.nan_to_num(move, posinf=0, neginf=0), -0.2, 0.2)
        off = np.abs(self._shown(bent) - places).max(-1)
        seen = (off < 1e-9 * (1 + far)) & (np.hypot(*bent.T) < self.limit)
        return np.where(seen[:, None], _ray(bent), np.nan)

    def _shown(self, bent: np.ndarray) -> np.ndarray:
        """Where angles from the axis, along x and y, are seen [..., 2], focal lengths from the principal point."""
        with np.errstate(all="ignore"):
            return np.stack(self.family.formula(self.numbers, *np.moveaxis(_ray(bent), -1, 0)), -1)

    @functools.cached_property
    def limit(self) -> float:
        """The angle from the axis [rad] up to which the lens shows a larger one farther out; pi: it does not fold.

        In steps of half the circle, so that rounding does not move it.
        """
        angles = self._profile[0]
        return math.pi / STEPS * (self._most if len(angles) == self._most or self.family.around else len(angles) - 1)

    @property
    def least_cosine(self) -> float:
        """Of the angle from the axis: no more, and a point is not seen. Of a panorama none is so small."""
        return -2.0 if self.family.around else math.cos(self.limit)

    @property
    def _most(self) -> int:
        """Steps to straight behind, or to the side."""
        return STEPS if self.family.wide else STEPS // 2

    @functools.cached_property
    def _profile(self) -> tuple[np.ndarray, np.ndarray]:
        """Angles from the axis [A] up to the fold, and the least radius at which each is seen [A]."""
        angles = np.arange(self._most) * (math.pi / STEPS)
        around = np.arange(DIRECTIONS) * (2 * math.pi / DIRECTIONS)
        bent = angles[:, None, None] * np.stack([np.cos(around), np.sin(around)], -1)
        u, v = np.moveaxis(self._shown(bent), -1, 0)
        outward = u * np.cos(around) + v * np.sin(around)
        most = FARTHEST if self.family.wide else math.inf
        rises = ((np.diff(outward, axis=0) > 0) & (outward[1:] < most)).all(1)  # not, where it is no number
        count = 1 + (len(rises) if rises.all() else int(np.argmin(rises)))
        return angles[:count], outward[:count].min(1)


def _ray(bent: np.ndarray) -> np.ndarray:
    """Unit directions [..., 3] of angles from the axis, along x and y [..., 2]."""
    angle = np.hypot(bent[..., 0], bent[..., 1])
    return np.concatenate([bent * np.sinc(angle / math.pi)[..., None], np.cos(angle)[..., None]], -1)


@functools.lru_cache(maxsize=1024)
def angle_of_view(lens: Lens, _family: Family, left: float, top: float, right: float, bottom: float) -> float:
    """The largest angle from the axis [rad] that is seen in a picture; its sides in focal lengths from the axis.

    ``_family``: the lens's, since the name of its model may get another.
    """
    if lens.family.wide:
        return lens.limit
    rays = lens.undistorted(np.array([(x, y) for x in (left, right) for y in (top, bottom)]))
    return float(np.nan_to_num(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]), nan=lens.limit).max())


@functools.lru_cache(maxsize=1024)
def check_picture(lens: Lens, _family: Family, left: float, top: float, right: float, bottom: float) -> None:
    """Refuse a picture that the lens does not fill.

    Of a wide lens the corners may be empty, outside of a circle that touches an edge. Arguments: :func:`angle_of_view`.

    Raises:
        InputError: if its coefficients fold it inside of the picture, or a panorama is not one of all around.
    """
    if lens.model == "EQUIRECTANGULAR":
        if np.abs(np.array([left, top, right, bottom]) / np.pi - [-1, -0.5, 1, 0.5]).max() > SEAM:
            raise InputError(
                "Camera lens EQUIRECTANGULAR: expected a picture of 2:1 that shows all around, fx = width / (2 pi), "
                f"fy = height / pi, cx and cy in its middle, got {np.degrees(right - left):.1f} x "
                f"{np.degrees(bottom - top):.1f} degrees; use such a picture."
            )
        return
    corners = np.array([(x, y) for x in (left, right) for y in (top, bottom)])
    edges = np.array([(left, 0.0), (right, 0.0), (0.0, top), (0.0, bottom)])
    unseen = np.isnan(lens.undistorted(edges if lens.family.wide else corners)[:, 0])
    if lens.limit < math.pi and (unseen.all() if lens.family.wide else unseen.any()):
        raise InputError(
            f"Camera lens {lens.model}: expected coefficients that show farther out what lies farther out, all over "
            f"the picture, but {list(lens.coefficients)} fold it {math.degrees(lens.limit):.0f} degrees from the axis; "
            "correct them, or undistort the photographs."
        )

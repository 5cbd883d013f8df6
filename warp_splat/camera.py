"""A camera in COLMAP's conventions: x right, y down, z forward, pixel centers at +0.5."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from warp_splat.errors import InputError
from warp_splat.lenses import Lens, angle_of_view, check_picture
from warp_splat.lenses.shutter import ROUNDED, Shutter, rotation_vector

MOST_SHARE = 0.5  # of its height by which a picture may move up or down while it is read

EXACT = 1e-12  # share of a center's distance from the origin that is rounding of float64
LEVEL = 1e-3  # length of a mean of ups from which on it says where up is
ODD = 2  # px by which a panorama's width may miss twice its height, once it has been resized

# What numbers of a camera are to be, when they are, and of which type.
PIXELS = ("a whole number of pixels, at least 1", lambda value: value >= 1 and value.is_integer(), int)
FOCAL = ("a positive number", lambda value: 0 < value < math.inf, float)
PRINCIPAL = ("a finite number", math.isfinite, float)
NUMBERS = {"width": PIXELS, "height": PIXELS, "fx": FOCAL, "fy": FOCAL, "cx": PRINCIPAL, "cy": PRINCIPAL}


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera and its pose, world to camera: ``x_camera = rotation @ x_world + translation``.

    Args:
        width: image width [px], at least 1.
        height: image height [px], at least 1.
        fx: horizontal focal length [px], positive.
        fy: vertical focal length [px], positive.
        cx: principal point from the image's left edge [px]; may lie outside the image.
        cy: principal point from the image's top edge [px].
        rotation: rotation part of camera_from_world, [3, 3], orthonormal with determinant +1.
        translation: translation part of camera_from_world, [3], world units.
        lens: its distortion, a :class:`warp_splat.Lens`; None: a pinhole's, which has none.
        shutter: how it moves while its rows are read, a :class:`warp_splat.Shutter`; rotation and translation are then
            those of the middle. None: it stands still.

    Raises:
        InputError: if a value is missing its shape, not finite, or out of range, the lens folds inside the picture, or
            the shutter moves the picture by more than half its height.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    rotation: np.ndarray
    translation: np.ndarray
    lens: Lens | None = None
    shutter: Shutter | None = None

    def __post_init__(self):
        for name, (expected, fits, kind) in NUMBERS.items():
            if getattr(getattr(self, name), "requires_grad", False):  # it would get none
                raise InputError(f"Camera {name}: expected a number, got a tensor that wants a gradient; detach it.")
            try:
                value = float(getattr(self, name))
            except (TypeError, ValueError, OverflowError) as error:
                raise InputError(f"Camera {name}: expected a number, got {getattr(self, name)!r:.80}.") from error
            if not fits(value):
                raise InputError(f"Camera {name}: expected {expected}, got {value}.")
            object.__setattr__(self, name, kind(value))
        for name, shape in (("rotation", (3, 3)), ("translation", (3,))):
            try:
                value = np.array(getattr(self, name), dtype=np.float64)
            except (TypeError, ValueError, RuntimeError) as error:  # torch's, of a tensor that wants a gradient
                raise InputError(f"Camera {name}: expected numbers of shape {shape}, got something else.") from error
            if value.shape != shape:
                raise InputError(f"Camera {name}: expected shape {shape}, got {value.shape}.")
            if not np.isfinite(value).all():
                raise InputError(f"Camera {name}: expected finite numbers, got {value.tolist()}.")
            value.flags.writeable = False
            object.__setattr__(self, name, value)
        small = np.abs(self.rotation).max() < 2  # products of larger numbers may overflow
        orthonormal = small and np.abs(self.rotation @ self.rotation.T - np.eye(3)).max() <= 1e-4
        if not orthonormal or np.linalg.det(self.rotation) < 0:
            raise InputError("Camera rotation: expected an orthonormal matrix with determinant +1 (world to camera).")
        for name, kind in (("lens", Lens), ("shutter", Shutter)):
            if not isinstance(part := getattr(self, name), kind | None):
                raise InputError(f"Camera {name}: expected a warp_splat.{kind.__name__} or None, got {part!r:.80}.")
        if self.lens is not None:
            check_picture(self.lens, self.lens.family, *self._picture)
            if self.lens.family.around and abs(self.width - 2 * self.height) > ODD:
                raise InputError(
                    f"Camera lens {self.lens.model}: expected a picture of 2:1, got {self.width} x {self.height} "
                    "pixels; use one that shows all around."
                )
        if self.shutter and (share := abs(self.shutter.turn[0]) * self.fy / self.height) > MOST_SHARE + ROUNDED:
            raise InputError(
                "Camera shutter: expected a turn that moves the picture up or down by at most half of its height "
                f"while it is read, got {share:.2f}; check fy and the poses."
            )

    @classmethod
    def rolling(cls, first: Camera, last: Camera) -> Camera:
        """``first`` with a rolling shutter: from its pose, when its first row is read, to that of ``last``.

        The center moves on a line at one speed, the rotation about one axis (:class:`warp_splat.Shutter`). Of ``last``
        only the pose counts.

        Raises:
            InputError: if it turns by more than a radian, or moves the picture by more than half its height.
        """
        turned = last.rotation @ first.rotation.T
        if (cosine := 0.5 * (np.trace(turned) - 1)) < 0:
            raise InputError(
                "Camera.rolling: expected a turn of at most 1 rad from the first row to the last, got "
                f"{math.acos(max(cosine, -1)):.3g}; check the poses."
            )
        turn = tuple(rotation_vector(turned))
        rotation, _ = Shutter(turn).moved(0.5, first.rotation, first.translation)
        shift, center = rotation @ (last.center - first.center), 0.5 * (first.center + last.center)
        return replace(first, rotation=rotation, translation=-rotation @ center, shutter=Shutter(turn, tuple(shift)))

    def at(self, row: float) -> Camera:
        """The camera that stands still where this one is when the middle of ``row`` is read, from 0 to height - 1."""
        if self.shutter is None:
            return self
        pose = self.shutter.moved((row + 0.5) / self.height - 0.5, self.rotation, self.translation)
        return replace(self, rotation=pose[0], translation=pose[1], shutter=None)

    @property
    def center(self) -> np.ndarray:
        """Camera center in world coordinates, [3]."""
        center = -(self.rotation * self.translation[:, None]).sum(0)  # in one order, unlike a product of matrices
        off = (self.rotation * center).sum(1) + self.translation  # of a rotation that was rounded, as in a text file
        return center - off @ self.rotation if np.abs(off).max() > EXACT * np.abs(center).max() else center

    @property
    def forward(self) -> np.ndarray:
        """Viewing direction in world coordinates, unit length, [3]."""
        return self.rotation[2]

    @property
    def _picture(self) -> tuple[float, ...]:
        """Left, top, right and bottom edge of the image, in focal lengths from the principal point."""
        x, y = -self.cx / self.fx, -self.cy / self.fy
        return x, y, x + self.width / self.fx, y + self.height / self.fy

    @property
    def reach(self) -> float:
        """The largest angle between the axis and what a pixel sees [rad]."""
        if self.lens:
            return angle_of_view(self.lens, self.lens.family, *self._picture)
        left, top, right, bottom = self._picture
        return math.atan(math.hypot(max(-left, right), max(-top, bottom)))

    def pixels(self, rays: np.ndarray) -> np.ndarray:
        """Where directions in the camera [P, 3] are seen [P, 2]; NaN where none is; a pinhole divides by z."""
        places = self.lens.distorted(rays) if self.lens else rays[:, :2] / rays[:, 2:]
        return places * (self.fx, self.fy) + (self.cx, self.cy)

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions in the camera [P, 3] that are seen at ``pixels`` [P, 2]; NaN where the lens sees none."""
        rays = self.directions(pixels)
        return rays if self.lens else rays / np.sqrt((rays * rays).sum(1, keepdims=True))

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """:meth:`rays`; without a lens of z = 1 instead of unit length."""
        places = (np.asarray(pixels, np.float64) - [self.cx, self.cy]) / [self.fx, self.fy]
        return self.lens.undistorted(places) if self.lens else np.concatenate([places, np.ones((len(places), 1))], 1)

    def resized(self, width: int, height: int) -> Camera:
        """The same camera for an image resized to ``width`` x ``height``: all of K is scaled."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )


def mean_up(cameras: Sequence[Camera]) -> np.ndarray:
    """Away from the ground, [3], unit length: where most cameras have it, or the first where they cancel out."""
    up = -np.mean([camera.rotation[1] for camera in cameras], axis=0)
    return up / length if (length := float(np.linalg.norm(up))) > LEVEL else -cameras[0].rotation[1]

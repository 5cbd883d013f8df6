"""A camera that is learned, or moves while its rows are read: what the projection is told, and its gradients."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.errors import InputError
from warp_splat.kernels.project import Projection
from warp_splat.kernels.project.rolling import make_expose
from warp_splat.lenses import Lens
from warp_splat.lenses.formulas import PINHOLE
from warp_splat.lenses.shutter import Shutter, cross, rotated, series
from warp_splat.runtime.launch import launch_in_lanes, send
from warp_splat.runtime.sums import in_pairs

LONGEST = 2.0 * math.pi  # rotation vector; a longer one says what a shorter one does
#: A gradient of a pose, in the camera's axes: [3] about the camera's center, [3] of the shift of the world.
Tangent = tuple[np.ndarray, np.ndarray]


class CameraParameters:
    """A camera whose pose and intrinsics are tensors, for :func:`warp_splat.rasterize` in place of a camera.

    Their gradients are those of the image that is drawn. Sums have one order, whatever the threads and the processor.
    Where the Jacobian of the affine projection is clamped, and how far a lens is followed, stays as ``base`` has it: it
    does not move with intrinsics and coefficients. Nor has ``planes`` of :class:`warp_splat.RenderOutput` a gradient by
    the place from which distances are taken, but for that of its weights.

    Args:
        base: the camera to start from.
        twist: where the camera stands relative to ``base``, [6]: a rotation vector w [rad] and a translation v [world
            units], both in the camera's axes and applied on the left of camera_from_world: ``x_camera = exp(w)
            (rotation @ x_world + translation) + v``; w is at most a whole turn. None: a leaf of zeros, float64.
        intrinsics: fx, fy, cx, cy [px], [4]. None: a leaf of those of ``base``, float64.
        last_twist: likewise where the last row of a rolling shutter stands; ``twist`` is then of the first.
        coefficients: those of ``base.lens``, [K], in its order; they have no unit. None: they are not learned.

    Attributes:
        here: the same with tensors of the host, if somebody knows the numbers: then nobody waits for a GPU's.

    Raises:
        InputError: if ``base`` is no camera, a tensor has not its shape or holds no real numbers, a camera without a
            rolling shutter is given a last twist, or one with it, or without a lens, coefficients.
    """

    here: "CameraParameters | None" = None

    def __init__(
        self,
        base: Camera,
        twist: torch.Tensor | None = None,
        intrinsics: torch.Tensor | None = None,
        last_twist: torch.Tensor | None = None,
        coefficients: torch.Tensor | None = None,
    ):
        if not isinstance(base, Camera):
            raise InputError(f"base: expected a warp_splat.Camera, got {type(base).__name__}.")
        if base.shutter is None and last_twist is not None:
            raise InputError("last_twist: expected a base with a rolling shutter (Camera.rolling); leave it out.")
        self.base = base
        self.last_twist = _checked("last_twist", last_twist, [0.0] * 6) if base.shutter else None
        self.twist = _checked("twist", twist, [0.0] * 6)
        self.intrinsics = _checked("intrinsics", intrinsics, [base.fx, base.fy, base.cx, base.cy])
        if coefficients is not None:
            if base.shutter is not None:
                raise InputError("coefficients: expected None for a camera with a rolling shutter; leave them out.")
            if not base.lens or not base.lens.coefficients:
                raise InputError(
                    "coefficients: expected None for a camera whose lens has none, got some; give the camera a lens "
                    "that has, such as warp_splat.Lens('OPENCV', (0.0, 0.0, 0.0, 0.0))."
                )
            coefficients = _checked("coefficients", coefficients, list(base.lens.coefficients))
        self.coefficients = coefficients

    @property
    def camera(self) -> Camera:
        """The camera as it stands now.

        Raises:
            InputError: if the numbers make none.
        """
        if self.here is not None:
            return self.here.camera
        fx, fy, cx, cy = _numbers(self.intrinsics)
        if (lens := self.base.lens) and self.coefficients is not None:
            lens = Lens(lens.model, tuple(_numbers(self.coefficients).tolist()))
        base = replace(self.base, fx=fx, fy=fy, cx=cx, cy=cy, lens=lens)
        if self.last_twist is None:
            return _twisted(base, "twist", self.twist)
        first = _twisted(base.at(-0.5), "twist", self.twist)
        return Camera.rolling(first, _twisted(base.at(base.height - 0.5), "last_twist", self.last_twist))


def _twisted(base: Camera, name: str, tensor: torch.Tensor) -> Camera:
    """A camera elsewhere. Raises InputError if the numbers make none."""
    twist = _numbers(tensor)
    if not np.isfinite(twist).all() or (twist[:3] * twist[:3]).sum() > LONGEST**2:
        raise InputError(
            f"{name}: expected finite numbers, of which the rotation vector is at most 2 pi long, got "
            f"{twist.tolist()}; turn the base camera instead."
        )
    pose = rotated(np.concatenate([base.rotation, base.translation[:, None]], 1), twist[:3, None], 1)
    return replace(base, rotation=pose[:, :3], translation=pose[:, 3] + twist[3:])


def _checked(name: str, tensor: torch.Tensor | None, start: list[float]) -> torch.Tensor:
    """``tensor``, or a leaf of ``start``. Raises InputError if it is no such tensor."""
    if tensor is None:
        return torch.tensor(start, dtype=torch.float64, requires_grad=True)
    if not isinstance(tensor, torch.Tensor) or tensor.shape != (len(start),) or not tensor.is_floating_point():
        got = f"{tensor.dtype} {list(tensor.shape)}" if isinstance(tensor, torch.Tensor) else type(tensor).__name__
        raise InputError(f"{name}: expected a tensor of {len(start)} real numbers, got {got}.")
    if tensor.layout != torch.strided or tensor.is_meta:
        kind = "a meta tensor" if tensor.is_meta else tensor.layout
        raise InputError(f"{name}: expected a dense tensor with numbers, got {kind}; make it with torch.tensor.")
    return tensor


def sums_of(make: Callable[[int], wp.Kernel], lanes: int, columns: int, inputs: list) -> torch.Tensor:
    """The columns of what a kernel writes of all Gaussians, summed in pairs in float64, in one order everywhere."""
    return in_pairs(launch_in_lanes(make, lanes, inputs, sums=columns))


def twist_gradient(
    camera: Camera, learned: CameraParameters, motion: np.ndarray, which: int, sums: np.ndarray
) -> np.ndarray:
    """Of the first or the last twist [6], from the sums over all Gaussians [6] and the gradient of the motion."""
    columns = ((camera.rotation * part).T for part in (sums[:3], sums[3:]))
    turn, shift = (part[0] + part[1] + part[2] for part in columns)
    turn, shift = pose_gradients(camera.shutter, (turn, shift), motion)[which]
    now = _numbers((learned.twist, learned.last_twist)[which])
    turn = turn - cross(now[3:], shift)
    turn = rotated(turn, -now[:3], 2)  # by the left Jacobian of the rotation, transposed
    return np.concatenate([turn, shift])


def of_sums(
    linear: Callable[[np.ndarray], np.ndarray], sums: torch.Tensor, peeks: bool, like: torch.Tensor
) -> torch.Tensor:
    """A function of ``sums`` [K], like ``like``. By its matrix, if the host cannot look at them without waiting."""
    if peeks:
        return torch.tensor(linear(sums.cpu().numpy())).to(like)
    matrix = np.stack([linear(row) for row in np.eye(len(sums))], 1)
    return (send(torch.from_numpy(matrix), sums.device) * sums).sum(1).to(like)


def intrinsics_gradient(camera: Camera, time: np.ndarray, sums: np.ndarray) -> np.ndarray:
    """Of the intrinsics [4], from the sums over all Gaussians [4]; ``time`` [2]: what comes through that of a row."""
    return sums / [camera.fx, camera.fy, 1.0, 1.0] + np.array([0.0, time[0], 0.0, time[1]]) / camera.height


def coefficients_gradient(lens: Lens, found: torch.Tensor, coefficients: torch.Tensor) -> torch.Tensor:
    """Of a lens's coefficients, like them; ``found``: of each group, of the formula's."""
    total = in_pairs(found).cpu().numpy()
    return torch.tensor((total[:, None] * _prepared(lens)).sum(0)).to(coefficients)


def _prepared(lens: Lens) -> np.ndarray:
    """Derivatives of the formula's coefficients by the model's, [K, C], by differences: most are one and the same."""
    middle, columns = np.array(lens.coefficients), []
    for step in np.diag(1e-5 * np.maximum(1.0, np.abs(middle))):
        ends = np.stack([middle + step, middle - step])
        above, below = (np.array(Lens(lens.model, tuple(end)).numbers) for end in ends)
        columns.append((above - below) / (ends[0] - ends[1]).sum())
    return np.stack(columns, 1)


def _numbers(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().to("cpu", torch.float64).numpy()


def exposed_by(camera: Camera, options: RasterOptions, lanes: int) -> wp.Function | None:
    """What a rolling shutter does to a Gaussian; None without one.

    Raises:
        InputError: if the projection is the user's own, whose rows nobody knows.
    """
    if camera.shutter is None:
        return None
    if isinstance(options.projection, Projection):
        raise InputError(
            "options.projection: expected one by name for a camera with a rolling shutter, got one of your own; choose "
            "affine, ellipsoid or unscented, or draw without the shutter (Camera.at)."
        )
    return make_expose(camera.lens.family if camera.lens else PINHOLE, lanes)


def motion_of(camera: Camera) -> np.ndarray | None:
    """Two quadruples that the kernel reads beside a quaternion; None if the camera stands still."""
    if camera.shutter is None:
        return None
    time = camera.fy / camera.height, camera.cy / camera.height - 0.5
    return np.array([[*camera.shutter.turn, time[0]], [*camera.shutter.shift, time[1]]])


def with_motion(quats: torch.Tensor, motion: np.ndarray | float, lanes: int) -> torch.Tensor:
    """Quaternions [N, 4] and the motion, for groups of ``lanes``: [N / lanes, 3, 4 lanes]."""
    groups = quats.new_empty(len(quats) // lanes, 3, lanes, 4)
    groups[:, 0] = quats.view(-1, lanes, 4)
    groups[:, 1:] = torch.as_tensor(motion).to(quats).view(-1, 1, *([4] if isinstance(motion, np.ndarray) else [1]))
    return groups.view(-1, 3, 4 * lanes)


def motion_gradient(turns: torch.Tensor | None, lanes: int, wanted: bool) -> np.ndarray:
    """Of the motion [2, 4], from that of what :func:`with_motion` made, in one order everywhere; zeros without one."""
    if turns is None or not wanted:
        return np.zeros((2, 4))
    parts = turns.view(-1, 3, lanes, 4)[:, 1:].nan_to_num(0.0, 0.0, 0.0)
    while parts.shape[2] > 1:
        parts = torch.add(*parts.chunk(2, 2))
    return in_pairs(parts.reshape(-1, 8)).cpu().numpy().reshape(2, 4)


def pose_gradients(shutter: Shutter | None, middle: Tangent, motion: np.ndarray) -> tuple[Tangent, Tangent]:
    """Of the poses of the first and the last row, from that of the middle with the motion as it is, and the motion's.

    All is that of the middle where there is no shutter.

    With w the turn and J(w) the left Jacobian of the exponential, small turns a and b of the two poses change w by
    J(w)^-1 b - J(-w)^-1 a, and turn the middle by half of J(w / 2) times that, and exp(w / 2) a.
    """
    if shutter is None:
        return middle, middle
    w, shift = np.array(shutter.turn), np.array(shutter.shift)
    by_turn, by_shift = motion[:, :3]
    turn = middle[0] + cross(shift, by_shift)
    by_turn = by_turn + 0.5 * rotated(turn, -0.5 * w, 2)
    half = 0.5 * middle[1]
    first = rotated(turn, -0.5 * w, 1) - _before_jacobian(w, by_turn), rotated(half + by_shift, -0.5 * w, 1)
    return first, (_before_jacobian(-w, by_turn), rotated(half - by_shift, 0.5 * w, 1))


def _before_jacobian(w: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """J(w)^-1 times a vector."""
    square = sum(part * part for part in w.tolist())
    factor = 0.5 * (series(square, 3) - 2.0 * series(square, 4)) / series(square, 2)
    across = cross(w, vector)
    return vector - 0.5 * across + factor * cross(w, across)

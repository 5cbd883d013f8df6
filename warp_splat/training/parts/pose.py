"""Poses that are a little off: they follow the cameras' gradients, near where structure from motion put them.

Photographs cannot tell a turn, a shift or a growth of all cameras from the opposite one of the scene. So these seven
motions are taken out of the poses after every step, to first order: the set as a whole stays where it was given.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from warp_splat.camera import Camera
from warp_splat.raster.api import RenderOutput
from warp_splat.raster.camera_parameters import CameraParameters
from warp_splat.scene.types import Scene, Sightings, View
from warp_splat.training.optimizer import power
from warp_splat.training.parts import PoseOptions
from warp_splat.training.seams import Setting, Step, Verdict

LENS_RATE = 0.1  # of the poses' rate: a lens learns from every photograph, a pose from its own
LAST_RATE = 0.01  # of the first one, at the end
ENOUGH = 10  # points in a photograph, to tell whether its pose is right
OFF = 0.5  # px that a pose moves its picture by: what blurs
FLAT = 1e-9  # length of a motion that moves nothing: growth, where all cameras stand at one place


class Pose:
    """A twist of each photograph's camera; if asked for, changes of each lens, which its photographs share."""

    def __init__(self, options: PoseOptions, setting: Setting):
        scene, new = setting.scene, torch.zeros
        self.options, self.iterations, self.scene = options, setting.iterations, scene
        self.places = {view: place for place, view in enumerate(scene.train)}
        self.lenses = {lens: place for place, lens in enumerate(dict.fromkeys(map(intrinsics_of, scene.train)))}
        device, numbers = setting.model.device, {"": 0, "focal": 1, "all": 4}[options.pose_intrinsics]
        self.units = torch.tensor([1.0] * 3 + [scene.extent] * 3, dtype=torch.float64, device=device)
        #: Radians and shares of the extent.
        self.twists = new(len(scene.train), 6, device=device, requires_grad=True)
        #: Shares of fx, fy, width and height; with "focal" one of both focal lengths.
        self.stretches = new(len(self.lenses), numbers, device=device, requires_grad=True)
        self.gauge = gauge([view.camera for view in scene.train], scene.extent)

    @classmethod
    def needed(cls, scene: Scene) -> Verdict:
        """If the points that structure from motion saw say that the median pose is off by what blurs."""
        found = [
            pose_error(view.camera, scene.tracks[view.name])
            for view in scene.train
            if view.name in scene.tracks and len(scene.tracks[view.name].ids) >= ENOUGH
        ]
        if not found:
            return Verdict(False, "the scene keeps no keypoints of its points, by which poses could be judged")
        off = float(np.median(found))
        return Verdict(off > OFF, f"the median pose is off by {off:.2f} px, judged by its points (limit {OFF} px)")

    def parameters(self) -> list[dict]:
        """Twists, and lenses if asked for."""
        groups = [{"name": "pose", "params": [self.twists], "lr": self._rate}]
        if self.options.pose_intrinsics:
            groups.append({"name": "lens", "params": [self.stretches], "lr": lambda i: LENS_RATE * self._rate(i)})
        return groups

    def _rate(self, iteration: int) -> float:
        """0 until there is something to compare with; then it falls."""
        start = self.options.pose_from_iter
        if iteration < start:
            return 0.0
        return self.options.pose_lr * power(LAST_RATE, iteration - start, max(self.iterations - start, 1))

    def camera(self, camera: Camera, step: Step) -> CameraParameters:
        """Where the photograph's camera has come to."""
        return self._learned(camera, step.view)

    def refined(self, camera: Camera, view: View) -> Camera:
        """As it stands now; of a photograph that is held out, the lens alone."""
        with torch.no_grad():
            return self._learned(camera, view).camera

    def _learned(self, camera: Camera, view: View) -> CameraParameters:
        twist = self.twists[self.places[view]].double() * self.units if view in self.places else torch.zeros(6)
        if not self.options.pose_intrinsics or intrinsics_of(view) not in self.lenses:
            return CameraParameters(camera, twist, torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy]).double())
        free = self.options.pose_intrinsics == "all"
        units = [camera.fx, camera.fy, free * camera.width, free * camera.height]
        given = [camera.fx, camera.fy, camera.cx, camera.cy]
        given, units = torch.tensor([given, units], dtype=torch.float64, device=self.stretches.device)
        return CameraParameters(
            camera, twist, given + units * self.stretches[self.lenses[intrinsics_of(view)]].double()
        )

    def loss(self, loss: torch.Tensor, out: RenderOutput, step: Step) -> torch.Tensor:
        """Add the squared distance from what was given."""
        away = [self.twists[self.places[step.view]], self.stretches[self.lenses[intrinsics_of(step.view)]]]
        for number in torch.cat(away).square().unbind():  # in one order
            loss = loss + self.options.pose_reg * number
        return loss

    def after_step(self, iteration: int) -> None:
        """Take out what moves the set as a whole."""
        moved = self.twists.detach().double().cpu().numpy().ravel()
        for motion in self.gauge:
            moved = moved - math.fsum((moved * motion).tolist()) * motion
        self.twists.detach().copy_(torch.from_numpy(moved.reshape(-1, 6)))


def intrinsics_of(view: View) -> tuple[float, ...]:
    """What photographs of one camera have in common."""
    camera = view.original
    return camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy


def gauge(cameras: Sequence[Camera], extent: float) -> list[np.ndarray]:
    """Orthonormal twists [6 V] of all cameras, in radians and extents, that move the set as a similarity does."""
    centers = np.stack([camera.center for camera in cameras])
    arms = (centers - centers.sum(0) / len(cameras)) / extent
    rotations, still = np.stack([camera.rotation for camera in cameras]), np.zeros((len(cameras), 3))
    motions = []
    for axis in np.eye(3):
        turn = np.broadcast_to(axis, arms.shape)
        motions += [(turn, np.cross(turn, arms)), (still, turn)]
    motions.append((still, arms))
    basis: list[np.ndarray] = []
    for turn, shift in motions:  # of the world; as the cameras see them, with the other sign
        seen = [(rotations * part[:, None]).transpose(2, 0, 1).sum(0) for part in (turn, shift)]  # in one order
        motion = np.concatenate(seen, 1).ravel()
        for other in basis:
            motion = motion - math.fsum((motion * other).tolist()) * other
        length = math.sqrt(math.fsum((motion * motion).tolist()))
        if length > FLAT:
            basis.append(motion / length)
    return basis


def pose_error(camera: Camera, seen: Sightings) -> float:
    """By how many pixels a pose probably moves its picture, judged by its points; infinite if it sees few of them.

    A step of Gauss and Newton from the pose to where its keypoints would have it moves the points; to that comes what
    the covariance of the keypoints leaves open. Keypoints far off count less (Cauchy's weights).
    """
    points = seen.points @ camera.rotation.T + camera.translation
    front = points[:, 2] > 0
    if np.count_nonzero(front) < ENOUGH:
        return math.inf
    (x, y, z), focal = points[front].T, np.array([camera.fx, camera.fy])
    slopes, zero = np.stack([x / z, y / z], 1), np.zeros_like(z)
    errors = focal * (seen.slopes[front] - slopes)
    turned = np.stack([[zero, z, -y], [-z, zero, x], [y, -x, zero]]).transpose(2, 1, 0)  # of x, y, z by each turn
    moved = np.concatenate([turned, np.broadcast_to(np.eye(3), turned.shape)], 2)
    rows = focal[:, None] * (moved[:, :2] - slopes[..., None] * moved[:, 2:]) / z[:, None, None]
    squares = (errors**2).sum(1)
    weights = 1 / (1 + squares / max(4 * np.median(squares), 1e-12))
    normal = np.einsum("n,nij,nik->jk", weights, rows, rows)
    step = np.linalg.lstsq(normal, np.einsum("n,nij,ni->j", weights, rows, errors), rcond=1e-12)[0]
    left = ((errors - rows @ step) ** 2).sum(1)
    noise = np.average(left, weights=weights) / 2
    return math.sqrt(((rows @ step) ** 2).sum(1).mean() + 6 * noise / len(left))

"""Poses that are a little off: they follow the cameras' gradients, near where structure from motion put them.

A turn and a shift of a camera look much alike, and either may look like more or less. So what is learned are six
numbers each of which moves what the picture shows by as much, and none as another does (after Park et al. 2023, CamP).

Photographs cannot tell a turn, a shift or a growth of all cameras from the opposite one of the scene. So these seven
motions are taken out of the poses after every step, to first order: the set as a whole stays where it was given.
"""

import functools
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch

from warp_splat.camera import Camera
from warp_splat.formats.checkpoint import Checkpoint
from warp_splat.raster.api import RenderOutput
from warp_splat.raster.camera_parameters import CameraParameters
from warp_splat.raster.drivers import driver_of
from warp_splat.runtime.launch import read_later, send
from warp_splat.runtime.sums import in_pairs
from warp_splat.scene.types import Scene, Sightings, View, visible
from warp_splat.training.optimizer import power
from warp_splat.training.parts import PoseOptions
from warp_splat.training.seams import Setting, Step, Verdict

LENS_RATE = 1.0  # of the poses' rate: a lens learns from every photograph, a pose from its own
LAST_RATE = 0.01  # of the first one, at the end
ENOUGH = 10  # points in a photograph, to tell whether its pose is right
OFF = 0.5  # px that a pose moves its picture by: what blurs
FLAT = 1e-9  # length of a motion that moves nothing: growth, where all cameras stand at one place
MOST = 1000  # points of a photograph that say how a pose moves it
DAMPING = 0.01  # of its square
NUMBERS = "pose.numbers"  # in a checkpoint


class Pose:
    """A twist of each photograph's camera; if asked for, changes of each lens, which its photographs share."""

    def __init__(self, options: PoseOptions, setting: Setting):
        scene, new = setting.scene, torch.zeros
        self.options, self.iterations, self.scene = options, setting.iterations, scene
        self.places = {view: place for place, view in enumerate(scene.train)}
        self.lenses = {lens: place for place, lens in enumerate(dict.fromkeys(map(intrinsics_of, scene.train)))}
        self.device, numbers = setting.model.device, {"": 0, "focal": 1, "all": 4}[options.pose_intrinsics]
        cameras, points = [view.camera for view in scene.train], scene.points.astype(np.float64)
        self._choose_numbers(factors(np.stack([sensitivity(camera, points, scene.extent) for camera in cameras])))
        #: Shares of the pictures' widths.
        self.moves = new(len(scene.train), 6, device=self.device, requires_grad=True)
        #: Shares of fx, fy, width and height; with "focal" one of both focal lengths.
        self.stretches = new(len(self.lenses), numbers, device=self.device, requires_grad=True)
        self.late = self.coming = self._read_later()

    def _choose_numbers(self, lower: np.ndarray) -> None:
        """What the numbers of each photograph stand for: those that ``lower`` [V, 6, 6] makes of a twist."""
        extent, cameras = self.scene.extent, [view.camera for view in self.scene.train]
        self.lower = lower
        #: Of each photograph and of each of its numbers: the twist, [V, 6, 6].
        self.ways_here = torch.from_numpy(inverses(lower) * np.array([1.0] * 3 + [extent] * 3))
        self.ways = self.ways_here.to(self.device)
        whole = [in_order(lower * motion[:, :, None]) for motion in gauge(cameras, extent)]
        self.gauge = orthonormal(np.stack(whole).reshape(len(whole), -1))
        self.motions = torch.from_numpy(np.stack(self.gauge)).to(self.device)

    def _read_later(self) -> Callable[[], list] | None:
        """The numbers, for the host of a GPU: it uses them a step late, when they have come without waiting."""
        numbers = [self.moves.detach().flatten(), self.stretches.detach().flatten()]
        return None if driver_of(self.device).peeks else read_later(torch.cat(numbers))

    def state(self) -> dict[str, torch.Tensor]:
        """What the numbers stand for: points and sizes of photographs may be others after a resume."""
        return {NUMBERS: torch.from_numpy(self.lower)}

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on with the same numbers."""
        if NUMBERS in checkpoint.arrays:  # not, if training went without this part so far
            self._choose_numbers(checkpoint.array(NUMBERS, self.lower.shape, np.float64))
            self.late = self.coming = self._read_later()

    @classmethod
    def needed(cls, scene: Scene) -> Verdict:
        """If the points that structure from motion saw say that the median pose is off by what blurs."""
        if any(view.camera.lens and view.camera.lens.family.wide for view in scene.train):
            return Verdict(False, "poses of cameras that see beside themselves are not judged")
        pairs = [(view.camera, scene.tracks[view.name]) for view in scene.train if view.name in scene.tracks]
        if not (found := [pose_error(camera, seen) for camera, seen in pairs if len(seen.ids) >= ENOUGH]):
            return Verdict(False, "the scene keeps no keypoints of its points, by which poses could be judged")
        off = float(np.median(found))
        return Verdict(off > OFF, f"the median pose is off by {off:.2f} px, judged by its points (limit {OFF} px)")

    def parameters(self) -> list[dict]:
        """Twists, and lenses if asked for."""
        groups = [{"name": "pose", "params": [self.moves], "lr": self._rate}]
        lens = {"name": "lens", "params": [self.stretches], "lr": lambda i: LENS_RATE * self._rate(i)}
        return groups + [lens] * bool(self.options.pose_intrinsics)

    def _rate(self, iteration: int) -> float:
        """0 until there is something to compare with; then it falls."""
        if iteration < (start := self.options.pose_from_iter):
            return 0.0
        return self.options.pose_lr * power(LAST_RATE, iteration - start, max(self.iterations - start, 1))

    def camera(self, camera: Camera, step: Step) -> CameraParameters:
        """Where the photograph's camera has come to."""
        found = self._learned(camera, step.view, self.ways, self.moves, self.stretches)
        if self.late is not None:
            moves, stretches = torch.tensor(self.late()).split([self.moves.numel(), self.stretches.numel()])
            numbers = moves.view_as(self.moves), stretches.view_as(self.stretches)
            found.here = self._learned(camera, step.view, self.ways_here, *numbers)
        return found

    def refined(self, camera: Camera, view: View) -> Camera:
        """As it stands now; of a photograph that is held out, the lens alone."""
        with torch.no_grad():
            return self._learned(camera, view, self.ways, self.moves, self.stretches).camera

    def _learned(
        self, camera: Camera, view: View, ways: torch.Tensor, moves: torch.Tensor, stretches: torch.Tensor
    ) -> CameraParameters:
        twist = torch.zeros(6)
        if view in self.places:
            place = self.places[view]
            twist = in_pairs(ways[place] * moves[place].double()[:, None])
        free = self.options.pose_intrinsics == "all"
        units = [camera.fx, camera.fy, free * camera.width, free * camera.height]
        lens, units = torch.tensor([[camera.fx, camera.fy, camera.cx, camera.cy], units], dtype=torch.float64)
        around = camera.lens is not None and camera.lens.family.around  # a panorama: its size says its intrinsics
        if self.options.pose_intrinsics and not around and intrinsics_of(view) in self.lenses:
            stretch = stretches[self.lenses[intrinsics_of(view)]].double()
            lens = send(lens, stretch.device) + send(units, stretch.device) * stretch
        return CameraParameters(camera, twist, lens)

    def loss(self, loss: torch.Tensor, out: RenderOutput, step: Step) -> torch.Tensor:
        """Add the squared distance from what was given."""
        away = [self.moves[self.places[step.view]], self.stretches[self.lenses[intrinsics_of(step.view)]]]
        return loss + (self.options.pose_reg * in_pairs(torch.cat(away).square())).to(loss.dtype)

    def after_step(self, iteration: int) -> None:
        """Take out what moves the set as a whole."""
        if self.late is not None:
            moved = self.moves.detach().double().flatten()
            moved = moved - ((self.motions * moved).sum(1, keepdim=True) * self.motions).sum(0)
            self.moves.detach().copy_(moved.view(-1, 6))
            self.late, self.coming = self.coming, self._read_later()
            return
        moved = self.moves.detach().double().cpu().numpy().ravel()
        for motion in self.gauge:
            moved = moved - dot(moved, motion) * motion
        self.moves.detach().copy_(torch.from_numpy(moved.reshape(-1, 6)))


def intrinsics_of(view: View) -> tuple:
    """What photographs of one camera have in common."""
    camera = view.original
    return camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.lens


def gauge(cameras: Sequence[Camera], extent: float) -> np.ndarray:
    """Seven twists of all cameras [7, V, 6], in radians and extents, that move the set as a similarity does."""
    centers = np.stack([camera.center for camera in cameras])
    arms = (centers - centers.sum(0) / len(cameras)) / extent
    rotations, still = np.stack([camera.rotation for camera in cameras]), np.zeros((len(cameras), 3))
    motions = []
    for axis in np.eye(3):
        turn = np.broadcast_to(axis, arms.shape)
        motions += [(turn, np.cross(turn, arms)), (still, turn)]
    motions.append((still, arms))
    axes = rotations.transpose(0, 2, 1)  # of the world; as the cameras see them, with the other sign
    parts = [[in_order(axes * part[:, :, None]) for part in motion] for motion in motions]
    return np.stack([np.concatenate(pair, 1) for pair in parts])


def in_order(terms: np.ndarray) -> np.ndarray:
    """Sum over the axis after the first, of which a sum over the last may have another order."""
    return functools.reduce(np.add, terms.swapaxes(0, 1))


def orthonormal(vectors: np.ndarray) -> list[np.ndarray]:
    """A basis of ``vectors`` [K, M], whose sums are exact."""
    basis: list[np.ndarray] = []
    for vector in vectors:
        rest = vector
        for other in basis:
            rest = rest - dot(rest, other) * other
        if (length := math.sqrt(dot(rest, rest))) > FLAT * math.sqrt(dot(vector, vector)):
            basis.append(rest / length)
    return basis


def dot(one: np.ndarray, other: np.ndarray) -> float:
    """The same on every processor."""
    return math.fsum((one * other).tolist())  # rounded once, whatever the order


def sensitivity(camera: Camera, points: np.ndarray, extent: float) -> np.ndarray:
    """How far a twist, in radians and extents, moves what the picture shows: squared shares of its width, [6, 6].

    The mean over the points [P, 3], damped: where they say little, a pose is to move little.
    """
    focal = np.array([camera.fx, camera.fy]) / camera.width
    ahead = (camera.rotation[2][:, None] * points.T).sum(0) > -camera.translation[2]  # of what a fisheye shows
    shown = points[visible(camera, points) & ahead]
    rows = focal[:, None, None] * slope_changes(camera, shown[:: -(-len(shown) // MOST) or 1])[1]
    rows[:, 3:] *= extent
    products = torch.from_numpy((rows[:, :, None] * rows[:, None]).transpose(3, 0, 1, 2))
    across, down = in_pairs(products).numpy() / max(len(products), 1)
    square = across + down
    return square + DAMPING * (np.diag(np.diag(square)) + focal[0] ** 2 * np.eye(6))


def factors(squares: np.ndarray) -> np.ndarray:
    """Lower triangles L with L L' = ``squares`` [V, 6, 6] (Cholesky), by steps that round alike everywhere."""
    lower = np.zeros_like(squares)
    for j in range(squares.shape[1]):
        for i in range(j, squares.shape[1]):
            rest = squares[:, i, j] - sum(lower[:, i, k] * lower[:, j, k] for k in range(j))
            lower[:, i, j] = np.sqrt(rest) if i == j else rest / lower[:, j, j]
    return lower


def inverses(lower: np.ndarray) -> np.ndarray:
    """Of lower triangles [V, 6, 6]."""
    found = np.zeros_like(lower)
    for j in range(lower.shape[1]):
        found[:, j, j] = 1.0 / lower[:, j, j]
        for i in range(j + 1, lower.shape[1]):
            found[:, i, j] = -sum(lower[:, i, k] * found[:, k, j] for k in range(j, i)) / lower[:, i, i]
    return found


def slope_changes(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slopes x / z and y / z of points [P, 3] in the camera, [2, P], and their changes with a twist, [2, 6, P]."""
    x, y, z = (camera.rotation[:, :, None] * points.T).sum(1) + camera.translation[:, None]
    u, v, zero, one = x / z, y / z, np.zeros_like(z), 1.0 / z
    changes = [[-u * v, 1.0 + u * u, -v, one, zero, -u * one], [-1.0 - v * v, u * v, u, zero, one, -v * one]]
    return np.stack([u, v]), np.array(changes)


def pose_error(camera: Camera, seen: Sightings) -> float:
    """By how many pixels a pose probably moves its picture, judged by its points; infinite if it sees few of them.

    A step of Gauss and Newton from the pose to where its keypoints would have it moves the points; to that comes what
    the covariance of the keypoints leaves open. Keypoints far off count less (Cauchy's weights).
    """
    front = (seen.points @ camera.rotation.T + camera.translation)[:, 2] > 0
    if np.count_nonzero(front) < ENOUGH:
        return math.inf
    slopes, changes = slope_changes(camera, seen.points[front])
    focal = np.array([camera.fx, camera.fy])[:, None]
    errors, rows = focal * (seen.slopes[front].T - slopes), focal[:, None] * changes
    squares = (errors**2).sum(0)
    weights = 1 / (1 + squares / max(4 * np.median(squares), 1e-12))
    normal = np.einsum("n,ijn,ikn->jk", weights, rows, rows)
    step = np.linalg.lstsq(normal, np.einsum("n,ijn,in->j", weights, rows, errors), rcond=1e-12)[0]
    moved = np.einsum("ijn,j->in", rows, step)
    noise = np.average(((errors - moved) ** 2).sum(0), weights=weights) / 2
    return math.sqrt((moved**2).sum(0).mean() + 6 * noise / len(squares))

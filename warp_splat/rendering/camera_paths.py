"""Cameras for videos: an orbit, a spiral, or a smooth path through those of training; and one where none is known."""

from dataclasses import replace

import numpy as np

from warp_splat.camera import Camera
from warp_splat.config import NEAR
from warp_splat.errors import InputError
from warp_splat.scene.types import Scene, visible

ORBIT_SIZE = (980, 545)  # px
ORBIT_VIEW = (1.4, 0.9)  # horizontal and vertical field of view, rad
ORBIT_RADIUS = 5.0  # world units from the world's origin
HALF = 0.5 * np.array(ORBIT_SIZE)
ORBIT_LENS = Camera(*ORBIT_SIZE, *(HALF / np.tan(0.5 * np.array(ORBIT_VIEW))), *HALF, np.eye(3), np.zeros(3))
PARALLEL = 1e-3  # squared sine: axes that cross at less do not say where
TURNS = 2  # of a spiral
LARGEST_SPIRAL = 0.3  # times the distance of what it looks at
KEY_FRAMES = 10  # between two cameras that a path passes: fewer show how a hand shook
DETOUR = 2.0  # photographs whose order by name is this many times longer than a tour were not taken in that order


def look_at(lens: Camera, place: np.ndarray, target: np.ndarray, up: np.ndarray) -> Camera:
    """The camera ``lens`` moved to ``place`` [3], looking at ``target`` [3], with ``up`` [3] upwards in its image."""
    forward = (target - place) / np.linalg.norm(target - place)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return placed_at(lens, np.stack([right, np.cross(forward, right), forward]), place)


def placed_at(lens: Camera, rotation: np.ndarray, place: np.ndarray) -> Camera:
    """The camera ``lens`` at ``place`` [3], with the rows of ``rotation`` [3, 3] for its axes."""
    return replace(lens, rotation=rotation, translation=-rotation @ place, shutter=None)


def orbit_cameras(center: np.ndarray, up: np.ndarray, start: np.ndarray, count: int, lens: Camera) -> list[Camera]:
    """Cameras on a circle around ``center``, looking at it.

    Args:
        center: [3], world.
        up: unit vector, [3]; the circle lies in the plane across it.
        start: the first camera's place, [3]; fixes radius and height.
        count: cameras.
        lens: size and intrinsics of all of them.
    """
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - slow to load, and other paths do without

    turns = Rotation.from_rotvec(np.outer(2.0 * np.pi * np.arange(count) / count, up))
    return [look_at(lens, center + arm, center, up) for arm in turns.apply(start - center)]


def origin_orbit(count: int, lens: Camera = ORBIT_LENS) -> list[Camera]:
    """``count`` cameras around the world's origin, which takes no scene; y points down, as in COLMAP's cameras."""
    return orbit_cameras(np.zeros(3), np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, -ORBIT_RADIUS]), count, lens)


def overview(means: np.ndarray) -> tuple[Camera, np.ndarray]:
    """A camera before Gaussians of which none is known, and their middle [3], at which it looks along z with y down.

    Most of them are in view. ``means``: [N, 3] world units, none or wherever they are.
    """
    means = means.astype(np.float64) if len(means) else np.zeros((1, 3))
    middle, half_view = np.median(means, axis=0), 0.5 * ORBIT_VIEW[1]
    radius = np.percentile(np.linalg.norm(means - middle, axis=1), 80) or 1.0
    distance = max(radius / np.sin(half_view), radius + 2.0 * NEAR)  # what is nearer does not show
    focal = HALF[1] / np.tan(half_view)
    lens = Camera(*ORBIT_SIZE, focal, focal, *HALF, np.eye(3), np.zeros(3))
    return placed_at(lens, np.eye(3), middle - [0.0, 0.0, distance]), middle


def focus_point(scene: Scene) -> tuple[np.ndarray, np.ndarray, float]:
    """The point nearest to all optical axes (least squares), the scene's up, the cameras' mean distance from it."""
    cameras = [view.camera for view in scene.train]
    across = [np.eye(3) - np.outer(camera.forward, camera.forward) for camera in cameras]
    # tells what axes that are nearly parallel do not
    middle = np.median(scene.points.astype(np.float64), axis=0) if len(scene.points) else np.zeros(3)
    wanted = sum(a @ (camera.center - middle) for a, camera in zip(across, cameras, strict=True))
    center = middle + np.linalg.lstsq(sum(across), wanted, rcond=PARALLEL)[0]
    return center, scene.up, float(np.mean([np.linalg.norm(camera.center - center) for camera in cameras]))


def focus_orbit(scene: Scene, count: int, lens: Camera = ORBIT_LENS) -> list[Camera]:
    """``count`` cameras around the point that the scene's cameras look at, level with it and at their mean distance.

    Raises:
        InputError: if there is no such point.
    """
    center, up, distance = focus_point(scene)
    first = scene.train[0].camera.center - center
    level = first - np.dot(first, up) * up
    if not (distance > 1e-6 and np.linalg.norm(level) > 1e-6 * distance):
        raise InputError("an orbit around the focus: the cameras look at no common point; use --orbit_center origin.")
    return orbit_cameras(center, up, center + distance * level / np.linalg.norm(level), count, lens)


def spiral_cameras(scene: Scene, count: int, lens: Camera) -> list[Camera]:
    """A closed spiral before the scene (Mildenhall et al. 2019, LLFF), looking at what the middle camera looks at.

    The middle camera is the one nearest to all. The radii cover nine tenths of the cameras. They are at most 0.3 of the
    distance of the points that the middle camera sees: cameras all around a thing shall not lead the spiral through it.
    """
    cameras = [view.camera for view in scene.train]
    centers = np.stack([camera.center for camera in cameras])
    middle = cameras[int(np.argmin(np.linalg.norm(centers[:, None] - centers, axis=2).sum(1)))]
    seen = scene.points[visible(middle, scene.points)]
    depth = np.median((seen - middle.center) @ middle.forward) if len(seen) else scene.extent
    target = middle.center + depth * middle.forward
    radii = np.percentile(np.abs((centers - middle.center) @ middle.rotation.T), 90, axis=0)
    radii = np.clip(radii, 0.05 * depth, LARGEST_SPIRAL * depth) * [1.0, 1.0, 0.5]  # less towards it than across
    angles = 2.0 * np.pi * np.arange(count) / count
    turns = np.stack([np.cos(TURNS * angles), np.sin(TURNS * angles), np.sin(angles)], axis=1)
    places = middle.center + (radii * turns) @ middle.rotation
    return [look_at(lens, place, target, -middle.rotation[1]) for place in places]


def path_cameras(scene: Scene, count: int, lens: Camera) -> list[Camera]:
    """A smooth path through the training cameras: cubic splines of place and rotation, at about equal speed.

    The cameras follow each other by name. Photographs of many authors have no such order: where a tour from each to the
    nearest is much shorter, they follow the tour. It starts at the first and passes every few of them.

    Raises:
        InputError: if all cameras are at one place and look one way.
    """
    from scipy.interpolate import CubicSpline  # noqa: PLC0415 - slow to load, and other paths do without
    from scipy.spatial.transform import Rotation, RotationSpline  # noqa: PLC0415

    cameras = [view.camera for view in scene.train]
    steps = _distances(cameras, scene.extent)
    named, tour = np.arange(len(cameras)), _tour(steps)
    order = tour if _length(steps, named) > DETOUR * _length(steps, tour) else named
    keys = order[np.unique(np.linspace(0, len(order) - 1, max(2, count // KEY_FRAMES)).round().astype(int))]
    kept = [keys[0]]
    for key in keys[1:]:
        if steps[kept[-1], key] > 1e-6 * steps.max():
            kept.append(key)
    if len(kept) < 2:
        raise InputError("--video path: expected training cameras at two places or more, found one; use orbit.")
    times = np.concatenate([[0.0], np.cumsum(steps[kept[:-1], kept[1:]])])
    places = CubicSpline(times, [cameras[key].center for key in kept])
    rotations = RotationSpline(times, Rotation.from_matrix([cameras[key].rotation for key in kept]))
    moments = np.linspace(0.0, times[-1], count)
    return [placed_at(lens, *pose) for pose in zip(rotations(moments).as_matrix(), places(moments), strict=True)]


def _distances(cameras: list[Camera], extent: float) -> np.ndarray:
    """[C, C]: how far each camera is from each; a quarter turn counts like the extent of the scene."""
    centers = np.stack([camera.center for camera in cameras])
    rotations = np.stack([camera.rotation for camera in cameras])
    cosines = 0.5 * (np.einsum("aij,bij->ab", rotations, rotations) - 1.0)
    turns = np.arccos(np.clip(cosines, -1.0, 1.0)) / (0.5 * np.pi)
    np.fill_diagonal(turns, 0.0)
    return np.linalg.norm(centers[:, None] - centers, axis=2) + extent * turns


def _length(steps: np.ndarray, order: np.ndarray) -> float:
    return float(steps[order[:-1], order[1:]].sum())


def _tour(steps: np.ndarray) -> np.ndarray:
    """A short open tour from the first camera: always to the nearest one left, then 2-opt (Croes 1958)."""
    order, left = [0], set(range(1, len(steps)))
    while left:
        order.append(min(left, key=lambda camera: steps[order[-1], camera]))
        left.remove(order[-1])
    tour, improved = np.append(order, len(order)), True
    steps = np.pad(steps, (0, 1))  # to an end that is near to all
    while improved:
        improved = False
        for i in range(len(order) - 2):
            ends = np.arange(i + 2, len(order))  # tour[i + 1 : end + 1] turned around
            gain = steps[tour[i], tour[i + 1]] - steps[tour[i], tour[ends]]
            gain = gain + (steps[tour[ends], tour[ends + 1]] - steps[tour[i + 1], tour[ends + 1]])
            if gain.max() > 1e-9 * steps.max():
                end = ends[np.argmax(gain)]
                tour[i + 1 : end + 1] = tour[i + 1 : end + 1][::-1].copy()
                improved = True
    return tour[:-1]

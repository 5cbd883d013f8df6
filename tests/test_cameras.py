"""Cameras against geometry by hand; ways of a camera, that they go where they should, evenly."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hostile import refusal
from scipy.spatial.transform import Rotation

from warp_splat.camera import Camera, mean_up
from warp_splat.rendering import camera_paths
from warp_splat.scene.types import Decoded, Scene, View

TURN = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # looks along the world's +x
FIELDS = {
    "width": 40,
    "height": 30,
    "fx": 50.0,
    "fy": 60.0,
    "cx": 18.0,
    "cy": 16.0,
    "rotation": TURN,
    "translation": (0.0, 0.0, 2.0),
}


def test_center_and_forward():
    camera = Camera(**FIELDS)
    np.testing.assert_allclose(camera.rotation @ camera.center + camera.translation, 0, atol=1e-12)
    np.testing.assert_allclose(camera.center, (-2, 0, 0))
    np.testing.assert_allclose(camera.forward, (1, 0, 0))


def test_a_rotation_of_six_decimals_draws_where_it_says():
    """As in a text file, half a million units from the origin: x in the camera is R x + t, however R was rounded."""
    turn = Rotation.from_rotvec([0.3, -0.4, 0.5]).as_matrix().round(6)
    camera = Camera(**{**FIELDS, "rotation": turn, "translation": -turn @ (5e5, -5e5, 1e3)})
    np.testing.assert_allclose(turn @ camera.center + camera.translation, 0, atol=1e-6)


def test_resized_scales_all_of_k():
    small = Camera(**FIELDS).resized(20, 10)
    assert (small.width, small.height) == (20, 10)
    np.testing.assert_allclose((small.fx, small.fy, small.cx, small.cy), (25, 20, 9, 16 / 3))
    np.testing.assert_array_equal(small.rotation, TURN)


def test_up_is_where_most_cameras_have_it_or_the_first():
    camera = Camera(**FIELDS)
    over = replace(camera, rotation=np.diag([-1.0, -1.0, 1.0]) @ TURN)
    np.testing.assert_allclose(mean_up([over, camera, camera]), (0, -1, 0))
    np.testing.assert_allclose(mean_up([over, camera]), (0, 1, 0))


def test_camera_copies_what_it_is_given():
    rotation = TURN.copy()
    camera = Camera(**{**FIELDS, "rotation": rotation})
    rotation[:] = 0
    np.testing.assert_array_equal(camera.rotation, TURN)
    with pytest.raises(ValueError, match="read-only"):
        camera.rotation[0, 0] = 2


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("width", value) for value in (np.nan, np.inf, 0, -3, 2.5)),
        ("height", 2.5),
        ("fx", 0.0),
        ("fy", -3.0),
        ("cx", np.nan),
        ("cy", np.inf),
        ("rotation", np.eye(4)),
        ("rotation", np.full((3, 3), np.nan)),
        ("rotation", np.diag((1.0, 1.0, -1.0))),
        ("rotation", 2 * np.eye(3)),
        ("translation", (0.0, 0.0)),
        ("translation", (0.0, np.inf, 0.0)),
        ("fx", torch.tensor(50.0, requires_grad=True)),  # it would get no gradient
        ("rotation", torch.eye(3, requires_grad=True)),
    ],
)
def test_bad_value_is_named(field, value):
    assert refusal(lambda: Camera(**{**FIELDS, field: value})).startswith(f"Camera {field}: expected")


LENS = Camera(80, 60, 70.0, 71.0, 41.0, 29.0, np.eye(3), np.zeros(3))
UP = np.array([0.0, 0.0, 1.0])


def scene_of(cameras):
    image = np.zeros((60, 80, 3), np.uint8)
    views = [View(f"{index}.png", camera, Decoded(image), camera) for index, camera in enumerate(cameras)]
    points = np.random.default_rng(0).normal(0, 0.2, (50, 3)).astype(np.float32)
    return Scene(views, [], points, np.zeros((50, 3), np.uint8))


@pytest.mark.parametrize("tilt", [0.0, 0.01])
def test_axes_that_are_nearly_parallel_are_at_their_points(tilt):
    """Of cameras 60 m above flat ground, they cross anywhere, or nowhere."""
    random, down = np.random.default_rng(0), np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    cameras = []
    for x, z in random.uniform(-200, 200, (60, 2)):
        turn = Rotation.from_rotvec(tilt * random.normal(size=3)).as_matrix() @ down
        cameras.append(replace(LENS, rotation=turn, translation=-turn @ (x, -60.0, z)))
    points = random.uniform(-200, 200, (5000, 3)) * (1, 0.01, 1)
    scene = replace(scene_of(cameras), points=points.astype(np.float32), colors=np.zeros((5000, 3), np.uint8))
    center, _, distance = camera_paths.focus_point(scene)
    assert abs(center[1]) < 3 and np.abs(center).max() < 60 and 60 < distance < 400


def test_axes_that_meet_say_where():
    """Eight degrees aside, before a wall that has most points."""
    cameras = []
    for x, y in np.random.default_rng(0).uniform(-0.4, 0.4, (30, 2)):
        turn = Rotation.align_vectors([[0.0, 0, 1]], [[-x, -y, 3.0]])[0].as_matrix()
        cameras.append(replace(LENS, rotation=turn, translation=-turn @ (x, y, 0.0)))
    points = np.random.default_rng(1).normal((0, 0, 10), 1, (900, 3)).astype(np.float32)
    scene = replace(scene_of(cameras), points=points, colors=np.zeros((900, 3), np.uint8))
    np.testing.assert_allclose(camera_paths.focus_point(scene)[0], (0, 0, 3), atol=1e-6)
    scene = replace(scene, points=points[:0], colors=np.zeros((0, 3), np.uint8))
    np.testing.assert_allclose(camera_paths.focus_point(scene)[0], (0, 0, 3), atol=1e-6)


def circle(count, radius=3.0, turn=1.5 * np.pi):
    """Cameras on a part of a circle around the origin, looking at it from above."""
    angles = np.linspace(0, turn, count)
    places = [np.array([radius * np.cos(a), radius * np.sin(a), 1.0]) for a in angles]
    return [camera_paths.look_at(LENS, place, np.zeros(3), UP) for place in places]


def centers(cameras):
    return np.stack([camera.center for camera in cameras])


def test_look_at_puts_the_target_in_the_middle_and_up_upwards():
    camera = camera_paths.look_at(LENS, np.array([1.0, 2.0, 3.0]), np.array([-2.0, 0.5, 1.0]), UP)
    np.testing.assert_allclose(camera.center, [1, 2, 3], atol=1e-12)
    seen = camera.rotation @ np.array([-2.0, 0.5, 1.0]) + camera.translation
    np.testing.assert_allclose(seen[:2], 0, atol=1e-12)
    assert seen[2] > 0 and (camera.rotation @ UP)[1] < 0 and abs((camera.rotation @ UP)[0]) < 1e-12


@pytest.mark.parametrize("make", [camera_paths.focus_orbit, camera_paths.spiral_cameras])
def test_closed_ways_are_even_and_look_at_the_thing(make):
    cameras = make(scene_of(circle(20)), 60, LENS)
    steps = np.linalg.norm(np.diff(centers([*cameras, cameras[0]]), axis=0), axis=1)
    assert len(cameras) == 60 and steps.max() < 2.2 * steps.min()
    for camera in cameras:
        assert (camera.fx, camera.cx, camera.width) == (LENS.fx, LENS.cx, LENS.width)
        x, y, z = camera.rotation @ np.zeros(3) + camera.translation
        assert z > 1 and np.hypot(x, y) < 0.2 * z


def test_path_passes_its_cameras_and_nothing_jumps():
    """Through every camera where there are few; between them it stays on the circle that they were taken from."""
    given = circle(12)
    path = camera_paths.path_cameras(scene_of(given), 221, LENS)
    distances = np.linalg.norm(centers(path)[:, None] - centers(given), axis=2)
    np.testing.assert_allclose(path[0].center, given[0].center, atol=1e-9)
    np.testing.assert_allclose(path[0].rotation, given[0].rotation, atol=1e-9)
    np.testing.assert_allclose(path[-1].rotation, given[-1].rotation, atol=1e-9)
    assert distances.min(0).max() < 0.05
    assert np.abs(np.linalg.norm(centers(path)[:, :2], axis=1) - 3).max() < 0.05
    steps = np.linalg.norm(np.diff(centers(path), axis=0), axis=1)
    turns = [Rotation.from_matrix(b.rotation @ a.rotation.T).magnitude() for a, b in pairwise(path)]
    assert steps.max() < 1.3 * np.median(steps) and max(turns) < 1.3 * np.median(turns)


def test_path_follows_names_unless_they_are_in_no_order():
    given = circle(40)
    length = np.linalg.norm(np.diff(centers(given), axis=0), axis=1).sum()
    for order in (np.arange(40), np.random.default_rng(1).permutation(40)):
        path = camera_paths.path_cameras(scene_of([given[index] for index in order]), 400, LENS)
        np.testing.assert_allclose(path[0].center, given[order[0]].center, atol=1e-9)
        assert np.linalg.norm(np.diff(centers(path), axis=0), axis=1).sum() < 1.6 * length


def test_path_takes_cameras_at_one_place_and_refuses_a_single_one():
    turning = [replace(LENS, rotation=Rotation.from_rotvec([0, 0.1 * k, 0]).as_matrix()) for k in range(5)]
    path = camera_paths.path_cameras(scene_of([*turning, turning[-1]]), 30, LENS)
    assert np.abs(centers(path)).max() < 1e-9 and len(path) == 30
    refusal(lambda: camera_paths.path_cameras(scene_of([LENS, LENS]), 30, LENS), "two places or more")

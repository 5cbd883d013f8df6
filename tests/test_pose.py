"""Refined poses: what moves and what stays, the verdict, the same bytes after a resume, the files that know them."""

import json
import shutil
from dataclasses import replace

import cameras as made_cameras
import numpy as np
import pytest
import torch
from commands import SCENE, train
from scene_files import write_colmap
from scipy.spatial.transform import Rotation
from trainings import begin, state_of, stepped

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.evaluation import alignment
from warp_splat.evaluation.alignment import find_pose, where_taken
from warp_splat.formats.colmap_text import write_colmap as write_model
from warp_splat.formats.model_folder import ply_path, read_cameras
from warp_splat.formats.ply import load_ply
from warp_splat.lenses import Lens
from warp_splat.raster.api import rasterize
from warp_splat.raster.data import Gaussians
from warp_splat.rendering.finished import Finished
from warp_splat.scene import load_scene
from warp_splat.scene.types import Decoded, View, visible
from warp_splat.training.parts.pose import MOST, Pose, factors, gauge, inverses, orthonormal, pose_error, sensitivity
from warp_splat.training.record import save_model
from warp_splat.viewer.command import _find_scene

ALL = {"parts": "pose", "pose_from_iter": 1, "pose_intrinsics": "all"}


def similar(camera, turn, shift, growth, middle):
    """The camera where a similarity about ``middle`` of the world takes it."""
    matrix = Rotation.from_rotvec(turn).as_matrix()
    rotation, center = camera.rotation @ matrix.T, growth * matrix @ (camera.center - middle) + shift + middle
    return replace(camera, rotation=rotation, translation=-rotation @ center)


def twist_between(camera, other, extent):
    """From one pose to the other, to first order, in radians and extents."""
    turn = Rotation.from_matrix(other.rotation @ camera.rotation.T)
    shift = other.translation - turn.as_matrix() @ camera.translation
    return np.concatenate([turn.as_rotvec(), shift / extent])


def test_the_gauge_is_what_similarities_do(scene):
    """Seven motions, which hold all that small similarities do to the cameras, and no more."""
    given = [view.camera for view in scene.train]
    motions = gauge(given, scene.extent)
    basis = np.stack(orthonormal(motions.reshape(7, -1)))
    np.testing.assert_allclose(basis @ basis.T, np.eye(7), atol=1e-12)
    middle = np.mean([camera.center for camera in given], axis=0)
    for numbers in 1e-6 * np.random.default_rng(0).normal(size=(9, 7)):
        moved = [similar(camera, numbers[:3], numbers[3:6], 1 + numbers[6], middle) for camera in given]
        twist = np.concatenate([twist_between(*pair, scene.extent) for pair in zip(given, moved, strict=True)])
        np.testing.assert_allclose(basis.T @ (basis @ twist), twist, atol=1e-10)
    still = gauge([replace(camera, translation=np.zeros(3)) for camera in given], scene.extent)
    assert len(orthonormal(still.reshape(7, -1))) == 6


def test_each_number_moves_the_picture_alike(scene):
    """Against differences: the mean square over the points, damped, is that of the numbers."""
    for view in scene.train[:3]:
        camera, extent = view.camera, scene.extent
        points = scene.points[visible(camera, scene.points)][:MOST].astype(np.float64)
        square = sensitivity(camera, points, extent)
        columns = []
        for step in 1e-6 * np.eye(6):
            ends = [slopes_of(twisted(camera, sign * step, extent), points) for sign in (1, -1)]
            columns.append((ends[0] - ends[1]) / 2e-6)
        rows = np.stack(columns, -1) * np.array([[camera.fx], [camera.fy]]) / camera.width
        exact = np.einsum("nij,nik->jk", rows, rows) / len(points)
        exact += 0.01 * (np.diag(np.diag(exact)) + (camera.fx / camera.width) ** 2 * np.eye(6))
        np.testing.assert_allclose(square, exact, atol=1e-8)
        (lower,) = factors(square[None])
        np.testing.assert_allclose(lower @ lower.T, square, atol=1e-12)
        np.testing.assert_allclose(inverses(lower[None])[0], np.linalg.inv(lower), rtol=1e-9, atol=1e-12)


def twisted(camera, twist, extent):
    turn = Rotation.from_rotvec(twist[:3]).as_matrix()
    translation = turn @ camera.translation + extent * twist[3:]
    return replace(camera, rotation=turn @ camera.rotation, translation=translation)


def test_only_what_is_seen_learns_and_the_set_stays(scene, tmp_path):
    trainer, _ = begin(scene, tmp_path, **ALL)
    pose = trainer.parts[0]
    trainer.differentiate(1)
    assert int((pose.moves.grad != 0).any(1).sum()) == 1 and pose.stretches.grad.shape == (1, 4)
    assert bool((pose.stretches.grad != 0).all())
    trainer, _ = stepped(scene, tmp_path, 12, **ALL)
    pose, moved = trainer.parts[0], trainer.refined(scene.train)
    numbers = pose.moves.detach().double().numpy()
    assert np.abs(numbers).max() > 1e-4 and len(pose.gauge) == 7
    assert np.abs(np.stack(pose.gauge) @ numbers.ravel()).max() < 1e-7
    for view, other, way, number in zip(scene.train, moved, pose.ways, numbers, strict=True):
        found = twist_between(view.camera, other.camera, scene.extent)
        np.testing.assert_allclose(found, number @ way.numpy() / [1, 1, 1, *[scene.extent] * 3], atol=1e-9)
    given = replace(scene.train[0])  # as if it were held out: the lens alone is known
    held = trainer.refined([given])[0]
    assert np.array_equal(held.camera.rotation, given.camera.rotation)
    assert held.camera.fx == moved[1].camera.fx != given.camera.fx
    trainer, _ = begin(scene, tmp_path, parts="pose")
    assert trainer.refined([given])[0].camera.fx == given.camera.fx
    assert held.original.fx / given.original.fx == pytest.approx(held.camera.fx / given.camera.fx)


def test_the_size_of_a_panorama_says_its_intrinsics(scene, tmp_path):
    trainer, _ = begin(scene, tmp_path, **ALL)
    trainer.parts[0].stretches.detach().fill_(0.1)
    view, turn = scene.train[0], 64 / (2 * np.pi)
    around = Camera(64, 32, turn, turn, 32, 16, np.eye(3), np.zeros(3), Lens("EQUIRECTANGULAR", ()))
    assert trainer.parts[0].refined(around, view).fx == turn
    assert trainer.parts[0].refined(view.camera, view).fx == pytest.approx(1.1 * view.camera.fx)


def test_verdict(tmp_path):
    """Of the embedded scene, the same with poses that are off, and one without keypoints."""
    scene = load_scene(SCENE, eval=True, resolution=2, report=lambda line: None)
    assert not Pose.needed(scene).needed
    generator = np.random.default_rng(0)
    turns = [Rotation.from_rotvec(0.02 * turn).as_matrix() for turn in generator.normal(size=(len(scene.train), 3))]
    cameras = [replace(v.camera, rotation=turn @ v.camera.rotation) for v, turn in zip(scene.train, turns, strict=True)]
    train = [replace(view, camera=camera) for view, camera in zip(scene.train, cameras, strict=True)]
    assert Pose.needed(replace(scene, train=train)).needed
    (tmp_path / "plain").mkdir()
    verdict = Pose.needed(load_scene(write_colmap(tmp_path / "plain"), report=lambda line: None))
    assert not verdict.needed and "keeps no keypoints" in verdict.sentence


def test_the_error_of_a_pose_is_the_way_of_its_points(scene):
    """Where a known turn and shift would move them; keypoints that are mistaken say little."""
    generator = np.random.default_rng(0)
    for view in scene.train[:5]:
        camera, seen = view.original, scene.tracks[view.name]
        right = seen._replace(slopes=slopes_of(camera, seen.points))
        turn = Rotation.from_rotvec([0.004, -0.006, 0.01]).as_matrix()
        wrong = replace(camera, rotation=turn @ camera.rotation, translation=camera.translation + 0.01)
        way = (slopes_of(wrong, seen.points) - right.slopes) * [camera.fx, camera.fy]
        assert pose_error(wrong, right) == pytest.approx(np.sqrt((way**2).sum(1).mean()), rel=0.02)
        assert pose_error(camera, right) < 1e-9
        mistaken = np.where(generator.random((len(right.ids), 1)) < 0.1, 0.3, 0.0)
        assert pose_error(camera, right._replace(slopes=right.slopes + mistaken)) < 0.01
        behind = replace(camera, rotation=np.diag([1.0, -1.0, -1.0]) @ camera.rotation, translation=-camera.translation)
        assert pose_error(behind, right) > 10


def slopes_of(camera, points):
    x, y, z = camera.rotation @ points.T + camera.translation[:, None]
    return np.stack([x / z, y / z], axis=1)


@pytest.mark.parametrize("linear", [False, True])
def test_a_photograph_is_found_while_the_model_stays(linear):
    """From 1 degree and 2 %, to where the model itself took it, with half of its light."""
    gaussians, right = made_cameras.cube(0), made_cameras.looking()
    exposed = lambda image, name: 0.5 * image if name == "a.png" else image  # noqa: E731
    with torch.no_grad():
        photo = exposed(rasterize(*gaussians, right).image, "a.png").numpy()
    photo = photo if linear else np.rint(255 * photo.clip(0, 1)).astype(np.uint8)
    turn = Rotation.from_rotvec([0.01, 0.01, -0.01]).as_matrix()
    start = replace(right, rotation=turn, translation=right.translation - 0.012)
    *others, sh = gaussians
    where = where_taken(Gaussians(*others, sh[:, :1], sh[:, 1:]), torch.zeros(3), RasterOptions(), 1.0, exposed, linear)
    camera = where(View("a.png", start, Decoded(photo), start))
    degrees, meters, focal = made_cameras.distance(camera, right)
    assert degrees < 0.05 and meters < 1e-3 and focal == 0


def test_a_model_that_shows_nothing_leads_nowhere_far():
    """Each further radian would be better, up to a hundred."""
    camera = made_cameras.looking()
    white = np.full((camera.height, camera.width, 3), 255, np.uint8)
    start = View("a.png", camera, Decoded(white), camera)
    found = find_pose(lambda learned: (learned.twist[0] / 100).float().expand(*white.shape), start, 1.0, False)
    degrees, meters, _ = made_cameras.distance(found, camera)
    assert degrees == pytest.approx(np.degrees(alignment.FARTHEST)) and meters < 1e-9


def test_what_saturates_moves_nothing():
    """A photograph ends at white, whatever the light was."""
    camera = made_cameras.looking()
    white = np.full((camera.height, camera.width, 3), 255, np.uint8)
    start = View("a.png", camera, Decoded(white), camera)
    draw = lambda learned: (1.5 + learned.twist[0] / 100).float().expand(*white.shape)  # noqa: E731
    assert made_cameras.distance(find_pose(draw, start, 1.0, False), camera)[:2] == (0, 0)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Held-out poses are refined in a few steps, which is enough to be better."""
    folder, options = tmp_path_factory.mktemp("model"), ["-r", "8", "--parts", "pose", "--pose_intrinsics=all"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(alignment, "STEPS", 4)
        assert train(folder, "--iterations", "24", "--densify_from_iter", "100", *options) == 0
        yield folder


@pytest.mark.parametrize("file", ["", "point_cloud/iteration_24/point_cloud.ply"])
def test_render_knows_the_cameras(trained, ran, file):
    """Also where only the file is named, which lies in the folder; its images go beside it."""
    folder, name = (trained / f"{file}.renders", "ours_0") if file else (trained, "ours_24")
    trained_results = json.loads((trained / "results.json").read_text())["ours_24"]
    assert trained_results["PSNR_POSE"] >= trained_results["PSNR"]
    assert "PSNR_POSE" in (trained / "per_view.md").read_text()
    said = ran("render", "-m", trained / file, "--skip_train")
    assert "cameras are those of the model, which were refined with it" in said
    results = json.loads((folder / "results.json").read_text())[name]
    for name in ("PSNR", "SSIM"):
        assert results[name] == pytest.approx(trained_results[name], abs=1e-3), name
    assert results["PSNR_POSE"] == pytest.approx(trained_results["PSNR_POSE"], abs=1e-6)


def test_the_viewer_has_both_cameras(trained):
    given = load_scene(SCENE, eval=True, resolution=8, report=lambda line: None)
    found = _find_scene(Finished(trained, 24), "")
    cameras = {view.name: view.camera for view in (*found.train, *found.test)}
    assert len(cameras) == 2 * (len(given.train) + len(given.test))
    for view in given.train:
        assert np.array_equal(cameras[f"{view.name}, as given"].rotation, view.camera.rotation)
    assert any(not np.allclose(cameras[v.name].rotation, v.camera.rotation, atol=1e-6) for v in given.train)


def test_other_tools_get_the_cameras(trained):
    """cameras.json, and a COLMAP model that pycolmap reads."""
    cameras_now, given = dict(read_cameras(trained)), load_scene(SCENE, eval=True, report=lambda line: None)
    beside = trained / "colmap"
    (beside / "images").symlink_to(SCENE / "images")
    scene = load_scene(beside, report=lambda line: None)
    assert len(scene.train) == len(cameras_now) == 50
    for view in scene.train:
        camera = cameras_now[view.name]
        np.testing.assert_allclose(view.camera.rotation, camera.rotation, atol=1e-12)
        np.testing.assert_allclose(view.camera.translation, camera.translation, atol=1e-12)
        assert (view.camera.fx, view.camera.cy) == (camera.fx, camera.cy)
    assert any(not np.allclose(cameras_now[v.name].rotation, v.camera.rotation, atol=1e-6) for v in given.train)
    np.testing.assert_allclose(np.sort(scene.points, 0), np.sort(given.points, 0), rtol=1e-6)


@pytest.mark.parametrize(("model", "coefficients"), [("RADIAL", (0.05, -0.01)), ("FOV", (0.9,)), ("FISHEYE", ())])
def test_lenses_are_written_as_colmap_has_them(model, coefficients, scene, tmp_path):
    """With those of the family's model that a model lacks as zeros."""
    view = scene.train[0]
    camera = replace(view.camera, lens=Lens(model, coefficients))
    (tmp_path / "images").symlink_to(SCENE / "images")
    write_model(tmp_path / "sparse" / "0", [(view.name, camera)], scene.points, scene.colors)
    (found,) = load_scene(tmp_path, lens="native", report=lambda line: None).train
    rays = np.random.default_rng(0).normal(size=(50, 3)) * 0.2 + [0, 0, 1]
    np.testing.assert_allclose(found.original.lens.distorted(rays), camera.lens.distorted(rays), atol=1e-12)
    assert found.original.fx / found.original.width == pytest.approx(camera.fx / camera.width, rel=1e-9)


def test_where_cameras_are_refined_no_more_none_are_left(trained, tmp_path, ran):
    folder = shutil.copytree(trained, tmp_path / "model")
    assert (ply_path(folder, 24).parent / "cameras.json").exists()
    ran("train", "--resume", folder, "--parts", "")
    assert not (ply_path(folder, 24).parent / "cameras.json").exists()


def test_gaussians_are_saved_though_cameras_are_not_finite(scene, tmp_path, capsys):
    trainer, run = stepped(scene, tmp_path, 3, **ALL)
    trainer.parts[0].moves.data[:] = torch.nan
    assert save_model(trainer, run) == ply_path(tmp_path, 3)
    assert load_ply(ply_path(tmp_path, 3)) and "warning: " in capsys.readouterr().err


def test_a_scene_that_changed_is_refused(trained, tmp_path, fails):
    other = write_colmap(tmp_path, ["a.png", "b.png"])
    message = fails("render", "-m", str(trained), "-s", str(other))
    assert "expected a refined camera for" in message and "found none; the scene has changed" in message


def test_options_of_parts_that_are_not_used_change_nothing(scene, tmp_path):
    states = []
    for options in ({}, {"pose_lr": 9.0, "pose_reg": 9.0, "pose_intrinsics": "all", "opacity_reg": 9.0}):
        trainer, run = stepped(scene, tmp_path, 12, **options)
        states.append(state_of(trainer, run)[0])
        assert trainer.refined(scene.train) is scene.train and trainer.where_taken() is None
    assert states[0] == states[1]

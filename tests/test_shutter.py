"""Rolling shutter: against pictures rendered row by row, and in float64."""

import json
from dataclasses import replace

import exact_cameras
import numpy as np
import pytest
import torch
from scenes import SCENES, SHUTTER, one_gaussian, scene_of
from scipy.spatial.transform import Rotation
from test_rasterize import relative_error, run, truth

from warp_splat import Camera, CameraParameters, InputError, RasterOptions, Shutter, rasterize
from warp_splat.compare.truth import for_oracle
from warp_splat.formats import model_folder
from warp_splat.kernels.project import affine
from warp_splat.rendering.camera_paths import look_at
from warp_splat.viewer.browser_camera import framed

ERROR = 1e-5
HALF_TURN = -np.eye(3)[[1, 0, 2]]


def row_by_row(scene):
    """Of each row, what a camera renders that stands still where this one is then."""
    cameras = [scene.camera.at(row) for row in range(scene.camera.height)]
    views = [rasterize(*scene.parameters(), camera, scene.background).image for camera in cameras]
    return torch.stack([view[row] for row, view in enumerate(views)])


def test_rows_are_those_of_cameras_that_stand_still(device):
    scene = scene_of("rolling degree2").to(device)
    wanted, off = row_by_row(scene), []
    for camera in (scene.camera, replace(scene.camera, shutter=None)):
        image = rasterize(*scene.parameters(), camera, scene.background).image
        off.append(float((image - wanted).square().mean().sqrt()))
    assert off[0] < 2e-3 and off[0] < 0.06 * off[1], off


def test_means_are_where_their_row_sees_them(device):
    """Fixed-point steps until nothing moves, against two steps of Newton's method."""
    scene = scene_of("rolling degree2").to(device)
    out = rasterize(*scene.parameters(), scene.camera)
    seen = (out.radii > 0).nonzero()[:, 0].tolist()
    assert len(seen) > 50
    for index in seen:
        mean, row = scene.means[index].double().cpu().numpy(), 0.5 * scene.camera.height
        for _ in range(20):
            camera = scene.camera.at(np.clip(row, -0.15 * scene.camera.height, 1.15 * scene.camera.height) - 0.5)
            place = camera.pixels((camera.rotation @ mean + camera.translation)[None])[0]
            row = place[1]
        np.testing.assert_allclose(out.means2d[index].cpu().numpy(), place, atol=1e-4)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("degree2", RasterOptions(depth=True)),
        ("needles", RasterOptions()),
        ("inside", RasterOptions(depth=True, antialiasing=True)),
        ("near_and_behind", RasterOptions()),
        pytest.param("fisheye", RasterOptions(depth=True), marks=pytest.mark.slow),
        *(
            pytest.param(name, RasterOptions(projection=projection), marks=pytest.mark.long)
            for name, projection in (
                ("opencv", "affine"),
                ("panorama", "affine"),
                ("degree2", "ellipsoid"),
                ("degree2", "unscented"),
                ("fisheye", "unscented"),
            )
        ),
    ],
    ids=str,
)
def test_image_and_gradients_are_those_in_float64(name, options, device):
    out, gradients = run(f"rolling {name}", device, options)
    expected = truth(f"rolling {name}", options)
    assert (out.image.cpu() - expected.out.image)[~expected.out.fragile].abs().max() < ERROR
    errors = {key: relative_error(gradient, expected.gradients[key]) for key, gradient in gradients.items()}
    assert max(errors.values()) < ERROR, errors


def test_beyond_the_picture_the_motion_ends_and_that_alone_is_what_an_oracle_without_the_end_misses(monkeypatch):
    """Gaussians of which a tail alone reaches into the picture: their means lie at up to twice its half height."""
    generator, count = torch.Generator().manual_seed(1), 40
    uniform = lambda *shape: torch.rand(count, *shape, generator=generator)  # noqa: E731
    depth = 2 + 2 * uniform()
    across, down = (depth[:, None] * 2 * (2 * uniform(2) - 1)).T
    given = [torch.stack([across, down, depth], 1), 2 * uniform(4) - 1, 0.2 + uniform(3), 0.2 + 0.6 * uniform()]
    given.append(2 * uniform(1, 3) - 1)
    camera = Camera(64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(3), np.zeros(3), shutter=SHUTTER)
    kinds = torch.float32, torch.float64
    leaves, exact_leaves = ([t.to(kind, copy=True).requires_grad_() for t in given] for kind in kinds)
    out = rasterize(*leaves, camera)
    weights = torch.randn(48, 64, 3, generator=generator)

    def off():
        """The largest difference of a sure pixel, and of a gradient relative to its norm."""
        black, options = torch.zeros(3).double(), for_oracle(RasterOptions())
        wanted = exact_cameras.exact_render(*exact_leaves, camera, black, **options)
        sure = ~wanted.fragile
        loss = ((out.image * weights)[sure].sum(), (wanted.image * weights)[sure].sum())
        found = torch.autograd.grad(loss[0], leaves, retain_graph=True)
        expected = torch.autograd.grad(loss[1], exact_leaves)
        far = max(float((a - b).norm() / b.norm()) for a, b in zip(found, expected, strict=True))
        return float((out.image - wanted.image)[sure].detach().abs().max()), far

    assert max(off()) < ERROR
    monkeypatch.setattr(exact_cameras, "LATEST", 1e9)
    image, gradient = off()
    assert 1e-3 < image < 0.05 and 1e-3 < gradient < 0.2


def test_nothing_that_only_other_rows_see_is_lost(device):
    """A Gaussian beyond the picture of the middle row, which the first rows see; one behind its camera."""
    turning = Shutter((0.0, 0.9, 0.0), (0.0, 0.0, 0.0))
    camera = Camera(20, 40, 30.0, 30.0, 10.0, 20.0, np.eye(3), np.zeros(3), shutter=turning)
    first = camera.at(3)
    ray = first.rays(np.array([[10.0, 3.5]]))[0]
    near = replace(camera, shutter=Shutter((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    for view, point in ((camera, (4.0 * first.rotation.T @ ray).tolist()), (near, [0.0, -0.05, 0.15])):
        given = one_gaussian(device, point, 0.01)
        assert rasterize(*given, view).alpha.max() > 0.3
        assert rasterize(*given, replace(view, shutter=None)).alpha.max() == 0


def test_two_poses_make_a_shutter():
    first = SCENES["off_center"]().camera
    turn = Rotation.from_rotvec([0.1, -0.3, 0.2]).as_matrix()
    last = replace(first, rotation=turn @ first.rotation, translation=turn @ first.translation + [0.1, 0.2, -0.3])
    rolling = Camera.rolling(first, last)
    for pose, row in ((first, -0.5), (last, first.height - 0.5)):
        still = rolling.at(row)
        np.testing.assert_allclose(still.rotation, pose.rotation, atol=1e-14)
        np.testing.assert_allclose(still.translation, pose.translation, atol=1e-14)
    middle = rolling.at(0.5 * first.height - 0.5)
    np.testing.assert_allclose(middle.rotation, rolling.rotation)
    np.testing.assert_allclose(middle.center, 0.5 * (first.center + last.center))
    np.testing.assert_allclose(rolling.shutter.turn, [0.1, -0.3, 0.2], atol=1e-14)
    assert first.at(3) is first


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda c: Shutter((1, 2)), r"Shutter turn: expected three finite numbers, got \(1, 2\)"),
        (lambda c: Shutter(shift=(0, 0, np.nan)), "Shutter shift: expected three finite numbers"),
        (lambda c: Shutter((0, 57, 0)), "Shutter turn: expected at most 1 rad from the first row to the last, got 57"),
        (lambda c: replace(c, shutter=0.1), r"Camera shutter: expected a warp_splat\.Shutter or None, got 0.1"),
        (
            lambda c: replace(c, shutter=Shutter((0.9, 0, 0))),
            "Camera shutter: expected a turn that moves .* by at most half",
        ),
        (
            lambda c: Camera.rolling(c, replace(c, rotation=HALF_TURN @ c.rotation)),
            "Camera.rolling: expected a turn of at most 1 rad",
        ),
    ],
)
def test_bad_input(make, message):
    with pytest.raises(InputError, match=message):
        make(SCENES["single"]().camera)


def test_two_poses_at_the_limits_make_a_camera_that_learns():
    """Put together of them again, it is a bit beyond."""
    rolling = scene_of("rolling single").camera
    for axis in np.random.default_rng(0).normal(size=(40, 3)):
        turn = axis / np.linalg.norm(axis)
        half = turn * 0.5 * rolling.height / rolling.fy / abs(turn[0])
        for most in (turn, half)[: 1 + (np.linalg.norm(half) < 1)]:
            if abs(most[0]) * rolling.fy / rolling.height <= 0.5:
                CameraParameters(replace(rolling, shutter=Shutter(tuple(most))))


def test_a_projection_of_ones_own_knows_no_shutter():
    scene, own = scene_of("rolling single"), RasterOptions(projection=affine.PROJECTION)
    sentence = r"options\.projection: expected one by name for a camera with a rolling shutter"
    with pytest.raises(InputError, match=sentence):
        rasterize(*scene.parameters(), scene.camera, options=own)


def test_cameras_json_keeps_it(tmp_path):
    camera = scene_of("rolling single").camera
    entry = {"img_name": "a.png", **model_folder.camera_entry(camera)}
    (tmp_path / "cameras.json").write_text(json.dumps([entry]))
    [(_, found)] = model_folder.read_cameras(tmp_path)
    assert found.shutter == camera.shutter
    (tmp_path / "cameras.json").write_text(json.dumps([entry | {"shutter": {"turn": [0, 57, 0], "shift": [0, 0, 0]}}]))
    with pytest.raises(InputError, match=r"a camera with other values .*Shutter turn: expected at most 1 rad"):
        model_folder.read_cameras(tmp_path)


def test_a_window_shows_the_middle():
    camera = scene_of("rolling single").camera
    shown, _ = framed(camera, 2 * camera.width, 3 * camera.height)
    assert shown.shutter is None and np.array_equal(shown.rotation, camera.rotation)
    path = look_at(camera, np.zeros(3), np.ones(3), np.array([0.0, -1.0, 0.0]))
    assert path.shutter is None

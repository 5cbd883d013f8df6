"""Rolling shutter: against pictures rendered row by row, and in float64."""

import json
from dataclasses import replace

import numpy as np
import pytest
import scenes
import torch
from scipy.spatial.transform import Rotation

from warp_splat import Camera, CameraParameters, InputError, RasterOptions, Shutter, check_gradients, rasterize
from warp_splat.compare import exact_motion, oracle, truth
from warp_splat.compare.exact_motion import exact_camera
from warp_splat.config import ADJOINTS
from warp_splat.formats import model_folder
from warp_splat.kernels.project import affine
from warp_splat.raster.data import Gaussians
from warp_splat.raster.drivers import CPU
from warp_splat.raster.project import Project, project
from warp_splat.rendering.camera_paths import look_at
from warp_splat.runtime import launch, pool
from warp_splat.viewer.browser_camera import framed

SHUTTER = Shutter((0.02, 0.05, -0.03), (0.05, 0.02, -0.08))
ERROR = 1e-5


def moving(name, shutter=SHUTTER):
    scene = scenes.SCENES[name]()
    return replace(scene, camera=replace(scene.camera, shutter=shutter))


def row_by_row(scene):
    """Of each row, what a camera renders that stands still where this one is then."""
    views = [
        rasterize(*scene.parameters(), scene.camera.at(row), scene.background).image for row in range(height(scene))
    ]
    return torch.stack([view[row] for row, view in enumerate(views)])


def height(scene):
    return scene.camera.height


def test_rows_are_those_of_cameras_that_stand_still(device):
    scene = moving("degree2").to(device)
    still = replace(scene.camera, shutter=None)
    wanted = row_by_row(scene)
    rolling, frozen = (
        rasterize(*scene.parameters(), camera, scene.background).image for camera in (scene.camera, still)
    )
    off = [float((image - wanted).square().mean().sqrt()) for image in (rolling, frozen)]
    assert off[0] < 2e-3 and off[0] < 0.06 * off[1], off


def test_means_are_where_their_row_sees_them(device):
    """Fixed-point steps until nothing moves, against two steps of Newton's method."""
    scene = moving("degree2").to(device)
    out = rasterize(*scene.parameters(), scene.camera)
    seen = (out.radii > 0).nonzero()[:, 0].tolist()
    assert len(seen) > 50
    for index in seen:
        mean, row = scene.means[index].double().cpu().numpy(), 0.5 * height(scene)
        for _ in range(20):
            camera = scene.camera.at(np.clip(row, -0.15 * height(scene), 1.15 * height(scene)) - 0.5)
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
    scene = moving(name).to(device)
    leaves = [tensor.requires_grad_() for tensor in scene.parameters()]
    out = rasterize(*leaves, scene.camera, scene.background, options=options)
    exact = moving(name).to("cpu", torch.float64)
    exact_leaves = [tensor.requires_grad_() for tensor in exact.parameters()]
    wanted = oracle.exact_render(*exact_leaves, exact.camera, exact.background, **truth.for_oracle(options))
    sure = ~wanted.fragile
    assert (out.image.cpu() - wanted.image)[sure].abs().max() < ERROR
    weights = torch.randn(wanted.image.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    weights *= sure[..., None]
    found = torch.autograd.grad((out.image * weights.float().to(device)).sum(), leaves)
    expected = torch.autograd.grad((wanted.image * weights).sum(), exact_leaves)
    for one, other in zip(found, expected, strict=True):
        assert (one.cpu() - other).norm() < ERROR * other.norm()


def test_beyond_the_picture_the_motion_ends_and_that_alone_is_what_an_oracle_without_the_end_misses(monkeypatch):
    """Gaussians of which a tail alone reaches into the picture: their means lie at up to twice its half height."""
    generator, count = torch.Generator().manual_seed(1), 40
    uniform = lambda *shape: torch.rand(count, *shape, generator=generator)  # noqa: E731
    depth = 2 + 2 * uniform()
    across, down = (depth[:, None] * 2 * (2 * uniform(2) - 1)).T
    given = [torch.stack([across, down, depth], 1), 2 * uniform(4) - 1, 0.2 + uniform(3), 0.2 + 0.6 * uniform()]
    given.append(2 * uniform(1, 3) - 1)
    camera = Camera(64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(3), np.zeros(3), shutter=SHUTTER)
    leaves, exact_leaves = (
        [t.to(kind, copy=True).requires_grad_() for t in given] for kind in (torch.float32, torch.float64)
    )
    out = rasterize(*leaves, camera)
    weights = torch.randn(48, 64, 3, generator=generator)

    def off():
        """The largest difference of a sure pixel, and of a gradient relative to its norm."""
        wanted = oracle.exact_render(
            *exact_leaves, camera, torch.zeros(3).double(), **truth.for_oracle(RasterOptions())
        )
        sure = ~wanted.fragile
        loss = ((out.image * weights)[sure].sum(), (wanted.image * weights)[sure].sum())
        found = torch.autograd.grad(loss[0], leaves, retain_graph=True)
        expected = torch.autograd.grad(loss[1], exact_leaves)
        far = max(float((a - b).norm() / b.norm()) for a, b in zip(found, expected, strict=True))
        return float((out.image - wanted.image)[sure].detach().abs().max()), far

    assert max(off()) < ERROR
    monkeypatch.setattr(exact_motion, "LATEST", 1e9)
    image, gradient = off()
    assert 1e-3 < image < 0.05 and 1e-3 < gradient < 0.2


def test_nothing_that_only_other_rows_see_is_lost(device):
    """A Gaussian beyond the picture of the middle row, which the first rows see; one behind its camera."""
    camera = Camera(
        20, 40, 30.0, 30.0, 10.0, 20.0, np.eye(3), np.zeros(3), shutter=Shutter((0.0, 0.9, 0.0), (0.0, 0.0, 0.0))
    )
    first = camera.at(3)
    ray = first.rays(np.array([[10.0, 3.5]]))[0]
    near = replace(camera, shutter=Shutter((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    for view, point in ((camera, 4.0 * first.rotation.T @ ray), (near, np.array([0.0, -0.05, 0.15]))):
        means = torch.tensor(point[None], dtype=torch.float32, device=device)
        one = torch.ones(1, 1, device=device)
        quats = one * torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device)
        given = (means, quats, 0.01 * one.expand(1, 3), 0.9 * one[0], torch.ones(1, 1, 3, device=device))
        assert rasterize(*given, view).alpha.max() > 0.3
        assert rasterize(*given, replace(view, shutter=None)).alpha.max() == 0


def test_two_poses_make_a_shutter():
    first = scenes.SCENES["off_center"]().camera
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
            lambda c: Camera.rolling(c, replace(c, rotation=-np.eye(3)[[1, 0, 2]] @ c.rotation)),
            "Camera.rolling: expected a turn of at most 1 rad",
        ),
        (
            lambda c: draw(replace(c, shutter=SHUTTER), projection=affine.PROJECTION),
            r"options\.projection: expected one by name for a camera with a rolling shutter",
        ),
        (
            lambda c: CameraParameters(c, last_twist=torch.zeros(6)),
            "last_twist: expected a base with a rolling shutter",
        ),
        (
            lambda c: draw(
                CameraParameters(replace(c, shutter=SHUTTER), last_twist=torch.tensor([2.0, 0, 0, 0, 0, 0]))
            ),
            "Camera.rolling: expected a turn of at most 1 rad",
        ),
    ],
)
def test_bad_input(make, message):
    with pytest.raises(InputError, match=message):
        make(scenes.SCENES["single"]().camera)


def draw(camera, **options):
    return rasterize(*scenes.SCENES["single"]().parameters(), camera, options=RasterOptions(**options))


@pytest.mark.slow
def test_one_at_a_time_as_on_a_gpu_is_the_same():
    """The kernels of a GPU, against sixteen Gaussians at once; gradients of the poses, too."""
    scene, found = moving("degree2"), []
    for driver in (CPU, replace(CPU, lanes=1)):
        given, camera = (
            [tensor.clone().requires_grad_() for tensor in scene.parameters()],
            CameraParameters(scene.camera),
        )
        splats = project(Gaussians(*given[:4], given[4][:, :1], given[4][:, 1:]), camera, RasterOptions(), driver)
        given += [camera.twist, camera.last_twist, camera.intrinsics]
        upstream = [torch.ones_like(part) for part in splats[:5]]
        found.append([*splats[:6], *torch.autograd.grad(splats[:5], given, upstream)])
    for sixteen, one in zip(*found, strict=True):
        torch.testing.assert_close(sixteen, one, rtol=5e-5, atol=1e-5 * max(float(one.detach().abs().max()), 1e-9))


def leaves(base, start):
    return CameraParameters(
        base,
        torch.tensor(start, dtype=torch.float64, requires_grad=True),
        last_twist=torch.tensor([-0.7 * part for part in start], dtype=torch.float64, requires_grad=True),
    )


HERE, THERE = (0.0,) * 6, (0.03, -0.02, 0.05, 0.02, 0.04, -0.03)


@pytest.mark.parametrize(
    ("name", "options", "adjoints", "start"),
    [
        ("degree2", RasterOptions(depth=True), ADJOINTS[:1], HERE),
        ("degree2", RasterOptions(antialiasing=True), ADJOINTS[:1], THERE),
        ("degree2", RasterOptions(), ADJOINTS[1:], HERE),
        ("needles", RasterOptions(), ADJOINTS[:1], THERE),
        ("inside", RasterOptions(depth=True), ADJOINTS[:1], THERE),
        pytest.param("fisheye", RasterOptions(depth=True), ADJOINTS, THERE, marks=pytest.mark.slow),
        *(
            pytest.param(name, RasterOptions(projection=projection), ADJOINTS, THERE, marks=pytest.mark.long)
            for name, projection in (
                ("opencv", "affine"),
                ("panorama", "affine"),
                ("degree2", "ellipsoid"),
                ("degree2", "unscented"),
                ("opencv", "unscented"),
                ("fisheye", "unscented"),
            )
        ),
    ],
    ids=str,
)
def test_gradients_of_both_poses_are_those_in_float64(name, options, adjoints, start, device):
    scene, exact = moving(name).to(device), moving(name).to("cpu", torch.float64)
    parameters = leaves(scene.camera, start)
    wanted = [parameters.twist, parameters.last_twist, parameters.intrinsics]
    camera = exact_camera(scene.camera, wanted[0], wanted[2], wanted[1])
    out = oracle.exact_render(*exact.parameters(), camera, exact.background, **truth.for_oracle(options))
    with torch.no_grad():
        other = exact_camera(scene.camera, wanted[0] + 0.01, 1.02 * wanted[2], wanted[1] - 0.01)
        aim = oracle.exact_render(*exact.parameters(), other, exact.background, **truth.for_oracle(options))
    upstream = ((out.image - aim.image) * ~out.fragile[..., None]).detach()
    expected = torch.autograd.grad((out.image * upstream).sum(), wanted)
    for adjoint in adjoints:
        drawn = rasterize(*scene.parameters(), parameters, scene.background, adjoint, options)
        found = torch.autograd.grad((drawn.image * upstream.float().to(device)).sum(), wanted)
        for one, other in zip(found, expected, strict=True):
            for part, true in zip(one.split(len(one) // 2), other.split(len(one) // 2), strict=True):
                assert (part - true).norm() < ERROR * true.norm(), (adjoint, found, expected)


def test_a_camera_that_learns_stays_where_it_is():
    """And away from the base it is that of the two poses."""
    scene = moving("off_center")
    for start in (HERE, THERE):
        parameters = leaves(scene.camera, start)
        exact = exact_camera(scene.camera, parameters.twist, parameters.intrinsics, parameters.last_twist)
        camera = parameters.camera
        np.testing.assert_allclose(camera.rotation, exact.rotation.detach(), atol=1e-14)
        np.testing.assert_allclose(camera.translation, exact.translation.detach(), atol=1e-13)
        np.testing.assert_allclose(camera.shutter.turn, exact.shutter.turn.detach(), atol=1e-13)
        np.testing.assert_allclose(camera.shutter.shift, exact.shutter.shift.detach(), atol=1e-13)


def test_check_gradients_names_the_last_row_if_it_is_off(monkeypatch):
    backward = Project.backward

    def spoiled(ctx, *upstream):
        gradients = backward(ctx, *upstream)
        gradients[8][4] *= 1.02
        return gradients

    monkeypatch.setattr(Project, "backward", staticmethod(spoiled))
    scene = moving("degree1")
    names = ["translation", "last_rotation", "last_translation"]
    report = check_gradients(*scene.parameters(), CameraParameters(scene.camera), parameters=names)
    assert report.named("off") == ["last_translation"] and report.worst is None, str(report)


def test_any_number_of_threads(monkeypatch):
    monkeypatch.setattr(launch, "SMALLEST_SLICE", 32)
    scene, before = scenes.cloud(0, 1003, scenes.make_camera(64, 48), degree=1), pool.get_threads()
    results = []
    for threads in (1, 2, 3):
        pool.set_threads(threads)
        parameters = CameraParameters(replace(scene.camera, shutter=SHUTTER))
        rasterize(*scene.parameters(), parameters).image.square().sum().backward()
        results.append(torch.cat([parameters.twist.grad, parameters.last_twist.grad, parameters.intrinsics.grad]))
    pool.set_threads(before)
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2])


def test_cameras_json_keeps_it(tmp_path):
    camera = moving("single").camera
    entry = {"img_name": "a.png", **model_folder.camera_entry(camera)}
    (tmp_path / "cameras.json").write_text(json.dumps([entry]))
    [(_, found)] = model_folder.read_cameras(tmp_path)
    assert found.shutter == camera.shutter
    (tmp_path / "cameras.json").write_text(json.dumps([entry | {"shutter": {"turn": [0, 57, 0], "shift": [0, 0, 0]}}]))
    with pytest.raises(InputError, match=r"a camera with other values .*Shutter turn: expected at most 1 rad"):
        model_folder.read_cameras(tmp_path)


def test_a_window_shows_the_middle():
    camera = moving("single").camera
    shown, _ = framed(camera, 2 * camera.width, 3 * camera.height)
    assert shown.shutter is None and np.array_equal(shown.rotation, camera.rotation)
    path = look_at(camera, np.zeros(3), np.ones(3), np.array([0.0, -1.0, 0.0]))
    assert path.shutter is None

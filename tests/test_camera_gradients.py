"""Gradients of a camera's pose and intrinsics against the float64 oracle, and what they leave as it is."""

import functools
import sys
from pathlib import Path

import numpy as np
import pytest
import scenes
import torch
from scenes import SCENES
from scipy.spatial.transform import Rotation

from warp_splat import CameraParameters, InputError, RasterOptions, check_gradients, rasterize, rasterize_views
from warp_splat.compare import oracle, truth
from warp_splat.compare.exact_motion import exact_camera
from warp_splat.config import ADJOINTS
from warp_splat.raster import project
from warp_splat.raster.differences import INPUTS
from warp_splat.raster.drivers import CUDA, using
from warp_splat.runtime import launch, pool

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import cameras

ERROR = 1e-5  # relative L2, of each of the four
LENS_ERROR = 1e-4  # of cameras with distortion, away from the base
PLAIN = RasterOptions()
HERE, THERE = (0.0,) * 6, (0.3, -0.2, 0.5, 0.2, 0.4, -0.3)  # twists
OTHER = (0.01, -0.02, 0.015, 0.02, 0.03, -0.01)
NAMES = ("rotation", "translation", "focal", "principal")


def split(twist, intrinsics):
    return dict(zip(NAMES, (twist[:3], twist[3:], intrinsics[:2], intrinsics[2:]), strict=True))


def exact_render(scene, options, twist, intrinsics):
    scene, camera = scene.to("cpu", torch.float64), exact_camera(scene.camera, twist, intrinsics)
    return oracle.exact_render(*scene.parameters(), camera, scene.background, **truth.for_oracle(options))


@functools.cache
def exact(name, options, start):
    """A scene, the upstream gradients of a squared distance from another camera's picture, and the truth."""
    scene = SCENES[name]()
    parameters = camera_at(scene, start)
    out = exact_render(scene, options, parameters.twist, parameters.intrinsics)
    with torch.no_grad():
        other = exact_render(
            scene, options, torch.tensor(OTHER, dtype=torch.float64) + parameters.twist, 1.02 * parameters.intrinsics
        )
    keys = ("image", "alpha", "depth")[: 3 if options.depth else 2]
    upstream = {key: (getattr(out, key) - getattr(other, key)).detach() for key in keys}
    for weight in upstream.values():
        weight[out.fragile] = 0
    loss = sum((getattr(out, key) * weight).sum() for key, weight in upstream.items())
    found = torch.autograd.grad(loss, [parameters.twist, parameters.intrinsics])
    return scene, {key: weight.float() for key, weight in upstream.items()}, split(*found)


def camera_at(scene, twist):
    return CameraParameters(scene.camera, torch.tensor(twist, dtype=torch.float64, requires_grad=True))


def found(scene, upstream, options, start, adjoint="manual", leaves=None):
    parameters = camera_at(scene, start)
    leaves = leaves or scene.parameters()
    out = rasterize(*leaves, parameters, scene.background, adjoint, options)
    sum((getattr(out, key) * weight).sum() for key, weight in upstream.items()).backward()
    return out, split(parameters.twist.grad, parameters.intrinsics.grad)


def errors(name, options=PLAIN, adjoint="manual", start=HERE):
    scene, upstream, expected = exact(name, options, start)
    _, gradients = found(scene, upstream, options, start, adjoint)
    return {key: float((gradients[key] - expected[key]).norm() / expected[key].norm().clamp_min(1e-6)) for key in NAMES}


@pytest.mark.parametrize("name", SCENES)
def test_scene(name):
    found = errors(name)
    assert max(found.values()) < ERROR, found


@pytest.mark.parametrize("adjoint", ADJOINTS[1:])
def test_modes(adjoint):
    found = errors("degree3", RasterOptions(depth=True), adjoint)
    assert max(found.values()) < ERROR, found


VARIANTS = [
    ("degree2", RasterOptions(antialiasing=True, blur=1.0)),
    ("degree2", RasterOptions(antialiasing=True, depth=True)),
    ("subpixel", RasterOptions(antialiasing=True)),
    ("off_center", RasterOptions(antialiasing=True, depth=True)),
    ("degree2", RasterOptions(projection="ellipsoid")),
    ("inside", RasterOptions(projection="ellipsoid", depth=True)),
    ("needles", RasterOptions(projection="ellipsoid")),
    ("off_center", RasterOptions(projection="ellipsoid", antialiasing=True)),
    ("near_and_behind", RasterOptions(projection="ellipsoid")),
    ("degree3", RasterOptions(sh_degree=1)),
]


@pytest.mark.parametrize(("name", "options"), VARIANTS, ids=str)
def test_options(name, options):
    found = errors(name, options)
    assert max(found.values()) < ERROR, found


@pytest.mark.parametrize("name", ["degree2", "inside", "far_world", "needles", "opencv", "fisheye"])
def test_away_from_the_base(name):
    """The gradient is that of the exponential map where the twist is, not that of its start."""
    found = errors(name, start=THERE)
    assert max(found.values()) < (LENS_ERROR if SCENES[name]().camera.lens else ERROR), found


def test_the_oracle_agrees_with_differences():
    """Where nothing is clamped."""
    scene = scenes.cloud(0, 40, scenes.make_camera(33, 27), degree=2, frame=0)
    parameters = camera_at(scene, OTHER)
    start = torch.cat([parameters.twist, parameters.intrinsics]).detach()

    def loss(numbers):
        out = exact_render(scene, RasterOptions(alpha_min=0.0, t_min=0.0), numbers[:6], numbers[6:])
        return out.image.square().sum()

    numbers = start.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(numbers), numbers)
    with torch.no_grad():
        for row in 1e-5 * torch.eye(10, dtype=torch.float64):
            ends = [float(loss(start + sign * row)) for sign in (1, -1)]
            assert (ends[0] - ends[1]) / 2e-5 == pytest.approx(float(gradient[row > 0]), rel=1e-5, abs=1e-6)


def test_the_camera_is_that_of_the_exponential_map():
    base = SCENES["off_center"]().camera
    for length in (0.0, 1e-9, 0.5, 3.0):
        twist = length * torch.tensor([0.6, 0.0, 0.8, 1.0, 2.0, 3.0], dtype=torch.float64)
        parameters = CameraParameters(base, twist.requires_grad_())
        exact = exact_camera(base, twist, parameters.intrinsics)
        np.testing.assert_allclose(parameters.camera.rotation, exact.rotation.detach(), atol=1e-14)
        np.testing.assert_allclose(parameters.camera.translation, exact.translation.detach(), atol=1e-13)
        assert parameters.camera.fy == base.fy and parameters.camera.width == base.width


def gradients_of(scene, camera):
    leaves = [tensor.clone().requires_grad_() for tensor in scene.parameters()]
    out = rasterize(*leaves, camera, scene.background)
    out.image.square().sum().backward()
    return [out.image.detach(), *(leaf.grad for leaf in leaves)]


@pytest.mark.parametrize("name", ["degree0", "degree3", "single"])
def test_nothing_else_changes(name):
    """Image and gradients of the Gaussians, bit for bit."""
    scene = SCENES[name]()
    parameters = CameraParameters(scene.camera)
    for plain, learned in zip(gradients_of(scene, scene.camera), gradients_of(scene, parameters), strict=True):
        assert torch.equal(plain, learned)
    assert parameters.twist.grad.abs().min() > 0 and parameters.intrinsics.grad.abs().min() > 0


def test_any_number_of_threads(monkeypatch):
    monkeypatch.setattr(launch, "SMALLEST_SLICE", 32)
    scene, before = scenes.cloud(0, 1003, scenes.make_camera(64, 48), degree=1), pool.get_threads()
    results = []
    for threads in (1, 2, 3):
        pool.set_threads(threads)
        parameters = CameraParameters(scene.camera)
        gradients_of(scene, parameters)
        results.append(torch.cat([parameters.twist.grad, parameters.intrinsics.grad]))
    pool.set_threads(before)
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2])


def test_kernels_of_a_gpu():
    """One Gaussian at a time; in fibers."""
    scene, upstream, expected = exact("degree2", RasterOptions(antialiasing=True), HERE)
    with using(CUDA):
        _, gradients = found(scene, upstream, RasterOptions(antialiasing=True), HERE)
    for key in NAMES:
        assert (gradients[key] - expected[key]).norm() < ERROR * expected[key].norm()


def test_only_what_is_wanted():
    scene = SCENES["degree1"]()
    shared = torch.tensor([40.0, 41.0, 18.0, 15.0], requires_grad=True)  # float32, as a model of one's own may have it
    cameras = [CameraParameters(scene.camera, torch.zeros(6), shared) for _ in range(2)]
    for out in rasterize_views(*scene.parameters(), cameras):
        out.image.sum().backward()
    assert shared.grad.dtype == torch.float32 and cameras[0].twist.grad is None
    both, alone = shared.grad.clone(), CameraParameters(scene.camera, intrinsics=shared)
    shared.grad = None
    rasterize(*scene.parameters(), alone).image.sum().backward()
    assert torch.equal(both, 2 * shared.grad)


def test_what_is_not_drawn_or_not_finite_says_nothing():
    scene = SCENES["near_and_behind"]()
    parameters = CameraParameters(scene.camera)
    out = rasterize(*scene.parameters(), parameters)
    culled = (out.radii == 0).nonzero()[:, 0]
    weight = torch.zeros_like(out.means2d)
    weight[culled] = 1.0
    (out.means2d * weight).sum().backward(retain_graph=True)
    assert len(culled) > 10 and not parameters.twist.grad.any() and not parameters.intrinsics.grad.any()
    drawn = (out.radii > 0).nonzero()[:, 0]
    weight[drawn[0]], weight[drawn[1]] = torch.inf, 1.0
    (out.means2d * weight).sum().backward()
    assert parameters.twist.grad.isfinite().all() and parameters.twist.grad.any()
    assert parameters.intrinsics.grad.tolist()[2:] == [1.0, 1.0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("camera",), "base: expected a warp_splat.Camera, got str"),
        ((None, torch.zeros(5)), r"twist: expected a tensor of 6 real numbers, got torch.float32 \[5\]"),
        ((None, [0.0] * 6), "twist: expected a tensor of 6 real numbers, got list"),
        ((None, None, torch.ones(4, dtype=torch.int32)), "intrinsics: expected a tensor of 4 real numbers"),
        ((None, torch.zeros(6).to_sparse()), "twist: expected a dense tensor with numbers, got torch.sparse_coo"),
        ((None, None, torch.ones(4, device="meta")), "intrinsics: expected a dense tensor .* got a meta tensor"),
    ],
)
def test_bad_input(arguments, message):
    with pytest.raises(InputError, match=message):
        CameraParameters(arguments[0] or SCENES["single"]().camera, *arguments[1:])


def test_numbers_that_make_no_camera():
    scene = SCENES["single"]()
    with pytest.raises(InputError, match="Camera fx: expected a positive number"):
        rasterize(*scene.parameters(), CameraParameters(scene.camera, None, torch.tensor([-1.0, 1, 1, 1])))
    for twist in ([torch.nan] * 6, [0, 0, 6.29, 0, 0, 0], [0, 0, 0, torch.inf, 0, 0]):
        with pytest.raises(InputError, match="twist: expected finite numbers, of which the rotation vector"):
            rasterize(*scene.parameters(), CameraParameters(scene.camera, torch.tensor(twist)))


@pytest.mark.parametrize("angle", [3.0, 6.283])
def test_a_turn_is_that_of_scipy(angle):
    base, axis = SCENES["single"]().camera, np.array([0.48, -0.6, 0.64])
    twist = torch.tensor([*(angle * axis), 0.1, 0.2, 0.3], dtype=torch.float64)
    turn = Rotation.from_rotvec(angle * axis).as_matrix()
    found = CameraParameters(base, twist).camera
    np.testing.assert_allclose(found.rotation, turn @ base.rotation, atol=1e-10)
    np.testing.assert_allclose(found.translation, turn @ base.translation + [0.1, 0.2, 0.3], atol=1e-9)


CHECKED = [
    ("degree2", RasterOptions(depth=True)),
    ("inside", RasterOptions(alpha_min=0.0)),
    ("off_center", RasterOptions(projection="ellipsoid", antialiasing=True)),
]


@pytest.mark.parametrize(("name", "options"), CHECKED, ids=str)
def test_check_gradients_agrees(name, options):
    scene = SCENES[name]()
    report = check_gradients(*scene.parameters(), camera_at(scene, OTHER), options=options, parameters=NAMES)
    assert [row.verdict for row in report.rows] == ["agrees"] * 4, str(report)


def test_check_gradients_looks_at_the_camera():
    scene = SCENES["single"]()
    report = check_gradients(*scene.parameters(), CameraParameters(scene.camera), directions=1)
    assert report.ok and {row.name for row in report.rows} == {*INPUTS, *NAMES}
    assert check_gradients(*SCENES["empty"]().parameters(), CameraParameters(scene.camera), directions=1).ok
    with pytest.raises(InputError, match="parameters: expected a list of some of means"):
        check_gradients(*scene.parameters(), scene.camera, parameters=["focal"])


@pytest.mark.parametrize(("index", "entry", "name"), [(6, 0, "rotation"), (6, 5, "translation"), (7, 1, "focal")])
def test_check_gradients_names_what_is_off(index, entry, name, monkeypatch):
    backward = project.Project.backward

    def spoiled(ctx, *upstream):
        gradients = backward(ctx, *upstream)
        gradients[index][entry] *= 1.02
        return gradients

    monkeypatch.setattr(project.Project, "backward", staticmethod(spoiled))
    scene = SCENES["degree1"]()
    report = check_gradients(*scene.parameters(), CameraParameters(scene.camera), parameters=NAMES)
    assert report.named("off") == [name] and report.worst is None, str(report)


def test_a_camera_finds_its_way_back():
    """From 5 degrees, 10 cm and 5 % of its focal lengths, in a picture that the renderer drew."""
    angle, place, focal = cameras.recover(seed=1, steps=220)[-1]
    assert angle < 0.05 and place < 1e-3 and focal < 1e-3, (angle, place, focal)

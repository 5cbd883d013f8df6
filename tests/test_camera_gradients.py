"""Gradients of a camera's poses, intrinsics and lens against the float64 oracle, and what they leave as it is."""

import functools
from dataclasses import replace

import cameras
import numpy as np
import pytest
import scenes
import torch
from scenes import SCENES, SHUTTER, scene_of
from scipy.spatial.transform import Rotation

from warp_splat import (
    CameraParameters,
    InputError,
    RasterOptions,
    check_gradients,
    rasterize,
    rasterize_views,
)
from warp_splat.compare import oracle, truth
from warp_splat.compare.exact_motion import exact_camera
from warp_splat.config import ADJOINTS
from warp_splat.raster.differences import INPUTS
from warp_splat.raster.drivers import CPU, CUDA, using
from warp_splat.raster.project import Project
from warp_splat.runtime import launch

ERROR = 1e-5  # relative L2, of each part of a camera
LENS_ERROR = 1e-4  # of coefficients, and of cameras with distortion away from the base
PLAIN = RasterOptions()
HERE, THERE, NEAR = (0.0,) * 6, (0.3, -0.2, 0.5, 0.2, 0.4, -0.3), (0.03, -0.02, 0.05, 0.02, 0.04, -0.03)  # twists
OTHER = torch.tensor((0.01, -0.02, 0.015, 0.02, 0.03, -0.01), dtype=torch.float64)
PARTS = {  # of what a camera may learn
    "twist": ("rotation", "translation"),
    "intrinsics": ("focal", "principal"),
    "last_twist": ("last_rotation", "last_translation"),
    "coefficients": ("coefficients",),
}
FINITE = "twist: expected finite numbers, of which the rotation vector"
NO_COEFFICIENTS = "coefficients: expected None for a camera"
POSE = (*PARTS["twist"], *PARTS["intrinsics"])


def learned(camera, start=HERE):
    """All that a camera may learn, by name, in float64: its poses away from the base by ``start`` and back."""
    found = {"twist": start, "intrinsics": (camera.fx, camera.fy, camera.cx, camera.cy)}
    if camera.shutter:
        found["last_twist"] = [-0.7 * part for part in start]
    elif camera.lens and camera.lens.coefficients:
        found["coefficients"] = camera.lens.coefficients
    return {key: torch.tensor(numbers, dtype=torch.float64, requires_grad=True) for key, numbers in found.items()}


def split(gradients):
    """By part."""
    parts = {}
    for key, gradient in gradients.items():
        parts |= zip(PARTS[key], gradient.split(len(gradient) // len(PARTS[key])), strict=True)
    return parts


def exact_render(scene, options, numbers):
    scene, more = scene.to("cpu", torch.float64), {key: numbers.get(key) for key in ("last_twist", "coefficients")}
    camera = exact_camera(scene.camera, numbers["twist"], numbers["intrinsics"], **more)
    return oracle.exact_render(*scene.parameters(), camera, scene.background, **truth.for_oracle(options))


@functools.cache
def exact(name, options, start):
    """A scene, the upstream gradients of a squared distance from another camera's picture, and the truth."""
    scene = scene_of(name)
    numbers = learned(scene.camera, start)
    out = exact_render(scene, options, numbers)
    with torch.no_grad():
        moved = numbers | {"twist": numbers["twist"] + OTHER, "intrinsics": 1.02 * numbers["intrinsics"]}
        moved |= {"last_twist": numbers["last_twist"] - OTHER} if "last_twist" in numbers else {}
        moved |= {"coefficients": 1.3 * numbers["coefficients"]} if "coefficients" in numbers else {}
        other = exact_render(scene, options, moved)
    keys = ("image", "alpha", "depth")[: 3 if options.depth else 2]
    upstream = {key: (getattr(out, key) - getattr(other, key)).detach() for key in keys}
    for weight in upstream.values():
        weight[out.fragile] = 0
    loss = sum((getattr(out, key) * weight).sum() for key, weight in upstream.items())
    found = torch.autograd.grad(loss, list(numbers.values()))
    expected = split(dict(zip(numbers, found, strict=True)))
    return scene, {key: weight.float() for key, weight in upstream.items()}, expected


def gradients_of(scene, upstream, options=PLAIN, start=HERE, adjoint="manual", leaves=None):
    """The renderer's, by part."""
    numbers = learned(scene.camera, start)
    camera = CameraParameters(scene.camera, **numbers)
    out = rasterize(*(leaves or scene.parameters()), camera, scene.background, adjoint, options)
    sum((getattr(out, key) * weight).sum() for key, weight in upstream.items()).backward()
    return split({key: leaf.grad for key, leaf in numbers.items()})


def check(name, options=PLAIN, adjoint="manual", start=HERE, driver=CPU):
    scene, upstream, expected = exact(name, options, start)
    with using(driver):
        found = gradients_of(scene, upstream, options, start, adjoint)
    errors = {key: float((found[key] - true).norm() / true.norm().clamp_min(1e-6)) for key, true in expected.items()}
    bent = set(errors) if scene.camera.lens and start != HERE else {"coefficients"}
    assert all(error < (LENS_ERROR if key in bent else ERROR) for key, error in errors.items()), errors


@pytest.mark.parametrize("name", SCENES)
def test_scene(name):
    check(name)


LONG, SLOW = pytest.mark.long, pytest.mark.slow
DEPTH, SHARP = RasterOptions(depth=True), RasterOptions(antialiasing=True)
ROLLING = [(name, "affine") for name in ("opencv", "panorama")]
ROLLING += [("degree2", "ellipsoid"), *((name, "unscented") for name in ("degree2", "opencv", "fisheye"))]


@pytest.mark.parametrize(
    ("name", "options", "adjoints", "start"),
    [
        ("degree3", DEPTH, ADJOINTS[1:], HERE),
        ("degree2", RasterOptions(antialiasing=True, blur=1.0), ADJOINTS[:1], HERE),
        ("degree2", RasterOptions(antialiasing=True, depth=True), ADJOINTS[:1], HERE),
        ("subpixel", SHARP, ADJOINTS[:1], HERE),
        ("off_center", RasterOptions(antialiasing=True, depth=True), ADJOINTS[:1], HERE),
        ("degree2", RasterOptions(projection="ellipsoid"), ADJOINTS[:1], HERE),
        ("inside", RasterOptions(projection="ellipsoid", depth=True), ADJOINTS[:1], HERE),
        ("needles", RasterOptions(projection="ellipsoid"), ADJOINTS[:1], HERE),
        ("off_center", RasterOptions(projection="ellipsoid", antialiasing=True), ADJOINTS[:1], HERE),
        ("near_and_behind", RasterOptions(projection="ellipsoid"), ADJOINTS[:1], HERE),
        ("degree3", RasterOptions(sh_degree=1), ADJOINTS[:1], HERE),
        # the gradient is that of the exponential map where the twist is, not that of its start
        *((name, PLAIN, ADJOINTS[:1], THERE) for name in ("degree2", "inside", "far_world", "needles")),
        *((name, PLAIN, ADJOINTS[:1], THERE) for name in ("opencv", "fisheye")),
        ("opencv", DEPTH, ADJOINTS[:1], HERE),
        ("opencv", RasterOptions(antialiasing=True, depth=True), ADJOINTS, HERE),
        pytest.param("fisheye", DEPTH, ADJOINTS, HERE, marks=SLOW),
        pytest.param("fisheye", RasterOptions(antialiasing=True, depth=True), ADJOINTS[:1], HERE, marks=SLOW),
        *(
            pytest.param(name, RasterOptions(projection="unscented", depth=True), ADJOINTS, HERE, marks=LONG)
            for name in ("opencv", "fisheye")
        ),
        ("rolling degree2", DEPTH, ADJOINTS[:1], HERE),
        ("rolling degree2", SHARP, ADJOINTS[:1], NEAR),
        ("rolling degree2", PLAIN, ADJOINTS[1:], HERE),
        ("rolling needles", PLAIN, ADJOINTS[:1], NEAR),
        ("rolling inside", DEPTH, ADJOINTS[:1], NEAR),
        pytest.param("rolling fisheye", DEPTH, ADJOINTS, NEAR, marks=SLOW),
        *(
            pytest.param(f"rolling {name}", RasterOptions(projection=projection), ADJOINTS, NEAR, marks=LONG)
            for name, projection in ROLLING
        ),
    ],
    ids=str,
)
def test_options(name, options, adjoints, start):
    for adjoint in adjoints:
        check(name, options, adjoint, start)


@pytest.mark.parametrize("name", ["degree2", pytest.param("opencv", marks=SLOW)])
def test_kernels_of_a_gpu(name):
    """One Gaussian at a time; in fibers."""
    check(name, SHARP, driver=CUDA)


def test_the_oracle_agrees_with_differences():
    """Where nothing is clamped."""
    scene = scenes.cloud(0, 40, scenes.make_camera(33, 27), degree=2, frame=0)
    numbers = learned(scene.camera, OTHER.tolist())
    start = torch.cat([numbers["twist"], numbers["intrinsics"]]).detach()

    def loss(values):
        moved = {"twist": values[:6], "intrinsics": values[6:]}
        return exact_render(scene, RasterOptions(alpha_min=0.0, t_min=0.0), moved).image.square().sum()

    leaf = start.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(leaf), leaf)
    with torch.no_grad():
        for row in 1e-5 * torch.eye(10, dtype=torch.float64):
            ends = [float(loss(start + sign * row)) for sign in (1, -1)]
            assert (ends[0] - ends[1]) / 2e-5 == pytest.approx(float(gradient[row > 0]), rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("start", [HERE, NEAR, *(tuple(r * n for n in (0.6, 0, 0.8, 1, 2, 3)) for r in (1e-9, 0.5, 3))])
@pytest.mark.parametrize("name", ["off_center", "rolling off_center"])
def test_the_camera_is_that_of_the_exponential_map(name, start):
    base = scene_of(name).camera
    if base.shutter and np.linalg.norm(start) > 1:
        return  # more than a shutter turns
    numbers = learned(base, start)
    found = CameraParameters(base, **numbers).camera
    exact = exact_camera(base, numbers["twist"], numbers["intrinsics"], numbers.get("last_twist"))
    np.testing.assert_allclose(found.rotation, exact.rotation.detach(), atol=1e-14)
    np.testing.assert_allclose(found.translation, exact.translation.detach(), atol=1e-13)
    assert found.fy == base.fy and found.width == base.width
    if base.shutter:
        np.testing.assert_allclose(found.shutter.turn, exact.shutter.turn.detach(), atol=1e-13)
        np.testing.assert_allclose(found.shutter.shift, exact.shutter.shift.detach(), atol=1e-13)


@pytest.mark.parametrize("angle", [3.0, 6.283])
def test_a_turn_is_that_of_scipy(angle):
    base, axis = SCENES["single"]().camera, np.array([0.48, -0.6, 0.64])
    twist = torch.tensor([*(angle * axis), 0.1, 0.2, 0.3], dtype=torch.float64)
    turn = Rotation.from_rotvec(angle * axis).as_matrix()
    found = CameraParameters(base, twist).camera
    np.testing.assert_allclose(found.rotation, turn @ base.rotation, atol=1e-10)
    np.testing.assert_allclose(found.translation, turn @ base.translation + [0.1, 0.2, 0.3], atol=1e-9)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        *((name, PLAIN) for name in ("degree0", "degree3", "single")),
        ("opencv", RasterOptions(depth=True, antialiasing=True)),
        pytest.param("fisheye", RasterOptions(depth=True, antialiasing=True), marks=SLOW),
        *(
            pytest.param(name, RasterOptions(depth=True, antialiasing=True, projection="unscented"), marks=LONG)
            for name in ("opencv", "fisheye")
        ),
    ],
    ids=str,
)
def test_nothing_else_changes(name, options):
    """Image and gradients of the Gaussians, bit for bit; nor is anything learned that wants no gradient."""
    scene, found = scene_of(name), []
    numbers = {key: leaf.detach().float() for key, leaf in learned(scene.camera).items()}  # as a model may have them
    for wanted in (False, True):
        leaves = [tensor.clone().requires_grad_() for tensor in scene.parameters()]
        given = {key: tensor.clone().requires_grad_(wanted) for key, tensor in numbers.items()}
        out = rasterize(*leaves, CameraParameters(scene.camera, **given), scene.background, options=options)
        (out.image.square().sum() + (out.depth.square().sum() if options.depth else 0)).backward()
        found.append([out.image.detach(), *(leaf.grad for leaf in leaves)])
        assert all((tensor.grad is not None) == wanted for tensor in given.values())
    plain = rasterize(*scene.parameters(), scene.camera, scene.background, options=options).image
    assert torch.equal(plain, found[0][0]) and all(torch.equal(*pair) for pair in zip(*found, strict=True))
    assert all(leaf.grad.abs().min() > 0 and leaf.grad.dtype == torch.float32 for leaf in given.values())


@pytest.mark.parametrize("kind", ["pinhole", "lens", "shutter"])
def test_any_number_of_threads(kind, monkeypatch, threads):
    monkeypatch.setattr(launch, "SMALLEST_SLICE", 32)
    scene = scenes.cloud(0, 1003, scenes.make_camera(64, 48), degree=1)
    more = {"pinhole": {}, "lens": {"lens": SCENES["opencv"]().camera.lens}, "shutter": {"shutter": SHUTTER}}[kind]
    scene, weight = replace(scene, camera=replace(scene.camera, **more)), torch.rand(48, 64, 3)
    results = []
    for count in (1, 2, 3):
        threads(count)
        results.append(torch.cat(list(gradients_of(scene, {"image": weight}).values())))
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2]) and results[0].abs().min() > 0


@pytest.mark.parametrize("count", [0, 16, 17])
def test_any_number_of_gaussians(count):
    """Whole groups of sixteen, and what is left over: more that nobody sees change nothing."""
    scene = SCENES["opencv"]()
    weight = {"image": torch.ones(scene.camera.height, scene.camera.width, 3)}
    few, more = ([tensor[:rows].clone() for tensor in scene.parameters()] for rows in (count, count + 5))
    more[3][count:] = 0.0
    found = [gradients_of(scene, weight, leaves=leaves)["coefficients"] for leaves in (few, more)]
    assert torch.equal(*found) and bool(found[0].any()) == (count > 0)


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


@pytest.mark.parametrize("name", ["near_and_behind", "opencv"])
def test_what_is_not_drawn_or_not_finite_says_nothing(name):
    scene = SCENES[name]()
    numbers = learned(scene.camera)
    out = rasterize(*scene.parameters(), CameraParameters(scene.camera, **numbers))
    culled, drawn = ((out.radii == 0).nonzero()[:, 0], (out.radii > 0).nonzero()[:, 0])
    weight = torch.zeros_like(out.means2d)
    weight[culled] = 1.0
    (out.means2d * weight).sum().backward(retain_graph=True)
    assert len(culled) > 10 and not any(leaf.grad.any() for leaf in numbers.values())
    weight[drawn[0]], weight[drawn[1]] = torch.inf, 1.0
    (out.means2d * weight).sum().backward()
    assert all(leaf.grad.isfinite().all() and leaf.grad.any() for leaf in numbers.values())
    assert numbers["intrinsics"].grad.tolist()[2:] == [1.0, 1.0]


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


@pytest.mark.parametrize(
    ("name", "numbers", "message"),
    [
        ("single", {"intrinsics": [-1.0, 1, 1, 1]}, "Camera fx: expected a positive number"),
        ("single", {"twist": [torch.nan] * 6}, FINITE),
        ("single", {"twist": [0, 0, 6.29, 0, 0, 0]}, FINITE),
        (
            "single",
            {"twist": [0, 0, 0, torch.inf, 0, 0]},
            FINITE,
        ),
        ("single", {"last_twist": [0.0] * 6}, "last_twist: expected a base with a rolling shutter"),
        ("rolling single", {"last_twist": [2.0, 0, 0, 0, 0, 0]}, "Camera.rolling: expected a turn of at most 1 rad"),
        (
            "single",
            {"coefficients": [0.0] * 4},
            f"{NO_COEFFICIENTS} whose lens has none, got some",
        ),
        (
            "opencv",
            {"coefficients": [0.0] * 3},
            r"coefficients: expected a tensor of 4 real numbers, got torch.float32 \[3\]",
        ),
        (
            "rolling opencv",
            {"coefficients": [0.0] * 4},
            f"{NO_COEFFICIENTS} with a rolling shutter",
        ),
        ("opencv", {"coefficients": [-0.9, 0, 0, 0]}, "Camera lens OPENCV: expected coefficients .* fold it"),
        ("opencv", {"coefficients": [torch.nan] * 4}, "Lens OPENCV: expected 4 finite coefficients"),
    ],
)
def test_numbers_that_make_no_camera(name, numbers, message):
    scene = scene_of(name)
    given = {key: torch.tensor(values, dtype=torch.float32) for key, values in numbers.items()}
    with pytest.raises(InputError, match=message):
        rasterize(*scene.parameters(), CameraParameters(scene.camera, **given))


@pytest.mark.parametrize(
    ("name", "options", "start", "parameters"),
    [
        ("degree2", DEPTH, OTHER.tolist(), POSE),
        ("inside", RasterOptions(alpha_min=0.0), OTHER.tolist(), POSE),
        ("off_center", RasterOptions(projection="ellipsoid", antialiasing=True), OTHER.tolist(), POSE),
        ("opencv", PLAIN, HERE, ("focal", "principal", "coefficients")),
        pytest.param("fisheye", PLAIN, HERE, ("focal", "principal", "coefficients"), marks=SLOW),
    ],
    ids=str,
)
def test_check_gradients_agrees(name, options, start, parameters):
    scene = SCENES[name]()
    camera = CameraParameters(scene.camera, **learned(scene.camera, start))
    report = check_gradients(*scene.parameters(), camera, options=options, parameters=parameters)
    assert [row.verdict for row in report.rows] == ["agrees"] * len(parameters), str(report)


def test_check_gradients_looks_at_the_camera():
    scene = SCENES["single"]()
    report = check_gradients(*scene.parameters(), CameraParameters(scene.camera), directions=1)
    assert report.ok and {row.name for row in report.rows} == {*INPUTS, *POSE}
    assert check_gradients(*SCENES["empty"]().parameters(), CameraParameters(scene.camera), directions=1).ok
    with pytest.raises(InputError, match="parameters: expected a list of some of means"):
        check_gradients(*scene.parameters(), scene.camera, parameters=["focal"])


@pytest.mark.parametrize(
    ("scene", "index", "entry", "name"),
    [
        ("degree1", 6, 0, "rotation"),
        ("degree1", 6, 5, "translation"),
        ("degree1", 7, 1, "focal"),
        ("opencv", 7, 2, "principal"),
        ("opencv", 9, 1, "coefficients"),
        ("rolling degree1", 8, 4, "last_translation"),
    ],
)
def test_check_gradients_names_what_is_off(scene, index, entry, name, spoil):
    """By 2 %."""
    spoil(Project, lambda gradients: gradients[index][entry].mul_(1.02))
    scene = scene_of(scene)
    numbers = learned(scene.camera)
    names = [part for key in numbers for part in PARTS[key]]
    report = check_gradients(*scene.parameters(), CameraParameters(scene.camera, **numbers), parameters=names)
    assert report.named("off") == [name] and report.worst is None, str(report)


def test_a_camera_finds_its_way_back():
    """From 5 degrees, 10 cm and 5 % of its focal lengths, in a picture that the renderer drew."""
    angle, place, focal = cameras.recover(seed=1, steps=220)[-1]
    assert angle < 0.05 and place < 1e-3 and focal < 1e-3, (angle, place, focal)


def test_a_lens_finds_its_way_back():
    """From no distortion, in a picture that the renderer drew."""
    errors = cameras.recover_lens(seed=1)
    assert errors[0] > 2.0 and errors[-1] < cameras.LENS_WANTED, errors

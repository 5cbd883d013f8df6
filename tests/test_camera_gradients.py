"""Gradients of a camera's poses, intrinsics and lens against the float64 oracle, and what they leave as it is."""

import functools

import learned_cameras
import pytest
import scenes
import torch
from common import using
from learned_cameras import DEPTH, HERE, LENS_ERROR, NEAR, OTHER, PLAIN, SHARP, exact_render, gradients_of, learned
from scenes import SCENES, scene_of

from warp_splat import CameraParameters, RasterOptions, rasterize
from warp_splat.config import ADJOINTS
from warp_splat.raster.drivers import CPU, CUDA

ERROR = 1e-5  # relative L2, of each part of a camera
THERE = (0.3, -0.2, 0.5, 0.2, 0.4, -0.3)  # a twist
LONG, SLOW = pytest.mark.long, pytest.mark.slow
ROLLING = [(name, "affine") for name in ("opencv", "panorama")]
ROLLING += [("degree2", "ellipsoid"), *((name, "unscented") for name in ("degree2", "opencv", "fisheye"))]


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
    expected = learned_cameras.split(dict(zip(numbers, found, strict=True)))
    return scene, {key: weight.float() for key, weight in upstream.items()}, expected


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

"""Gradients of a camera's poses, intrinsics and lens against the float64 oracle, and what they leave as it is."""

import functools
from dataclasses import replace

import exact_cameras
import learned_cameras
import numpy as np
import pytest
import scenes
import torch
from common import using
from exact_cameras import exact_camera
from learned_cameras import DEPTH, HERE, LENS_ERROR, NEAR, OTHER, PLAIN, SHARP, exact_render, gradients_of, learned
from scenes import LENSES, SCENES, scene_of

from warp_splat import CameraParameters, Lens, RasterOptions, rasterize
from warp_splat.compare import truth
from warp_splat.config import ADJOINTS
from warp_splat.lenses.formulas import MODELS
from warp_splat.raster.drivers import CPU, CUDA
from warp_splat.raster.project import project

ERROR = 1e-5  # relative L2, of each part of a camera
THERE = (0.3, -0.2, 0.5, 0.2, 0.4, -0.3)  # a twist
BOTH, UNSCENTED = RasterOptions(antialiasing=True, depth=True), RasterOptions(projection="unscented", depth=True)
LONG, SLOW = pytest.mark.long, pytest.mark.slow
AWAY = ("degree2", "inside", "far_world", "needles", "opencv", "fisheye")
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
        ("subpixel", SHARP, ADJOINTS[:1], HERE),
        ("off_center", BOTH, ADJOINTS[:1], HERE),
        ("inside", RasterOptions(projection="ellipsoid", depth=True), ADJOINTS[:1], HERE),
        ("needles", RasterOptions(projection="ellipsoid"), ADJOINTS[:1], HERE),
        ("off_center", RasterOptions(projection="ellipsoid", antialiasing=True), ADJOINTS[:1], HERE),
        ("near_and_behind", RasterOptions(projection="ellipsoid"), ADJOINTS[:1], HERE),
        ("degree3", RasterOptions(sh_degree=1), ADJOINTS[:1], HERE),
        # the gradient is that of the exponential map where the twist is, not that of its start
        *((name, PLAIN, ADJOINTS[:1], THERE) for name in AWAY),
        ("opencv", DEPTH, ADJOINTS[:1], HERE),
        ("opencv", BOTH, ADJOINTS, HERE),
        pytest.param("fisheye", DEPTH, ADJOINTS, HERE, marks=SLOW),
        pytest.param("fisheye", BOTH, ADJOINTS[:1], HERE, marks=SLOW),
        *(pytest.param(name, UNSCENTED, ADJOINTS, HERE, marks=LONG) for name in ("opencv", "fisheye")),
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
        ("opencv", BOTH),
        pytest.param("fisheye", BOTH, marks=SLOW),
        *(pytest.param(name, replace(BOTH, projection="unscented"), marks=LONG) for name in ("opencv", "fisheye")),
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


BENT = [(model, way) for model, (_, count) in MODELS.items() if count for way in ("affine", "unscented")]
EVERY_LENS = pytest.mark.parametrize(("model", "projection"), BENT)


class Numeric(torch.autograd.Function):
    """Where a lens's formula in NumPy shows points [..., 3]; its derivative by differences."""

    @staticmethod
    def forward(ctx, rays, lens):
        step, points = 1e-5, rays.detach().numpy()

        def shown(x):
            return np.stack(lens.family.formula(lens.numbers, *np.moveaxis(x, -1, 0)), -1)

        rows = [(shown(points + d) - shown(points - d)) / (2 * step) for d in step * np.eye(3)]
        ctx.slopes = torch.from_numpy(np.stack(rows, -1))
        return torch.from_numpy(shown(points))

    @staticmethod
    def backward(ctx, adj):
        return (adj[..., None] * ctx.slopes).sum(-2), None


@pytest.fixture
def bent(model, monkeypatch):
    """Seen through the lens; the oracle is told of it."""
    bend = lambda rays, lens: Numeric.apply(rays, Lens(lens.model, tuple(lens.coefficients)))  # noqa: E731
    monkeypatch.setattr(exact_cameras, "bend", bend)
    monkeypatch.setattr(exact_cameras, "WIDE", [name for name, (family, _) in MODELS.items() if family.wide])
    scene = SCENES["fisheye"]()
    return replace(scene, camera=replace(scene.camera, fx=60.0, fy=63.0, lens=LENSES[model]))


@LONG
@EVERY_LENS
def test_coefficients_of_every_lens(bent, projection):
    """In every mode, against float64 differences of the image, where no Gaussian comes or goes between them."""
    options, numbers = RasterOptions(projection=projection), learned(bent.camera)
    start = numbers["coefficients"].detach()

    def draw(k):
        return exact_render(bent, options, numbers | {"coefficients": k})

    def slope(step):
        rows = step * torch.eye(len(start), dtype=torch.float64)
        return torch.stack([(draw(start + row).image - draw(start - row).image) / (2 * step) for row in rows])

    with torch.no_grad():
        out, slopes, finer = draw(start), slope(1e-6), slope(3e-7)
        sure = ~out.fragile & ((slopes - finer).abs() < 0.05 * (1 + slopes.abs())).all(0).all(-1)
        upstream = (out.image - draw(1.3 * start).image) * sure[..., None]
    assert sure.float().mean() > 0.98
    expected = (slopes * upstream).sum((1, 2, 3))
    for adjoint in ADJOINTS:
        found = gradients_of(bent, {"image": upstream.float()}, options, adjoint=adjoint)["coefficients"]
        assert (found - expected).norm() < LENS_ERROR * expected.norm(), (adjoint, found, expected)


@LONG
@EVERY_LENS
def test_splats_of_every_lens(bent, projection):
    """Means, conics and opacities that are drawn, against float64 differences by the coefficients."""
    options, numbers = RasterOptions(projection=projection, antialiasing=True), learned(bent.camera)
    coefficients = numbers["coefficients"]
    splats = project(bent.gaussians(), CameraParameters(bent.camera, coefficients=coefficients), options)
    drawn, exact = splats.radii > 0, bent.to("cpu", torch.float64)
    generator = torch.Generator().manual_seed(3)
    weights = [torch.randn(part.shape, generator=generator) for part in (splats.means2d, splats.conics)]
    weights[1] /= splats.conics.detach().abs().amax(1, keepdim=True).clamp_min(1e-6)
    weights = [torch.where(drawn[:, None], weight, 0) for weight in weights]
    names = ("sh_degree", "antialiasing", "projection", "near", "blur")
    given = {name: value for name, value in truth.for_oracle(options).items() if name in names}

    def loss(means2d, conics):
        return sum((part * weight.to(part)).sum() for part, weight in zip((means2d, conics), weights, strict=True))

    def exact_loss(k):
        camera = exact_camera(bent.camera, numbers["twist"], numbers["intrinsics"], coefficients=k)
        found = exact_cameras.exact_splats(*exact.parameters(), camera, **given)
        conics = torch.linalg.inv(found.cov2d).flatten(1)[:, [0, 1, 3]]
        return float(loss(*(torch.where(drawn[:, None], part, 0) for part in (found.means2d, conics))).detach())

    loss(splats.means2d, splats.conics).backward()
    expected = []
    for row in 1e-4 * torch.eye(len(coefficients), dtype=torch.float64):
        near, far = ([exact_loss((coefficients + sign * row).tolist()) for sign in (n, -n)] for n in (1, 2))
        expected.append((8 * (near[0] - near[1]) - (far[0] - far[1])) / 12e-4)
    expected = torch.tensor(expected, dtype=torch.float64)
    assert drawn.sum() > 20
    assert (coefficients.grad - expected).norm() < LENS_ERROR * expected.norm(), (coefficients.grad, expected)

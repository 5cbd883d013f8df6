"""Gradients of a lens's coefficients: of the image against the float64 oracle, of splats against differences of it."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
import torch
from scenes import SCENES

from warp_splat import Camera, CameraParameters, InputError, Lens, RasterOptions, check_gradients, rasterize
from warp_splat.compare import exact_lenses, oracle, truth
from warp_splat.compare.exact_motion import exact_camera
from warp_splat.config import ADJOINTS
from warp_splat.lenses.formulas import MODELS
from warp_splat.raster import project as projection
from warp_splat.raster.data import Gaussians
from warp_splat.raster.drivers import CUDA, using
from warp_splat.raster.project import project
from warp_splat.runtime import launch, pool

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import cameras

ERROR = 1e-4  # relative L2, of all coefficients
SMALL = (0.06, -0.03, 0.004, -0.006, 0.02, -0.01, 0.015, 0.005, 0.003, -0.002, 0.004, 0.001)
COEFFICIENTS = {"FOV": (0.9,), "EUCM": (0.6, 1.1)}
PLAIN = RasterOptions()


def coefficients_of(lens):
    return torch.tensor(lens.coefficients, dtype=torch.float64, requires_grad=True)


def with_coefficients(base, coefficients):
    """As the oracle takes it."""
    intrinsics = torch.tensor([base.fx, base.fy, base.cx, base.cy], dtype=torch.float64)
    return exact_camera(base, torch.zeros(6, dtype=torch.float64), intrinsics, coefficients=coefficients)


def exact_gradient(scene, options):
    """Upstream gradients of a squared distance from a picture through other coefficients, and the truth."""
    exact, coefficients = scene.to("cpu", torch.float64), coefficients_of(scene.camera.lens)

    def draw(k):
        camera = with_coefficients(scene.camera, k)
        return oracle.exact_render(*exact.parameters(), camera, exact.background, **truth.for_oracle(options))

    out = draw(coefficients)
    with torch.no_grad():
        other = draw(1.3 * coefficients)
    upstream = {key: (getattr(out, key) - getattr(other, key)).detach() for key in ("image", "alpha", "depth")}
    for weight in upstream.values():
        weight[out.fragile] = 0
    loss = sum((getattr(out, key) * weight).sum() for key, weight in upstream.items())
    return {key: weight.float() for key, weight in upstream.items()}, torch.autograd.grad(loss, coefficients)[0]


def found_gradient(scene, upstream, options, adjoint="manual", leaves=None):
    coefficients = coefficients_of(scene.camera.lens)
    camera = CameraParameters(scene.camera, coefficients=coefficients)
    out = rasterize(*(leaves or scene.parameters()), camera, scene.background, adjoint, options)
    sum((getattr(out, key) * weight).sum() for key, weight in upstream.items()).backward()
    return out.image.detach(), coefficients.grad


LONG = pytest.mark.long
VARIANTS = [
    ("opencv", {}, ADJOINTS[:1]),
    ("opencv", {"antialiasing": True}, ADJOINTS),
    pytest.param("fisheye", {}, ADJOINTS, marks=pytest.mark.slow),
    pytest.param("fisheye", {"antialiasing": True}, ADJOINTS[:1], marks=pytest.mark.slow),
    pytest.param("opencv", {"projection": "unscented"}, ADJOINTS, marks=LONG),
    pytest.param("fisheye", {"projection": "unscented"}, ADJOINTS, marks=LONG),
]


@pytest.mark.parametrize(("name", "options", "adjoints"), VARIANTS, ids=str)
def test_image(name, options, adjoints):
    scene, options = SCENES[name](), RasterOptions(depth=True, **options)
    upstream, expected = exact_gradient(scene, options)
    for adjoint in adjoints:
        _, found = found_gradient(scene, upstream, options, adjoint)
        assert (found - expected).norm() < ERROR * expected.norm(), (adjoint, found, expected)


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


def with_slopes(rays, lens):
    return Numeric.apply(rays, Lens(lens.model, tuple(lens.coefficients)))


def through(model, monkeypatch):
    """A scene through any lens, and how the oracle is told."""
    scene, lens = SCENES["fisheye"](), Lens(model, COEFFICIENTS.get(model, SMALL[: MODELS[model][1]]))
    monkeypatch.setattr(exact_lenses, "bend", with_slopes)
    monkeypatch.setattr(exact_lenses, "WIDE", [name for name, (family, _) in MODELS.items() if family.wide])
    return replace(scene, camera=replace(scene.camera, fx=60.0, fy=63.0, lens=lens))


EVERY_LENS = pytest.mark.parametrize(
    ("model", "projection"),
    [(model, way) for model, (_, count) in MODELS.items() if count for way in ("affine", "unscented")],
)


@LONG
@EVERY_LENS
def test_image_of_every_lens(model, projection, monkeypatch):
    """In every mode, against float64 differences of the image, where no Gaussian comes or goes between them."""
    scene, options = through(model, monkeypatch), RasterOptions(projection=projection)
    exact = scene.to("cpu", torch.float64)

    def draw(k):
        camera = with_coefficients(scene.camera, k)
        return oracle.exact_render(*exact.parameters(), camera, exact.background, **truth.for_oracle(options))

    with torch.no_grad():
        start = coefficients_of(scene.camera.lens).detach()
        out = draw(start)
        slopes, finer = (
            torch.stack([(draw(start + row).image - draw(start - row).image) / (2 * step) for row in rows])
            for step in (1e-6, 3e-7)
            for rows in (step * torch.eye(len(start), dtype=torch.float64),)
        )
        sure = ~out.fragile & ((slopes - finer).abs() < 0.05 * (1 + slopes.abs())).all(0).all(-1)
        upstream = (out.image - draw(1.3 * start).image) * sure[..., None]
    assert sure.float().mean() > 0.98
    expected = (slopes * upstream).sum((1, 2, 3))
    for adjoint in ADJOINTS:
        _, found = found_gradient(scene, {"image": upstream.float()}, options, adjoint)
        assert (found - expected).norm() < ERROR * expected.norm(), (adjoint, found, expected)


@LONG
@EVERY_LENS
def test_splats_of_every_lens(model, projection, monkeypatch):
    """Means, conics and opacities that are drawn, against float64 differences by the coefficients."""
    scene, options = through(model, monkeypatch), RasterOptions(projection=projection, antialiasing=True)
    camera, lens = scene.camera, scene.camera.lens
    coefficients = coefficients_of(lens)
    *shapes, sh = scene.parameters()
    splats = project(
        Gaussians(*shapes, sh[:, :1], sh[:, 1:]), CameraParameters(camera, coefficients=coefficients), options
    )
    drawn, exact = splats.radii > 0, scene.to("cpu", torch.float64)
    generator = torch.Generator().manual_seed(3)
    weights = [torch.randn(part.shape, generator=generator) for part in (splats.means2d, splats.conics)]
    weights[1] /= splats.conics.detach().abs().amax(1, keepdim=True).clamp_min(1e-6)
    weights = [torch.where(drawn[:, None], weight, 0) for weight in weights]

    def loss(means2d, conics):
        return sum((part * weight.to(part)).sum() for part, weight in zip((means2d, conics), weights, strict=True))

    def exact_loss(k):
        found = oracle.exact_splats(*exact.parameters(), with_coefficients(camera, k), **view_options(options))
        conics = torch.linalg.inv(found.cov2d)
        conics = torch.stack([conics[:, 0, 0], conics[:, 0, 1], conics[:, 1, 1]], 1)
        keep = [torch.where(drawn[:, None], part, 0) for part in (found.means2d, conics)]
        return float(loss(*keep))

    loss(splats.means2d, splats.conics).backward()
    expected = []
    for row in 1e-4 * torch.eye(len(coefficients), dtype=torch.float64):
        near, far = ([exact_loss((coefficients + sign * row).tolist()) for sign in (n, -n)] for n in (1, 2))
        expected.append((8 * (near[0] - near[1]) - (far[0] - far[1])) / 12e-4)
    expected = torch.tensor(expected, dtype=torch.float64)
    assert drawn.sum() > 20
    assert (coefficients.grad - expected).norm() < ERROR * expected.norm(), (coefficients.grad, expected)


def view_options(options):
    names = ("sh_degree", "antialiasing", "projection", "near", "blur")
    return {name: value for name, value in truth.for_oracle(options).items() if name in names}


def test_any_number_of_threads(monkeypatch):
    monkeypatch.setattr(launch, "SMALLEST_SLICE", 32)
    scene, before = scenes.cloud(0, 1003, scenes.make_camera(64, 48), degree=1), pool.get_threads()
    scene = replace(scene, camera=replace(scene.camera, lens=SCENES["opencv"]().camera.lens))
    results = []
    for threads in (1, 2, 3):
        pool.set_threads(threads)
        results.append(found_gradient(scene, {"image": torch.ones(48, 64, 3)}, PLAIN)[1])
    pool.set_threads(before)
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2]) and results[0].abs().min() > 0


@pytest.mark.parametrize("count", [0, 16, 17])
def test_any_number_of_gaussians(count):
    """Whole groups of sixteen, and what is left over: more that nobody sees change nothing."""
    scene = SCENES["opencv"]()
    weight = {"image": torch.ones(scene.camera.height, scene.camera.width, 3)}
    few, more = ([tensor[:rows].clone() for tensor in scene.parameters()] for rows in (count, count + 5))
    more[3][count:] = 0.0
    found = [found_gradient(scene, weight, PLAIN, leaves=leaves)[1] for leaves in (few, more)]
    assert torch.equal(*found) and bool(found[0].any()) == (count > 0)


@pytest.mark.parametrize(
    ("name", "projection"),
    [
        ("opencv", "affine"),
        pytest.param("fisheye", "affine", marks=pytest.mark.slow),
        pytest.param("opencv", "unscented", marks=LONG),
        pytest.param("fisheye", "unscented", marks=LONG),
    ],
)
def test_nothing_else_changes(name, projection):
    """Image and gradients of the Gaussians, bit for bit; nor is anything learned that wants no gradient."""
    found, options = [], RasterOptions(depth=True, antialiasing=True, projection=projection)
    for learned in (False, True):
        scene = SCENES[name]()
        leaves = [tensor.clone().requires_grad_() for tensor in scene.parameters()]
        coefficients = torch.tensor(scene.camera.lens.coefficients, requires_grad=learned)
        camera = CameraParameters(scene.camera, coefficients=coefficients)
        out = rasterize(*leaves, camera, scene.background, options=options)
        (out.image.square().sum() + out.depth.square().sum()).backward()
        assert (coefficients.grad is not None) == learned
        tensors = [out.image.detach(), *(leaf.grad for leaf in leaves), camera.twist.grad, camera.intrinsics.grad]
        found.append(tensors)
    assert all(torch.equal(*pair) for pair in zip(*found, strict=True))
    assert coefficients.grad.dtype == torch.float32


def test_a_share_that_is_not_finite_is_left_out():
    scene = SCENES["opencv"]()
    coefficients = coefficients_of(scene.camera.lens)
    out = rasterize(*scene.parameters(), CameraParameters(scene.camera, coefficients=coefficients))
    drawn = (out.radii > 0).nonzero()[:, 0]
    weight = torch.zeros_like(out.means2d)
    weight[drawn[0]], weight[drawn[1]] = torch.inf, 1.0
    (out.means2d * weight).sum().backward()
    assert coefficients.grad.isfinite().all() and coefficients.grad.any()


@pytest.mark.slow
def test_kernels_of_a_gpu():
    """One Gaussian at a time; in fibers."""
    scene, options = SCENES["opencv"](), RasterOptions(antialiasing=True)
    upstream, expected = exact_gradient(scene, options)
    upstream.pop("depth")
    _, expected = found_gradient(scene, upstream, options)
    with using(CUDA):
        _, found = found_gradient(scene, upstream, options)
    assert (found - expected).norm() < ERROR * expected.norm()


def spoil(monkeypatch, index, entry):
    """Make a gradient of the projection's inputs wrong by 2 %."""
    backward = projection.Project.backward

    def spoiled(ctx, *upstream):
        gradients = backward(ctx, *upstream)
        gradients[index][entry] *= 1.02
        return gradients

    monkeypatch.setattr(projection.Project, "backward", staticmethod(spoiled))


NAMES = ("focal", "principal", "coefficients")


@pytest.mark.parametrize("name", ["opencv", pytest.param("fisheye", marks=pytest.mark.slow)])
def test_check_gradients_agrees(name):
    scene = SCENES[name]()
    camera = CameraParameters(scene.camera, coefficients=coefficients_of(scene.camera.lens))
    report = check_gradients(*scene.parameters(), camera, parameters=NAMES)
    assert [row.verdict for row in report.rows] == ["agrees"] * 3, str(report)


@pytest.mark.parametrize(("index", "entry", "name"), [(7, 2, "principal"), (9, 1, "coefficients")])
def test_check_gradients_names_what_is_off(index, entry, name, monkeypatch):
    spoil(monkeypatch, index, entry)
    scene = SCENES["opencv"]()
    camera = CameraParameters(scene.camera, coefficients=coefficients_of(scene.camera.lens))
    report = check_gradients(*scene.parameters(), camera, parameters=NAMES)
    assert report.named("off") == [name] and report.worst is None, str(report)


def test_a_lens_finds_its_way_back():
    """From no distortion, in a picture that the renderer drew."""
    errors = cameras.recover_lens(seed=1)
    assert errors[0] > 2.0 and errors[-1] < cameras.LENS_WANTED, errors


def test_bad_input():
    scene = SCENES["opencv"]()
    with pytest.raises(InputError, match="coefficients: expected None for a camera whose lens has none, got some"):
        CameraParameters(SCENES["single"]().camera, coefficients=torch.zeros(4))
    with pytest.raises(InputError, match=r"coefficients: expected a tensor of 4 real numbers, got torch.float32 \[3\]"):
        CameraParameters(scene.camera, coefficients=torch.zeros(3))
    first, last = (replace(scene.camera, translation=shift) for shift in (np.zeros(3), np.full(3, 0.1)))
    with pytest.raises(InputError, match="coefficients: expected None for a camera with a rolling shutter"):
        CameraParameters(Camera.rolling(first, last), coefficients=torch.zeros(4))
    folded = CameraParameters(scene.camera, coefficients=torch.tensor([-0.9, 0.0, 0.0, 0.0]))
    with pytest.raises(InputError, match=r"Camera lens OPENCV: expected coefficients .* fold it"):
        rasterize(*scene.parameters(), folded)
    with pytest.raises(InputError, match="Lens OPENCV: expected 4 finite coefficients"):
        rasterize(*scene.parameters(), CameraParameters(scene.camera, coefficients=torch.full((4,), torch.nan)))

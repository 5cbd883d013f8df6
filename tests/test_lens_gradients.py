"""Gradients of the coefficients of every lens, against differences of the float64 oracle."""

from dataclasses import replace

import exact_cameras
import numpy as np
import pytest
import torch
from exact_cameras import exact_camera
from learned_cameras import LENS_ERROR, exact_render, gradients_of, learned
from scenes import LENSES, SCENES

from warp_splat import CameraParameters, Lens, RasterOptions
from warp_splat.compare import truth
from warp_splat.config import ADJOINTS
from warp_splat.lenses.formulas import MODELS
from warp_splat.raster.project import project

EVERY_LENS = pytest.mark.parametrize(
    ("model", "projection"),
    [(model, way) for model, (_, count) in MODELS.items() if count for way in ("affine", "unscented")],
)
pytestmark = pytest.mark.long


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
def scene(model, monkeypatch):
    """Seen through the lens; the oracle is told of it."""
    bend = lambda rays, lens: Numeric.apply(rays, Lens(lens.model, tuple(lens.coefficients)))  # noqa: E731
    monkeypatch.setattr(exact_cameras, "bend", bend)
    monkeypatch.setattr(exact_cameras, "WIDE", [name for name, (family, _) in MODELS.items() if family.wide])
    scene = SCENES["fisheye"]()
    return replace(scene, camera=replace(scene.camera, fx=60.0, fy=63.0, lens=LENSES[model]))


@EVERY_LENS
def test_image(scene, projection):
    """In every mode, against float64 differences of the image, where no Gaussian comes or goes between them."""
    options, numbers = RasterOptions(projection=projection), learned(scene.camera)
    start = numbers["coefficients"].detach()

    def draw(k):
        return exact_render(scene, options, numbers | {"coefficients": k})

    with torch.no_grad():
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
        found = gradients_of(scene, {"image": upstream.float()}, options, adjoint=adjoint)["coefficients"]
        assert (found - expected).norm() < LENS_ERROR * expected.norm(), (adjoint, found, expected)


@EVERY_LENS
def test_splats(scene, projection):
    """Means, conics and opacities that are drawn, against float64 differences by the coefficients."""
    options, numbers = RasterOptions(projection=projection, antialiasing=True), learned(scene.camera)
    coefficients = numbers["coefficients"]
    splats = project(scene.gaussians(), CameraParameters(scene.camera, coefficients=coefficients), options)
    drawn, exact = splats.radii > 0, scene.to("cpu", torch.float64)
    generator = torch.Generator().manual_seed(3)
    weights = [torch.randn(part.shape, generator=generator) for part in (splats.means2d, splats.conics)]
    weights[1] /= splats.conics.detach().abs().amax(1, keepdim=True).clamp_min(1e-6)
    weights = [torch.where(drawn[:, None], weight, 0) for weight in weights]
    names = ("sh_degree", "antialiasing", "projection", "near", "blur")
    given = {name: value for name, value in truth.for_oracle(options).items() if name in names}

    def loss(means2d, conics):
        return sum((part * weight.to(part)).sum() for part, weight in zip((means2d, conics), weights, strict=True))

    def exact_loss(k):
        camera = exact_camera(scene.camera, numbers["twist"], numbers["intrinsics"], coefficients=k)
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

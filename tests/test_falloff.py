"""A falloff of the user's own, on both drivers, against the formulas in torch, pixel by pixel and in float64."""

from dataclasses import replace
from typing import Any

import pytest
import torch
import warp as wp
from commands import ROOT
from common import using
from heavy_tails import fall, heavy_tails, reach
from hostile import refusal
from scenes import SCENES, make_camera

from warp_splat import Falloff, RasterOptions, check_gradients, rasterize
from warp_splat.config import ALPHA_MAX
from warp_splat.kernels.simd import fill, over, times
from warp_splat.raster.drivers import CPU, CUDA
from warp_splat.raster.gradcheck import _check_falloff

OPTIONS = RasterOptions(falloff=heavy_tails, alpha_min=0.02, t_min=0.0, depth=True)


def dense(out):
    """Image and depth of the splats of ``out``: every one of them at every pixel, by the formulas."""
    drawn = torch.nonzero(out.radii > 0)[:, 0]
    drawn = drawn[torch.argsort(out.depths[drawn], stable=True)]
    splats = [getattr(out, name) for name in ("means2d", "conics", "opacities2d", "colors", "depths")]
    leaves = [tensor.detach().double().requires_grad_() for tensor in splats]
    means2d, conics, opacities, colors, depths = (leaf[drawn] for leaf in leaves)
    height, width, _ = out.image.shape
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    dx, dy = (means2d[:, axis, None, None] - pixel for axis, pixel in enumerate((x, y)))
    xx, xy, yy = (entry[:, None, None] for entry in conics.unbind(1))
    alpha = opacities[:, None, None] / (1 + 0.5 * (xx * dx**2 + 2 * xy * dx * dy + yy * dy**2))
    alpha = torch.where(alpha < OPTIONS.alpha_min, 0.0, alpha.clamp(max=ALPHA_MAX))
    front = torch.cat([torch.ones_like(alpha[:1]), (1 - alpha).cumprod(0)])
    weights = alpha * front[:-1]
    image = torch.einsum("nyx,nc->yxc", weights, colors)
    return leaves, image, torch.einsum("nyx,n->yx", weights, depths) / (1 - front[-1]).clamp_min(1e-10)


@pytest.mark.parametrize("driver", [pytest.param(CPU, marks=pytest.mark.slow), CUDA])  # half a minute to compile
@pytest.mark.parametrize("adjoint", ["stepwise", "reversible", "stored"])
def test_against_a_dense_formula(adjoint, driver):
    scene = SCENES["degree1"]()
    generator = torch.Generator().manual_seed(3)
    leaves = [tensor.clone().requires_grad_() for tensor in scene.parameters()]
    with using(driver):
        out = rasterize(*leaves, scene.camera, adjoint=adjoint, options=OPTIONS)
        upstream = torch.randn(out.image.shape, generator=generator)
        exact, image, depth = dense(out)
        splats = [out.means2d, out.conics, out.opacities2d, out.colors, out.depths]
        found = torch.autograd.grad((out.image * upstream).sum() + 0.1 * out.depth.sum(), splats)
    assert (out.image - image).abs().max() < 1e-5 and (out.depth - depth).abs().max() < 1e-4
    wanted = torch.autograd.grad((image * upstream).sum() + 0.1 * depth.sum(), exact)
    for gradient, truth in zip(found, wanted, strict=True):
        assert (gradient - truth).norm() < 1e-4 * truth.norm()


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", ["stepwise", "reversible", "stored"])
def test_gradients_agree_with_differences(adjoint):
    scene = SCENES["degree1"]()
    assert check_gradients(*scene.parameters(), scene.camera, adjoint=adjoint, options=OPTIONS, directions=3).ok


@pytest.mark.slow
def test_manual_refuses_another_falloff_where_a_gradient_is_asked_for():
    scene = SCENES["degree1"]()
    leaves = [tensor.clone().requires_grad_() for tensor in scene.parameters()]
    refusal(lambda: rasterize(*leaves, scene.camera, options=OPTIONS), "'manual' is the derivative of the Gaussian")
    image = rasterize(*scene.parameters(), scene.camera, options=OPTIONS).image
    assert torch.equal(image, rasterize(*leaves, scene.camera, adjoint="stored", options=OPTIONS).image)


def drawn(**options):
    scene = SCENES["single"]()
    return rasterize(*scene.parameters(), scene.camera, options=RasterOptions(**options))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Falloff(lambda q: q, reach), "Falloff.fall: expected a wp.func of one Any"),
        (lambda: Falloff(reach, reach), "Falloff.fall: expected a wp.func of one Any"),
        (lambda: Falloff(fall, 3.0), "Falloff.reach: expected a wp.func of one float, got 3.0"),
        (lambda: drawn(falloff="wide"), r"options\.falloff: expected a warp_splat.Falloff or None, got 'wide'"),
        (lambda: drawn(falloff=Falloff(misspelled, reach)), r'falloff: .* function "misspelled" .*/extending.md\.$'),
    ],
)
def test_what_is_no_falloff_is_refused(make, message):
    refusal(make, match=message)


@wp.func
def misspelled(q: Any):
    return wp.expp(-q)


@wp.func
def doubled(q: Any):
    return fall(q) + fall(q)


@wp.func
def rising(q: Any):
    return fall(-q)


@wp.func
def too_near(x: float):
    return 0.5 * reach(x)


@pytest.mark.parametrize(
    ("falloff", "message"),
    [
        (heavy_tails, None),
        (Falloff(doubled, reach), "options.falloff.fall: expected 1 at q = 0, got 2;"),
        (Falloff(rising, reach), "falloff.fall: expected a finite number, at most 1 as nearer to the mean, at q"),
        (Falloff(fall, too_near), "options.falloff.reach: expected the q where fall .* got 0.5 for x = 2, around"),
    ],
    ids=["right", "doubled", "rising", "too near"],
)
def test_what_is_none_is_found(falloff, message):
    check = lambda: _check_falloff(falloff, torch.device("cpu"))  # noqa: E731
    refusal(check, match=message) if message else check()


@wp.func
def cubic(q: Any):
    one = fill(1.0, q)
    inverse = over(one, one + q / 3.0)
    return times(inverse, times(inverse, inverse))


@wp.func
def cubic_reach(x: float):
    return 3.0 * (wp.pow(x, 1.0 / 3.0) - 1.0)


@pytest.mark.parametrize("cuts", [{"tolerance": 1e-3}, {"alpha_min": 2e-6}], ids=str)
def test_the_bound_of_one_that_falls_slowly(cuts):
    """Against all that can be drawn; far away, hundreds count."""
    random = torch.Generator().manual_seed(0)
    camera, falloff = make_camera(400, 40, fx=100.0, seed=None), Falloff(cubic, cubic_reach)
    means = 0.1 * torch.randn(300, 3, generator=random) + torch.tensor([-1.5, 0.0, 4.0])
    quats, sh = torch.randn(300, 4, generator=random), 1.7 * torch.rand(300, 1, 3, generator=random)
    given = means, quats, torch.full((300, 3), 0.03), torch.full((300,), 0.985), sh, camera
    options = RasterOptions(falloff=falloff, t_min=0.0, alpha_min=1e-12)
    exact = rasterize(*given, adjoint="stepwise", options=options).image
    out = rasterize(*given, adjoint="stepwise", options=replace(options, bound=True, **{"alpha_min": 1 / 255, **cuts}))
    error = (out.image - exact).abs().amax(2)
    assert error.max() > 1e-4 and (error <= out.bound + 1e-5).all()


def test_it_is_the_one_of_the_page():
    assert (ROOT / "tests/heavy_tails.py").read_text() in (ROOT / "docs/extending.md").read_text()

"""The projection of sixteen Gaussians side by side, against that of one at a time, as on a GPU."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from warp_splat import InputError, rasterize
from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.kernels.harmonics import C0, C1
from warp_splat.kernels.project import Projection
from warp_splat.kernels.project.ellipsoid import make_lens, make_outline
from warp_splat.raster import project as projection
from warp_splat.raster.data import Gaussians, Splats2D
from warp_splat.raster.drivers import CPU

CAMERA = Camera(70, 53, 60.0, 55.0, 30.0, 27.0, np.eye(3), np.zeros(3))
OPTIONS = {
    "plain": RasterOptions(),
    "antialiased": RasterOptions(antialiasing=True),
    "ellipsoid": RasterOptions(projection="ellipsoid"),
    "degree 1": RasterOptions(sh_degree=1),
}


def gaussians(count, coefficients=15):
    """Of degree 3 or less, some behind the camera, beside the image, too faint, or not finite."""
    generator = torch.Generator().manual_seed(count)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    means = 1.5 * normal(count, 3) + torch.tensor([0.0, 0.0, 2.5])
    quats, scales = normal(count, 4), torch.exp(normal(count, 3) - 3.0)
    opacities = torch.rand(count, generator=generator) ** 3
    sh_dc, sh_rest = normal(count, 1, 3), 0.3 * normal(count, coefficients, 3)
    if count > 16:
        means[:7] = torch.tensor([0.0, 0.0, 3.0])
        opacities[:7] = 1.0
        quats[1] = 0.0
        scales[2] = 1.0e30  # too large on the image
        means[3, 1] = torch.nan
        sh_rest[4, :1, 0] = torch.inf
        quats[5] = torch.tensor([3.0e38, 3.0e38, 0.0, 0.0])  # of any norm
        means[6] = torch.tensor([-2.0e38, -2.0e38, -1.0e38])  # behind the camera
    return Gaussians(means, quats, scales, opacities, sh_dc, sh_rest)


def project(count, options, sets=1, left_out=None, spread=False, coefficients=15, driver=CPU):
    """Splats, and gradients of their random weighting, which is ``left_out`` for those not drawn.

    Gradients are asked for ``sets`` times; ``spread``: no tensor is contiguous.
    """
    inputs = [tensor.requires_grad_() for tensor in gaussians(count, coefficients)]
    given = [torch.stack([tensor, tensor], -1)[..., 0] for tensor in inputs] if spread else inputs
    splats = projection.project(Gaussians(*given), CAMERA, options, driver)
    outputs = splats[:5]  # what has gradients
    generator = torch.Generator().manual_seed(1)
    upstream = [torch.randn(output.shape, generator=generator) for output in outputs]
    if left_out is not None:
        for tensor in upstream:
            tensor[splats.radii <= 0] = left_out
    grads = [torch.autograd.grad(outputs, inputs, upstream, retain_graph=True) for _ in range(sets)]
    return Splats2D(*(output.detach() for output in splats)), [Gaussians(*found) for found in grads]


@pytest.mark.parametrize("name", OPTIONS)
@pytest.mark.parametrize(
    ("count", "coefficients"), [(0, 15), (1, 15), (15, 15), (16, 15), (17, 15), (100, 15), (99, 0), (99, 3), (99, 8)]
)
def test_sixteen_and_one_agree(count, coefficients, name):
    outputs, (grads,) = project(count, OPTIONS[name], coefficients=coefficients)
    single, (single_grads,) = project(count, OPTIONS[name], coefficients=coefficients, driver=replace(CPU, lanes=1))
    torch.testing.assert_close(outputs.radii, single.radii, rtol=0, atol=0)
    if count == 100:
        assert (outputs.radii > 0).sum() > 20 and (outputs.radii == 0).sum() > 20
        # what reaches the camera's plane is left out as an ellipsoid before it is too large
        assert outputs.radii[:7].sign().tolist() == [1, -1, 0 if name == "ellipsoid" else -1, -1, -1, 1, 0]
    for found, wanted in zip((*outputs[:-1], *grads), (*single[:-1], *single_grads), strict=True):
        largest = float(wanted.abs().max()) if wanted.numel() else 0.0
        torch.testing.assert_close(found, wanted, rtol=2e-5, atol=1e-6 * largest)


@pytest.mark.parametrize("name", OPTIONS)
def test_those_left_out_have_no_influence(name):
    """Nor do their neighbors see what comes from upstream for them."""
    outputs, (grads,) = project(100, OPTIONS[name], left_out=0.0)
    left_out = outputs.radii <= 0
    _, (others,) = project(100, OPTIONS[name], left_out=torch.nan)
    torch.testing.assert_close(grads, others, rtol=0, atol=0)
    for tensor in (*outputs[:-1], *grads):
        assert not tensor[left_out].any()


def test_a_color_is_finite_even_if_the_sum_of_its_channels_is_not():
    given = gaussians(1)
    given.means[0], given.opacities[0] = torch.tensor([0.0, 0.0, 3.0]), 1.0
    given.sh_dc[0], given.sh_rest[0, 1] = 3.4e38, 2.0e38
    outputs = projection.project(given, CAMERA, OPTIONS["plain"])
    assert outputs.radii[0] > 0
    torch.testing.assert_close(outputs.colors, torch.full((1, 3), 3.4e38 * C0 + 2.0e38 * C1))


@pytest.mark.parametrize("exponent", [-100, -60, -31, -30, -29, 29, 30, 31, 60, 100])
def test_quaternions_of_any_norm(exponent):
    """A power of two: the same Gaussian, bit for bit, and the gradient times its inverse."""
    given = gaussians(16)

    def derived(factor):
        quats = (factor * given.quats).requires_grad_()
        outputs = projection.project(given._replace(quats=quats), CAMERA, OPTIONS["plain"])
        return outputs, torch.autograd.grad(outputs.conics.sum(), quats)[0]

    outputs, grad = derived(1.0)
    scaled, scaled_grad = derived(2.0**exponent)
    assert (outputs.radii > 0).sum() > 3
    torch.testing.assert_close(scaled, outputs, rtol=0, atol=0)
    torch.testing.assert_close(scaled_grad * 2.0**exponent, grad, rtol=1e-6, atol=0)


@pytest.mark.parametrize("degree", [0, 1])
def test_inactive_degrees_have_no_gradient(degree):
    torch.full((100, 15, 3), torch.nan)  # what the next tensor of that size may find in memory
    _, (grads,) = project(100, RasterOptions(sh_degree=degree))
    assert grads.sh_rest[:, :3].any() == (degree > 0) and not grads.sh_rest[:, (degree + 1) ** 2 - 1 :].any()


@pytest.mark.parametrize("center", [(1e6 + 0.3, -2e6 + 0.7, 3e6 + 0.1), (5e5 + 0.01, 4e6 + 0.13, 100.0)])
def test_colors_far_from_the_origin(center):
    """Where float32 knows a camera's place to a quarter of a unit, colors are those of float64 all the same."""
    center = torch.tensor(center, dtype=torch.float64)
    camera = Camera(70, 53, 60.0, 55.0, 30.0, 27.0, np.eye(3), -center.numpy())
    generator = torch.Generator().manual_seed(2)
    means = (center + torch.randn(50, 3, generator=generator) + torch.tensor([0.0, 0.0, 4.0])).float()
    sh = torch.randn(50, 4, 3, generator=generator)
    still = (torch.tensor([[1.0, 0, 0, 0]]).repeat(50, 1), torch.full((50, 3), 0.1), torch.ones(50))
    given = Gaussians(means.requires_grad_(), *still, sh[:, :1], sh[:, 1:])
    outputs = projection.project(given, camera, RasterOptions())
    weights = torch.randn(50, 3, generator=generator)
    (grad,) = torch.autograd.grad(outputs.colors, means, weights)
    exact = means.detach().double().requires_grad_()
    x, y, z = torch.nn.functional.normalize(exact - center, dim=1).unbind(1)
    functions = torch.stack([torch.full_like(x, C0), -C1 * y, C1 * z, -C1 * x], 1)
    colors = torch.relu(torch.einsum("nk,nkc->nc", functions, sh.double()) + 0.5) * (outputs.radii > 0)[:, None]
    (wanted,) = torch.autograd.grad(colors, exact, weights.double())
    assert (outputs.radii > 0).sum() > 20
    assert (outputs.colors - colors).abs().max() < 1e-5
    assert (grad - wanted).norm() < 1e-5 * wanted.norm()


def test_gradients_can_be_asked_for_twice():
    _, (first, second) = project(37, OPTIONS["plain"], sets=2)
    torch.testing.assert_close(second, first, rtol=0, atol=0)


def test_inputs_need_not_be_contiguous():
    outputs, (grads,) = project(40, OPTIONS["plain"])
    others, (other_grads,) = project(40, OPTIONS["plain"], spread=True)
    torch.testing.assert_close((others, other_grads), (outputs, grads), rtol=0, atol=0)


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ((3.0,), "lens: expected a function of the lanes .* of 4 arguments, got 3.0; see docs/extending.md."),
        ((make_lens(16),), "lens: expected a function of the lanes .* of 4 arguments, got <Function .*; see"),
        ((lambda lanes: 3.0,), "lens: expected .*, got one that makes 3.0; see"),
        ((make_outline,), "lens: expected .* of 4 arguments, got one that makes <Function"),
        ((make_lens, lambda lanes: None), "outline: expected .* of 17 arguments, got one that makes None; see"),
    ],
)
def test_what_is_no_projection_is_refused(members, message):
    *geometry, sh_dc, _ = gaussians(1)
    with pytest.raises(InputError, match=f"Projection.{message}"):
        rasterize(*geometry, sh_dc, CAMERA, options=RasterOptions(projection=Projection(*members)))

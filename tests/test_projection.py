"""The projection of sixteen Gaussians side by side, against that of one at a time, as on a GPU."""

import numpy as np
import pytest
import torch

from warp_splat import projection
from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.projection import Project, camera_view
from warp_splat.renderer import Dropped

CAMERA = Camera(70, 53, 60.0, 55.0, 30.0, 27.0, np.eye(3), np.zeros(3))
OPTIONS = {
    "plain": RasterOptions(),
    "antialiased": RasterOptions(antialiasing=True),
    "ellipsoid": RasterOptions(projection="ellipsoid"),
    "degree 1": RasterOptions(sh_degree=1),
}


def gaussians(count):
    """Of degree 2, some behind the camera, beside the image, too faint, or not finite."""
    generator = torch.Generator().manual_seed(count)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    means = 1.5 * normal(count, 3) + torch.tensor([0.0, 0.0, 2.5])
    quats, scales = normal(count, 4), torch.exp(normal(count, 3) - 3.0)
    opacities = torch.rand(count, generator=generator) ** 3
    sh_dc, sh_rest = normal(count, 1, 3), 0.3 * normal(count, 8, 3)
    if count > 16:
        quats[1] = 0.0
        scales[2] = 3.0e38
        means[3, 1] = torch.nan
        sh_rest[4, 0, 0] = torch.inf
        means[4] = torch.tensor([0.0, 0.0, 3.0])
        opacities[4] = 1.0
    return means, quats, scales, opacities, sh_dc, sh_rest


def project(count, options, sets=1):
    """Outputs, and gradients of their random weighting (asked for ``sets`` times)."""
    inputs = [tensor.requires_grad_() for tensor in gaussians(count)]
    outputs = Project.apply(*inputs, camera_view(CAMERA, 8, options), Dropped())
    generator = torch.Generator().manual_seed(1)
    upstream = [torch.randn(output.shape, generator=generator) for output in outputs[:5]]
    grads = [torch.autograd.grad(outputs[:5], inputs, upstream, retain_graph=True) for _ in range(sets)]
    return [output.detach() for output in outputs], grads


@pytest.mark.parametrize("name", OPTIONS)
@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 100])
def test_sixteen_and_one_agree(count, name, monkeypatch):
    outputs, (grads,) = project(count, OPTIONS[name])
    monkeypatch.setattr(projection, "LANES", 1)
    single, (single_grads,) = project(count, OPTIONS[name])
    torch.testing.assert_close(outputs[6], single[6], rtol=0, atol=0)
    if count == 100:
        assert (outputs[6] > 0).sum() > 20 and (outputs[6] == 0).sum() > 20 and (outputs[6] == -1).sum() == 4
    for found, wanted in zip((*outputs[:6], *grads), (*single[:6], *single_grads), strict=True):
        torch.testing.assert_close(found, wanted, rtol=2e-5, atol=1e-6 * float(wanted.abs().max() if count else 0))


def test_gradients_of_those_left_out_are_zero():
    outputs, (grads,) = project(100, OPTIONS["plain"])
    left_out = outputs[6] <= 0
    for tensor in (*outputs[:6], *grads):
        assert not tensor[left_out].any()


def test_gradients_can_be_asked_for_twice():
    _, (first, second) = project(37, OPTIONS["plain"], sets=2)
    for found, wanted in zip(second, first, strict=True):
        torch.testing.assert_close(found, wanted, rtol=0, atol=0)


def test_inputs_need_not_be_contiguous():
    inputs = gaussians(40)
    spread = [torch.stack([tensor, tensor], -1)[..., 0] for tensor in inputs]
    view = camera_view(CAMERA, 8, RasterOptions())
    for found, wanted in zip(
        Project.apply(*spread, view, Dropped()), Project.apply(*inputs, view, Dropped()), strict=True
    ):
        torch.testing.assert_close(found, wanted, rtol=0, atol=0)

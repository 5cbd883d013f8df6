"""Harmonics behind the Gaussians: against float64, and the same bytes for any number of threads."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from warp_splat.camera import Camera
from warp_splat.compare.oracle import sh_basis
from warp_splat.lenses import Lens
from warp_splat.raster.behind import put_behind
from warp_splat.raster.drivers import CPU, CUDA, using
from warp_splat.runtime import pool

FISHEYE = Lens("OPENCV_FISHEYE", (0.01, 0.0, 0.0, 0.0))


def made(width, height, focal, lens=None):
    """A camera, and image, alpha, harmonics and an upstream gradient."""
    rotation, random = Rotation.from_rotvec([0.3, 0.9, -0.4]).as_matrix(), torch.Generator().manual_seed(1)
    camera = Camera(width, height, focal, 1.1 * focal, 0.5 * width + 1, 0.5 * height - 2, rotation, np.ones(3), lens)
    image, upstream = (torch.rand(height, width, 3, generator=random) for _ in range(2))
    alpha = torch.rand(height, width, generator=random)
    harmonics = 0.7 * torch.randn(16, 3, generator=random)
    return camera, [leaf.requires_grad_() for leaf in (image, alpha, harmonics)], upstream


def exact(camera, image, alpha, harmonics):
    """In float64, by the oracle's harmonics."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.rays(np.stack([x.ravel(), y.ravel()], 1))
    seen = torch.from_numpy(np.isfinite(rays).all(1)).view(alpha.shape)
    basis = sh_basis(torch.from_numpy(np.nan_to_num(rays) @ camera.rotation), 3)
    colors = (0.5 + basis @ harmonics).clamp_min(0.0).view(image.shape)
    return image + (seen * (1.0 - alpha))[..., None] * colors, seen


@pytest.mark.parametrize("driver", [CPU, CUDA], ids=["lanes", "fibers"])
@pytest.mark.parametrize(("size", "lens"), [((37, 31), None), ((5, 3), None), ((64, 48), FISHEYE)], ids=str)
def test_image_and_gradients_are_those_of_float64(size, lens, driver):
    """Some colors are cut to 0; the fisheye leaves corners unseen."""
    camera, leaves, upstream = made(*size, 8.0, lens)
    wide = [leaf.detach().double().requires_grad_() for leaf in leaves]
    expected, seen = exact(camera, *wide)
    with using(driver):
        found = put_behind(*leaves, camera)
        gradients = torch.autograd.grad(found, leaves, upstream)
    assert bool(seen.all()) == (lens is None)
    torch.testing.assert_close(found.double(), expected, rtol=0.0, atol=3e-6)
    for gradient, right in zip(gradients, torch.autograd.grad(expected, wide, upstream.double()), strict=True):
        assert (gradient - right).norm() < 3e-6 * right.norm()


def test_threads_change_nothing():
    camera, leaves, upstream = made(211, 130, 90.0)
    before, found = pool.get_threads(), []
    for threads in (1, 2, 3):
        pool.set_threads(threads)
        image = put_behind(*leaves, camera)
        found.append([image, *torch.autograd.grad(image, leaves, upstream)])
    pool.set_threads(before)
    assert all(torch.equal(one, other) for row in found[1:] for one, other in zip(found[0], row, strict=True))


def test_a_pixel_that_is_not_finite_spoils_no_coefficient():
    camera, leaves, upstream = made(37, 31, 8.0)
    upstream[3, 4] = torch.inf
    assert all(
        torch.isfinite(gradient).all()
        for gradient in torch.autograd.grad(put_behind(*leaves, camera), leaves[2:], upstream)
    )

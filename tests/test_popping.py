"""What another order of overlapping Gaussians changes: orders exchanged one by one, in float64, against the bound."""

import pytest
import torch

from warp_splat.compare import oracle
from warp_splat.compare.scenes import cloud, look, tensors
from warp_splat.config import RasterOptions
from warp_splat.raster.api import render
from warp_splat.raster.data import Gaussians
from warp_splat.rendering import popping
from warp_splat.rendering.popping import popping_of


def scene(seed, count, sigma, camera):
    arrays = cloud(seed, count, camera, sigma=sigma, opacity=(0.3, 1.0), aspect=0.3)
    return Gaussians(**{name: rows for name, rows in tensors(arrays).items() if name in Gaussians._fields})


def seen_by(gaussians, camera):
    """Alphas [P, N] and colors [N, 3] nearest first, depths, and deviations along the camera's axis."""
    double = [tensor.double() for tensor in gaussians]
    sh = torch.cat([double[4], double[5]], 1)
    splats = oracle.exact_splats(*double[:4], sh, camera)
    order = torch.sort(splats.z, stable=True).indices
    pixels = torch.cartesian_prod(torch.arange(camera.height), torch.arange(camera.width))
    raw, _ = oracle._alphas(splats, order, camera, pixels)
    alphas = torch.where(raw < oracle.ALPHA_MIN, 0.0, raw.clamp_max(oracle.ALPHA_MAX))
    axis = torch.as_tensor(camera.rotation[2], dtype=torch.float64)
    along = (axis @ oracle.covariances(double[1], double[2]) @ axis).sqrt()
    return alphas, splats.color[order], splats.z[order], along[order]


def blended(alphas, colors, order):
    alphas, colors = alphas[:, order], colors[order]
    through = torch.cumprod(1.0 - alphas, 1)
    front = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], 1)
    return (alphas * front) @ colors


@pytest.mark.parametrize(("seed", "count", "sigma"), [(0, 12, (2.0, 9.0)), (1, 40, (1.0, 5.0)), (2, 6, (5.0, 20.0))])
def test_no_order_of_those_that_overlap_changes_more(seed, count, sigma, monkeypatch):
    monkeypatch.setattr(popping, "AT_ONCE", 5)  # lists are compared in parts
    camera = look(40, 36)
    gaussians = scene(seed, count, sigma, camera)
    found = popping_of(gaussians, camera, RasterOptions()).flatten().double()
    alphas, colors, depths, along = seen_by(gaussians, camera)
    first, generator = blended(alphas, colors, list(range(count))), torch.Generator().manual_seed(seed)
    order, exchanged, worst = list(range(count)), set(), torch.zeros_like(found)
    for _ in range(400):
        place = int(torch.randint(0, count - 1, (1,), generator=generator))
        pair = tuple(sorted(order[place : place + 2]))
        if abs(depths[pair[0]] - depths[pair[1]]) < along[pair[0]] + along[pair[1]]:
            order[place], order[place + 1] = order[place + 1], order[place]
            exchanged.add(pair)
            worst = torch.maximum(worst, (blended(alphas, colors, order) - first).abs().amax(1))
    assert exchanged and worst.max() > 1e-3
    assert (worst <= found + 1e-6).all()


def test_of_two_it_is_what_exchanging_them_changes():
    camera = look(40, 36)
    gaussians = scene(4, 2, (6.0, 7.0), camera)
    gaussians = gaussians._replace(means=gaussians.means[:1] + torch.tensor([[0.0, 0.0, 0.0], [0.02, 0.0, 0.01]]))
    alphas, colors, depths, along = seen_by(gaussians, camera)
    assert (depths[0] - depths[1]).abs() < along.sum()
    change = (blended(alphas, colors, [0, 1]) - blended(alphas, colors, [1, 0])).abs().amax(1)
    found = popping_of(gaussians, camera, RasterOptions()).flatten().double()
    assert (found - change).abs().max() < 1e-3 * change.max()


def test_within_a_tolerance_what_is_too_faint_for_the_usual_cut_counts():
    """Wide layers close to each other, dark before bright and the other way round."""
    camera, count, options = look(40, 36), 400, RasterOptions(tolerance=0.01)
    gaussians = Gaussians(*(tensor[:1].expand(count, *tensor.shape[1:]) for tensor in scene(4, 2, (6.0, 7.0), camera)))
    forward = torch.tensor(camera.rotation[2], dtype=torch.float32)
    means = gaussians.means + torch.linspace(0.0, 1e-3, count)[:, None] * forward
    dark = torch.where(torch.arange(count) < count // 2, -1.7, 1.7)[:, None, None].expand(count, 1, 3)
    gaussians = gaussians._replace(means=means, sh_dc=dark, opacities=torch.full((count,), 0.0039))
    orders = (gaussians._replace(means=order) for order in (means, means.flip(0)))
    first, second = (render(given, camera, torch.zeros(3), options).image for given in orders)
    change = (first - second).abs().amax(2)
    assert 0.1 < change.max() and (change <= popping_of(gaussians, camera, options) + 1e-3).all()


def test_apart_nothing_changes():
    camera = look(40, 36)
    gaussians = scene(4, 2, (6.0, 7.0), camera)
    forward = torch.as_tensor(camera.rotation[2], dtype=torch.float32) * 10.0 * gaussians.scales.max()
    gaussians = gaussians._replace(means=torch.stack([gaussians.means[0], gaussians.means[0] + forward]))
    assert popping_of(gaussians, camera, RasterOptions()).max() == 0.0

"""Gaussians behind an opaque surface: an oracle of a plane and three splats, and the whole renderer against float64."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import C0, SCENES

import warp_splat
from warp_splat import Camera, InputError, RasterOptions
from warp_splat.compare.oracle import exact_render
from warp_splat.config import ADJOINTS

CAMERA = Camera(40, 24, 30.0, 30.0, 20.0, 12.0, np.eye(3), np.zeros(3))
DEPTHS, OPACITIES = (2.0, 3.0, 5.0), (0.5, 0.6, 0.9)
COLORS = np.float32([[1, 0, 0], [0, 1, 0], [0, 0, 1]])


def three():
    """Splats so large that they have one opacity in the whole picture."""
    means = torch.tensor([[0.0, 0.0, z] for z in DEPTHS])
    scales = torch.tensor([[900.0, 900.0, 1e-3]]).repeat(3, 1)
    sh = torch.from_numpy((COLORS - 0.5) / C0)[:, None]
    return means, torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1), scales, torch.tensor(OPACITIES), sh


def test_a_plane_and_three_splats(driver):
    """A slanted plane, nearer on the right; no plane in the first columns."""
    surface = np.linspace(6.0, 1.0, CAMERA.width, dtype=np.float32)[None].repeat(CAMERA.height, 0)
    surface[:, :3], surface[:, 3:5] = 0.0, np.nan
    options = RasterOptions(depth=True, strongest=1, hidden_from=torch.from_numpy(surface))
    out = warp_splat.rasterize(*three(), CAMERA, options=options)
    for x in range(CAMERA.width):
        color, light, sum_z, strongest = np.zeros(3), 1.0, 0.0, (0.0, -1)
        for number, (z, opacity) in enumerate(zip(DEPTHS, OPACITIES, strict=True)):
            if not (surface[0, x] > 0 and z >= surface[0, x]):
                color, sum_z = color + light * opacity * COLORS[number], sum_z + light * opacity * z
                strongest = max(strongest, (light * opacity, number))
                light *= 1 - opacity
        np.testing.assert_allclose(out.image[:, x], color[None].repeat(CAMERA.height, 0), atol=2e-4)
        np.testing.assert_allclose(out.alpha[:, x], 1 - light, atol=2e-4)
        np.testing.assert_allclose(out.depth[:, x], sum_z / max(1 - light, 1e-10), rtol=3e-4)
        assert (out.strongest[:, x, 0] == strongest[1]).all()


def half_hidden():
    """A scene, a surface at the median depth of its Gaussians, and which are in front."""
    scene = SCENES["degree1"]()
    depths = warp_splat.rasterize(*scene.parameters(), scene.camera).depths
    limit = float(depths[depths > 0].median())
    return scene, torch.full((scene.camera.height, scene.camera.width), limit), depths < limit


@pytest.mark.parametrize("mode", ADJOINTS)
def test_one_depth_for_all_is_a_scene_without_what_is_behind(mode, driver):
    """Image and gradients, by any adjoint, are those of the Gaussians in front alone."""
    (scene, surface, front), found = half_hidden(), []
    for hides, kept in ((surface, slice(None)), (None, front)):
        options = RasterOptions(depth=True, hidden_from=hides)
        leaves = [tensor.clone().requires_grad_() for tensor in scene.parameters()]
        out = warp_splat.rasterize(*(leaf[kept] for leaf in leaves), scene.camera, scene.background, mode, options)
        weights = torch.linspace(0, 1, out.image.numel()).view_as(out.image)
        ((out.image * weights).sum() + out.alpha.sum() + out.depth.mean()).backward()
        found.append([out.image.detach(), out.alpha.detach(), *(leaf.grad for leaf in leaves)])
    assert 0.1 < out.alpha.mean() < 0.99
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other) or (one - other).norm() < 1e-6 * other.norm()


def test_the_scene_in_front_agrees_with_float64():
    scene, surface, front = half_hidden()
    out = warp_splat.rasterize(*scene.parameters(), scene.camera, options=RasterOptions(hidden_from=surface))
    exact = exact_render(*(tensor[front].double() for tensor in scene.parameters()), scene.camera, torch.zeros(3))
    assert (out.image - exact.image).abs().max() < 1e-4


def test_what_hides_is_checked():
    surface = torch.ones(24, 40)
    for options, sentence in (
        (RasterOptions(hidden_from=surface[1:]), r"options.hidden_from: expected shape \[24, 40\], got \[23, 40\]"),
        (RasterOptions(hidden_from=surface, bound=True), "neither bound nor tolerance"),
        (replace(RasterOptions(hidden_from=surface), tolerance=0.1), "neither bound nor tolerance"),
        (RasterOptions(tolerance=-1.0), "options.tolerance: expected numbers above 0"),
        (RasterOptions(tolerance=surface.to_sparse()), "options.tolerance: expected a dense tensor"),
        (RasterOptions(tolerance=surface.to("meta")), "options.tolerance: expected a tensor on the CPU"),
    ):
        for call in (warp_splat.rasterize, warp_splat.check_gradients):
            with pytest.raises(InputError, match=sentence):
                call(*three(), CAMERA, options=options)

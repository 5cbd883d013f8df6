"""What is blended beside the color, on both drivers: against float64, and one channel against many."""

import functools
from dataclasses import replace

import pytest
import torch
import warp as wp
from hostile import refusal
from scenes import PARAMETERS, SCENES, cloud, make_camera
from test_rasterize import GRADIENT, IMAGE_MAX, relative_error

import warp_splat
from warp_splat import RasterOptions, rasterize_views, tape
from warp_splat.compare import oracle
from warp_splat.raster.drivers import CUDA

ALL = RasterOptions(normals=True, median_depth=True, strongest=3)
NARROW = 1e-3  # of a transmittance around 1/2, or of two weights: float32 may decide otherwise


def features_of(scene, channels, seed=0):
    return torch.randn(len(scene.means), channels, generator=torch.Generator().manual_seed(seed))


def leaves_of(scene, features, kind=torch.float32):
    return [tensor.to(kind).clone().requires_grad_() for tensor in (*scene.parameters(), features)]


def render(scene, leaves, options=None, adjoint="manual"):
    return warp_splat.rasterize(*leaves[:5], scene.camera, scene.background, adjoint, options, features=leaves[5])


@functools.cache
def truth(name):
    """Leaves in float64, and what every pixel should be, by name."""
    scene = SCENES[name]()
    leaves = leaves_of(scene, features_of(scene, 5), torch.float64)
    exact = oracle.exact_render(*leaves[:5], scene.camera)
    weights, order = exact.weights, exact.order
    center, axes = torch.tensor(scene.camera.center), oracle.rotation_matrices(leaves[1])
    normals = axes[torch.arange(len(axes)), :, leaves[2].argmin(1)]
    normals = normals * -((normals * (leaves[0] - center)).sum(1, keepdim=True)).sign().detach()
    after = 1 - weights.cumsum(2)
    crossed = (after <= 0.5).double().argmax(2)
    median = torch.where((after <= 0.5).any(2), exact.splats.z[order[crossed]], 0)
    strong = weights.topk(min(4, weights.shape[2]), 2)
    sure = ~exact.fragile & ((after - 0.5).abs().amin(2) > NARROW)
    sure &= (strong.values[..., :-1] - strong.values[..., 1:]).amin(2) > NARROW * 1e-2
    shown = {"features": weights @ leaves[5][order], "normals": weights @ normals[order], "median_depth": median}
    shown["planes"] = weights @ (normals * (leaves[0] - center)).sum(1, keepdim=True)[order]
    shown["strongest_weights"] = strong.values[..., :3]
    return leaves, shown, order[strong.indices[..., :3]], sure


@pytest.mark.parametrize("adjoint", ["manual", pytest.param("stored", marks=pytest.mark.long)])
@pytest.mark.parametrize("name", ["degree1", "saturated"])
def test_all_channels_against_float64(name, adjoint, driver):
    exact, shown, order, sure = truth(name)
    assert sure.double().mean() > 0.8
    scene = SCENES[name]()
    leaves = leaves_of(scene, features_of(scene, 5))
    out = render(scene, leaves, ALL, adjoint)
    assert torch.equal(out.strongest[sure], order[sure])
    for index, (key, wanted) in enumerate(shown.items()):
        found = getattr(out, key)
        assert (found - wanted)[sure].abs().max() < IMAGE_MAX * (10 if key == "median_depth" else 1), key
        upstream = torch.randn(found.shape, generator=torch.Generator().manual_seed(index))
        upstream[~sure] = 0
        inputs, exact_inputs = ([*given[:4], given[5]] for given in (leaves, exact))  # all but the harmonics
        gradients = torch.autograd.grad(found, inputs, upstream, retain_graph=True, allow_unused=True)
        expected = torch.autograd.grad(wanted, exact_inputs, upstream.double(), retain_graph=True, allow_unused=True)
        for one, other in zip(gradients, expected, strict=True):
            if one is None:
                assert other is None or not other.any(), key
            else:
                assert relative_error(one, other if other is not None else torch.zeros_like(one)) < GRADIENT


def test_many_channels_are_those_of_one_alone(driver):
    """37: two groups on a CPU, three on a GPU. Geometry's gradients are the sum of all."""
    scene = SCENES["degree1"]()
    features = features_of(scene, 37)
    upstream = features_of(scene, 37 * 100, 1).flatten()[: scene.camera.height * scene.camera.width * 37]
    upstream = upstream.view(scene.camera.height, scene.camera.width, 37)
    together = leaves_of(scene, features)
    image = render(scene, together).features
    image.backward(upstream)
    summed = torch.zeros_like(scene.means, dtype=torch.float64)
    for channel in (0, 31, 36) if driver is CUDA else range(37):
        alone = leaves_of(scene, features[:, channel : channel + 1])
        found = render(scene, alone).features
        assert torch.equal(found[..., 0], image[..., channel])
        found.backward(upstream[..., channel : channel + 1])
        assert torch.equal(alone[5].grad[:, 0], together[5].grad[:, channel])
        summed += alone[0].grad
    assert driver is CUDA or relative_error(together[0].grad, summed) < 1e-5


def test_color_is_the_same_beside_channels(driver):
    scene = SCENES["dense_tile"]()
    leaves = leaves_of(scene, features_of(scene, 512))
    out = render(scene, leaves, ALL)
    alone = warp_splat.rasterize(*scene.parameters(), scene.camera, scene.background)
    assert torch.equal(out.image, alone.image) and torch.equal(out.alpha, alone.alpha)
    assert alone.features is alone.normals is alone.median_depth is alone.strongest is alone.strongest_weights is None
    assert out.features.shape == (*out.alpha.shape, 512) and out.strongest.shape == (*out.alpha.shape, 3)


def test_the_same_bits_for_any_number_of_threads(same_by_threads):
    scene = cloud(3, 4000, make_camera(200, 150))

    def everything():
        leaves = leaves_of(scene, features_of(scene, 3))
        out = render(scene, leaves, ALL)
        (out.features.sum() + out.normals.sum() + out.median_depth.sum() + out.strongest_weights.sum()).backward()
        return [out.features, out.median_depth, out.strongest, *(leaf.grad for leaf in leaves if leaf.grad is not None)]

    same_by_threads(everything)


def test_pixels_that_are_not_finite_are_dropped(driver):
    scene, found = SCENES["degree1"](), []
    for value in (0.0, float("nan")):
        leaves = leaves_of(scene, features_of(scene, 4))
        out = render(scene, leaves)
        upstream = torch.ones_like(out.features)
        upstream[5, 7, 1] = value
        upstream[5, 7, [0, 2, 3]] = 0.0
        out.features.backward(upstream)
        assert out.dropped.pixels == (value != 0.0)
        found.append([leaf.grad for leaf in leaves if leaf.grad is not None])
    assert all(map(torch.equal, *found))


@pytest.mark.parametrize("name", ["empty", "size_1x1", "single", "empty panorama"])
def test_small_scenes(name, driver):
    scene, *cameras = (SCENES[word]() for word in name.split())
    scene = replace(scene, camera=cameras[0].camera) if cameras else scene
    leaves = leaves_of(scene, features_of(scene, 2))
    out = render(scene, leaves, ALL)
    (out.features.sum() + out.normals.sum() + out.median_depth.sum() + out.strongest_weights.sum()).backward()
    assert (out.strongest < len(scene.means)).all() and leaves[5].grad.shape == (len(scene.means), 2)
    assert ((out.strongest < 0) == (out.strongest_weights == 0)).all()
    assert ((out.median_depth > 0) <= (out.alpha > 0.49)).all()


def test_several_views_and_the_tape(device):
    scene = SCENES["degree1"]().to(device)
    features = features_of(scene, 3).to(device)
    leaves = leaves_of(scene, features)
    views = rasterize_views(*leaves[:5], [scene.camera] * 2, options=ALL, features=leaves[5])
    assert torch.equal(views[0].features, views[1].features)
    kinds = dict(zip(PARAMETERS, (wp.vec3, wp.vec4, wp.vec3, wp.float32, wp.vec3), strict=True))
    arrays = {name: wp.from_torch(getattr(scene, name), kind, requires_grad=True) for name, kind in kinds.items()}
    arrays["features"] = wp.from_torch(features, requires_grad=True)
    with wp.Tape() as recorded:
        out = tape.rasterize(**arrays, camera=scene.camera, options=ALL)
    assert out.normals.dtype == wp.vec3 and torch.equal(wp.to_torch(out.strongest), views[0].strongest)
    shown = ("features", "normals", "median_depth", "strongest_weights")
    upstream = {name: torch.randn(getattr(views[0], name).shape).to(device) for name in shown}
    torch.autograd.backward([getattr(views[0], name) for name in shown], list(upstream.values()))
    grads = {getattr(out, name): wp.from_torch(upstream[name], tape.PIXELS[name]) for name in shown}
    recorded.backward(grads=grads)
    for leaf, array in zip(leaves, arrays.values(), strict=True):
        assert leaf.grad is None or torch.equal(leaf.grad, wp.to_torch(array.grad))


@pytest.mark.parametrize(
    ("features", "options", "found"),
    [
        (torch.zeros(120, 0), None, r"features: expected 1 to 512 channels, got 0\."),
        (torch.zeros(120, 513), None, r"features: expected 1 to 512 channels, got 513\."),
        (torch.zeros(119, 2), None, r"features: expected shape \[120, C\], got \[119, 2\]\."),
        (torch.zeros(120), None, r"features: expected shape \[120, C\], got \[120\]\."),
        (torch.zeros(120, 2).double(), None, "features: expected float32, got float64"),
        (torch.full((120, 2), torch.nan), None, "features: expected finite numbers"),
        ([[0.0]] * 120, None, "features: expected a float32 torch tensor"),
        (None, RasterOptions(strongest=9), r"options.strongest: expected a whole number, 0 to 8, got 9\."),
        (None, RasterOptions(strongest=True), "options.strongest: expected a whole number"),
        (None, RasterOptions(normals=1), "options.normals: expected True or False, got 1"),
    ],
)
def test_bad_input(features, options, found):
    scene = SCENES["degree1"]()
    call = functools.partial(warp_splat.rasterize, *scene.parameters(), scene.camera)
    refusal(lambda: call(options=options, features=features), match=found)


def test_planes_are_those_of_a_scene_beside_the_origin(driver):
    """Where it lies far away, so much that float32 has no more digits than it needs for the means."""
    scene, shift = SCENES["degree1"](), torch.tensor([2.0**17, -(2.0**16), 3 * 2.0**15])
    found = []
    for far in (torch.zeros(3), shift):
        leaves = leaves_of(scene, features_of(scene, 5))
        near = (leaves[0].detach() + shift) - shift  # as far as they can be told there
        leaves[0] = (near + far).requires_grad_()
        moved = scene.camera.translation - scene.camera.rotation @ far.double().numpy()
        out = render(replace(scene, camera=replace(scene.camera, translation=moved)), leaves, ALL)
        found.append([out.planes, *torch.autograd.grad(out.planes.sum(), leaves[:4])])
    for one, other in zip(*found, strict=True):
        assert (one - other).norm() < 1e-5 * one.norm()

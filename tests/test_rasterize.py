"""The renderer against the float64 oracle, scene by scene, and what it promises beside numbers.

Pixels that hang on a rounding (``Render.fragile``) are left out, counted and limited; at those an error may be one
Gaussian's share. Their upstream gradients are zero, so that the gradients do not hang on them either.
"""

import functools
from dataclasses import dataclass, replace

import numpy as np
import pytest
import scenes
import torch
from scenes import PARAMETERS, SCENES

import warp_splat
from warp_splat import InputError, RasterOptions, adjoints
from warp_splat.compare import oracle
from warp_splat.config import ADJOINTS

IMAGE_MAX, IMAGE_MEAN = 1e-4, 1e-5  # allowed error of image and alpha
SHARE = 0.02  # at a fragile pixel: the largest weight that one decision moves is about 1e-2
FRAGILE = 0.02  # of a scene's pixels
GRADIENT = 1e-4  # relative L2
DEPTH = 1e-4  # relative
PLAIN = RasterOptions()


@dataclass(frozen=True)
class Truth:
    """A scene, the oracle's render of it, upstream gradients, and the gradients of the inputs and of means2d."""

    scene: scenes.Scene
    out: oracle.Render
    upstream: dict  # image, alpha, and depth if asked for
    gradients: dict


def backward(out, upstream, leaves):
    """Gradients of all leaves and of means2d, by name."""
    out.means2d.retain_grad()
    sum((getattr(out, name) * weight).sum() for name, weight in upstream.items()).backward()
    return {name: leaf.grad for name, leaf in leaves.items()} | {"means2d": out.means2d.grad}


def leaves_of(scene):
    """Leaf tensors that require gradients: the five inputs and the background."""
    return {name: getattr(scene, name).detach().clone().requires_grad_() for name in (*PARAMETERS, "background")}


@functools.cache
def truth(name, options):
    """Computed once per scene and options, in float64."""
    scene = SCENES[name]()
    leaves = leaves_of(scene.to("cpu", torch.float64))
    chosen = {key: getattr(options, key) for key in ("sh_degree", "antialiasing", "projection", "alpha_min", "t_min")}
    out = oracle.render(*[leaves[key] for key in PARAMETERS], scene.camera, leaves["background"], **chosen)
    generator = torch.Generator().manual_seed(1)
    upstream = {}
    for key in ("image", "alpha", "depth")[: 3 if options.depth else 2]:
        weight = torch.randn(getattr(out, key).shape, generator=generator)
        weight[out.fragile] = 0
        upstream[key] = weight / (4 if key == "depth" else 1)  # depths are about 4
    gradients = backward(out, upstream, leaves)
    for key in ("image", "alpha", "depth", "means2d"):
        setattr(out, key, getattr(out, key).detach())
    return Truth(scene, out, upstream, gradients)


def rasterize(scene, leaves=None, options=None, **more):
    """The renderer's output; from ``leaves`` (by name) where given."""
    source = {name: getattr(scene, name) for name in (*PARAMETERS, "background")} | (leaves or {})
    background = source.pop("background")
    return warp_splat.rasterize(**source, camera=scene.camera, background=background, options=options, **more)


def run(name, device, options=PLAIN, adjoint="manual"):
    """Render and differentiate a scene with the upstream gradients of its truth."""
    expected = truth(name, options)
    leaves = leaves_of(expected.scene.to(device))
    out = rasterize(expected.scene, leaves, options, adjoint=adjoint)
    upstream = {key: weight.to(device) for key, weight in expected.upstream.items()}
    return out, backward(out, upstream, leaves)


def check_image(out, expected):
    """Image and alpha within the limits, fragile pixels within a Gaussian's share and few."""
    fragile = expected.fragile
    assert fragile.double().mean() < FRAGILE
    for key in ("image", "alpha"):
        error = (getattr(out, key).detach().cpu().double() - getattr(expected, key)).abs()
        assert error[~fragile].max() < IMAGE_MAX, key
        assert error[~fragile].mean() < IMAGE_MEAN, key
        assert (error[fragile] < SHARE * expected.image.max().clamp_min(1)).all(), key


def check_depth(out, expected):
    """Expected depth where there is something, zero where there is nothing."""
    depth, sure = out.depth.detach().cpu().double(), ~expected.fragile
    solid = (expected.alpha > 1e-3) & sure
    assert ((depth - expected.depth).abs()[solid] < DEPTH * expected.depth[solid]).all()
    assert (depth[(expected.alpha == 0) & sure] == 0).all()


def check_culling(out, expected):
    """Radius 0 for what cannot be seen, a radius that covers the ellipse for what can."""
    radii = out.radii.cpu()
    assert radii.dtype == torch.int32 and (radii >= 0).all()
    assert (radii[expected.touches] > 0).all()
    assert (radii[~expected.near_image] == 0).all()
    drawn = radii > 0
    error = (out.means2d.detach().cpu().double() - expected.means2d).abs().amax(1)
    assert (error <= 1e-5 * (50 + expected.means2d.abs().amax(1)))[drawn].all()
    assert (radii[drawn] >= expected.reach[drawn] - 1).all()
    assert (radii[drawn] <= 1.1 * expected.reach[drawn] + 3).all()


def relative_error(gradient, expected):
    """L2 of the difference over L2 of the truth; a truth of zero asks for (almost) zero."""
    assert gradient is not None and gradient.shape == expected.shape
    return ((gradient.cpu().double() - expected.double()).norm() / expected.double().norm().clamp_min(1e-6)).item()


def check_gradients(gradients, expected):
    """Every gradient finite and within the limit; all errors are shown when one fails."""
    errors = {name: relative_error(gradient, expected[name]) for name, gradient in gradients.items()}
    assert all(error < GRADIENT for error in errors.values()), errors


@pytest.mark.parametrize("adjoint", ADJOINTS)
@pytest.mark.parametrize("name", SCENES)
def test_scene(name, adjoint, device, record_property):
    out, gradients = run(name, device, adjoint=adjoint)
    expected = truth(name, PLAIN)
    record_property("fragile_pixels", int(expected.out.fragile.sum()))
    check_image(out, expected.out)
    check_culling(out, expected.out)
    check_gradients(gradients, expected.gradients)


VARIANTS = [
    ("degree2", RasterOptions(depth=True)),
    ("inside", RasterOptions(depth=True)),
    ("opaque", RasterOptions(depth=True)),
    ("empty", RasterOptions(depth=True)),
    ("layers_4000", RasterOptions(depth=True)),
    ("degree2", RasterOptions(antialiasing=True)),
    ("subpixel", RasterOptions(antialiasing=True)),
    ("near_and_behind", RasterOptions(antialiasing=True)),
    ("offcentre", RasterOptions(antialiasing=True, depth=True)),
    ("degree3", RasterOptions(sh_degree=0)),
    ("degree3", RasterOptions(sh_degree=1)),
    ("degree3", RasterOptions(sh_degree=2)),
    ("degree2", RasterOptions(sh_degree=3)),
    ("degree2", RasterOptions(projection="ellipsoid")),
    ("inside", RasterOptions(projection="ellipsoid", depth=True)),
    ("needles", RasterOptions(projection="ellipsoid")),
    ("offcentre", RasterOptions(projection="ellipsoid", antialiasing=True)),
    ("near_and_behind", RasterOptions(projection="ellipsoid")),
    ("degree1", RasterOptions(alpha_min=0.0)),
    ("saturated", RasterOptions(t_min=0.0)),
    ("saturated", RasterOptions(alpha_min=1e-4, t_min=1e-2)),
    ("layers_4000", RasterOptions(alpha_min=0.0, t_min=0.0)),
    ("degree2", RasterOptions(exp_degree=None)),
    ("degree2", RasterOptions(exp_degree=6)),
]


@pytest.mark.parametrize(("name", "options"), VARIANTS, ids=str)
def test_options(name, options, device):
    check_options(name, options, device, "manual")


@pytest.mark.parametrize("adjoint", ADJOINTS[1:])
@pytest.mark.parametrize(("name", "options"), [VARIANTS[0], VARIANTS[-3]], ids=str)
def test_options_in_other_modes(name, options, adjoint, device):
    check_options(name, options, device, adjoint)


def check_options(name, options, device, adjoint):
    out, gradients = run(name, device, options, adjoint)
    expected = truth(name, options)
    check_image(out, expected.out)
    check_culling(out, expected.out)
    check_gradients(gradients, expected.gradients)
    if options.depth:
        check_depth(out, expected.out)


@pytest.mark.parametrize("adjoint", ADJOINTS[1:])
@pytest.mark.parametrize("name", ["dense_tile", "saturated", "degree3"])
def test_modes_share_the_image_and_agree_on_the_gradients(name, adjoint, device):
    (first, expected), (second, found) = run(name, device), run(name, device, adjoint=adjoint)
    assert torch.equal(first.image, second.image) and torch.equal(first.alpha, second.alpha)
    for key, gradient in found.items():
        assert relative_error(gradient, expected[key]) < 2e-5, key


def test_stored_refuses_what_does_not_fit(device, monkeypatch):
    monkeypatch.setattr(adjoints, "available_memory", lambda device: 2**20)
    scene = SCENES["dense_tile"]().to(device)
    with pytest.raises(InputError, match=r"'stored': the transmittances of \d+ tile instances take .* GiB"):
        rasterize(scene, leaves_of(scene), adjoint="stored")
    assert rasterize(scene, adjoint="stored").image.isfinite().all()  # without gradients nothing is stored


def test_extent_of_the_reference(device):
    """Its square reaches 3 standard deviations, the ellipse 3.33 at opacity 1: nothing else may differ."""
    scene = SCENES["degree2"]().to(device)
    exact, square = (rasterize(scene, options=RasterOptions(extent=extent)) for extent in ("ellipse", "square"))
    assert (exact.image - square.image).abs().max() < 0.05
    faint = {"opacities": scene.opacities * 0.3}  # 2 log(255 * 0.3) < 9: the square holds the ellipse
    exact, square = (rasterize(scene, faint, RasterOptions(extent=extent)) for extent in ("ellipse", "square"))
    assert torch.equal(exact.image, square.image)


def test_loop_cap(device):
    """Entries of the tile's list beyond ``max_steps`` are as if they were not there."""
    scene = SCENES["layers_4000"]().to(device)
    depths = torch.tensor(scene.camera.rotation[2], dtype=torch.float32, device=device) @ scene.means.T
    nearest = depths.argsort()[:100]
    few = {name: getattr(scene, name)[nearest] for name in PARAMETERS}
    leaves = leaves_of(scene)
    capped = rasterize(scene, leaves, RasterOptions(max_steps=100))
    assert (capped.image - rasterize(scene, few).image).abs().max() < 1e-6
    capped.image.sum().backward()
    assert leaves["opacities"].grad.nonzero().shape[0] == 100


def test_means2d_carries_gradients_of_its_own(device):
    """A loss on the 2D means alone reaches the 3D means (and nothing else asks for an image)."""
    scene = SCENES["offcentre"]()
    leaves, exact = leaves_of(scene.to(device)), leaves_of(scene.to("cpu", torch.float64))
    out = rasterize(scene, leaves)
    weight = torch.randn(120, 2, generator=torch.Generator().manual_seed(2)) * (out.radii.cpu() > 0)[:, None]
    (out.means2d * weight.to(device)).sum().backward()
    splats = oracle.project(*[exact[key] for key in PARAMETERS], scene.camera)
    (splats.means2d * weight).sum().backward()
    assert relative_error(leaves["means"].grad, exact["means"].grad) < 1e-5


def test_second_derivatives_are_refused(device):
    scene = SCENES["offcentre"]()
    leaves = leaves_of(scene.to(device))
    loss = rasterize(scene, leaves).image.square().sum()
    (first,) = torch.autograd.grad(loss, leaves["means"], create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        first.sum().backward()


@pytest.mark.parametrize("key", ["image", "alpha", "depth"])
def test_one_output_alone(key, device):
    """A loss on one output only: the others bring nothing."""
    expected = truth("degree1", RasterOptions(depth=True))
    scene, weight = expected.scene, expected.upstream[key]
    leaves, exact = leaves_of(scene.to(device)), leaves_of(scene.to("cpu", torch.float64))
    gradients = backward(rasterize(scene, leaves, RasterOptions(depth=True)), {key: weight.to(device)}, leaves)
    out = oracle.render(*[exact[name] for name in PARAMETERS], scene.camera, exact["background"])
    for name, value in backward(out, {key: weight}, exact).items():
        if value is not None and value.abs().max() > 0:
            assert relative_error(gradients[name], value) < GRADIENT, name


def equal(first, second):
    """Bit for bit: two (outputs, gradients)."""
    outputs = all(torch.equal(getattr(first[0], key), getattr(second[0], key)) for key in ("image", "alpha", "radii"))
    return outputs and all(torch.equal(first[1][name], second[1][name]) for name in first[1])


@pytest.mark.parametrize("name", ["dense_tile", "ties", "inside"])
def test_bit_identical_between_runs(name, device):
    assert equal(run(name, device), run(name, device))


@pytest.mark.parametrize("name", ["dense_tile", "degree3"])
def test_bit_identical_between_thread_counts(name, device):
    results, threads = [], warp_splat.get_threads()
    try:
        for count in (1, 2):
            warp_splat.set_threads(count)
            results.append(run(name, device))
    finally:
        warp_splat.set_threads(threads)
    assert equal(*results)


def test_several_views_equal_separate_calls(device):
    """Outputs and gradients, bit for bit, for cameras of different sizes; of the first, against float64 as well."""
    expected = truth("degree3", PLAIN)
    first = expected.scene.camera
    moved = replace(first, translation=first.translation + np.array([0.2, -0.1, 0.3]))
    cameras = [first, first.resized(31, 47), moved]
    results = []
    for together in (True, False):
        leaves = leaves_of(expected.scene.to(device))
        gaussians, background = [leaves[name] for name in PARAMETERS], leaves["background"]
        if together:
            outputs = warp_splat.rasterize_views(*gaussians, cameras, background)
        else:
            outputs = [warp_splat.rasterize(*gaussians, camera, background) for camera in cameras]
        for out in outputs:
            out.means2d.retain_grad()
        sum((out.image.square().sum() + out.alpha.sum()) for out in outputs).backward()
        gradients = {name: leaf.grad for name, leaf in leaves.items()}
        results.append((outputs, gradients, [out.means2d.grad for out in outputs]))
    check_image(results[0][0][0], expected.out)
    assert [out.image.shape for out in results[0][0]] == [(c.height, c.width, 3) for c in cameras]
    for a, b in zip(results[0][0], results[1][0], strict=True):
        assert equal((a, {}), (b, {}))
    assert all(torch.equal(results[0][1][name], results[1][1][name]) for name in results[0][1])
    assert all(torch.equal(a, b) and a.abs().max() > 0 for a, b in zip(results[0][2], results[1][2], strict=True))
    assert warp_splat.rasterize_views(*gaussians, []) == []


def test_sh_pair_equals_sh_tensor(device):
    scene = SCENES["degree3"]().to(device)
    leaves = leaves_of(scene)
    pair = [leaves["sh"].detach()[:, :1].clone(), leaves["sh"].detach()[:, 1:].clone()]
    whole, parts = rasterize(scene, leaves), rasterize(scene, {"sh": [part.requires_grad_() for part in pair]})
    assert torch.equal(whole.image, parts.image)
    whole.image.square().sum().backward()
    parts.image.square().sum().backward()
    assert torch.equal(leaves["sh"].grad, torch.cat([part.grad for part in pair], 1))


def test_sh_pair_of_degree_0(device):
    scene = SCENES["degree0"]().to(device)
    assert torch.equal(rasterize(scene, {"sh": (scene.sh, scene.sh[:, :0])}).image, rasterize(scene).image)


def test_zero_gaussians(device):
    scene = SCENES["empty"]().to(device)
    out = rasterize(scene, options=RasterOptions(depth=True))
    assert torch.equal(out.image, scene.background.expand(18, 20, 3))
    assert out.alpha.shape == out.depth.shape == (18, 20) and not out.alpha.any() and not out.depth.any()
    assert out.means2d.shape == (0, 2) and out.radii.shape == (0,)
    _, gradients = run("empty", device)
    assert all(gradients[name].numel() == 0 for name in PARAMETERS)


def test_background_defaults_to_black_and_may_be_numbers(device):
    scene = SCENES["degree0"]().to(device)
    black = warp_splat.rasterize(*scene.parameters(), scene.camera)
    assert torch.equal(black.image, rasterize(scene, {"background": torch.zeros(3, device=device)}).image)
    numbers = tuple(scene.background.tolist())
    assert torch.equal(rasterize(scene, {"background": numbers}).image, rasterize(scene).image)


def test_without_gradients(device):
    scene = SCENES["degree1"]().to(device)
    leaves = leaves_of(scene)
    with torch.no_grad():
        out = rasterize(scene, leaves)
    assert not out.image.requires_grad and not out.means2d.requires_grad
    assert torch.equal(out.image, rasterize(scene, leaves).image)
    assert not rasterize(scene).image.requires_grad


@pytest.mark.parametrize("name", [*PARAMETERS, "background"])
def test_gradient_of_one_input_only(name, device):
    expected = truth("degree1", PLAIN)
    scene = expected.scene.to(device)
    leaf = getattr(scene, name).clone().requires_grad_()
    out = rasterize(scene, {name: leaf})
    sum((getattr(out, key) * weight.to(device)).sum() for key, weight in expected.upstream.items()).backward()
    assert relative_error(leaf.grad, expected.gradients[name]) < GRADIENT
    assert all(getattr(scene, other).grad is None for other in PARAMETERS)


def test_non_contiguous_inputs(device):
    scene = SCENES["degree1"]().to(device)
    leaves, strided = leaves_of(scene), {}
    for name in PARAMETERS:
        padded = torch.stack([getattr(scene, name), torch.zeros_like(getattr(scene, name))], -1)
        strided[name] = padded[..., 0].requires_grad_()
        assert not strided[name].is_contiguous()
    first, second = rasterize(scene, leaves), rasterize(scene, strided)
    assert torch.equal(first.image, second.image)
    first.image.square().sum().backward()
    second.image.square().sum().backward()
    assert all(torch.equal(leaves[name].grad, strided[name].grad) for name in PARAMETERS)


@pytest.mark.parametrize(("key", "value"), [("image", float("nan")), ("image", float("inf")), ("alpha", float("nan"))])
def test_upstream_gradient_that_is_not_finite_drops_its_pixel(key, value, device):
    expected = truth("degree1", PLAIN)
    results = []
    for bad in (True, False):
        upstream = {name: weight.to(device, copy=True) for name, weight in expected.upstream.items()}
        for weight in upstream.values():
            weight[5, 7] = 0
        if bad:
            upstream[key][5, 7] = value
        leaves = leaves_of(expected.scene.to(device))
        out = rasterize(expected.scene, leaves)
        torch.autograd.backward([out.image, out.alpha], [upstream["image"], upstream["alpha"]])
        results.append({name: leaf.grad for name, leaf in leaves.items()})
        assert out.dropped.pixels == (1 if bad else 0)
    assert all(torch.equal(results[0][name], results[1][name]) for name in results[0])


def test_quaternion_of_zero_norm_is_culled(device):
    scene = SCENES["degree1"]().to(device)
    touched = truth("degree1", PLAIN).out.touches.nonzero()[0].item()
    leaves = leaves_of(scene)
    with torch.no_grad():
        leaves["quats"][touched] = 0
    others = torch.arange(len(scene.means), device=device) != touched
    rest = {name: getattr(scene, name)[others] for name in PARAMETERS}
    out = rasterize(scene, leaves)
    assert out.radii[touched] == 0
    assert torch.equal(out.image, rasterize(scene, rest).image)
    out.image.square().sum().backward()
    for leaf in leaves.values():
        assert leaf.grad.isfinite().all()
    assert all(not leaves[name].grad[touched].any() for name in PARAMETERS)

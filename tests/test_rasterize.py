"""The renderer against the float64 oracle, scene by scene, and what it promises beside numbers.

Pixels that hang on a rounding (``Render.fragile``) are left out, counted and limited; at those an error may be one
Gaussian's share. Their upstream gradients are zero, so that the gradients do not hang on them either.
"""

import functools
from dataclasses import dataclass

import numpy as np
import pytest
import scenes
import torch
from exact_cameras import exact_render, exact_splats
from scenes import PARAMETERS, SCENES

import warp_splat
from warp_splat import Camera, InputError, RasterOptions
from warp_splat.compare import oracle
from warp_splat.compare.truth import for_oracle
from warp_splat.config import ADJOINTS
from warp_splat.runtime import launch
from warp_splat.training.loss import image_loss

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
    scene = scenes.scene_of(name)
    leaves = leaves_of(scene.to("cpu", torch.float64))
    out = exact_render(*[leaves[key] for key in PARAMETERS], scene.camera, leaves["background"], **for_oracle(options))
    generator = torch.Generator().manual_seed(1)
    upstream = {}
    for key in ("image", "alpha", "depth")[: 3 if options.depth else 2]:
        weight = torch.randn(getattr(out, key).shape, generator=generator)
        weight[out.fragile] = 0
        upstream[key] = weight / (4 if key == "depth" else 1)  # depths are about 4
    gradients = backward(out, upstream, leaves)
    known = {key: getattr(out, key).detach() for key in ("image", "alpha", "depth", "means2d")}
    return Truth(scene, out._replace(**known), upstream, gradients)


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


def check_culling(out, expected, camera, options):
    """Radius 0 for what cannot be seen, a radius that covers the ellipse for what can."""
    radii = out.radii.cpu()
    near_image, reach = scenes.culling(expected, camera, options.alpha_min)
    assert radii.dtype == torch.int32 and (radii >= 0).all()
    assert (radii[expected.touches] > 0).all()
    assert (radii[~near_image] == 0).all()
    drawn = radii > 0
    error = (out.means2d.detach().cpu().double() - expected.means2d).abs().amax(1)
    assert (error <= 1e-5 * (50 + expected.means2d.abs().amax(1)))[drawn].all()
    assert (radii[drawn] >= reach[drawn] - 1).all()
    assert (radii[drawn] <= 1.1 * reach[drawn] + 3).all()


def relative_error(gradient, expected):
    """L2 of the difference over L2 of the truth; a truth of zero asks for (almost) zero."""
    assert gradient is not None and gradient.shape == expected.shape
    gradient, expected = gradient.cpu().double(), expected.cpu().double()
    return ((gradient - expected).norm() / expected.norm().clamp_min(1e-6)).item()


def check_gradients(gradients, expected):
    """Every gradient finite and within the limit; all errors are shown when one fails."""
    errors = {name: relative_error(gradient, expected[name]) for name, gradient in gradients.items()}
    assert all(error < GRADIENT for error in errors.values()), errors


VARIANTS = [
    *((name, RasterOptions(depth=True)) for name in ("degree2", "inside", "opaque", "empty", "layers_4000")),
    *((name, RasterOptions(antialiasing=True)) for name in ("degree2", "subpixel", "near_and_behind")),
    ("off_center", RasterOptions(antialiasing=True, depth=True)),
    *(("degree3", RasterOptions(sh_degree=degree)) for degree in (0, 1, 2)),
    ("degree2", RasterOptions(sh_degree=3)),
    *((name, RasterOptions(projection="ellipsoid")) for name in ("degree2", "needles", "near_and_behind")),
    ("inside", RasterOptions(projection="ellipsoid", depth=True)),
    ("off_center", RasterOptions(projection="ellipsoid", antialiasing=True)),
    ("fisheye", RasterOptions(projection="unscented", antialiasing=True, depth=True)),
    ("saturated", RasterOptions(alpha_max=0.999)),
    ("near_and_behind", RasterOptions(near=0.01, blur=0.1, antialiasing=True)),
    ("near_and_behind", RasterOptions(near=1.5, blur=1.0, projection="unscented")),
    ("degree1", RasterOptions(alpha_min=0.0)),
    ("saturated", RasterOptions(t_min=0.0)),
    ("saturated", RasterOptions(alpha_min=1e-4, t_min=1e-2)),
    ("layers_4000", RasterOptions(alpha_min=0.0, t_min=0.0)),
    ("degree2", RasterOptions(exp_degree=6)),
]
IN_ALL_MODES = [VARIANTS[0], ("layers_4000", RasterOptions(alpha_min=0.0, t_min=0.0))]
IN_ALL_MODES += [("opaque", RasterOptions(alpha_max=0.999))]
LONG = [(name, RasterOptions(projection="unscented")) for name in ("opencv", "panorama", "inside")]


@pytest.mark.parametrize(
    ("name", "options", "adjoint"),
    [
        *((name, PLAIN, adjoint) for name in SCENES for adjoint in ADJOINTS),
        *((name, options, "manual") for name, options in VARIANTS),
        *((name, options, adjoint) for name, options in IN_ALL_MODES for adjoint in ADJOINTS[1:]),
        pytest.param("degree2", RasterOptions(exp_degree=None), "manual", marks=pytest.mark.slow),
        *(pytest.param(name, options, "manual", marks=pytest.mark.long) for name, options in LONG),
    ],
    ids=str,
)
def test_scene(name, options, adjoint, device, record_property):
    out, gradients = run(name, device, options, adjoint)
    expected = truth(name, options)
    record_property("fragile_pixels", int(expected.out.fragile.sum()))
    check_image(out, expected.out)
    check_culling(out, expected.out, expected.scene.camera, options)
    check_gradients(gradients, expected.gradients)
    if options.depth:
        check_depth(out, expected.out)


def test_seven_points_know_the_short_axes_of_long_needles(device):
    """Their area is what antialiasing asks for. Gradients lose digits, as the points lie far apart."""
    name, options = "needles_long", RasterOptions(projection="unscented", antialiasing=True)
    (out, gradients), expected = run(name, device, options, "manual"), truth(name, options)
    check_image(out, expected.out)
    errors = {key: relative_error(gradient, expected.gradients[key]) for key, gradient in gradients.items()}
    assert all(error < 1e-3 for error in errors.values()), errors


def test_gradients_of_needles_err_by_the_square_of_how_long_they_are(device):
    """In float32: at most 1e-6 times that, at any angle; what squares of long offsets leave of the short axis."""
    camera, random = Camera(256, 256, 256, 256, 128, 128, np.eye(3), np.zeros(3)), np.random.default_rng(0)
    for long in (0.1, 0.4, 1.6):
        turn = random.uniform(0, np.pi / 2)
        quat, scales = (np.cos(turn), 0, 0, np.sin(turn)), (4 * long, 0.005, 0.005)
        numbers = [(0.1, 0.2, 4)], [quat], [scales], [0.8], [[(1, 1, 1)]]
        given = [torch.tensor(number, dtype=torch.float32, device=device).requires_grad_() for number in numbers]
        exact = [tensor.detach().cpu().double().requires_grad_() for tensor in given]
        out = warp_splat.rasterize(*given, camera)
        expected = exact_render(*exact, camera, torch.zeros(3, dtype=torch.float64), **for_oracle(PLAIN))
        upstream = torch.from_numpy(random.normal(size=(256, 256, 3))) * ~expected.fragile[..., None]
        (out.image * upstream.float().to(device)).sum().backward()
        (expected.image * upstream).sum().backward()
        a, b, c = out.conics[0].detach().double().tolist()
        ratio = np.linalg.cond([[a, b], [b, c]])  # of squares
        errors = [relative_error(tensor.grad, truth.grad) for tensor, truth in zip(given, exact, strict=True)]
        assert max(errors) < 1e-6 * ratio


@pytest.mark.parametrize("adjoint", ADJOINTS[1:])
@pytest.mark.parametrize("name", ["dense_tile", "saturated", "degree3"])
def test_modes_share_the_image_and_agree_on_the_gradients(name, adjoint, device):
    (first, expected), (second, found) = run(name, device), run(name, device, adjoint=adjoint)
    assert torch.equal(first.image, second.image) and torch.equal(first.alpha, second.alpha)
    for key, gradient in found.items():
        assert relative_error(gradient, expected[key]) < 2e-5, key


def test_stored_refuses_what_does_not_fit(device, monkeypatch):
    monkeypatch.setattr(launch, "available_memory", lambda device: 2**20)
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
    few = {name: getattr(scene, name)[depths.argsort()[:100]] for name in PARAMETERS}
    leaves = leaves_of(scene)
    capped = rasterize(scene, leaves, RasterOptions(max_steps=100))
    assert (capped.image - rasterize(scene, few).image).abs().max() < 1e-6
    capped.image.sum().backward()
    assert leaves["opacities"].grad.nonzero().shape[0] == 100


def test_means2d_carries_gradients_of_its_own(device):
    """A loss on the 2D means alone reaches the 3D means (and nothing else asks for an image)."""
    scene = SCENES["off_center"]()
    leaves, exact = leaves_of(scene.to(device)), leaves_of(scene.to("cpu", torch.float64))
    out = rasterize(scene, leaves)
    weight = torch.randn(120, 2, generator=torch.Generator().manual_seed(2)) * (out.radii.cpu() > 0)[:, None]
    (out.means2d * weight.to(device)).sum().backward()
    splats = exact_splats(*[exact[key] for key in PARAMETERS], scene.camera)
    (splats.means2d * weight).sum().backward()
    assert relative_error(leaves["means"].grad, exact["means"].grad) < 1e-5


@pytest.mark.parametrize(
    "loss",
    [
        lambda out: out.image.square().sum(),
        lambda out: out.image.sum(),  # whose gradients by pixels are constants to torch
        lambda out: out.alpha[5, 7],
        lambda out: out.colors.sum(),
        lambda out: image_loss(out.image, torch.zeros_like(out.image), 0.2),
    ],
)
def test_second_derivatives_are_refused(loss, device):
    scene = SCENES["off_center"]()
    leaves = leaves_of(scene.to(device))
    out = rasterize(scene, leaves)
    with pytest.raises(InputError, match="create_graph=True: expected False"):
        torch.autograd.grad(loss(out), leaves["means"], create_graph=True)


@pytest.mark.parametrize("key", ["image", "alpha", "depth"])
def test_one_output_alone(key, device):
    """A loss on one output only: the others bring nothing."""
    expected = truth("degree1", RasterOptions(depth=True))
    scene, weight = expected.scene, expected.upstream[key]
    leaves, exact = leaves_of(scene.to(device)), leaves_of(scene.to("cpu", torch.float64))
    gradients = backward(rasterize(scene, leaves, RasterOptions(depth=True)), {key: weight.to(device)}, leaves)
    out = exact_render(*[exact[name] for name in PARAMETERS], scene.camera, exact["background"])
    for name, value in backward(out, {key: weight}, exact).items():
        if value is not None and value.abs().max() > 0:
            assert relative_error(gradients[name], value) < GRADIENT, name

"""Calls of the renderer: the same bits whatever the threads, several views, inputs of every kind; errors by name."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scenes
import torch
from hostile import refusal
from scenes import PARAMETERS, SCENES
from test_rasterize import GRADIENT, PLAIN, check_image, leaves_of, rasterize, relative_error, run, truth
from torch.utils.checkpoint import checkpoint

import warp_splat
from warp_splat import Camera, InputError, RasterOptions
from warp_splat.config import ADJOINTS
from warp_splat.raster.drivers import CPU, DRIVERS
from warp_splat.training.loss import image_loss


def equal(first, second):
    """Bit for bit: two (outputs, gradients)."""
    outputs = all(torch.equal(getattr(first[0], key), getattr(second[0], key)) for key in ("image", "alpha", "radii"))
    return outputs and all(torch.equal(first[1][name], second[1][name]) for name in first[1])


@pytest.mark.parametrize("name", ["dense_tile", "ties", "inside", "degree3"])
def test_bit_identical_between_runs_and_thread_counts(name, device, threads):
    first = run(name, device)
    for count in (1, 2):
        threads(count)
        assert equal(run(name, device), first)


@pytest.mark.parametrize("adjoint", ADJOINTS)
def test_an_opacity_has_its_gradient_where_its_weight_underflows(adjoint):
    camera, in_front = scenes.make_camera(32, 32, seed=None), 6  # each of opacity 0.99 in all pixels
    opacities = torch.tensor([1.0] * in_front + [1e-36], requires_grad=True)
    means = torch.tensor([[0.0, 0.0, 5.0 + 0.5 * place] for place in range(in_front + 1)])
    scales = torch.tensor([[50.0] * 3] * in_front + [[0.5] * 3])
    quats, sh = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(in_front + 1, 1), torch.full((in_front + 1, 1, 3), 0.7)
    options = RasterOptions(alpha_min=0.0, t_min=0.0)
    given = means, quats, scales, opacities, sh, camera, (0.1, 0.2, 0.3), adjoint, options
    warp_splat.rasterize(*given).image.sum().backward()
    variance = (camera.fx * 0.5 / 8.0) ** 2 + 0.3  # px^2: all its pixels together are 2 pi of these
    light = 3 * (0.5 + 0.7 * 0.28209479) - 0.6  # that it adds, less the background's that it hides
    expected = 0.01**in_front * 2 * math.pi * variance * light
    assert opacities.grad is not None and opacities.grad[-1].item() == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("adjoint", ADJOINTS)
def test_defaults_of_torch_change_nothing(adjoint):
    """The inputs say of what type the numbers are, and where they lie."""
    scene = truth("degree3", PLAIN).scene.to("cpu")
    leaves = [leaves_of(scene) for _ in range(3)]
    photograph = torch.full((scene.camera.height, scene.camera.width, 3), 90, dtype=torch.uint8)

    def everything(leaves):
        gaussians = [leaves[name] for name in PARAMETERS]
        out = warp_splat.rasterize(*gaussians, scene.camera, adjoint=adjoint, options=RasterOptions(depth=True))
        image_loss(out.image, photograph).backward()
        return out, {name: leaves[name].grad for name in PARAMETERS}

    def beside():
        asked = RasterOptions(normals=True, median_depth=True, strongest=2), RasterOptions(bound=True)
        outs = [warp_splat.rasterize(*scene.parameters(), scene.camera, options=options) for options in asked]
        return [outs[0].median_depth, outs[0].strongest_weights, outs[0].normals, outs[1].image, outs[1].bound]

    expected, found, dtype = everything(leaves[0]), beside(), torch.get_default_dtype()
    try:
        torch.set_default_dtype(torch.float64)
        assert equal(everything(leaves[1]), expected)
        assert all(torch.equal(one, other) for one, other in zip(beside(), found, strict=True))
    finally:
        torch.set_default_dtype(dtype)
    with torch.device("meta"):
        assert equal(everything(leaves[2]), expected)


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


@pytest.mark.parametrize("name", ["degree3", "degree0"])
def test_sh_pair_equals_sh_tensor(name, device):
    scene = SCENES[name]().to(device)
    leaves = leaves_of(scene)
    pair = [leaves["sh"].detach()[:, :1].clone(), leaves["sh"].detach()[:, 1:].clone()]
    whole, parts = rasterize(scene, leaves), rasterize(scene, {"sh": [part.requires_grad_() for part in pair]})
    assert torch.equal(whole.image, parts.image)
    whole.image.square().sum().backward()
    parts.image.square().sum().backward()
    assert torch.equal(leaves["sh"].grad, torch.cat([part.grad for part in pair if part.grad is not None], 1))


@pytest.mark.parametrize("options", [{"alpha_min": 0.0}, {"alpha_min": 1e-9}, {"tolerance": 1e-6}], ids=str)
def test_where_alpha_rounds_to_zero_there_is_no_depth(options):
    """Beside a Gaussian, in front of a camera of one row: its weight does not, and its gradient is not huge."""
    camera, mean = Camera(32, 1, 30, 30, 2, 0.5, np.eye(3), np.zeros(3)), torch.tensor([[0.0, 0.0, 3.0]])
    given = [torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.2), torch.tensor([0.9]), torch.zeros(1, 1, 3)]
    out = warp_splat.rasterize(mean.requires_grad_(), *given, camera, options=RasterOptions(depth=True, **options))
    none = out.alpha == 0
    assert none.any() and not out.depth[none].any()
    assert (out.depth[~none] - 3).abs().max() < 1.5  # as far as the transmittance has digits
    out.depth[none].sum().backward()
    assert not mean.grad.any()


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


@pytest.mark.parametrize("name", ["degree1", "empty"])  # torch calls a tensor of nothing contiguous
def test_inputs_of_any_strides(name, device):
    scene = SCENES[name]().to(device)
    leaves, strided = leaves_of(scene), {}
    for key in PARAMETERS:
        padded = torch.stack([getattr(scene, key), torch.zeros_like(getattr(scene, key))], -1)
        strided[key] = padded[..., 0].requires_grad_()
        assert strided[key].is_contiguous() == (name == "empty")
    first, second = rasterize(scene, leaves), rasterize(scene, strided)
    assert torch.equal(first.image, second.image)
    first.image.square().sum().backward()
    second.image.square().sum().backward()
    assert all(torch.equal(leaves[key].grad, strided[key].grad) for key in PARAMETERS)


@pytest.mark.parametrize(("key", "value"), [("image", float("nan")), ("image", float("inf")), ("alpha", float("nan"))])
def test_upstream_gradient_that_is_not_finite_drops_its_pixel(key, value, driver, device):
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


SCENE = scenes.cloud(0, 6, scenes.make_camera(20, 18), degree=1)


def call(device, **changed):
    """Rasterize a good scene with some arguments changed."""
    arguments = {name: getattr(SCENE, name).to(device) for name in (*PARAMETERS, "background")}
    arguments["camera"] = SCENE.camera
    for name, change in changed.items():
        arguments[name] = change(arguments.get(name)) if callable(change) else change
    return warp_splat.rasterize(**arguments)


def test_memory_that_runs_out_is_explained(monkeypatch):
    def failing(*arguments):
        raise RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate much")

    monkeypatch.setitem(DRIVERS, "cpu", replace(CPU, bin=failing))
    explained = r"Out of memory on cpu in stage 'bin', with 6 Gaussians on 20 x 18 px; render"
    refusal(lambda: call("cpu"), match=explained)


def put(value, *index):
    """A change: one element of a tensor."""

    def change(tensor):
        tensor = tensor.clone()
        tensor[index] = value
        return tensor

    return change


def options(**values):
    return lambda _: RasterOptions(**values)


SHAPES = [
    ("means", lambda t: t[:, :2], "6, 2"),
    ("quats", lambda t: t[:, :3], "6, 3"),
    ("scales", lambda t: t[:, :1], "6, 1"),
    ("opacities", lambda t: t[:, None], "6, 1"),
    ("sh", lambda t: torch.zeros(6, 5, 3, device=t.device), "6, 5, 3|5"),
    ("sh", lambda t: t[:, :0], "6, 0, 3|0"),
    ("sh", lambda t: t[..., :2], "6, 4, 2"),
    ("sh", lambda t: (t[:, :2], t[:, 2:]), "6, 2, 3"),
    ("sh", lambda t: (t[:, :1], t[:5, 1:]), "5, 3, 3|5"),
    ("sh", lambda t: (t[:, :1], t[:, 1:2], t[:, 2:]), "3"),
    ("means", lambda t: t.to_sparse(), "dense"),
    ("background", lambda _: (0, 0), "2"),
    ("background", lambda t: t.new_zeros(4), "4"),
]
KINDS = [
    (name, change, found)
    for name in PARAMETERS
    for change, found in [
        (lambda t: t.to(torch.float64), "float64"),
        (lambda t: t.to(torch.int64), "int64"),
        (lambda t: t.cpu().numpy(), "ndarray"),
        (None, "None"),
    ]
]
FINITE = "(?i:nan|inf|finite)"
NUMBERS = [
    ("scales", put(0.0, 3, 1), "0"),
    ("opacities", put(-0.25, 3), "-0.25"),
    ("opacities", put(1.0001, 3), "to 1.0001"),
    *(
        (name, put(value, 2) if name == "opacities" else put(value, 2, 1), FINITE)
        for name in PARAMETERS
        for value in (math.nan, math.inf, -math.inf)
    ),
    *(("background", put(value, 1), FINITE) for value in (math.nan, math.inf, -math.inf)),
]
OTHERS = [
    ("camera", SCENE.camera.resized(10**6, 10**6), "expected at most .* pixels, got 1000000 x 1000000"),
    *(("camera", camera, type(camera).__name__) for camera in (None, {"width": 20}, np.eye(4))),
    ("adjoint", "magic", "magic"),
    ("adjoint", None, "None"),
    ("options", {"depth": True}, "dict"),
    ("options", options(sh_degree=4), r"\.sh_degree: expected 0, 1, 2, 3 or None, got 4\."),
    ("options", options(sh_degree=np.zeros(2)), r"\.sh_degree: expected 0, 1, 2, 3 or None, got array"),
    ("options", options(alpha_max=1.0), r"\.alpha_max: expected a number from 0 to 0\.9999, got 1\.0\."),
    ("options", options(near=0.0), r"\.near: expected a number from 1e-06 to 1e\+06, got 0\.0\."),
    ("options", options(blur=math.nan), r"\.blur: expected a number from 1e-06 to 1e\+06, got nan\."),
]


@pytest.mark.parametrize(("name", "change", "found"), [*SHAPES, *KINDS, *NUMBERS, *OTHERS])
def test_what_is_found_is_said(name, change, found, device):
    refusal(lambda: call(device, **{name: change}), match=rf"(?s){name}.*({found})")


@pytest.mark.parametrize("name", PARAMETERS)
def test_number_and_device_of_one_that_differs(name, device):
    with pytest.raises(InputError, match=r"(?s)(means|quats|scales|opacities|sh).*5") as error:
        call(device, **{name: lambda t: t[:5]})
    assert "6" in str(error.value) and (name == "means" or name in str(error.value))
    refusal(lambda: call(device, **{name: lambda t: t.to("meta")}), match=rf"{name}: .* got one on meta; .*\.cpu\(\)")
    if torch.cuda.is_available():
        other = "cuda" if device == "cpu" else "cpu"
        means, first, found = (other, "quats", device) if name == "means" else (device, name, other)
        said = rf"{first}: expected a tensor on {means}.*, as the means, got one on {found}"
        refusal(lambda: call(device, **{name: lambda t: t.to(other)}), match=said)


def test_ends_of_the_ranges_are_good(device):
    out = call(device, opacities=lambda t: t.clone().fill_(1), scales=put(1e-30, 0, 0))
    assert out.image.isfinite().all()
    assert not call(device, opacities=lambda t: t.clone().fill_(0)).alpha.any()
    rounded, exact = (call(device, opacities=lambda t, value=value: t.clone().fill_(value)) for value in (1.0000001, 1))
    assert torch.allclose(rounded.image, exact.image, atol=1e-5)


@pytest.mark.parametrize("mode", ADJOINTS)
def test_forgotten_between_the_passes(mode, device):
    """By torch's checkpoints, which render again for the adjoint and let it read what was kept but once."""
    leaves = [getattr(SCENE, name).detach().to(device).requires_grad_() for name in PARAMETERS]
    draw = lambda *given: warp_splat.rasterize(*given, SCENE.camera, adjoint=mode).image  # noqa: E731
    images = draw(*leaves), checkpoint(draw, *leaves, use_reentrant=False)
    found = [torch.autograd.grad(image.square().sum(), leaves) for image in images]
    assert all(map(torch.equal, *found))


@pytest.mark.parametrize("name", [*PARAMETERS, "background"])
def test_signs_that_torch_has_not_written_yet(name, device):
    plain, lazy = call(device), call(device, **{name: lambda t: torch._neg_view(-t)})
    assert torch.equal(plain.image, lazy.image)


def test_signs_of_upstream_and_of_a_surface(device):
    leaf, depths = SCENE.means.detach().to(device).requires_grad_(), call(device).depths
    surface = depths.median().expand(18, 20).contiguous()
    options = [RasterOptions(hidden_from=depth) for depth in (surface, torch._neg_view(-surface))]
    images = [call(device, means=leaf, options=one).image for one in options]
    weight = torch.rand(images[0].shape, device=device)
    ups = weight, torch._neg_view(-weight)
    found = [torch.autograd.grad(images[0], leaf, up, retain_graph=True)[0] for up in ups]
    assert torch.equal(*images) and torch.equal(*found) and found[0].any()


@pytest.mark.parametrize(
    "cameras", [SCENE.camera, None, iter(()), [SCENE.camera, None]], ids=["one", "None", "iterator", "list"]
)
def test_cameras(cameras, device):
    found = "NoneType" if isinstance(cameras, list) else type(cameras).__name__
    refusal(lambda: warp_splat.rasterize_views(*SCENE.to(device).parameters(), cameras), match=f"(?s)camera.*{found}")


def test_bad_input_leaves_the_renderer_working(device):
    before = call(device).image
    refusal(lambda: call(device, means=put(float("nan"), 0, 0)))
    assert torch.equal(before, call(device).image)

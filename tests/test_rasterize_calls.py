"""Calls of the renderer: the same bits whatever the threads, several views, inputs of every kind."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import PARAMETERS, SCENES
from test_rasterize import GRADIENT, PLAIN, check_image, leaves_of, rasterize, relative_error, run, truth

import warp_splat
from warp_splat import RasterOptions
from warp_splat.config import ADJOINTS
from warp_splat.training.loss import image_loss


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

    expected, dtype = everything(leaves[0]), torch.get_default_dtype()
    try:
        torch.set_default_dtype(torch.float64)
        assert equal(everything(leaves[1]), expected)
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


def test_no_gaussians_of_any_strides(device):
    """Torch calls a tensor of nothing contiguous, whatever its strides."""
    scene = SCENES["empty"]().to(device)
    leaves = leaves_of(scene)
    strided = leaves | {
        "means": torch.zeros(0, 6, device=device)[:, ::2],
        "quats": torch.zeros(0, 4, 2, device=device)[..., 0],
        "sh": torch.zeros(0, 16, 6, device=device)[..., :3],
    }
    assert torch.equal(rasterize(scene, strided).image, rasterize(scene, leaves).image)


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

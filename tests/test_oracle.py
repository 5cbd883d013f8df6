"""The oracle itself, against closed forms, SciPy, a scalar loop, and finite differences; and the scenes' own claims."""

import math

import numpy as np
import pytest
import scenes
import torch
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from warp_splat.compare import oracle

C0 = 0.5 / math.sqrt(math.pi)  # the harmonic of degree 0
CENTERED = scenes.make_camera(9, 7, fx=20, seed=None)  # the middle pixel's center is the principal point
SMALL = scenes.make_camera(13, 11, fx=15, fy=12, cx=7.3, cy=4.1)


def double(*values):
    """Float64 tensors."""
    return [torch.tensor(value, dtype=torch.float64) for value in values]


def ball(z, sigma, opacity, rgb, camera=CENTERED, background=(0, 0, 0)):
    """Render isotropic Gaussians on the optical axis; lists of equal length."""
    count = len(z)
    means = [[0, 0, depth] for depth in z]
    sh = [[[(value - 0.5) / C0 for value in color]] for color in rgb]
    quats = [[1.0, 0, 0, 0]] * count
    return oracle.exact_render(*double(means, quats, [[s] * 3 for s in sigma], opacity, sh), camera, background)


def test_one_gaussian_closed_form():
    out = ball(z=[4.0], sigma=[0.3], opacity=[0.6], rgb=[[0.2, 0.5, 0.9]], background=(1, 0, 0.5))
    variance = (20 * 0.3 / 4) ** 2 + 0.3
    alpha = 0.6 * math.exp(-0.5 * (2**2 + 1**2) / variance)  # two pixels right of the middle, one down
    expected = [alpha * 0.2 + (1 - alpha), alpha * 0.5, alpha * 0.9 + (1 - alpha) * 0.5]
    assert out.image[4, 6].tolist() == pytest.approx(expected, rel=1e-12)
    assert out.alpha[3, 4].item() == pytest.approx(0.6, rel=1e-12)
    assert out.depth[4, 6].item() == pytest.approx(4, rel=1e-12)
    reach = scenes.culling(out, CENTERED)[1].item()
    assert reach == pytest.approx(math.sqrt(2 * variance * math.log(255 * 0.6)), rel=1e-12)


def test_two_layers_closed_form_whatever_the_order_of_input():
    out = ball(z=[5.0, 2.0], sigma=[0.2, 0.1], opacity=[0.7, 0.4], rgb=[[1, 0, 0], [0, 1, 0]], background=(0, 0, 1))
    assert out.image[3, 4].tolist() == pytest.approx([0.6 * 0.7, 0.4, 0.6 * 0.3], rel=1e-12)
    assert out.depth[3, 4].item() == pytest.approx((0.4 * 2 + 0.42 * 5) / 0.82, rel=1e-12)


def test_clamp_and_stop():
    out = ball(z=[1.0, 2, 3], sigma=[1.0, 1, 1], opacity=[1.0, 0.98, 0.98], rgb=[[1, 0, 0], [0, 1, 0], [0, 0, 1]])
    # 0.99 first; 0.01 * 0.02 = 2e-4 may go on; 4e-6 may not, so the third is not blended and T stays at 2e-4
    assert out.image[3, 4].tolist() == pytest.approx([0.99, 0.01 * 0.98, 0], rel=1e-12)
    assert out.alpha[3, 4].item() == pytest.approx(1 - 2e-4, rel=1e-12)


def test_spherical_harmonics_match_scipy():
    x, y, z = directions = np.random.default_rng(0).normal(size=(3, 50))
    x, y, z = directions / np.linalg.norm(directions, axis=0)
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    columns = []
    for degree in range(4):  # the real basis that keeps the Condon-Shortley sign
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), polar, azimuth)
            columns.append(value.real if order == 0 else math.sqrt(2) * (value.real if order > 0 else value.imag))
    basis = oracle.sh_basis(torch.tensor(np.stack([x, y, z], 1)), 3)
    assert np.abs(basis.numpy() - np.stack(columns, 1)).max() < 1e-12


def test_covariance_matches_scipy():
    rng = np.random.default_rng(1)
    quats, scales = rng.normal(size=(20, 4)) * 10 ** rng.uniform(-3, 3, (20, 1)), rng.uniform(0.1, 2, (20, 3))
    rotation = Rotation.from_quat(quats, scalar_first=True).as_matrix()
    expected = np.einsum("nij,nj,nkj->nik", rotation, scales**2, rotation)
    assert np.abs(oracle.covariances(*double(quats, scales)).numpy() - expected).max() < 1e-12


def test_jacobian_is_the_projections_inside_the_frame_and_limited_beyond():
    points = torch.tensor([[0.2, -0.1, 2.0], [-1.0, 0.9, 3.0], [9.0, 0.1, 2.0]], dtype=torch.float64)

    def to_pixels(point):
        x, y, z = point
        return torch.stack([SMALL.fx * x / z + SMALL.cx, SMALL.fy * y / z + SMALL.cy])

    jacobians = oracle.jacobians(points, SMALL)
    for point, jacobian in zip(points[:2], jacobians, strict=False):
        assert torch.allclose(jacobian, torch.autograd.functional.jacobian(to_pixels, point), rtol=1e-12)
    limit = (13 - 7.3) / 15 + 0.3 * 13 / 30
    assert jacobians[2, 0].tolist() == pytest.approx([7.5, 0, -15 * limit / 2], rel=1e-12)


def scalar_pixel(splats, row, column, background):
    """One pixel as the papers' loop has it: sort, skip, clamp, stop."""
    order = sorted((z, n) for n, z in enumerate(splats.z.tolist()) if splats.live[n])
    color, transmittance = np.zeros(3), 1.0
    for _, n in order:
        d = splats.means2d[n].numpy() - [column + 0.5, row + 0.5]
        conic = np.linalg.inv(splats.cov2d[n].numpy())
        alpha = min(0.99, splats.opacity[n].item() * math.exp(-0.5 * d @ conic @ d))
        if alpha < 1 / 255:
            continue
        if transmittance * (1 - alpha) < 1e-4:
            break
        color += transmittance * alpha * splats.color[n].numpy()
        transmittance *= 1 - alpha
    return color + transmittance * np.asarray(background)


@pytest.mark.parametrize("name", ["saturated", "opaque", "near_and_behind", "inside", "ties"])
def test_blending_matches_a_scalar_loop(name):
    scene = scenes.SCENES[name]().to("cpu", torch.float64)
    image = oracle.exact_render(*scene.parameters(), scene.camera, scene.background).image
    splats = oracle.exact_splats(*scene.parameters(), scene.camera)
    rng = np.random.default_rng(0)
    for row, column in zip(rng.integers(0, 30, 25), rng.integers(0, 33, 25), strict=True):
        expected = scalar_pixel(splats, row, column, scene.background)
        assert np.abs(image[row, column].numpy() - expected).max() < 1e-12


def differentiable(scene, **options):
    """A function of the five inputs and the background, and those as float64 leaves."""
    leaves = [tensor.clone().requires_grad_() for tensor in [*scene.parameters(), scene.background]]

    def images(*inputs):
        out = oracle.exact_render(*inputs[:5], scene.camera, inputs[5], **options)
        sure = ~out.fragile
        return out.image * sure[..., None], out.alpha * sure, out.depth * sure

    return images, leaves


@pytest.mark.parametrize(
    ("seed", "degree", "options"),
    [
        pytest.param(0, 0, {}, marks=pytest.mark.slow),
        pytest.param(1, 1, {"antialiasing": True}, marks=pytest.mark.slow),
        pytest.param(2, 2, {"sh_degree": 1}, marks=pytest.mark.slow),
        (3, 3, {}),
    ],
)
def test_gradients_match_central_differences(seed, degree, options):
    """Of every input number, on few Gaussians: some clamped at 0.99, some beyond the frame, some colors below 0."""
    scene = scenes.cloud(seed, 5, SMALL, degree, sigma=(3, 8), opacity=(0.5, 1), frame=0.4, low=-0.5, rest=0.3)
    images, leaves = differentiable(scene.to("cpu", torch.float64), **options)
    assert torch.autograd.gradcheck(images, leaves, eps=1e-7, atol=1e-5, rtol=1e-5, fast_mode=False)


@pytest.mark.parametrize("name", ["saturated", "inside", "needles", "opaque", "degree3"])
def test_gradients_match_directional_differences(name):
    scene = scenes.SCENES[name]().to("cpu", torch.float64)
    images, leaves = differentiable(scene)
    generator = torch.Generator().manual_seed(0)
    upstream = [torch.randn(out.shape, generator=generator, dtype=torch.float64) for out in images(*leaves)]

    def loss(*inputs):
        return sum((out * weight).sum() for out, weight in zip(images(*inputs), upstream, strict=True))

    gradients = torch.autograd.grad(loss(*leaves), leaves)
    for n, (leaf, gradient) in enumerate(zip(leaves, gradients, strict=True)):
        step = torch.randn(leaf.shape, generator=generator, dtype=torch.float64)
        step *= 1e-8 * leaf.detach().abs().clamp_min(1e-6)  # small beside each number: scales of 1e-5 stay positive
        ends = [loss(*leaves[:n], leaf + sign * step, *leaves[n + 1 :]).item() for sign in (1, -1)]
        expected = (gradient * step).sum().item()
        assert (ends[0] - ends[1]) / 2 == pytest.approx(expected, rel=1e-4, abs=1e-11)


def test_means2d_gradient_is_the_images():
    """A shift of every 2D mean is a shift of the principal point: covariance and colors stay."""
    scene = scenes.SCENES["degree1"]().to("cpu", torch.float64)
    _, leaves = differentiable(scene)
    out = oracle.exact_render(*leaves[:5], scene.camera, leaves[5])
    out.means2d.retain_grad()
    out.image.square().sum().backward()
    ends = []
    for step in (1e-6, -1e-6):
        shifted = scenes.replace(scene.camera, cx=scene.camera.cx + step)
        ends.append(oracle.exact_render(*leaves[:5], shifted, leaves[5]).image.square().sum().item())
    assert (ends[0] - ends[1]) / 2e-6 == pytest.approx(out.means2d.grad[:, 0].sum().item(), rel=1e-5)


@pytest.mark.parametrize("name", [name for name in scenes.SCENES if name not in ("ties", "empty")])
def test_scene_is_the_same_twice_and_its_order_is_sure(name):
    scene, again = scenes.SCENES[name](), scenes.SCENES[name]()
    assert all(torch.equal(a, b) for a, b in zip(scene.parameters(), again.parameters(), strict=True))
    camera = scene.camera
    z = scene.means.double() @ torch.tensor(camera.rotation[2].copy()) + camera.translation[2]
    z = z[z > 0].sort().values
    assert (z.diff() / z[1:] > 1e-5).all()
    assert ((z / 0.2 - 1).abs() > 1e-4).all()


def facts(name):
    """The oracle's render and projection of a scene."""
    scene = scenes.SCENES[name]().to("cpu", torch.float64)
    out = oracle.exact_render(*scene.parameters(), scene.camera, scene.background)
    return scene, out, oracle.exact_splats(*scene.parameters(), scene.camera)


def test_scenes_hold_what_their_names_say():
    scene, out, splats = facts("inside")
    slopes = (splats.means2d - scene.means.new_tensor([scene.camera.cx, scene.camera.cy])) / torch.tensor([14, 16])
    limits = 1.3 * torch.tensor([45 / 28, 37 / 32])
    assert ((slopes.abs() > limits).any(1) & out.touches).sum() >= 10
    _, out, splats = facts("negative_color")
    assert 0.2 < (splats.color[out.touches] == 0).double().mean() < 0.8
    _, out, _ = facts("saturated")
    assert (out.alpha > 1 - 2e-4).double().mean() > 0.5
    _, out, _ = facts("faint")
    assert 40 < out.touches.sum() < 80
    _, out, splats = facts("near_and_behind")
    assert (~splats.live).sum() > 60 and out.touches.sum() > 60
    scene, _, splats = facts("dense_tile")
    assert ((splats.means2d > 0) & (splats.means2d < 16)).all(1).sum() > 300
    _, out, _ = facts("layers_4000")
    assert out.touches.sum() == 4000


@pytest.mark.parametrize(("gap", "fragile"), [(0.0, False), (1e-8, True), (3e-7, True), (1e-4, False)])
def test_depths_that_differ_by_rounding_only_are_marked(gap, fragile):
    """Float32 may swap two Gaussians whose depths are neighbors there; equal depths go by index everywhere."""
    out = ball(z=[2.0, 2.0 * (1 + gap)], sigma=[0.3, 0.3], opacity=[0.5, 0.5], rgb=[[1, 0, 0], [0, 1, 0]])
    assert bool(out.fragile[3, 4]) == fragile

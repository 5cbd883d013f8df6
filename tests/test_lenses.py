"""Lenses: formulas against COLMAP's, their inverse and their derivatives, where they fold, a panorama's seam."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scenes
import torch
from hostile import refusal
from scenes import LENSES
from scipy.spatial.transform import Rotation

from warp_splat import Camera, CameraParameters, RasterOptions, rasterize
from warp_splat.kernels.formula import Notes, Number
from warp_splat.kernels.project import affine
from warp_splat.lenses import Lens
from warp_splat.lenses.formulas import MODELS, PINHOLE, Family
from warp_splat.raster.data import Gaussians
from warp_splat.raster.drivers import CPU
from warp_splat.raster.project import project

pycolmap = pytest.importorskip("pycolmap")


def colmap_camera(lens):
    """COLMAP's camera with focal length 1 and the principal point at 0; a panorama has neither."""
    if lens.model == "EQUIRECTANGULAR":
        return pycolmap.Camera(model=lens.model, width=200, height=100, params=[200, 100])
    camera = pycolmap.Camera.create_from_model_name(0, lens.model, 1.0, 100, 100)
    focals = len(camera.focal_length_idxs())
    camera.params = [1.0] * focals + [0.0, 0.0, *lens.coefficients]
    return camera


def directions(most, count=300, least_z=0.05):
    """Unit vectors up to an angle from the axis, those that COLMAP sees."""
    rng = np.random.default_rng(1)
    angle, around = rng.uniform(0, most, count), rng.uniform(0, 2 * np.pi, count)
    angle[:3] = 0, 1e-9, 1e-4
    rays = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], 1)
    return rays[rays[:, 2] > least_z]


@pytest.mark.parametrize("model", MODELS)
def test_lenses_show_points_where_colmap_does(model):
    lens, camera = LENSES[model], colmap_camera(LENSES[model])
    rays = directions(lens.limit, least_z=-1 if model == "EQUIRECTANGULAR" else 0.05)
    wanted = camera.img_from_cam(5.0 * rays)
    if model == "EQUIRECTANGULAR":
        wanted = (wanted - [100, 50]) * np.pi / 100
    found = lens.distorted(5.0 * rays)
    assert len(rays) > 100
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_what_a_lens_shows_is_found_again(model):
    lens = LENSES[model]
    rays = directions(0.98 * lens.limit, least_z=-1 if lens.family.wide else 0.05)
    np.testing.assert_allclose(lens.undistorted(lens.distorted(rays)), rays, atol=1e-7)


#: The words of kernels, in NumPy.
WORDS = {
    "times": np.multiply,
    "fma": lambda a, b, c: a * b + c,
    "inverse": lambda a: 1 / a,
    "root": np.sqrt,
    "angle": np.arctan2,
    "less": np.less,
    "pick": lambda mask, a, b: np.where(mask > 0, a, b),
    "fill": lambda value, like: np.full_like(like, value),
}


@pytest.mark.parametrize("model", MODELS)
def test_derivatives_that_are_written_down_are_those_of_the_formula(model):
    lens = LENSES[model]
    x, y, z = directions(0.95 * lens.limit, least_z=-1 if lens.family.wide else 0.1)[3:].T * 3.0
    notes = Notes()
    one = notes.given("1.0").name
    variables = [Number(notes, "xyz"[i], tuple(one if i == j else None for j in range(3))) for i in range(3)]
    u, v = lens.family.formula([notes.given(f"k[{i}]") for i in range(lens.family.count)], *variables)
    known = {**WORDS, "k": lens.numbers, "x": x, "y": y, "z": z}
    names = [notes.real(name) for name in (u.name, v.name, *u.slopes, *v.slopes)]
    exec("\n".join(notes.lines(names, "x")), known)
    found = np.stack([known[name] for name in names])
    step = 1e-6
    places = lens.distorted(np.stack([x, y, z], 1)).T
    np.testing.assert_allclose(found[:2], places, atol=1e-12)
    for axis in range(3):
        ahead, back = (np.stack([x, y, z], 1) + side * step * np.eye(3)[axis] for side in (1, -1))
        wanted = (lens.distorted(ahead) - lens.distorted(back)).T / (2 * step)
        np.testing.assert_allclose(found[[2 + axis, 5 + axis]], wanted, rtol=1e-6, atol=1e-7)


@pytest.mark.slow
def test_a_panorama_that_turns_is_a_picture_that_rolls(device):
    """At the seam nothing is lost and nothing is there twice."""
    scene = scenes.SCENES["panorama"]().to(device)
    camera, columns = scene.camera, 23
    turn = Rotation.from_euler("y", 2 * np.pi * columns / camera.width).as_matrix()
    turned = replace(camera, rotation=turn @ camera.rotation, translation=turn @ camera.translation)
    options = RasterOptions(alpha_min=1e-6)
    still, rolled = (rasterize(*scene.parameters(), view, options=options) for view in (camera, turned))
    assert (still.image - still.image.roll(1, 1)).abs().max() > 0.1
    torch.testing.assert_close(rolled.image.roll(-columns, 1), still.image, rtol=0, atol=2e-3)
    assert (rolled.image.roll(-columns, 1) - still.image).abs().mean() < 1e-5


def picture(model="OPENCV", coefficients=(0.1, 0.0, 0.0, 0.0), size=(40, 30), focal=(20.0, 20.0)):
    width, height = size
    return Camera(width, height, *focal, width / 2, height / 2, np.eye(3), np.zeros(3), lens=Lens(model, coefficients))


def drawn(projection):
    scene = scenes.SCENES["single"]()
    return rasterize(*scene.parameters(), picture(), options=RasterOptions(projection=projection))


FOLDS = (-0.5, 0, 0, 0)
PANORAMA = {"model": "EQUIRECTANGULAR", "coefficients": ()}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: picture("ORTHO"), "Lens model: expected one of SIMPLE_RADIAL, .*, got 'ORTHO'"),
        (lambda: picture(coefficients=(0.1, 0.2)), r"Lens OPENCV: expected 4 finite coefficients, got \(0.1, 0.2\)"),
        (lambda: picture(coefficients=(0.1, 0.2, 0.0, np.nan)), "expected 4 finite coefficients"),
        (lambda: picture(coefficients=FOLDS), "Camera lens OPENCV: expected .* fold it 39 degrees from the axis"),
        (lambda: picture("OPENCV_FISHEYE", FOLDS, focal=(9, 9)), "OPENCV_FISHEYE: expected .* fold it 47 degrees"),
        (lambda: picture(**PANORAMA), "expected a picture of 2:1 .*, got 114.6 x 85.9 degrees"),
        (lambda: picture(**PANORAMA, size=(90, 30), focal=(90 / (2 * np.pi), 30 / np.pi)), "2:1, got 90 x 30 pixels"),
        (lambda: replace(picture(), lens=3), r"Camera lens: expected a warp_splat\.Lens or None, got 3"),
        (lambda: drawn("ellipsoid"), r"options\.projection: expected affine or unscented for a camera with a lens"),
        (lambda: drawn(affine.PROJECTION), "for a camera with a lens, got one of your own"),
    ],
)
def test_what_is_no_lens_or_knows_none_is_refused(make, message):
    refusal(make, match=message)


def test_panoramas_are_resized_to_whole_pixels():
    assert scenes.SCENES["panorama"]().camera.resized(13, 7).width == 13


@pytest.mark.parametrize(("model", "coefficients"), [("OPENCV", (0.0,) * 4), ("FOV", (0.0,))])
def test_a_lens_without_distortion_is_a_pinhole(model, coefficients, device):
    scene = scenes.SCENES["degree1"]().to(device)
    bent = replace(scene.camera, lens=Lens(model, coefficients))
    pinhole, drawn = (rasterize(*scene.parameters(), camera) for camera in (scene.camera, bent))
    assert PINHOLE.count == 0 and bent.lens.limit == pytest.approx(np.pi / 2)
    torch.testing.assert_close(drawn.image, pinhole.image, rtol=0, atol=1e-5)


@pytest.mark.parametrize(("model", "coefficients"), [("FOV", (0.0,)), ("DIVISION", (-0.1,)), ("DIVISION", (0.1,))])
def test_lenses_at_their_ends(model, coefficients, device):
    """No number overflows near the direction that is infinitely far out."""
    scene = scenes.SCENES["single"]().to(device)
    camera = replace(scene.camera, lens=Lens(model, coefficients))
    around = torch.randn(4000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1e-3, 1e-3, 1.0])
    means = (around - torch.from_numpy(camera.translation)) @ torch.from_numpy(camera.rotation)
    rows = [tensor[:1].expand(4000, *tensor.shape[1:]) for tensor in scene.parameters()[1:]]
    rasterize(means.float().to(device), *rows, camera)


@pytest.mark.parametrize("projection", ["affine", pytest.param("unscented", marks=pytest.mark.long)])
def test_a_panorama_shows_what_is_straight_behind(projection, device):
    """Half of it at either end of the picture."""
    leaves, options = scenes.one_gaussian(device, [0.0, 0.0, -3.0], 0.3), RasterOptions(projection=projection)
    alpha = rasterize(*leaves, panorama(), options=options).alpha.detach()
    assert alpha[:, [0, -1]].max() > 0.7 and alpha[:, alpha.shape[1] // 2].max() == 0
    torch.testing.assert_close(alpha, alpha.flip(1), rtol=0, atol=1e-4)
    torch.testing.assert_close(alpha, alpha.flip(0), rtol=0, atol=1e-4)


def panorama():
    """Around the origin."""
    return replace(scenes.SCENES["panorama"]().camera, rotation=np.eye(3), translation=np.zeros(3))


@pytest.mark.parametrize("down", [3.0, -3.0])
def test_a_pole_is_seen_at_all_longitudes(down, device):
    """As a band all around, which is fainter at most by 30 %, half a turn away; on that side alone; with gradients."""
    leaves = scenes.one_gaussian(device, [1e-4, down, 1e-4], 0.3)
    out = rasterize(*leaves, panorama())
    at_pole, away = (out.alpha[-1], out.alpha[0]) if down > 0 else (out.alpha[0], out.alpha[-1])
    assert at_pole.min() > 0.7 * at_pole.max() > 0.4 and away.max() == 0
    out.image.square().sum().backward()
    assert all(leaf.grad.isfinite().all() for leaf in leaves) and leaves[3].grad.abs().min() > 0


def test_what_a_panorama_shows_at_its_seam_and_near_its_poles_is_found_again():
    camera = panorama()
    columns, rows = np.array([1e-6, 0.5, 30.0, 59.5, 60 - 1e-6]), np.array([0.25, 0.5, 15.0, 29.5, 29.75])
    pixels = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    np.testing.assert_allclose(camera.pixels(camera.rays(pixels)), pixels, atol=1e-9)
    ends = camera.rays(np.stack([[0.0, camera.width], [15.0, 15.0]], 1))
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-12)


def test_channels_cross_the_seam(device):
    scene = scenes.SCENES["panorama"]().to(device)
    features = torch.rand(len(scene.means), 3, generator=torch.Generator().manual_seed(1)).to(device).requires_grad_()
    out = rasterize(*scene.parameters(), scene.camera, features=features, options=RasterOptions(strongest=1))
    sh = ((features.detach() - 0.5) / scenes.C0)[:, None]
    colors = rasterize(*scene.parameters()[:4], sh, scene.camera)
    torch.testing.assert_close(out.features, colors.image, rtol=0, atol=1e-5)
    assert out.strongest.max() < len(scene.means) and (out.strongest[:, [0, -1]] >= 0).any()
    out.features.sum().backward()
    assert float(features.grad.sum()) == pytest.approx(3 * float(out.alpha.sum()), rel=1e-4)


MORE = [("opencv", "affine"), ("panorama", "affine"), ("fisheye", "unscented")]


@pytest.mark.parametrize(
    ("name", "projection"),
    [
        ("fisheye", "affine"),
        pytest.param("rolling degree2", "affine", marks=pytest.mark.slow),
        *(pytest.param(*case, marks=pytest.mark.long) for case in MORE),
    ],
)
def test_one_at_a_time_as_on_a_gpu_is_the_same(name, projection):
    """The kernels of a GPU, against sixteen Gaussians at once; of a shutter, gradients of the poses, too."""
    scene, options, found = scenes.scene_of(name), RasterOptions(projection=projection), []
    for driver in (CPU, replace(CPU, lanes=1)):
        given, camera = [tensor.clone().requires_grad_() for tensor in scene.parameters()], scene.camera
        gaussians = Gaussians(*given[:4], given[4][:, :1], given[4][:, 1:])
        if camera.shutter:
            camera = CameraParameters(camera)
            given += [camera.twist, camera.last_twist, camera.intrinsics]
        splats = project(gaussians, camera, options, driver)
        upstream = [torch.ones_like(part) for part in splats[:5]]
        found.append([*splats[:6], *torch.autograd.grad(splats[:5], given, upstream)])
    for sixteen, one in zip(*found, strict=True):
        torch.testing.assert_close(sixteen, one, rtol=5e-5, atol=1e-5 * max(float(one.detach().abs().max()), 1e-9))


def folding(k, x, y, z):
    u, v = x / z, y / z
    shrunk = 1 + k[0] * (u * u + v * v)
    return u * shrunk, v * shrunk


def own_camera(monkeypatch, formula, coefficient=0.1):
    monkeypatch.setitem(MODELS, "OWN", (Family(formula, count=1, wide=False), 1))
    return Camera(96, 64, 60.0, 60.0, 48.0, 32.0, np.eye(3), np.zeros(3), lens=Lens("OWN", (coefficient,)))


def test_a_name_may_get_another_formula(monkeypatch):
    reach = own_camera(monkeypatch, lambda k, x, y, z: (x / z, y / z)).reach
    assert own_camera(monkeypatch, folding).reach < reach - 0.01
    own_camera(monkeypatch, lambda k, x, y, z: (x / z, y / z), -0.9)
    refusal(lambda: own_camera(monkeypatch, folding, -0.9), match="fold it")


@pytest.mark.parametrize(
    ("message", "scale"),
    [
        ("found one by if, and, or", lambda k, _: 2.0 if k[0] > 0 else 1.0),
        ("found float", lambda k, _: math.sqrt(1 + k[0] * k[0])),
        ("found float", lambda k, _: int(k[0]) + 1.0),
        ("found less_equal", lambda k, r: np.where(r <= 0.1, 1.0, 1 + k[0] * r)),
        ("found multiply with out", lambda k, r: np.multiply(k[0], r, out=r if isinstance(r, np.ndarray) else (r,))),
    ],
)
def test_what_a_formula_cannot_be_is_refused(monkeypatch, message, scale):
    def formula(k, x, y, z):
        s = scale(k, (x * x + y * y) / (z * z))
        return x / z * s, y / z * s

    scene = scenes.SCENES["degree1"]()
    camera = own_camera(monkeypatch, formula)
    refusal(lambda: rasterize(*scene.parameters(), camera), match=message)


def test_a_choice_counts_as_true_what_is_not_zero(monkeypatch, device):
    def formula(k, x, y, z):
        return np.where(x, 0.5, 1.0) * np.where(0 * k[0], 0.0, x / z), np.where(k[0], 1.0, 0.5) * y / z

    means = torch.tensor([[-0.5, 0.2, 2.0], [0.5, -0.4, 2.0]], device=device)
    quats, scales = torch.eye(4, device=device)[:1].expand(2, 4), torch.full((2, 3), 0.05, device=device)
    opacities, sh = torch.full((2,), 0.7, device=device), torch.zeros(2, 1, 3, device=device)
    out = rasterize(means, quats, scales, opacities, sh, own_camera(monkeypatch, formula, -0.1))
    wanted = torch.tensor([[48 - 7.5, 32 + 6.0], [48 + 7.5, 32 - 12.0]])
    torch.testing.assert_close(out.means2d.cpu(), wanted, rtol=0, atol=1e-4)

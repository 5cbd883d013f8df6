"""The renderer on Warp's tape: the bits of torch, between kernels of the user's own, and nothing else recorded."""

import re
import sys

import numpy as np
import pytest
import torch
import warp as wp
from commands import ROOT
from common import using
from hostile import refusal
from scenes import SCENES, cloud, make_camera

import warp_splat
from warp_splat import CameraParameters, InputError, RasterOptions, tape
from warp_splat.config import ADJOINTS
from warp_splat.raster.drivers import CPU, CUDA

KINDS = {"means": wp.vec3, "quats": wp.vec4, "scales": wp.vec3, "opacities": wp.float32, "sh": wp.vec3}
TWIST = [0.01, -0.02, 0.015, 0.05, -0.03, 0.02]


@wp.kernel
def twice(x: wp.array[wp.vec3], y: wp.array[wp.vec3]):
    y[wp.tid()] = 2.0 * x[wp.tid()]


@wp.kernel
def weigh(image: wp.array2d[wp.vec3], alpha: wp.array2d[float], weights: wp.array2d[wp.vec4], loss: wp.array[float]):
    y, x = wp.tid()
    w = weights[y, x]
    lit = wp.dot(image[y, x], wp.vec3(w[0], w[1], w[2]))
    wp.atomic_add(loss, 0, lit + alpha[y, x] * w[3])


def scene_of(device, name="degree1"):
    """A scene, numbers of its camera, and what the loss weighs its pixels with."""
    scene = SCENES[name]().to(device)
    camera = scene.camera
    weights = torch.randn(camera.height, camera.width, 4, generator=torch.Generator().manual_seed(0)).to(device)
    return scene, [camera.fx, camera.fy, camera.cx, camera.cy], weights


def arrays_of(scene, **wanted):
    """Warp arrays of a scene's Gaussians, by name; those ``wanted`` have a gradient."""
    return {name: wp.from_torch(getattr(scene, name), KINDS[name], requires_grad=name in wanted) for name in KINDS}


def ones(image):
    """The gradient of the sum of an image."""
    return {image: wp.full_like(image, wp.vec3(1.0))}


def by_torch(device, mode="manual", options=None):
    """Gradients of halved means, of the others, of background and camera."""
    scene, intrinsics, weights = scene_of(device)
    leaves = [tensor.clone().requires_grad_() for tensor in (scene.means / 2, *scene.parameters()[1:])]
    background = scene.background.clone().requires_grad_()
    numbers = [torch.tensor(values, dtype=torch.float64, device=device) for values in (TWIST, intrinsics)]
    learned = [tensor.requires_grad_() for tensor in numbers]
    camera = CameraParameters(scene.camera, *learned)
    out = warp_splat.rasterize(2.0 * leaves[0], *leaves[1:], camera, background, mode, options)
    torch.autograd.backward([out.image, out.alpha], [weights[..., :3].contiguous(), weights[..., 3].contiguous()])
    return out, [leaf.grad for leaf in (*leaves, background, *learned)]


def on_tape(device, mode="manual", options=None, requires_grad=True):
    """The tape, its loss, and the arrays of :func:`by_torch`."""
    wp.init()
    scene, intrinsics, weights = scene_of(device)
    given = {name: getattr(scene, name) for name in KINDS} | {"means": scene.means / 2}
    arrays = [wp.from_torch(given[name].clone(), KINDS[name], requires_grad=requires_grad) for name in KINDS]
    arrays.append(wp.from_torch(scene.background.clone(), requires_grad=requires_grad))
    for values in (TWIST, intrinsics):
        numbers = torch.tensor(values, dtype=torch.float64, device=device)
        arrays.append(wp.from_torch(numbers, requires_grad=requires_grad))
    loss = wp.from_torch(torch.zeros(1, device=device), requires_grad=True)
    with wp.Tape() as recorded:
        means = wp.empty_like(arrays[0], requires_grad=True)
        wp.launch(twice, len(means), [arrays[0], means], device=device)
        learned = {"twist": arrays[6], "intrinsics": arrays[7]}
        out = tape.rasterize(means, *arrays[1:5], scene.camera, arrays[5], mode, options, **learned)
        weights = wp.from_torch(weights, wp.vec4)
        wp.launch(weigh, out.image.shape, [out.image, out.alpha, weights, loss], device=device)
    assert len(recorded.launches) == 3
    return recorded, loss, arrays, out


@pytest.mark.parametrize(("mode", "driver"), [*((mode, CPU) for mode in ADJOINTS), ("manual", CUDA)])
def test_the_bits_are_those_of_torch(mode, driver, device):
    options = RasterOptions(depth=True, antialiasing=True)
    with using(driver):
        expected, gradients = by_torch(device, mode, options)
        recorded, loss, arrays, out = on_tape(device, mode, options)
        recorded.backward(loss)
    assert torch.equal(wp.to_torch(out.image), expected.image) and torch.equal(wp.to_torch(out.alpha), expected.alpha)
    assert torch.equal(wp.to_torch(out.depth), expected.depth) and torch.equal(wp.to_torch(out.radii), expected.radii)
    assert all(torch.equal(wp.to_torch(array.grad), grad) for array, grad in zip(arrays, gradients, strict=True))


@pytest.mark.parametrize("mode", ADJOINTS)
def test_two_ways_back_add_up_unless_the_tape_is_zeroed_and_inputs_may_change(mode, device):
    recorded, loss, arrays, out = on_tape(device, mode)
    recorded.backward(loss)
    once = [array.grad.numpy().copy() for array in arrays]
    assert not out.image.grad.numpy().any(), "read and zeroed, as Warp's kernels do"
    recorded.zero()
    assert not any(array.grad.numpy().any() for array in arrays)
    for array in arrays:
        wp.to_torch(array, requires_grad=False).mul_(0.8)
    for times in (1, 2):
        recorded.backward(loss)
        assert all(np.array_equal(array.grad.numpy(), times * grad) for array, grad in zip(arrays, once, strict=True))


def test_gradients_of_the_pixels_are_kept_where_that_is_asked_for(device):
    recorded, loss, _, out = on_tape(device)
    out.image.retain_grad = True
    recorded.backward(loss)
    assert out.image.grad.numpy().any() and not out.alpha.grad.numpy().any()


@pytest.mark.parametrize("wanted", KINDS)
def test_arrays_that_want_no_gradient(wanted, device):
    scene, _, _ = scene_of(device)
    arrays = arrays_of(scene, **{wanted: True})
    with wp.Tape() as recorded:
        out = tape.rasterize(**arrays, camera=scene.camera)
    recorded.backward(grads=ones(out.image))
    learned = {name for name, array in arrays.items() if array.grad is not None and array.grad.numpy().any()}
    assert learned == {wanted}


def test_features_alone_may_want_a_gradient(device):
    """What no gradient reaches, the image, is left alone; that of a sum of features is the weight of each Gaussian."""
    scene, _, _ = scene_of(device)
    features = wp.from_torch(torch.ones(len(scene.means), 1).to(device), requires_grad=True)
    with wp.Tape() as recorded:
        out = tape.rasterize(**arrays_of(scene), camera=scene.camera, features=features)
    recorded.backward(grads={out.features: wp.full_like(out.features, 1.0)})
    assert features.grad.numpy().sum() == pytest.approx(out.alpha.numpy().sum(), rel=1e-4)


def test_without_gradients_or_a_tape_nothing_is_recorded(device):
    scene, _, _ = scene_of(device)
    with wp.Tape() as recorded:
        still = tape.rasterize(**arrays_of(scene), camera=scene.camera)
    out = tape.rasterize(**arrays_of(scene, means=True), camera=scene.camera)
    assert not recorded.launches and out.image.grad is None
    assert np.array_equal(out.image.numpy(), still.image.numpy())


def test_warps_quaternions_have_w_last(device):
    scene, _, _ = scene_of(device)
    gradients = []
    for turn, kind in ((0, wp.vec4), (-1, wp.quat)):
        quats = wp.from_torch(scene.quats.roll(turn, 1), kind, requires_grad=True)
        with wp.Tape() as recorded:
            out = tape.rasterize(**arrays_of(scene) | {"quats": quats}, camera=scene.camera)
        recorded.backward(grads=ones(out.image))
        gradients.append(wp.to_torch(quats.grad).roll(-turn, 1))
    assert gradients[0].any() and torch.equal(*gradients)


@pytest.mark.parametrize("mode", ADJOINTS)
def test_rasterize_of_tensors_inside_a_tape_records_nothing_and_says_nothing(mode, device, threads, capfd):
    """Whatever threads take part: 6,000 Gaussians are enough to share every launch."""
    scene = cloud(3, 6000, make_camera(200, 150), degree=1).to(device)
    leaves = [tensor.clone().requires_grad_() for tensor in scene.parameters()]
    threads(3)
    with wp.Tape() as recorded:
        out = warp_splat.rasterize(*leaves, scene.camera, adjoint=mode)
        out.image.sum().backward()
    assert not recorded.launches and leaves[0].grad.any()
    recorded.backward()
    assert "Warp" not in "".join(capfd.readouterr()).replace("Warp CUDA warning", "")


def test_a_capture_on_the_cpu_is_refused():
    """It would replay nothing."""
    scene = cloud(3, 50, make_camera(40, 30), degree=1)
    with pytest.raises(InputError, match="ScopedCapture: expected none on the CPU"), wp.ScopedCapture(device="cpu"):
        warp_splat.rasterize(*scene.parameters(), scene.camera)
    warp_splat.rasterize(*scene.parameters(), scene.camera)


@pytest.mark.parametrize(
    ("name", "change", "found"),
    [
        ("means", wp.to_torch, "expected a Warp array, got Tensor; rasterize takes"),
        ("means", lambda a: wp.array(a.numpy(), dtype=wp.vec3d), "expected an array of float32, got one of vec3d"),
        ("quats", lambda a: a[:3], r"quats: expected shape \[120, 4\], got \[3, 4\]"),
        ("quats", lambda a: wp.array(a.numpy()[:, :3], dtype=wp.vec3), r"quats: .* got \[120, 3\]"),
        ("sh", lambda a: (a, None), r"sh\[1\]: expected a Warp array, got NoneType"),
        ("twist", lambda _: wp.zeros(5, dtype=float), "twist: expected a tensor of 6 real numbers"),
        ("features", lambda _: wp.zeros((120, 0), dtype=float), "features: expected 1 to 512 channels, got 0"),
        ("features", lambda _: wp.zeros((119, 2), dtype=float), r"features: expected shape \[120, C\], got \[119, 2\]"),
        ("twist", lambda _: wp.zeros(6, dtype=int), "twist: expected an array of float32 or float64, got one of int"),
    ],
)
def test_bad_input(name, change, found):
    wp.init()  # where no other test has run before
    scene, _, _ = scene_of("cpu")
    arrays = arrays_of(scene)
    refusal(lambda: tape.rasterize(**arrays | {name: change(arrays.get(name))}, camera=scene.camera), match=found)
    with pytest.raises(InputError, match="camera: expected a Camera, got CameraParameters"):
        tape.rasterize(**arrays, camera=warp_splat.CameraParameters(scene.camera))


def test_no_gaussian_at_all(device):
    wp.init()
    scene = SCENES["empty"]().to(device)
    shapes = {name: getattr(scene, name).shape[: 2 if name == "sh" else 1] for name in KINDS}
    kept = {"device": device, "requires_grad": True}
    arrays = {name: wp.zeros(shape, dtype=KINDS[name], **kept) for name, shape in shapes.items()}
    with wp.Tape() as recorded:
        out = tape.rasterize(**arrays, camera=scene.camera)
    recorded.backward(grads=ones(out.image))
    assert not out.image.numpy().any()


def test_a_body_in_flight_is_fitted_to_pictures(tmp_path, monkeypatch):
    """The page's example: two kernels, the renderer and a third kernel, eighty times on a tape."""
    monkeypatch.syspath_prepend(tmp_path)
    names = {}
    for text in re.findall(r"^```python\n(.*?)^```$", (ROOT / "docs/tape.md").read_text(), re.MULTILINE | re.DOTALL):
        if file := re.match(r"# (\w+\.py)\n", text):
            (tmp_path / file[1]).write_text(text)
        else:
            exec(text, names)
    sys.modules.pop("flight")
    assert np.allclose(names["throw"].numpy(), names["THROW"], atol=2e-3)
    assert np.allclose(names["spin"].numpy(), names["SPIN"], atol=2e-3)


@pytest.mark.parametrize("name", ["means", "image"])
def test_worlds_of_another_number_than_cameras_are_refused(name, device):
    scene, *_ = scene_of(device)
    arrays, shape = arrays_of(scene), (3, scene.camera.height, scene.camera.width)
    if name == "means":
        arrays[name] = wp.from_torch(torch.stack([scene.means] * 3), wp.vec3)
    out = {"image": wp.zeros(shape, dtype=wp.vec3, device=device)} if name == "image" else None
    with pytest.raises(InputError, match=f"{name}: expected one array for each of 2 cameras, got 3"):
        tape.rasterize_worlds(**arrays, cameras=[scene.camera] * 2, out=out)


def test_worlds_share_features_and_write_into_one_array(device):
    scene, *_ = scene_of(device)
    features, twists = torch.rand(len(scene.means), 2, device=device), wp.zeros(2, wp.spatial_vector, device=device)
    shown = wp.zeros((2, scene.camera.height, scene.camera.width, 2), dtype=float, device=device)
    cameras = [scene.camera, make_camera(scene.camera.width, scene.camera.height, seed=3)]
    more = {"features": wp.from_torch(features), "twist": twists, "out": {"features": shown}}
    tape.rasterize_worlds(**arrays_of(scene), cameras=cameras, **more)
    for camera, found in zip(cameras, wp.to_torch(shown), strict=True):
        assert torch.equal(found, warp_splat.rasterize(*scene.parameters(), camera, features=features).features)


def test_worlds_are_separate_calls_into_one_array(device):
    """Two worlds of their own means, the rest in common, each with its camera; and no new arrays for the pictures."""
    scene, _, weights = scene_of(device)
    arrays, both = arrays_of(scene), torch.stack([scene.means, scene.means + 0.05])
    means = wp.from_torch(both, wp.vec3, requires_grad=True)
    cameras = [scene.camera, make_camera(scene.camera.width, scene.camera.height, seed=3)]
    shape = (2, scene.camera.height, scene.camera.width)
    images = wp.zeros(shape, dtype=wp.vec3, device=device, requires_grad=True)
    alphas = wp.zeros(shape, dtype=float, device=device, requires_grad=True)
    surface = torch.full(shape, float(scene.means.norm(dim=1).median()), device=device)
    surface[1] = 0.0  # no surface
    given = {**arrays, "means": means, "out": {"image": images, "alpha": alphas}}
    with wp.Tape() as recorded:
        found = tape.rasterize_worlds(**given, cameras=cameras, hidden_from=wp.from_torch(surface))
    recorded.backward(grads={images: wp.from_torch(weights[..., :3].expand(2, -1, -1, -1).contiguous(), wp.vec3)})
    for world, camera in enumerate(cameras):
        leaf = both[world].clone().requires_grad_()
        options = RasterOptions(hidden_from=surface[world])
        expected = warp_splat.rasterize(leaf, *scene.parameters()[1:], camera, options=options)
        (expected.image * weights[..., :3]).sum().backward()
        assert torch.equal(wp.to_torch(images, requires_grad=False)[world], expected.image)
        assert torch.equal(wp.to_torch(found[world].alpha, requires_grad=False), expected.alpha)
        assert torch.equal(wp.to_torch(means.grad)[world], leaf.grad)
    with pytest.raises(InputError, match="options: expected"):
        tape.rasterize(*arrays.values(), scene.camera, options={}, hidden_from=wp.from_torch(surface[0]))
    refusal(lambda: tape.rasterize_worlds(**given, cameras=scene.camera), match="cameras: expected a sequence")
    refusal(lambda: tape.rasterize(*arrays.values(), scene.camera, out=images), match="got 'array'")
    refusal(lambda: tape.rasterize_worlds(**given | {"out": 7}, cameras=cameras), match="got 'int'")
    wrong = {"image": r"out\['image'\]: expected .* got \[3, 3, 3\]", "depth": "some of image, alpha, got 'depth'"}
    for name, sentence in wrong.items():
        with pytest.raises(InputError, match=sentence):
            tape.rasterize(*arrays.values(), scene.camera, out={name: wp.zeros((3, 3), dtype=wp.vec3)})

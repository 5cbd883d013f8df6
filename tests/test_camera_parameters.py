"""What a camera that learns may be, what is refused, and that check_gradients and Adam make use of its gradients."""

from dataclasses import replace

import cameras
import numpy as np
import pytest
import scenes
import torch
from exact_cameras import exact_camera
from hostile import refusal
from learned_cameras import DEPTH, HERE, NEAR, OTHER, PARTS, PLAIN, gradients_of, learned
from scenes import SCENES, SHUTTER, scene_of
from scipy.spatial.transform import Rotation

from warp_splat import CameraParameters, RasterOptions, check_gradients, rasterize, rasterize_views
from warp_splat.raster.differences import INPUTS
from warp_splat.raster.project import Project

FINITE = "twist: expected finite numbers, of which the rotation vector"
NO_COEFFICIENTS = "coefficients: expected None for a camera"
POSE = (*PARTS["twist"], *PARTS["intrinsics"])


@pytest.mark.parametrize("start", [HERE, NEAR, *(tuple(r * n for n in (0.6, 0, 0.8, 1, 2, 3)) for r in (1e-9, 0.5, 3))])
@pytest.mark.parametrize("name", ["off_center", "rolling off_center"])
def test_the_camera_is_that_of_the_exponential_map(name, start):
    base = scene_of(name).camera
    if base.shutter and np.linalg.norm(start) > 1:
        return  # more than a shutter turns
    numbers = learned(base, start)
    found = CameraParameters(base, **numbers).camera
    exact = exact_camera(base, numbers["twist"], numbers["intrinsics"], numbers.get("last_twist"))
    np.testing.assert_allclose(found.rotation, exact.rotation.detach(), atol=1e-14)
    np.testing.assert_allclose(found.translation, exact.translation.detach(), atol=1e-13)
    assert found.fy == base.fy and found.width == base.width
    if base.shutter:
        np.testing.assert_allclose(found.shutter.turn, exact.shutter.turn.detach(), atol=1e-13)
        np.testing.assert_allclose(found.shutter.shift, exact.shutter.shift.detach(), atol=1e-13)


@pytest.mark.parametrize("angle", [3.0, 6.283])
def test_a_turn_is_that_of_scipy(angle):
    base, axis = SCENES["single"]().camera, np.array([0.48, -0.6, 0.64])
    twist = torch.tensor([*(angle * axis), 0.1, 0.2, 0.3], dtype=torch.float64)
    turn = Rotation.from_rotvec(angle * axis).as_matrix()
    found = CameraParameters(base, twist).camera
    np.testing.assert_allclose(found.rotation, turn @ base.rotation, atol=1e-10)
    np.testing.assert_allclose(found.translation, turn @ base.translation + [0.1, 0.2, 0.3], atol=1e-9)


@pytest.mark.parametrize("kind", ["pinhole", "lens", "shutter"])
def test_any_number_of_threads(kind, same_by_threads):
    scene = scenes.cloud(0, 1003, scenes.make_camera(64, 48), degree=1)
    more = {"pinhole": {}, "lens": {"lens": SCENES["opencv"]().camera.lens}, "shutter": {"shutter": SHUTTER}}[kind]
    scene, weight = replace(scene, camera=replace(scene.camera, **more)), torch.rand(48, 64, 3)
    found = same_by_threads(lambda: gradients_of(scene, {"image": weight}).values())
    assert torch.cat(found).abs().min() > 0


@pytest.mark.parametrize("count", [0, 16, 17])
def test_any_number_of_gaussians(count):
    """Whole groups of sixteen, and what is left over: more that nobody sees change nothing."""
    scene = SCENES["opencv"]()
    weight = {"image": torch.ones(scene.camera.height, scene.camera.width, 3)}
    few, more = ([tensor[:rows].clone() for tensor in scene.parameters()] for rows in (count, count + 5))
    more[3][count:] = 0.0
    found = [gradients_of(scene, weight, leaves=leaves)["coefficients"] for leaves in (few, more)]
    assert torch.equal(*found) and bool(found[0].any()) == (count > 0)


def test_only_what_is_wanted():
    scene = SCENES["degree1"]()
    shared = torch.tensor([40.0, 41.0, 18.0, 15.0], requires_grad=True)  # float32, as a model of one's own may have it
    cameras = [CameraParameters(scene.camera, torch.zeros(6), shared) for _ in range(2)]
    for out in rasterize_views(*scene.parameters(), cameras):
        out.image.sum().backward()
    assert shared.grad.dtype == torch.float32 and cameras[0].twist.grad is None
    both, alone = shared.grad.clone(), CameraParameters(scene.camera, intrinsics=shared)
    shared.grad = None
    rasterize(*scene.parameters(), alone).image.sum().backward()
    assert torch.equal(both, 2 * shared.grad)


@pytest.mark.parametrize("name", ["near_and_behind", "opencv"])
def test_what_is_not_drawn_or_not_finite_says_nothing(name):
    scene = SCENES[name]()
    numbers = learned(scene.camera)
    out = rasterize(*scene.parameters(), CameraParameters(scene.camera, **numbers))
    culled, drawn = ((out.radii == 0).nonzero()[:, 0], (out.radii > 0).nonzero()[:, 0])
    weight = torch.zeros_like(out.means2d)
    weight[culled] = 1.0
    (out.means2d * weight).sum().backward(retain_graph=True)
    assert len(culled) > 10 and not any(leaf.grad.any() for leaf in numbers.values())
    weight[drawn[0]], weight[drawn[1]] = torch.inf, 1.0
    (out.means2d * weight).sum().backward()
    assert all(leaf.grad.isfinite().all() and leaf.grad.any() for leaf in numbers.values())
    assert numbers["intrinsics"].grad.tolist()[2:] == [1.0, 1.0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("camera",), "base: expected a warp_splat.Camera, got str"),
        ((None, torch.zeros(5)), r"twist: expected a tensor of 6 real numbers, got torch.float32 \[5\]"),
        ((None, [0.0] * 6), "twist: expected a tensor of 6 real numbers, got list"),
        ((None, None, torch.ones(4, dtype=torch.int32)), "intrinsics: expected a tensor of 4 real numbers"),
        ((None, torch.zeros(6).to_sparse()), "twist: expected a dense tensor with numbers, got torch.sparse_coo"),
        ((None, None, torch.ones(4, device="meta")), "intrinsics: expected a dense tensor .* got a meta tensor"),
    ],
)
def test_bad_input(arguments, message):
    refusal(lambda: CameraParameters(arguments[0] or SCENES["single"]().camera, *arguments[1:]), match=message)


@pytest.mark.parametrize(
    ("name", "numbers", "message"),
    [
        ("single", {"intrinsics": [-1.0, 1, 1, 1]}, "Camera fx: expected a positive number"),
        ("single", {"twist": [torch.nan] * 6}, FINITE),
        ("single", {"twist": [0, 0, 6.29, 0, 0, 0]}, FINITE),
        ("single", {"twist": [0, 0, 0, torch.inf, 0, 0]}, FINITE),
        ("single", {"last_twist": [0.0] * 6}, "last_twist: expected a base with a rolling shutter"),
        ("rolling single", {"last_twist": [2.0, 0, 0, 0, 0, 0]}, "Camera.rolling: expected a turn of at most 1 rad"),
        ("single", {"coefficients": [0.0] * 4}, f"{NO_COEFFICIENTS} whose lens has none, got some"),
        ("opencv", {"coefficients": [0.0] * 3}, r"coefficients: expected a tensor of 4 .*, got torch.float32 \[3\]"),
        ("rolling opencv", {"coefficients": [0.0] * 4}, f"{NO_COEFFICIENTS} with a rolling shutter"),
        ("opencv", {"coefficients": [-0.9, 0, 0, 0]}, "Camera lens OPENCV: expected coefficients .* fold it"),
        ("opencv", {"coefficients": [torch.nan] * 4}, "Lens OPENCV: expected 4 finite coefficients"),
    ],
)
def test_numbers_that_make_no_camera(name, numbers, message):
    scene = scene_of(name)
    given = {key: torch.tensor(values, dtype=torch.float32) for key, values in numbers.items()}
    refusal(lambda: rasterize(*scene.parameters(), CameraParameters(scene.camera, **given)), match=message)


@pytest.mark.parametrize(
    ("name", "options", "start", "parameters"),
    [
        ("degree2", DEPTH, OTHER.tolist(), POSE),
        ("inside", RasterOptions(alpha_min=0.0), OTHER.tolist(), POSE),
        ("off_center", RasterOptions(projection="ellipsoid", antialiasing=True), OTHER.tolist(), POSE),
        ("opencv", PLAIN, HERE, ("focal", "principal", "coefficients")),
        pytest.param("fisheye", PLAIN, HERE, ("focal", "principal", "coefficients"), marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_check_gradients_agrees(name, options, start, parameters):
    scene = SCENES[name]()
    camera = CameraParameters(scene.camera, **learned(scene.camera, start))
    report = check_gradients(*scene.parameters(), camera, options=options, parameters=parameters)
    assert [row.verdict for row in report.rows] == ["agrees"] * len(parameters), str(report)


def test_check_gradients_looks_at_the_camera():
    scene = SCENES["single"]()
    report = check_gradients(*scene.parameters(), CameraParameters(scene.camera), directions=1)
    assert report.ok and {row.name for row in report.rows} == {*INPUTS, *POSE}
    assert check_gradients(*SCENES["empty"]().parameters(), CameraParameters(scene.camera), directions=1).ok
    fixed = lambda: check_gradients(*scene.parameters(), scene.camera, parameters=["focal"])  # noqa: E731
    refusal(fixed, "parameters: expected a list of some of means")


@pytest.mark.parametrize(
    ("scene", "index", "entry", "name"),
    [
        ("degree1", 6, 0, "rotation"),
        ("degree1", 6, 5, "translation"),
        ("degree1", 7, 1, "focal"),
        ("opencv", 7, 2, "principal"),
        ("opencv", 9, 1, "coefficients"),
        ("rolling degree1", 8, 4, "last_translation"),
    ],
)
def test_check_gradients_names_what_is_off(scene, index, entry, name, spoil):
    """By 2 %."""
    spoil(Project, lambda gradients: gradients[index][entry].mul_(1.02))
    scene = scene_of(scene)
    numbers = learned(scene.camera)
    names = [part for key in numbers for part in PARTS[key]]
    report = check_gradients(*scene.parameters(), CameraParameters(scene.camera, **numbers), parameters=names)
    assert report.named("off") == [name] and report.worst is None, str(report)


@pytest.mark.slow
def test_a_camera_finds_its_way_back():
    """From 5 degrees, 10 cm and 5 % of its focal lengths, in a picture that the renderer drew."""
    angle, place, focal = cameras.recover(seed=1, steps=220)[-1]
    assert angle < 0.05 and place < 1e-3 and focal < 1e-3, (angle, place, focal)


def test_a_lens_finds_its_way_back():
    """From no distortion, in a picture that the renderer drew."""
    errors = cameras.recover_lens(seed=1)
    assert errors[0] > 2.0 and errors[-1] < cameras.LENS_WANTED, errors

"""The physics under the splats, against closed forms, quadrature and stiff solvers of SciPy; the benchmark's files."""

import json

import footprints
import light as physics
import numpy as np
import pytest
import volume as measure
from hostile import refusal
from light import Volume
from scipy.integrate import quad, solve_ivp
from scipy.spatial.transform import Rotation

from warp_splat.compare.scenes import make_camera

BACKGROUND = np.array([0.2, 0.8, 0.4])
COLOR = np.array([0.9, 0.3, 0.1])
INTEGRATORS = (physics.integrate_exponential, physics.integrate_euler, physics.integrate_rk4)


def slab(tau):
    """A medium of constant extinction and color."""
    return lambda s: (np.full((len(s), 1), tau), np.tile(tau * COLOR, (len(s), 1, 1)))


def wavy(s):
    """Smooth, but neither constant nor nothing at the ends, where rules for periodic functions would be too good."""
    tau = (1 + 0.5 * np.sin(2 * s) + 0.2 * s)[:, None]
    color = np.stack([0.5 + 0.4 * np.cos(s), 0.3 + 0.1 * s, 0.9 - 0.2 * s], -1)[:, None]
    return tau, tau[..., None] * color


def cloud(count, seed=3, density=2.0):
    """Rotated Gaussians of aspect ratios up to 10, in front of the origin."""
    rng = np.random.default_rng(seed)
    return Volume(
        means=rng.normal(size=(count, 3)) * 0.5 + [0, 0, 6],
        quats=rng.normal(size=(count, 4)),
        scales=np.exp(rng.uniform(np.log(0.1), 0, (count, 3))),
        densities=rng.uniform(0.1, 1, count) * density,
        colors=rng.uniform(0, 1, (count, 3)),
        background=BACKGROUND,
    )


def directions(count, seed=4):
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(count, 3)) * [0.1, 0.1, 0] + [0, 0, 1]
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def extinction(volume, point):
    """tau_i at one point by its definition, with the covariance inverted."""
    rotation = Rotation.from_quat(volume.quats, scalar_first=True).as_matrix()
    covariance = rotation @ (volume.scales[:, :, None] ** 2 * rotation.transpose(0, 2, 1))
    offset = point - volume.means
    return volume.densities * np.exp(-0.5 * np.einsum("ni,nij,nj->n", offset, np.linalg.inv(covariance), offset))


def test_profile_is_the_gaussian_along_the_ray():
    volume, rays, origin = cloud(5), directions(3), np.array([0.2, -0.1, 0.3])
    profile = physics.ray_profile(volume, origin, rays)
    for s in (0.0, 4.0, 5.5, 7.0):
        expected = [extinction(volume, origin + s * ray) for ray in rays]
        assert profile.extinction(np.array([s])) == pytest.approx(np.array(expected), rel=1e-11, abs=1e-300)


@pytest.mark.parametrize("end", [3.0, 6.1, np.inf])
def test_depth_is_the_integral(end):
    volume, rays = cloud(3), directions(2)
    depths = physics.ray_profile(volume, np.zeros(3), rays).depths(end)
    for ray, row in zip(rays, np.broadcast_to(depths, (2, 3)), strict=True):
        for index, depth in enumerate(row):
            whole = quad(lambda s, r=ray, i=index: extinction(volume, s * r)[i], 0, min(end, 16), points=[6], limit=200)
            assert depth == pytest.approx(whole[0], rel=1e-8, abs=1e-12)


def test_needle_keeps_its_digits():
    # axes 1 : 1e-6, seen along its length and 1e-6 beside it: q = 1/2, whatever the rotation
    turn = Rotation.from_rotvec([0.3, -1.1, 0.7])
    quat = turn.as_quat(scalar_first=True)
    needle = Volume([turn.apply([0, 0, 5])], [quat], [[1e-6, 1e-6, 1]], [1], [COLOR], BACKGROUND)
    profile = physics.ray_profile(needle, turn.apply([1e-6, 0, 0]), turn.apply([[0, 0, 1]]))
    assert profile.peak[0, 0] == pytest.approx(np.exp(-0.5), rel=1e-7)
    assert profile.width[0, 0] == pytest.approx(1, rel=1e-12)
    assert profile.center[0, 0] == pytest.approx(5, rel=1e-12)


@pytest.mark.parametrize(
    ("integrate", "steps", "tolerance"), [*zip(INTEGRATORS, (3, 20000, 200), (1e-14, 1e-4, 1e-10), strict=True)]
)
def test_constant_medium(integrate, steps, tolerance):
    """And an empty one, which shows the background."""
    expected = COLOR * (1 - np.exp(-0.7 * 3)) + BACKGROUND * np.exp(-0.7 * 3)
    assert integrate(slab(0.7), 1.0, 4.0, steps, BACKGROUND)[0] == pytest.approx(expected, abs=tolerance)
    assert np.array_equal(integrate(slab(0.0), 0.0, 1.0, 4, BACKGROUND)[0], BACKGROUND)


def alone(**more):
    """One Gaussian."""
    good = {"means": [[0.1, 0, 4]], "quats": [[1, 0, 0, 0]], "scales": [[0.5, 0.3, 0.4]], "densities": [3.0]}
    return Volume(**good | {"colors": [COLOR], "background": BACKGROUND} | more)


def test_single_gaussian_is_its_color_at_its_depth():
    volume = alone()
    profile = physics.ray_profile(volume, np.zeros(3), directions(4))
    seen = np.exp(-profile.depths().sum(-1))[:, None]
    expected = COLOR * (1 - seen) + BACKGROUND * seen
    assert physics.integrate_exact(profile, volume.colors, BACKGROUND) == pytest.approx(expected, abs=1e-14)


def radiance(medium, far, method, **allowed):
    """By a solver of SciPy's, from the far end to the camera."""

    def toward_camera(q, radiance):
        tau, source = medium(np.array([far - q]))
        return source[0, 0] - tau[0, 0] * radiance

    return solve_ivp(toward_camera, (0, far), BACKGROUND, method=method, **allowed).y[:, -1]


@pytest.mark.parametrize(("integrate", "order"), list(zip(INTEGRATORS, (2, 1, 4), strict=True)))
def test_orders(integrate, order):
    truth = radiance(wavy, 3, "DOP853", rtol=1e-13, atol=1e-14)
    errors = [np.abs(integrate(wavy, 0.0, 3.0, n, BACKGROUND)[0] - truth).max() for n in (32, 64, 128)]
    slopes = np.log2(errors[:-1]) - np.log2(errors[1:])
    assert slopes == pytest.approx([order, order], abs=0.15)


@pytest.mark.parametrize(("optical_depth", "method"), [(3.0, "LSODA"), (3.0, "Radau"), (1e4, "Radau"), (1e6, "Radau")])
def test_truth_against_a_stiff_solver(optical_depth, method):
    profile, volume = measure.stiff_medium(optical_depth, rays=1)
    allowed = {"rtol": 1e-9, "atol": 1e-11, "max_step": 0.5}
    found = radiance(profile.medium(volume.colors), measure.FAR, method, **allowed)
    truth = physics.integrate_exact(profile, volume.colors, BACKGROUND)[0]
    assert found == pytest.approx(truth, abs=1e-6)


def test_dense_media_leave_only_the_exponential_alive():
    profile, volume = measure.stiff_medium(1e6, rays=4)
    truth = physics.integrate_exact(profile, volume.colors, BACKGROUND, 128)
    medium = profile.medium(volume.colors)
    highest = max(volume.colors.max(), BACKGROUND.max())
    for samples in (8, 64, 512):
        radiance = physics.integrate_exponential(medium, 0.0, measure.FAR, samples, BACKGROUND)
        assert radiance.min() >= 0 and radiance.max() <= highest * (1 + 1e-14)
        for explicit in INTEGRATORS[1:]:  # no warning either: it would fail this test
            with np.errstate(divide="raise"):
                error = explicit(medium, 0.0, measure.FAR, samples, BACKGROUND) - truth
            assert not np.abs(error).max() < 1e6
    assert np.abs(radiance - truth).max() < 1e-4


@pytest.mark.parametrize(("name", "limit"), [("Euler", 2.0), ("RK4", 2.785293563), ("exponential", np.inf)])
def test_stability_limits(name, limit):
    assert measure._slab_limit(measure.METHODS[name][0]) == pytest.approx(limit, rel=1e-5)


def test_thin_far_separate_gaussians_are_splats():
    camera = make_camera(24, 18, fx=60, seed=5)
    columns, rows = np.meshgrid([4.3, 11.9, 19.6], [4.7, 12.4])
    pixels = np.stack([columns.ravel(), rows.ravel()], 1)
    points = np.concatenate([(pixels - [camera.cx, camera.cy]) / camera.fx, np.ones((6, 1))], 1) * 1000
    points *= np.linspace(1, 1.5, 6)[:, None]
    rng = np.random.default_rng(6)
    volume = Volume(
        means=(points - camera.translation) @ camera.rotation,
        quats=rng.normal(size=(6, 4)),
        scales=rng.uniform(0.7, 1, (6, 3)) * points[:, 2:] / camera.fx,  # a pixel
        densities=np.ones(6),
        colors=rng.uniform(0, 1, (6, 3)),
        background=BACKGROUND,
    )
    densities = 1e-3 / physics.peak_depths(volume, camera)  # optical depth 1e-3 each
    volume = Volume(**{**vars(volume), "densities": densities})
    truth = physics.render_volume(volume, camera)
    assert np.abs(truth - BACKGROUND).max() > 2e-4
    images = physics.splat_ladder(volume, camera)
    assert np.abs(images.pop("no overlap") - truth).max() < 1e-12
    for name in ("linear depth", "linear peak", "affine", "ellipsoid"):
        assert np.abs(images[name] - truth).max() < 2e-5, name  # 1e-3^2 / 2, and the perspective in a pixel's width


def test_overlap_is_what_the_first_rung_ignores():
    camera = make_camera(5, 5, fx=10, seed=None)
    turns, sizes, black = [[1, 0, 0, 0]] * 2, [[0.4] * 3] * 2, [0] * 3
    pairs = [Volume([[0, 0, 4], [0, 0, z]], turns, sizes, [3, 3], np.eye(3)[:2], black) for z in (12.0, 4.1)]
    alone = [physics.splat_ladder(volume, camera)["no overlap"] for volume in pairs]
    whole = [physics.render_volume(volume, camera) for volume in pairs]
    errors = [np.abs(one - other).max() for one, other in zip(alone, whole, strict=True)]
    assert errors[0] < 1e-12 and errors[1] > 0.1


def test_renderer_rung_is_linear_and_clamped():
    # a Gaussian that fills the image, od 20 in the middle: the renderer stops at 0.99, light goes through
    camera = make_camera(3, 3, fx=10, seed=None)
    volume = Volume([[0, 0, 5]], [[1, 0, 0, 0]], [[1] * 3], [20 / np.sqrt(2 * np.pi)], [[1, 1, 1]], [0] * 3)
    assert physics.peak_depths(volume, camera) == pytest.approx([20], rel=1e-5)
    assert physics.splat_ladder(volume, camera)["3DGS"][1, 1] == pytest.approx([0.99] * 3)
    assert physics.render_volume(volume, camera)[1, 1] == pytest.approx([1 - np.exp(-20)] * 3, abs=1e-13)


@pytest.mark.parametrize(
    ("name", "value"), [("scales", [[1, 0, 1]]), ("densities", [-1]), ("quats", [[0] * 4]), ("colors", [[np.nan] * 3])]
)
def test_bad_volumes_are_refused(name, value):
    refusal(lambda: Volume(**vars(alone()) | {name: value}), "Volume")


@pytest.mark.slow
def test_run_writes_its_files(tmp_path, monkeypatch):
    scenes = {name: measure.SCENES[name] for name in ("one", "needle at the edge")}
    few = {"OPTICAL_DEPTHS": (1.0, 1e6), "SAMPLES": [8, 64, 512, 4096], "REPEATS": 1, "RAYS": 2}
    few |= {"LIMIT_DEPTHS": (1e2,), "SCENES": scenes, "PICTURED": tuple(scenes)}
    for name, value in few.items():
        monkeypatch.setattr(measure, name, value)
    said = []
    results = measure.compare_with_physics(tmp_path / "new", said.append)
    assert {record["rung"] for record in results["ladder"]} == set(measure.PARENT)
    assert "unstable" in "\n".join(said)
    assert set(json.loads((tmp_path / "new/volume.json").read_text())) == set(results)
    lines = (tmp_path / "new/volume.csv").read_text().splitlines()
    assert len(lines) == 1 + sum(map(len, results.values()))
    for name in ("volume_stiff.png", "volume_maps.png"):
        assert (tmp_path / "new" / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", footprints.CAMERAS)
def test_footprints_through_lenses_are_exact_in_the_limit(name):
    """The smaller Gaussians are, the better lines and planes describe what the lens makes of them."""
    camera, most = footprints.CAMERAS[name]
    errors = {projection: [] for projection in footprints.PROJECTED}
    for size in (0.08, 0.02):
        volume = footprints.made_volume(camera, min(most, 60.0), size)  # away from the poles of a panorama
        images = footprints.footprint_images(volume, camera)
        light = np.nansum(np.abs(images["truth"] - volume.background))
        for projection, found in errors.items():
            found.append(np.nansum(np.abs(images[projection] - images["truth"])) / light)
    for projection, (large, small) in errors.items():
        assert small < 0.4 * large and small < 0.03, (projection, large, small)

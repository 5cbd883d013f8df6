"""Gaussians in Newton's simulations: pictures against float64, meshes between them, gradients."""

from dataclasses import replace

import numpy as np
import pytest
import simulations
import torch
import warp as wp
from exact_cameras import exact_render
from hostile import refusal
from scenes import C0
from scipy.spatial.transform import Rotation
from simulations import BACKGROUND, BODIES, CAMERAS, FOV, HEIGHT, PLACE, UNSEEN, WIDTH, images, newton, state_of

from warp_splat import InputError, Lens, RasterOptions, Shutter
from warp_splat.compare.oracle import sh_basis
from warp_splat.formats.splats import concatenated
from warp_splat.newton import SensorSplatCamera, camera_of_fov
from warp_splat.raster.worlds import Worlds


@pytest.fixture(scope="module")
def simulation(tmp_path_factory):
    return simulations.make_simulation(tmp_path_factory.mktemp("files"))


def moved(splats, transform, scale=1.0):
    """In float64, so that differences may be small."""
    turn = Rotation.from_quat(transform[3:])
    directions = torch.from_numpy(np.random.default_rng(0).normal(size=(64, 3)))
    directions /= directions.norm(dim=1, keepdim=True)
    degree = round(splats.sh.shape[1] ** 0.5) - 1
    here, there = sh_basis(directions, degree), sh_basis(directions @ torch.from_numpy(turn.as_matrix()), degree)
    return splats._replace(
        means=scale * splats.means.astype(float) @ turn.as_matrix().T + transform[:3],
        sh=np.einsum("jk,nkc->njc", torch.linalg.lstsq(here, there).solution.numpy(), splats.sh),
        scales=splats.scales + np.log(scale),
        quats=(turn * Rotation.from_quat(splats.quats.astype(float), scalar_first=True)).as_quat(scalar_first=True),
    )


def seen_exactly(parts, body, camera_transform, lens=None, shutter=None, **cuts):
    """The float64 renderer's picture of a world, whose harmonics are turned."""
    both = [parts[0], moved(moved(parts[1], PLACE, 1.5), body)]
    means, sh, opacities, scales, quats = (torch.from_numpy(array).double() for array in concatenated(both))
    turn = np.diag([1.0, -1, -1]) @ Rotation.from_quat(camera_transform[3:]).as_matrix().T
    pose = {"rotation": turn, "translation": -turn @ np.array(camera_transform[:3])}
    camera = replace(camera_of_fov(WIDTH, HEIGHT, FOV), **pose, lens=lens, shutter=shutter)
    return exact_render(means, quats, scales.exp(), opacities.sigmoid(), sh, camera, BACKGROUND, **cuts)


def test_pictures_are_those_of_the_float64_renderer(simulation):
    """Four views of two worlds, in any order; the index is that of the strongest Gaussian's shape."""
    worlds = [1, 0, 0, 1]
    transforms = wp.array([CAMERAS[view % 2] for view in range(4)], dtype=wp.transform)
    made = images(4, rgb_image=wp.vec3, color_image=wp.uint32, forward_depth_image=float, shape_index_image=wp.uint32)
    camera = camera_of_fov(WIDTH, HEIGHT, FOV)
    simulation.sensor.update(state_of(simulation), transforms, camera, world_indices=worlds, **made)
    for view, world in enumerate(worlds):
        exact = seen_exactly(simulation.parts, BODIES[world], CAMERAS[view % 2])
        rgb = made["rgb_image"].numpy()[view]
        np.testing.assert_allclose(rgb, exact.image, atol=1e-4)
        packed = made["color_image"].numpy()[view].view(np.uint8).reshape(HEIGHT, WIDTH, 4)
        np.testing.assert_allclose(packed[..., :3], 255 * np.clip(rgb, 0, 1), atol=0.51)
        indices = made["shape_index_image"].numpy()[view]
        assert set(np.unique(indices)) <= {0, 1 + world, 2**32 - 1} and (indices == 1 + world).any()
        assert (made["forward_depth_image"].numpy()[view][exact.alpha > 0.1] > 1).all()


@pytest.mark.parametrize("at_once", [1, 60, 2**20])
@pytest.mark.parametrize("meshes", [False, True])
def test_views_are_drawn_together_with_the_bits_of_each(simulation, meshes, at_once, monkeypatch):
    """Whether they see from the same place, one after the other, or not; and with two cameras."""
    monkeypatch.setattr("warp_splat.newton.sensor.AT_ONCE", at_once)
    camera = camera_of_fov(WIDTH, HEIGHT, FOV)
    worlds, eyes = [1, 0, 0, 1, 1, 0], [0, 0, 1, 0, 0, 0]
    cameras = [*[camera] * 4, *[replace(camera, fx=30.0)] * 2]
    transforms = wp.array([CAMERAS[eye] for eye in eyes], dtype=wp.transform)
    surfaces = np.random.default_rng(0).uniform(-3, 7, (6, HEIGHT, WIDTH)).astype(np.float32)
    found = []
    for together in (True, False):
        made = images(6, rgb_image=wp.vec3, forward_depth_image=float, shape_index_image=wp.uint32)
        more = {"mesh_depth": wp.array(surfaces, dtype=float)} if meshes else {}
        with monkeypatch.context() as patch:
            patch.setattr("warp_splat.newton.sensor.takes", lambda *_, chosen=together: chosen)
            simulation.sensor.update(state_of(simulation), transforms, cameras, world_indices=worlds, **made, **more)
        found.append([array.numpy() for array in made.values()])
    assert all(map(np.array_equal, *found)) and found[0][0].std() > 0.05


def test_views_that_are_too_many_together_are_drawn_in_parts(simulation, monkeypatch):
    """And what one alone cannot be drawn with is said; the surface of the options hides in every view."""
    camera, transforms = camera_of_fov(WIDTH, HEIGHT, FOV), wp.array([CAMERAS[0]] * 2, dtype=wp.transform)
    made, more = images(rgb_image=wp.vec3), images(rgb_image=wp.vec3)
    simulation.sensor.update(state_of(simulation), transforms, camera, **made)
    counts, bins = [], Worlds.__init__

    def counted(self, gaussians, counts_of, *others):
        counts.append(len(counts_of))
        if len(counts_of) > 1:
            raise InputError("too many")
        bins(self, gaussians, counts_of, *others)

    monkeypatch.setattr(Worlds, "__init__", counted)
    simulation.sensor.update(state_of(simulation), transforms, camera, **more)
    assert counts == [1, 2, 1, 1] and np.array_equal(made["rgb_image"].numpy(), more["rgb_image"].numpy())
    wrong = state_of(simulation, [(np.nan, 0, 0, 0, 0, 0, 1), BODIES[1]])
    refusal(lambda: simulation.sensor.update(wrong, transforms, camera, **more), match="means: expected finite numbers")
    hides = RasterOptions(hidden_from=torch.full((HEIGHT, WIDTH), 1e-3))
    hidden = SensorSplatCamera(simulation.model, background=BACKGROUND, options=hides)
    hidden.update(state_of(simulation), transforms, camera, **more)
    np.testing.assert_allclose(more["rgb_image"].numpy(), np.broadcast_to(BACKGROUND, (2, HEIGHT, WIDTH, 3)), rtol=1e-6)


def test_the_depth_of_meshes_may_be_written_over(simulation):
    """Also where shapes are named."""
    camera, transforms = camera_of_fov(WIDTH, HEIGHT, FOV), wp.array(CAMERAS, dtype=wp.transform)
    surfaces = np.random.default_rng(0).uniform(-3, 7, (2, HEIGHT, WIDTH)).astype(np.float32)
    index, found = wp.full((2, HEIGHT, WIDTH), 77, dtype=wp.uint32), []
    for over in (False, True):
        mesh = wp.array(surfaces, dtype=float)
        made = images(shape_index_image=wp.uint32, forward_depth_image=float)
        made |= {"forward_depth_image": mesh} if over else {}
        simulation.sensor.update(state_of(simulation), transforms, camera, **made, mesh_depth=mesh, mesh_index=index)
        found.append([array.numpy() for array in made.values()])
    assert all(map(np.array_equal, *found)) and {0, 77} < set(np.unique(found[0][0]))


def test_what_meshes_show_may_be_written_over_on_a_tape(simulation):
    camera, rng = camera_of_fov(WIDTH, HEIGHT, FOV), np.random.default_rng(0)
    depth = rng.uniform(-3, 7, (2, HEIGHT, WIDTH)).astype(np.float32)
    color = rng.integers(0, 2**32, depth.shape, dtype=np.uint64).astype(np.uint32)
    found = []
    for over in (False, True):
        state, transforms = state_of(simulation), wp.array(CAMERAS, dtype=wp.transform, requires_grad=True)
        meshes = {"mesh_depth": wp.array(depth, dtype=float), "mesh_color": wp.array(color, dtype=wp.uint32)}
        made = images(rgb_image=wp.vec3, forward_depth_image=float, color_image=wp.uint32)
        made |= dict(zip(("forward_depth_image", "color_image"), meshes.values(), strict=True)) if over else {}
        with wp.Tape() as recorded:
            simulation.sensor.update(state, transforms, camera, **made, **meshes)
        recorded.backward(grads={made["rgb_image"]: wp.full((2, HEIGHT, WIDTH), wp.vec3(1.0, 2.0, 3.0), dtype=wp.vec3)})
        found.append([state.body_q.grad.numpy().copy(), transforms.grad.numpy()])
    assert all((one == other).all() and other.any() for one, other in zip(*found, strict=True))


@pytest.mark.parametrize("opacity", [0.06, 0.012])  # of all 92 % and 38 %
def test_a_thick_fog_is_named_and_not_the_mesh_behind(opacity):
    count, builder, size = 40, newton.ModelBuilder(), (1, HEIGHT, WIDTH)
    places = np.stack([np.zeros(count), np.zeros(count), -3 - 0.01 * np.arange(count)], 1)
    fog = newton.Gaussian(places, None, np.full((count, 3), 5.0), np.full(count, opacity), np.ones((count, 3)))
    shape = builder.add_shape_gaussian(-1, gaussian=fog, cfg=UNSEEN)
    model, named = builder.finalize(device="cpu"), wp.zeros(size, dtype=wp.uint32)
    meshes = {"mesh_depth": wp.full(size, 6.0, dtype=float), "mesh_index": wp.full(size, 77, dtype=wp.uint32)}
    eye = wp.array([(0, 0, 0, 0, 0, 0, 1)], dtype=wp.transform)
    camera, sensor = camera_of_fov(WIDTH, HEIGHT, 0.5), SensorSplatCamera(model)
    sensor.update(model.state(), eye, camera, shape_index_image=named, **meshes)
    assert (named.numpy() == (shape if opacity > 0.03 else 77)).all()


def test_a_world_without_gaussians_shows_those_of_all(simulation):
    """Or nothing, if there are none."""
    for shared in (True, False):
        world, scene = newton.ModelBuilder(), newton.ModelBuilder()
        ball = newton.Gaussian([[0.0, 0, 0]], None, [[0.5] * 3], [0.9], np.full((1, 3), 1.0))
        if shared:
            scene.add_shape_gaussian(-1, gaussian=ball, cfg=UNSEEN)
        body = world.add_body(mass=1.0, inertia=wp.mat33(np.eye(3)))
        scene.add_world(world)
        world.add_shape_gaussian(body, gaussian=ball, cfg=UNSEEN)
        scene.add_world(world)
        model, made = scene.finalize(device="cpu"), images(2, rgb_image=wp.vec3, shape_index_image=wp.uint32)
        same = wp.array([CAMERAS[1]] * 2, dtype=wp.transform)
        SensorSplatCamera(model).update(model.state(), same, camera_of_fov(WIDTH, HEIGHT, FOV), **made)
        first, second = made["rgb_image"].numpy()
        assert (first.max() > 0.3) == shared and second.max() > 0.3
        first, second = (set(np.unique(indices)) for indices in made["shape_index_image"].numpy())
        one = wp.zeros((1, 1, 1), dtype=wp.vec3)
        SensorSplatCamera(model).update(model.state(), same[:1], camera_of_fov(1, 1, FOV), rgb_image=one)
        assert first == ({0, 2**32 - 1} if shared else {2**32 - 1}) and 2**32 - 1 in second and len(second) > 1


@pytest.mark.parametrize(
    ("lens", "shutter"),
    [
        (Lens("OPENCV_FISHEYE", (0.05, -0.02, 0.004, 0.0)), None),
        (Lens("OPENCV", (-0.2, 0.03, 0.001, -0.002)), None),
        (None, Shutter((0.1, -0.2, 0.15), (0.2, 0.1, -0.1))),
        (Lens("OPENCV_FISHEYE", (0.05, -0.02, 0.004, 0.0)), Shutter((0.05, -0.1, 0.1), (0.1, 0.1, -0.1))),
    ],
    ids=("fisheye", "distorted", "rolling", "rolling fisheye"),
)
def test_lenses_and_shutters_are_those_of_the_float64_renderer(simulation, lens, shutter):
    """To 1e-5, but where rounding decides whether a Gaussian is blended at all."""
    camera = replace(camera_of_fov(WIDTH, HEIGHT, FOV), lens=lens, shutter=shutter)
    made = images(rgb_image=wp.vec3)
    simulation.sensor.update(state_of(simulation), wp.array(CAMERAS, dtype=wp.transform), camera, **made)
    for view, image in enumerate(made["rgb_image"].numpy()):
        exact = seen_exactly(simulation.parts, BODIES[view], CAMERAS[view], lens, shutter)
        sure = ~exact.fragile.numpy()
        plain = seen_exactly(simulation.parts, BODIES[view], CAMERAS[view])
        assert sure.mean() > 0.9 and abs(plain.image - exact.image).max() > 0.05, "it matters"
        np.testing.assert_allclose(image[sure], exact.image.numpy()[sure], atol=1e-5)


def test_gradients_are_those_of_finite_differences(simulation):
    """Of bodies and cameras, to 1e-4, against differences of the float64 renderer; without cuts, which jump."""
    cuts = {"alpha_min": 0.0, "t_min": 0.0}
    sensor = SensorSplatCamera(simulation.model, background=BACKGROUND, options=RasterOptions(**cuts))
    weights = np.random.default_rng(0).uniform(-1, 1, (2, HEIGHT, WIDTH, 3)).astype(np.float32)
    state, transforms = state_of(simulation), wp.array(CAMERAS, dtype=wp.transform, requires_grad=True)
    made = images(rgb_image=wp.vec3)
    with wp.Tape() as recorded:
        sensor.update(state, transforms, camera_of_fov(WIDTH, HEIGHT, FOV), **made)
    recorded.backward(grads={made["rgb_image"]: wp.array(weights, dtype=wp.vec3)})

    def loss(body, camera):
        return float((seen_exactly(simulation.parts, body, camera, **cuts).image.numpy() * weights[0]).sum())

    def nudged(transform, axis, step):
        turn = Rotation.from_rotvec(step * np.eye(3)[axis - 3] if axis >= 3 else np.zeros(3))
        place = np.array(transform[:3]) + (step * np.eye(3)[axis] if axis < 3 else 0)
        return (*place, *(turn * Rotation.from_quat(transform[3:])).as_quat())

    for array, which in ((state.body_q, 0), (transforms, 1)):
        slopes, found = array.grad.numpy()[0].astype(np.float64), []
        quat = [BODIES[0], CAMERAS[0]][which][3:]
        for axis in range(6):
            one = np.eye(3)[axis % 3]
            change = [*one, 0, 0, 0, 0] if axis < 3 else [0, 0, 0, *half_of_product(one, quat)]  # d(exp(w / 2) q) / dw
            ends = []
            for step in (1e-5, -1e-5):
                pair = [BODIES[0], CAMERAS[0]]
                pair[which] = nudged(pair[which], axis, step)
                ends.append(loss(*pair))
            found.append((slopes @ change, (ends[0] - ends[1]) / 2e-5))
        found = np.array(found)
        assert np.linalg.norm(found[:, 0] - found[:, 1]) < 1e-4 * np.linalg.norm(found[:, 1]), found


def half_of_product(axis, quat):
    """Half of the product of (axis, 0) and ``quat``, x y z w."""
    vector, w = np.array(quat[:3]), quat[3]
    return 0.5 * np.array([*(w * np.array(axis) + np.cross(axis, vector)), -np.dot(axis, vector)])


def test_meshes_hide_splats_and_splats_hide_meshes():
    """Newton's own picture of a slanted board between three splats that fill the view, against a sum by hand."""
    depths, opacities = (2.0, 3.0, 5.0), np.float32([0.4, 0.6, 0.9])
    colors = np.float32([[1, 0, 0], [0, 1, 0], [0, 0, 1]])
    builder = newton.ModelBuilder()
    means, scales = [[0, 0, -z] for z in depths], [[900, 900, 1e-3]] * 3
    splats = newton.Gaussian(means, None, scales, opacities, (colors - 0.5) / C0)
    builder.add_shape_gaussian(-1, gaussian=splats, cfg=UNSEEN)
    board = (0.6, 0.0, -3.2, *Rotation.from_rotvec([0, 0.9, 0]).as_quat())
    builder.add_shape_box(-1, xform=board, hx=1.2, hy=0.7, hz=0.01)
    model = builder.finalize(device="cpu")
    state, transforms = model.state(), wp.array([(0, 0, 0, 0, 0, 0, 1)], dtype=wp.transform)
    theirs = newton.sensors.SensorCamera(model)
    rays = theirs.compute_camera_rays_pinhole(WIDTH, HEIGHT, camera_fov=FOV)
    mesh = images(1, color_image=wp.uint32, forward_depth_image=float, shape_index_image=wp.uint32)
    theirs.update(state, transforms, rays, **mesh)
    color, depth = mesh["color_image"].numpy()[0], mesh["forward_depth_image"].numpy()[0].copy()
    color = color.view(np.uint8).reshape(HEIGHT, WIDTH, 4)[..., :3] / 255
    assert (depth == 0).any() and ((depth > 2) & (depth < 3)).any() and ((depth > 3) & (depth < 5)).any()
    given = dict(zip(("mesh_color", "mesh_depth", "mesh_index"), mesh.values(), strict=True))
    made = images(1, rgb_image=wp.vec3) | mesh  # their pictures are written over
    SensorSplatCamera(model).update(state, transforms, camera_of_fov(WIDTH, HEIGHT, FOV), **made, **given)
    hit = depth > 0
    image, light, sum_z = np.zeros((HEIGHT, WIDTH, 3)), np.ones((HEIGHT, WIDTH)), np.zeros((HEIGHT, WIDTH))
    shares = []
    for z, opacity, own in zip(depths, opacities, colors, strict=True):
        share = np.where(hit & (z >= depth), 0.0, light * opacity)
        image, light, sum_z = image + share[..., None] * own, light - share, sum_z + share * z
        shares.append(share)
    np.testing.assert_allclose(made["rgb_image"].numpy()[0], image + (light * hit)[..., None] * color, atol=3e-4)
    wanted = np.where(hit, sum_z + light * depth, sum_z / np.maximum(1 - light, 1e-9))
    np.testing.assert_allclose(made["forward_depth_image"].numpy()[0], wanted, rtol=1e-3)
    on_mesh = hit & (light > np.max(shares, 0))
    np.testing.assert_array_equal(made["shape_index_image"].numpy()[0], np.where(on_mesh, 1, 0))

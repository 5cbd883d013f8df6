"""Newton's sensor of Gaussians as callers meet it: what it refuses, its memory and device, the calls of others."""

import gc
import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
import warp as wp
from hostile import refusal
from simulations import CAMERAS, FOV, HEIGHT, WIDTH, images, make_simulation, newton, state_of
from splat_files import small_splats

from warp_splat import Lens, RasterOptions
from warp_splat.formats.exchange import save_gaussians
from warp_splat.formats.splats import SplatFile
from warp_splat.newton import SensorSplatCamera, camera_of_fov, gaussian_of_file


@pytest.fixture(scope="module")
def simulation(tmp_path_factory):
    return make_simulation(tmp_path_factory.mktemp("files"))


def test_options_are_checked_when_the_sensor_is_made(simulation):
    for options, word in (({"alpha_min": 5.0}, "alpha_min"), ({"exp_degree": 7}, "exp_degree")):
        make = partial(SensorSplatCamera, simulation.model, options=RasterOptions(**options))
        refusal(make, f"options.{word}: expected")
    refusal(lambda: SensorSplatCamera(simulation.model, adjoint="bogus"), "adjoint: expected one of")


@pytest.fixture
def allocated(monkeypatch):
    """Which of our modules take memory of Warp's."""
    found, take = [], wp._src.context.CpuDefaultAllocator.allocate

    def allocate(self, size):
        frame = sys._getframe(1)
        while frame and not (name := frame.f_globals["__name__"]).startswith("warp_splat."):
            frame = frame.f_back
        found.append(name if frame else "the caller")
        return take(self, size)

    monkeypatch.setattr(wp._src.context.CpuDefaultAllocator, "allocate", allocate)
    return found


@pytest.mark.slow
def test_buffers_are_used_again(simulation, allocated):
    """After the first call nothing takes memory of Warp's; images stay in place."""
    state, transforms = state_of(simulation), wp.array(CAMERAS, dtype=wp.transform)
    camera, made = camera_of_fov(WIDTH, HEIGHT, FOV), images(rgb_image=wp.vec3, forward_depth_image=float)
    places, alive, pictures = {name: array.ptr for name, array in made.items()}, [], []
    for _ in range(4):
        for _ in range(10):
            simulation.sensor.update(state, transforms, camera, **made)
        gc.collect()
        alive.append(sum(isinstance(thing, wp.array) for thing in gc.get_objects()))
        pictures.append(made["rgb_image"].numpy().copy())
        if len(alive) == 1:
            allocated.clear()
    assert not allocated and len(set(alive)) == 1
    assert all(np.array_equal(picture, pictures[0]) for picture in pictures) and pictures[0].std() > 0.05
    assert places == {name: array.ptr for name, array in made.items()}


def test_the_device_is_that_of_the_model(simulation, monkeypatch):
    """Whatever the scope says: with no default device at all, a picture and its gradients are the same."""
    camera, found = camera_of_fov(WIDTH, HEIGHT, FOV), []
    ones = wp.full((2, HEIGHT, WIDTH), wp.vec3(1.0))
    for scoped in (True, False):
        state, transforms = state_of(simulation), wp.array(CAMERAS, dtype=wp.transform, requires_grad=True)
        made = images(rgb_image=wp.vec3)
        with wp.ScopedDevice("cpu") if scoped else monkeypatch.context() as change, wp.Tape() as recorded:
            if not scoped:
                change.setattr(wp._src.context.runtime, "default_device", None)
                with pytest.raises(AttributeError):
                    wp.zeros(1)
            simulation.sensor.update(state, transforms, camera, **made)
            recorded.backward(grads={made["rgb_image"]: ones})
        found.append([array.numpy() for array in (made["rgb_image"], transforms.grad, state.body_q.grad)])
    assert all(np.array_equal(one, other) and one.any() for one, other in zip(*found, strict=True))


def test_what_newtons_sensor_is_told_this_one_understands(simulation):
    """By its names, in its order, and the world of each view as an array."""
    state, transforms = state_of(simulation), wp.array(CAMERAS, dtype=wp.transform)
    worlds, found = wp.array([1, 0], dtype=wp.int32), []
    rays = newton.sensors.SensorCamera.compute_camera_rays_pinhole(WIDTH, HEIGHT, camera_fov=FOV)
    for sensor, lens in (
        (newton.sensors.SensorCamera(simulation.model), rays),
        (simulation.sensor, camera_of_fov(WIDTH, HEIGHT, FOV)),
    ):
        made = {
            "color_image": sensor.allocate_image_color(2, WIDTH, HEIGHT),
            "forward_depth_image": sensor.allocate_image_depth_forward(2, WIDTH, HEIGHT),
            "shape_index_image": sensor.allocate_image_shape_index(2, WIDTH, HEIGHT),
        }
        sensor.update(state, transforms, lens, **made, world_indices=worlds)
        found.append({name: (array.shape, array.dtype, array.device) for name, array in made.items()})
    assert found[0] == found[1]
    indices = made["shape_index_image"].numpy()
    assert [set(np.unique(index)) - {2**32 - 1} for index in indices] == [{0, 2}, {0, 1}]


def test_what_newtons_tiled_camera_is_told_this_one_understands(simulation):
    """Poses [cameras, worlds], an image of its own making, a lens for each camera: what single calls draw."""
    state, poses = state_of(simulation), wp.array([[pose] * 2 for pose in CAMERAS], dtype=wp.transform)
    fov = camera_of_fov(WIDTH, HEIGHT, FOV)
    lenses = [fov, replace(fov, lens=Lens("OPENCV_FISHEYE", (0.05, -0.02, 0.004, 0.0)))]
    with pytest.warns(DeprecationWarning, match="SensorTiledCamera"):
        theirs = newton.sensors.SensorTiledCamera(simulation.model)
        color = theirs.utils.create_color_image_output(WIDTH, HEIGHT, len(lenses))
    simulation.sensor.update(state, poses, lenses, color_image=color)
    for number, camera in enumerate(lenses):
        made = images(color_image=wp.uint32)
        simulation.sensor.update(state, wp.array([CAMERAS[number]] * 2, dtype=wp.transform), camera, **made)
        np.testing.assert_array_equal(color.numpy()[:, number], made["color_image"].numpy())
    assert len(np.unique(color.numpy(), axis=0)) == len(np.unique(color.numpy(), axis=1)) == 2


def test_a_file_without_gaussians_is_no_shape(tmp_path):
    save_gaussians(path := tmp_path / "none.ply", SplatFile(small_splats(3, 4, 1).take([])))
    refusal(lambda: gaussian_of_file(path), "none.ply: expected Gaussians, found none")


def test_refused_in_one_sentence(simulation):
    empty = newton.ModelBuilder().finalize(device="cpu")
    refusal(lambda: SensorSplatCamera(empty), "expected a Gaussian shape")
    for wrong in (None, newton.ModelBuilder()):
        refusal(partial(SensorSplatCamera, wrong), f"a newton.Model, as finalized, got {type(wrong).__name__}")
    state, transforms = state_of(simulation), wp.array(CAMERAS, dtype=wp.transform)
    camera = camera_of_fov(WIDTH, HEIGHT, FOV)
    update = partial(simulation.sensor.update, state, transforms, camera)
    sizes = "rgb_image: expected (2, 32, 40) of vec3f, got (3, 32, 40) of vec3f"
    refusal(lambda: update(**images(3, rgb_image=wp.vec3)), sizes)
    kinds = "color_image: expected (2, 32, 40) of uint32, got (2, 32, 40) of vec3f"
    refusal(lambda: update(**images(2, color_image=wp.vec3)), kinds)
    refusal(lambda: simulation.sensor.update(state, transforms, [camera]), "camera: expected one, or 2 of one size")
    for wrong in (7, [camera, None]):
        refusal(lambda wrong=wrong: simulation.sensor.update(state, transforms, wrong), "camera: expected a warp_splat")
    refusal(lambda: simulation.sensor.update(state, np.zeros((2, 7)), camera), "expected a Warp array of transforms")
    refusal(partial(update, rgb_image=np.zeros(3)), "rgb_image: expected (2, 32, 40) of vec3f, got ndarray")
    refusal(lambda: simulation.sensor.update(empty.state(), transforms, camera), "state: expected one of the model's")
    refusal(lambda: SensorSplatCamera(simulation.model, background=0), "background: expected three numbers")
    named = wp.zeros((2, 32, 40), dtype=wp.uint32)
    refusal(partial(update, shape_index_image=named, mesh_index=named), "mesh_index: expected mesh_depth beside it")
    hiding = SensorSplatCamera(simulation.model, options=RasterOptions(hidden_from=torch.ones(HEIGHT, WIDTH)))
    depth = wp.zeros((2, HEIGHT, WIDTH), dtype=float)
    refusal(lambda: hiding.update(state, transforms, camera, mesh_depth=depth), "none beside options.hidden_from")
    for worlds in ([0, 2], [0.5, 1.0], [0], 1):
        refusal(partial(update, world_indices=worlds), f"world_indices: expected 2 of 0..1, got {worlds}")
    refusal(lambda: camera_of_fov(WIDTH, HEIGHT, 0), "camera_fov: expected radians between 0 and pi, got 0")


def test_any_number_of_threads_gives_the_same_bytes(simulation, same_by_threads):
    """As many pixels as threads share."""
    state, transforms, camera = state_of(simulation), wp.array(CAMERAS, dtype=wp.transform), camera_of_fov(160, 96, FOV)
    kinds = {"rgb_image": wp.vec3, "color_image": wp.uint32, "shape_index_image": wp.uint32}

    def pictures():
        made = {name: wp.zeros((2, 96, 160), dtype=kind) for name, kind in kinds.items()}
        simulation.sensor.update(state, transforms, camera, **made)
        return [array.numpy() for array in made.values()]

    assert same_by_threads(pictures)[0].std() > 0.05

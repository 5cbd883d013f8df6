"""The CUDA kernels on the CPU, by Warp's fibers: equal to the float64 oracle and to the CPU's driver, in every mode.

The driver alone is another one; all else is the renderer as users call it.
"""

import numpy as np
import pytest
import torch
import warp as wp
from common import using
from test_rasterize import check_gradients, check_image, relative_error, run, truth

from warp_splat import RasterOptions
from warp_splat.config import ADJOINTS
from warp_splat.kernels.cuda import warps
from warp_splat.kernels.splat import Splat2D
from warp_splat.raster import api
from warp_splat.raster.data import LONG, Gaussians, Room
from warp_splat.raster.drivers import CUDA
from warp_splat.runtime.launch import launch_blocks, view

SCENES = ("degree1", "dense_tile", "saturated", "needles", "ties", "size_1x1", "size_17x33", "single", "empty")
PLAIN = RasterOptions()


@pytest.fixture
def blocks():
    """The renderer with the driver of a GPU, in fibers."""
    with using(CUDA):
        yield


@pytest.mark.parametrize("adjoint", ADJOINTS)
@pytest.mark.parametrize("name", SCENES)
def test_against_the_oracle(name, adjoint, blocks):
    out, gradients = run(name, "cpu", adjoint=adjoint)
    expected = truth(name, PLAIN)
    check_image(out, expected.out)
    check_gradients(gradients, expected.gradients)


@pytest.mark.parametrize("adjoint", ADJOINTS)
def test_against_the_lanes(adjoint):
    """Also of loops that are cut after 100 steps, as of the longest tile."""
    options = RasterOptions(depth=True, alpha_min=1e-3, t_min=1e-3, max_steps=100)
    with using(CUDA):
        first, gradients = run("dense_tile", "cpu", options, adjoint)
    second, expected = run("dense_tile", "cpu", options, adjoint)
    for key in ("image", "alpha"):
        assert (getattr(first, key) - getattr(second, key)).abs().max() < 1e-6, key
    # expected depth: rounding of alpha, which is 1e-3 and more where there is anything, divided by alpha
    assert (first.depth - second.depth).abs().max() < 1e-4 * second.depth.max()
    for key, gradient in gradients.items():
        assert relative_error(gradient, expected[key]) < 1e-5, key


@pytest.mark.parametrize("columns", [10, 16])
@pytest.mark.parametrize("threads", [32, 256])
def test_lanes_know_the_sums_of_their_columns(columns, threads, blocks):
    vector = wp.types.vector(length=columns, dtype=float)

    @wp.kernel(module="unique", module_options={"enable_backward": False, "block_dim": threads})
    def add(rows: wp.array[vector], sums_out: wp.array2d[float]):
        _block, thread = wp.tid()
        total = warps.lane_sum(rows[thread], thread)
        column = warps.column_of(thread, wp.static(columns))
        if column >= 0:
            sums_out[thread // 32, column] = total

    rows = torch.randn(threads, columns, generator=torch.Generator().manual_seed(0))
    sums = torch.full((threads // 32, columns), float("nan"))
    launch_blocks(add, 1, [view(rows, vector)], [view(sums, wp.float32)], "cpu")
    assert torch.allclose(sums, rows.view(-1, 32, columns).sum(1), atol=1e-5)


def test_two_runs_give_the_same_bits(blocks):
    (first, gradients), (second, again) = (run("dense_tile", "cpu") for _ in range(2))
    assert torch.equal(first.image, second.image)
    assert all(torch.equal(gradients[key], again[key]) for key in gradients)


@pytest.mark.parametrize("adjoint", ["manual", "reversible"])
def test_the_room_for_instances_changes_no_byte(adjoint, blocks):
    """Unknown, too small, just enough or ample; where it was too small, the view is rendered again."""
    scene = truth("degree1", PLAIN).scene
    found, rooms = [], [Room(instances) for instances in (0, 1, 10**5, 0)]
    rooms[3].learn(10**4)
    for room in [None, *rooms, rooms[0]]:  # the first also knows, the second time
        given = scene.parameters()
        leaves = [tensor.clone().requires_grad_() for tensor in (*given[:4], given[4][:, :1], given[4][:, 1:])]
        out = api.render(Gaussians(*leaves), scene.camera, scene.background, PLAIN, adjoint, room=room)
        grads = torch.autograd.grad((out.image * out.image.detach()).sum() + out.alpha.sum(), leaves)
        found.append([out.image, out.alpha, *grads])
    assert all(torch.equal(a, b) for other in found[1:] for a, b in zip(other, found[0], strict=True))
    assert rooms[0].instances == rooms[1].instances > 1 and rooms[2].instances == 10**5


def test_room_grows_before_it_is_needed():
    room = Room()
    sizes = set()
    for count in range(1000, 200_000, 100):
        room.learn(count)
        assert 1.25 * count <= room.instances <= 1.25 * count * 9 / 8 + 1024
        sizes.add(room.instances)
    assert len(sizes) < 70  # or there would be new memory for each
    room.learn(5)
    assert room.instances == max(sizes)


def test_room_shrinks_once_it_has_been_far_too_large_for_long():
    room = Room()
    room.learn(10**6)
    large = room.instances
    for _ in range(LONG - 1):  # the view that needed it all is among these
        room.learn(1000)
    assert room.instances == large
    for _ in range(LONG):
        room.learn(1000)
    assert 1250 <= room.instances < 3000
    room = Room(2000)
    for _ in range(3 * LONG):
        room.learn(1000)
    assert room.instances == 2048, "no new memory where little is gained"


@pytest.mark.slow
def test_ellipses_touch_the_blocks_of_the_pixels_that_they_hold():
    """Against float64, every pixel tried; needles, specks and what is farther off than it reaches."""

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def look(splats: wp.array[Splat2D], z_most: wp.array[float], touched_out: wp.array[int]):
        i = wp.tid()
        touched_out[i] = warps.blocks_of(splats[i], z_most[i], 0.5, 0.5)

    random, count = np.random.default_rng(0), 3000
    angle, z_most = random.uniform(0, np.pi, count), random.uniform(0.01, 8, count)
    sides = 10 ** random.uniform(-0.3, 2.5, (count, 2))
    mean = random.uniform(0, 16, (count, 2)) + random.normal(size=(count, 2)) * sides.max(1, keepdims=True)
    turn = np.stack([np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)], -1).reshape(-1, 2, 2)
    conic = turn.swapaxes(1, 2) @ (turn / sides[:, :, None] ** 2)
    root = np.linalg.cholesky(conic).swapaxes(1, 2)
    splats = np.zeros(count, Splat2D.numpy_dtype())
    splats["mean"], splats["root"] = mean, np.stack([root[:, 0, 0], root[:, 0, 1], root[:, 1, 1]], -1)
    found = wp.empty(count, dtype=int, device="cpu")
    given = [wp.array(splats, dtype=Splat2D, device="cpu"), wp.array(z_most, dtype=float, device="cpu")]
    wp.launch(look, count, given, [found], device="cpu")
    here = (found.numpy()[:, None] >> np.arange(8) & 1).astype(bool)

    def held(fine, z_most):
        """Which blocks hold a place where z is that at most, of a grid of ``fine`` places a pixel."""
        x, y = np.meshgrid(np.arange(7 * fine + 1) / fine, np.arange(3 * fine + 1) / fine)
        places = np.stack([x.ravel(), y.ravel()], -1) + [[[8 * (b % 2) + 0.5, 4 * (b // 2) + 0.5]] for b in range(8)]
        offsets = places[None] - mean[:, None, None]
        z = ((offsets @ root.swapaxes(1, 2)[:, None]) ** 2).sum(-1)
        return (z <= z_most[:, None, None]).any(-1)

    assert not (held(1, z_most) & ~here).any() and 0.1 < here.mean() < 0.9
    assert (here & ~held(4, 1.1 * z_most + 0.1)).mean() < 2e-3  # of needles, between the places

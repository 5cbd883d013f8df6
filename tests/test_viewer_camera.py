"""The viewer without a browser: cameras, pace, pictures."""

import itertools
import socket
from dataclasses import replace

import numpy as np
import pytest
import torch
from fake_viser import PHOTO, ROTATION, wxyz
from hostile import refusal
from scene_files import project
from scipy.spatial.transform import Rotation

from warp_splat.camera import Camera
from warp_splat.config import NEAR
from warp_splat.lenses import Lens
from warp_splat.rendering.camera_paths import overview
from warp_splat.scene.types import visible
from warp_splat.viewer import server
from warp_splat.viewer.browser_camera import browser_camera, fitting_fov, framed, is_at, pivot, sized
from warp_splat.viewer.picture import depth_colors, depth_range, overlay
from warp_splat.viewer.watcher import FEWEST, MOST, pixels_after


def test_camera_of_a_browser():
    """What lies ahead is in the middle, what lies half the field of view above it at the upper edge."""
    position, fov = np.array([1.0, 2.0, 3.0]), 0.8
    right, down, ahead = ROTATION
    camera = browser_camera(wxyz(PHOTO), position, fov, 640, 360)
    above = ahead - np.tan(fov / 2) * down
    beside = ahead + np.tan(fov / 2) * 640 / 360 * right
    found = project(camera, position + np.stack([ahead, above, beside]))
    np.testing.assert_allclose(found, [[320, 180], [320, 0], [640, 180]], atol=1e-9)
    np.testing.assert_allclose(camera.center, position)


@pytest.mark.parametrize(
    "change",
    [
        {"wxyz": np.zeros(4)},
        {"position": np.array([np.inf, 0, 0])},
        {"fov": 0.0},
        {"width": 0},
        {"width": 1e300},
        {"wxyz": np.ones(3)},
        {"position": np.zeros(2)},
    ],
)
def test_what_is_no_camera(change):
    values = {"wxyz": np.array([1, 0, 0, 0]), "position": np.zeros(3), "fov": 1.0, "width": 64, "height": 36}
    refusal(lambda: browser_camera(**{**values, **change}))


@pytest.mark.parametrize("size", [(640, 360), (200, 900), (300, 200), (37, 41)])
def test_photograph_in_a_window(size):
    """Its pixels lie in its box, to scale; the field of view shows all of it, up to the window's edge on one side."""
    camera, (rows, columns) = framed(PHOTO, *size)
    width, height = columns.stop - columns.start, rows.stop - rows.start
    corners = np.array([[x, y, 1.0] for x, y in itertools.product((0.0, 300.0), (0.0, 200.0))])
    rays = (corners - [140, 110, 0]) / [250, 260, 1]
    points = (7.0 * rays - PHOTO.translation) @ PHOTO.rotation
    scale = [width / 300, height / 200]
    np.testing.assert_allclose(project(camera, points), corners[:, :2] * scale + [columns.start, rows.start], atol=1e-9)
    assert 0 <= columns.start and columns.stop <= size[0] and 0 <= rows.start and rows.stop <= size[1]
    assert width == size[0] or height == size[1]
    assert fitting_fov(PHOTO, *size) == pytest.approx(2 * np.arctan(size[1] / 2 / camera.fy))


def test_being_at_a_camera():
    def moved(angle, shift):
        rotation = Rotation.from_rotvec([0, angle, 0]).as_matrix() @ PHOTO.rotation
        return Camera(10, 10, 9, 9, 5, 5, rotation, -rotation @ (PHOTO.center + np.array([shift, 0, 0])))

    assert is_at(moved(0, 0), PHOTO, 4.0) and is_at(moved(5e-4, 5e-4), PHOTO, 4.0)
    assert not is_at(moved(0.01, 0), PHOTO, 4.0) and not is_at(moved(np.pi, 0), PHOTO, 4.0)
    assert not is_at(moved(0, 0.05), PHOTO, 4.0)


@pytest.mark.parametrize("subject", [PHOTO.center + 3 * PHOTO.forward, PHOTO.center - PHOTO.forward, PHOTO.center])
def test_pivot_lies_ahead(subject):
    ahead = pivot(PHOTO, subject) - PHOTO.center
    assert ahead @ PHOTO.forward == pytest.approx(np.linalg.norm(ahead)) and np.linalg.norm(ahead) >= 0.99


@pytest.mark.parametrize("means", [np.zeros((0, 3)), np.zeros((1, 3)), np.full((5, 3), 1e6), np.eye(3) * 1e-9])
def test_overview(means):
    camera, middle = overview(means.astype(np.float32))
    assert np.isfinite(camera.translation).all() and np.linalg.norm(camera.center - middle) > 1e-4


def test_overview_sees_the_bulk():
    means = np.random.default_rng(0).normal((5, 6, 7), 0.1, (1000, 3))
    means[0] = 1e6  # a floater
    camera, middle = overview(means)
    assert np.abs(middle - (5, 6, 7)).max() < 0.1 and 0.1 < np.linalg.norm(camera.center - middle) < 2
    assert visible(camera, means).mean() > 0.8


@pytest.mark.parametrize(("fixed", "rate"), [(0.02, 1e-7), (0.02, 5e-6), (0.09, 1e-6), (0.001, 1e-9), (0.5, 1e-6)])
def test_pace_settles(fixed, rate):
    """On a machine that takes ``fixed`` seconds for any frame and ``rate`` for a pixel: fast enough, no smaller."""
    pixels = 0.25 * MOST
    for _ in range(60):
        pixels = pixels_after(fixed + rate * round(pixels), round(pixels))
    seconds = fixed + rate * pixels
    assert seconds < 0.12 or pixels == FEWEST
    assert seconds > 0.08 or pixels == MOST


def test_pace_gets_out_of_a_bad_start_quickly():
    pixels, frames = 0.25 * MOST, 0
    while 2e-6 * pixels > 0.2:
        pixels = pixels_after(2e-6 * pixels, round(pixels))
        frames += 1
    assert frames <= 2
    assert pixels_after(0.001, 500) >= FEWEST  # a window that is small takes less than the pace allows


def test_sized():
    assert (sized(PHOTO, 1e9).width, sized(PHOTO, 1e9).height) == (300, 200)
    small = sized(PHOTO, 15_000)
    assert (small.width, small.height) == (150, 100) and small.cx == 70
    assert sized(PHOTO, 0.1).width == 1


def test_depth_colors():
    depth = torch.tensor([[2.0, 8.0], [4.0, 0.0]])
    alpha = torch.tensor([[1.0, 1.0], [1.0, 0.0]])
    assert depth_range(depth.repeat(50, 50), alpha.repeat(50, 50)) == pytest.approx((2, 8))
    colors = depth_colors(depth, alpha, 2.0, 8.0)
    near, far, between, nothing = colors[0, 0], colors[0, 1], colors[1, 0], colors[1, 1]
    assert near.argmax() == 0 and far.argmax() == 2 and between.argmax() == 1 and nothing.sum() == 0
    assert depth_range(depth, torch.zeros(2, 2)) == (NEAR, 1.0)
    assert torch.isfinite(depth_colors(depth, alpha, *depth_range(torch.zeros(2, 2), torch.ones(2, 2)))).all()


@pytest.mark.parametrize("opacity", [0.0, 0.5, 1.0])
def test_overlay(opacity):
    frame, photograph = np.full((20, 30, 3), 100, np.uint8), np.full((50, 50, 3), 200, np.uint8)
    result = overlay(frame, photograph, np.s_[:20, 5:25], opacity)
    assert (result[:, 5:25] == 100 + 100 * opacity).all()
    assert (result[:, :5] == 100).all() and (result[:, 25:] == 100).all() and (frame == 100).all()


def test_free_port():
    with socket.socket() as taken:
        taken.bind((server.HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert port < server.free_port(port) < port + server.PORTS
    assert server.free_port(port) == port


@pytest.mark.parametrize(("model", "kept"), [("OPENCV_FISHEYE", True), ("EQUIRECTANGULAR", False)])
def test_photographs_show_through_their_own_lens(model, kept):
    """A panorama's tiles, and frames that were made smaller, are no panoramas: a pinhole takes its place."""
    lens = Lens(model, (0.02, 0.0, 0.0, 0.0) if kept else ())
    numbers = {"fx": 300 / np.pi, "fy": 300 / np.pi, "cx": 300, "cy": 150, "width": 600, "height": 300}
    wide, box = framed(replace(PHOTO, **numbers, lens=lens), 900, 300)
    assert wide.lens == (lens if kept else None) and (wide.width, wide.height) == (900, 300)
    assert box == np.s_[0:300, 150:750] and (wide.cx, wide.cy) == (450, 150)
    assert framed(replace(PHOTO, **numbers, lens=lens), 600, 300)[0].lens == wide.lens

"""The viewer without a browser: cameras, pace, pictures, and its handlers with a browser's place taken by a fake."""

import asyncio
import itertools
import socket
import sys
import time
from contextlib import contextmanager, nullcontext
from types import ModuleType, SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from scene_files import write_colmap
from scipy.spatial.transform import Rotation

from warp_splat.camera import Camera
from warp_splat.cli import main
from warp_splat.color import to_srgb
from warp_splat.config import NEAR, TrainConfig, ViewConfig
from warp_splat.errors import InputError
from warp_splat.formats.exchange import save_gaussians
from warp_splat.formats.splats import SplatArrays, SplatFile
from warp_splat.gaussians import GaussianModel
from warp_splat.run import Run, finish
from warp_splat.scene.types import Scene, View
from warp_splat.trainer import Trainer
from warp_splat.viewer import server, watcher
from warp_splat.viewer.camera import Box, browser_camera, fitting_fov, framed, is_at, look_at_all, pivot, sized
from warp_splat.viewer.pace import FEWEST, MOST, Pace
from warp_splat.viewer.picture import depth_colors, depth_range, overlay
from warp_splat.viewer.run import make_draw, view
from warp_splat.viewer.training import TrainingViewer

ROTATION = Rotation.from_euler("xyz", (0.3, -0.5, 0.2)).as_matrix()
PHOTO = Camera(300, 200, 250.0, 260.0, 140.0, 110.0, ROTATION, np.array([0.1, -0.2, 4.0]))


def project(camera, points):
    """Pixels [P, 2], from the definition of a pinhole camera."""
    x, y, z = camera.rotation @ points.T + camera.translation[:, None]
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)


def wxyz(camera):
    """Camera to world, as browsers say it."""
    return np.roll(Rotation.from_matrix(camera.rotation.T).as_quat(), 1)


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
        {"wxyz": np.full(4, np.nan)},
        {"position": np.array([np.inf, 0, 0])},
        {"fov": 0.0},
        {"fov": np.nan},
        {"width": 0},
        {"height": 0},
    ],
)
def test_what_is_no_camera(change):
    values = {"wxyz": np.array([1, 0, 0, 0]), "position": np.zeros(3), "fov": 1.0, "width": 64, "height": 36}
    with pytest.raises(InputError):
        browser_camera(**{**values, **change})


@pytest.mark.parametrize("size", [(640, 360), (200, 900), (300, 200), (37, 41)])
def test_photograph_in_a_window(size):
    """Its pixels lie in its box, to scale; the field of view shows all of it, up to the window's edge on one side."""
    camera, box = framed(PHOTO, *size)
    corners = np.array([[x, y, 1.0] for x, y in itertools.product((0.0, 300.0), (0.0, 200.0))])
    rays = (corners - [140, 110, 0]) / [250, 260, 1]
    points = (7.0 * rays - PHOTO.translation) @ PHOTO.rotation
    scale = [box.width / 300, box.height / 200]
    np.testing.assert_allclose(project(camera, points), corners[:, :2] * scale + [box.left, box.top], atol=1e-9)
    assert 0 <= box.left and box.left + box.width <= size[0] and 0 <= box.top and box.top + box.height <= size[1]
    assert box.width == size[0] or box.height == size[1]
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
def test_look_at_all(means):
    look = look_at_all(means.astype(np.float32))
    assert np.isfinite(np.concatenate(look[:3])).all() and np.linalg.norm(look.position - look.target) > 1e-4


def test_look_at_all_sees_the_bulk():
    means = np.random.default_rng(0).normal((5, 6, 7), 0.1, (1000, 3))
    means[0] = 1e6  # a floater
    look = look_at_all(means)
    assert np.abs(look.target - (5, 6, 7)).max() < 0.1 and 0.1 < np.linalg.norm(look.position - look.target) < 2


@pytest.mark.parametrize(("fixed", "rate"), [(0.02, 1e-7), (0.02, 5e-6), (0.09, 1e-6), (0.001, 1e-9), (0.5, 1e-6)])
def test_pace_settles(fixed, rate):
    """On a machine that takes ``fixed`` seconds for any frame and ``rate`` for a pixel: fast enough, no smaller."""
    pace = Pace()
    for _ in range(60):
        pixels = round(pace.pixels)
        pace.took(fixed + rate * pixels, pixels)
    seconds = fixed + rate * pace.pixels
    assert seconds < 0.12 or pace.pixels == FEWEST
    assert seconds > 0.08 or pace.pixels == MOST


def test_pace_gets_out_of_a_bad_start_quickly():
    pace, frames = Pace(), 0
    while 2e-6 * pace.pixels > 0.2:  # a window that is small takes less than the pace allows
        pace.took(2e-6 * pace.pixels, round(pace.pixels))
        frames += 1
    assert frames <= 2
    pace.took(0.001, 500)
    assert pace.pixels >= FEWEST


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
    result = overlay(frame, photograph, Box(5, 0, 20, 20), opacity)
    assert (result[:, 5:25] == 100 + 100 * opacity).all()
    assert (result[:, :5] == 100).all() and (result[:, 25:] == 100).all() and (frame == 100).all()


def test_free_port():
    with socket.socket() as taken:
        taken.bind((server.HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert port < server.free_port(port) < port + server.PORTS
    assert server.free_port(port) == port
    for number in (0, -1, 65536):
        with pytest.raises(InputError, match="--port: expected 1 to 65535"):
            server.free_port(number)


# handlers ---------------------------------------------------------------------------------------------------------


class Control:
    """A control of viser's: a value, and whom to call when it changes."""

    def __init__(self, value=None):
        self._value, self.handlers = value, []

    @property
    def value(self):
        return self._value

    @value.setter
    def value(self, value):
        if value != self._value:
            self._value = value
            self.call()

    def call(self, **target):
        for handler in self.handlers:
            handler(SimpleNamespace(target=SimpleNamespace(**target)))

    def on_update(self, handler):
        self.handlers.append(handler)

    on_click = on_update


class FakeClient:
    """What viser knows of a browser, and the frames that were sent to it."""

    def __init__(self, number, camera, size=(96, 64)):
        self.client_id, self.frames = number, []
        self.camera = SimpleNamespace(
            wxyz=wxyz(camera),
            position=camera.center,
            fov=1.0,
            image_width=size[0],
            image_height=size[1],
            look_at=camera.center + 4 * camera.forward,
            on_update=lambda handler: setattr(self, "moved", handler),
        )
        self.gui = SimpleNamespace(
            add_dropdown=lambda label, options, **_: Control(options[0]),
            add_slider=lambda label, low, high, step, value, **_: Control(value),
            add_button_group=lambda label, options: Control(),
            add_markdown=lambda text: SimpleNamespace(content=text),
        )
        self.scene = SimpleNamespace(set_background_image=self.receive)
        self.atomic, self.flush = MagicMock(), lambda: None

    def receive(self, frame, format, jpeg_quality):
        self.frames.append((frame, jpeg_quality))


class FakeServer:
    """A server without sockets; browsers enter and leave as the test says."""

    def __init__(self, **_):
        self.gui, self.scene, self.initial_camera = MagicMock(), MagicMock(), SimpleNamespace()
        self.stopped = False

    def get_port(self):
        return 8080

    def on_client_connect(self, handler):
        self.enter = lambda client: asyncio.run(handler(client))

    def on_client_disconnect(self, handler):
        self.leave = lambda client: asyncio.run(handler(client))

    def stop(self):
        self.stopped = True


@pytest.fixture
def fake_viser(monkeypatch):
    module = ModuleType("viser")
    module.ViserServer = FakeServer
    monkeypatch.setitem(sys.modules, "viser", module)


def some_gaussians(count, coefficients=1):
    random = np.random.default_rng(5)
    return SplatArrays(
        random.uniform(-1, 1, (count, 3)).astype(np.float32),
        random.normal(0, 0.5, (count, coefficients, 3)).astype(np.float32),
        np.full(count, 3.0, np.float32),
        np.full((count, 3), -2.0, np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
    )


def some_scene():
    turned = Rotation.from_rotvec([0, 0.3, 0]).as_matrix()
    cameras = [Camera(60, 60, 70, 70, 30, 30, r, [0, 0, 4.0]) for r in (np.eye(3), turned, turned @ turned)]
    image = np.random.default_rng(6).integers(0, 256, (60, 60, 3)).astype(np.uint8)
    views = [View(f"{i}.png", camera, image, camera) for i, camera in enumerate(cameras)]
    points = np.random.default_rng(7).uniform(-1, 1, (200, 3)).astype(np.float32)
    return Scene(views[:2], views[2:], points, np.full((200, 3), 90, np.uint8))


@pytest.fixture
def viewer(fake_viser):
    model, scene = GaussianModel.from_splats(some_gaussians(50)), some_scene()
    with server.Viewer(make_draw(model, {}), lambda: model.parameters["means"], scene, 8080) as viewer:
        yield viewer
    assert viewer.server.stopped


def drawn(viewer):
    """Draw until nothing is due; how many frames that took."""
    return sum(1 for _ in iter(viewer.draw, False))


def at_rest(monkeypatch):
    monkeypatch.setattr(watcher, "REST", -1.0)


def test_frames_are_quick_while_moving_and_sharp_at_rest(viewer, monkeypatch):
    client = FakeClient(1, PHOTO, size=(960, 640))
    viewer.server.enter(client)
    viewer.watchers[1].pace.pixels = 96 * 64
    assert viewer.moving and drawn(viewer) == 1 and drawn(viewer) == 0
    frame, quality = client.frames[-1]
    assert frame.shape == (64, 96, 3) and quality == server.MOVING_QUALITY
    client.moved()
    assert drawn(viewer) == 1 and len(client.frames) == 2
    at_rest(monkeypatch)
    assert drawn(viewer) == 1 and drawn(viewer) == 0 and not viewer.moving
    frame, quality = client.frames[-1]
    assert frame.shape == (640, 960, 3) and quality == server.SHARP_QUALITY
    assert "960 x 640 px" in viewer.watchers[1].note.content


def test_a_training_camera_and_its_photograph(viewer, monkeypatch):
    at_rest(monkeypatch)
    client = FakeClient(1, PHOTO, size=(120, 60))
    viewer.server.enter(client)
    looks = viewer.watchers[1]
    looks.opacity.value = 1.0
    drawn(viewer)
    looks.steps.call(value="next")
    assert looks.view.value == "0.png"
    view = viewer.views["0.png"]
    np.testing.assert_allclose(client.camera.position, view.camera.center)
    np.testing.assert_allclose(np.abs(client.camera.wxyz @ wxyz(view.camera)), 1)
    drawn(viewer)
    frame = client.frames[-1][0]
    np.testing.assert_array_equal(frame[:, 30:90], view.image)  # the size of the photograph, in the middle
    assert not np.array_equal(frame[:, :30], view.image[:, :30])
    looks.opacity.value = 0.0
    drawn(viewer)
    np.testing.assert_array_equal(client.frames[-1][0][:, 30:90], picture_of(viewer, view.camera))
    for step, name in (("again", "0.png"), ("previous", "2.png"), ("next", "0.png"), ("next", "1.png")):
        looks.steps.call(value=step)
        assert looks.view.value == name
    looks.opacity.value = 1.0
    client.camera.position = client.camera.position + 0.5
    client.moved()
    drawn(viewer)
    assert not np.array_equal(client.frames[-1][0][:, 30:90], view.image)  # no longer there: no photograph


def picture_of(viewer, camera):
    image = viewer.draw_camera(camera, False).image
    return (image.clamp(0, 1) * 255).round().byte().numpy()


def test_kinds_of_frames(viewer, monkeypatch):
    at_rest(monkeypatch)
    client = FakeClient(1, some_scene().train[0].camera)
    viewer.server.enter(client)
    frames = {}
    for kind in ("image", "depth", "alpha"):
        viewer.watchers[1].kind.value = kind
        assert drawn(viewer) == 1
        frames[kind] = client.frames[-1][0]
    assert (frames["alpha"] == frames["alpha"][..., :1]).all() and frames["alpha"].max() > 200
    assert not np.array_equal(frames["depth"], frames["image"]) and frames["depth"].any()
    assert "depth" not in viewer.watchers[1].note.content


def test_two_browsers_and_one_that_leaves(viewer, monkeypatch):
    at_rest(monkeypatch)
    one, other = FakeClient(1, PHOTO), FakeClient(2, some_scene().train[0].camera)
    assert viewer.deserted
    viewer.server.enter(one)
    viewer.server.enter(other)
    assert drawn(viewer) == 2 and not np.array_equal(one.frames[0][0], other.frames[0][0])
    viewer.watchers[1].kind.value = "alpha"
    assert drawn(viewer) == 1 and len(other.frames) == 1
    viewer.refresh()
    assert drawn(viewer) == 2
    viewer.server.leave(one)
    viewer.refresh()
    assert drawn(viewer) == 1 and len(one.frames) == 3 and not viewer.deserted
    viewer.server.leave(other)
    assert drawn(viewer) == 0 and not viewer.deserted  # it may be loading the page again
    monkeypatch.setattr(server, "DESERTED", 0.0)
    assert viewer.deserted


def test_one_that_leaves_while_its_frame_is_drawn(viewer):
    client = FakeClient(1, PHOTO)
    viewer.server.enter(client)
    draw = viewer.draw_camera

    def leave(camera, depth):
        viewer.server.leave(client)
        return draw(camera, depth)

    viewer.draw_camera = leave
    assert drawn(viewer) == 1 and client.frames == []


@pytest.mark.parametrize("size", [(0, 0), (100_000, 100_000)])
def test_windows_of_strange_sizes(viewer, monkeypatch, size):
    at_rest(monkeypatch)
    client = FakeClient(1, PHOTO, size=size)
    viewer.server.enter(client)
    assert drawn(viewer) == 1
    assert [frame.shape[0] * frame.shape[1] <= MOST for frame, _ in client.frames] == [True] * (size != (0, 0))


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("coefficients", [1, 16])
def test_small_models(fake_viser, count, coefficients):
    """Also an empty one, and one without spherical harmonics."""
    model = GaussianModel.from_splats(some_gaussians(count, coefficients))
    with server.Viewer(make_draw(model, {}), lambda: model.parameters["means"], None, 8080) as viewer:
        client = FakeClient(1, PHOTO)
        viewer.server.enter(client)
        for kind in ("image", "depth", "alpha"):
            viewer.watchers[1].kind.value = kind
            assert drawn(viewer) == 1
        assert len(client.frames) == 3


# training ---------------------------------------------------------------------------------------------------------


def steps(watch, count=12):
    """Parameters after a few steps, with ``watch`` called after each as the loop does."""
    trainer = Trainer(some_scene(), TrainConfig(iterations=count, sh_interval=4, densify_from_iter=2, quiet=True))
    run = Run(None, time.perf_counter())
    look = watch(trainer, run)
    for iteration in range(1, count + 1):
        if run.iteration:
            trainer.update(run.iteration)
        trainer.differentiate(iteration)
        run.iteration = iteration
        look([])
    return {name: tensor.detach().numpy().tobytes() for name, tensor in trainer.model.parameters.items()}


def watch_training(trainer, run):
    viewer = server.Viewer(trainer.look, lambda: trainer.model.parameters["means"], trainer.scene, 8080)
    return viewer, TrainingViewer(trainer, run, viewer)


def test_training_is_the_same_with_somebody_looking(fake_viser, monkeypatch):
    clients = []

    def watched(trainer, run):
        at_rest(monkeypatch)
        monkeypatch.setattr("warp_splat.viewer.training.REFRESH", 0.0)
        monkeypatch.setattr("warp_splat.viewer.training.SHARE", 1e9)
        viewer, training = watch_training(trainer, run)
        for number, kind in enumerate(("image", "depth", "alpha")):
            clients.append(FakeClient(number, trainer.scene.train[0].camera))
            viewer.server.enter(clients[-1])
            viewer.watchers[number].kind.value = kind
        return training.between_steps

    assert steps(watched) == steps(lambda trainer, run: lambda interrupted: None)
    assert sum(len(client.frames) for client in clients) >= 12


def test_nobody_looking_costs_nothing(fake_viser):
    def watched(trainer, run):
        viewer, training = watch_training(trainer, run)
        viewer.draw = viewer.refresh = None  # not to be called
        return training.between_steps

    steps(watched, 2)


class Paused:
    """A training that is paused, and what happens while it waits."""

    def __init__(self, monkeypatch, happens):
        trainer = Trainer(some_scene(), TrainConfig(iterations=10))
        self.viewer, self.training = watch_training(trainer, Run(None, 0.0))
        self.client = FakeClient(1, trainer.scene.train[0].camera)
        self.viewer.server.enter(self.client)
        self.interrupted, self.waits = [], 0
        self.training._toggle()

        def wait(seconds):
            self.waits += 1
            if self.waits == 3:
                happens(self)

        monkeypatch.setattr(self.viewer, "wait", wait)
        at_rest(monkeypatch)
        self.training.between_steps(self.interrupted)


@pytest.mark.parametrize(
    "happens",
    [
        lambda paused: paused.training._toggle(),
        lambda paused: paused.interrupted.append(2),
        lambda paused: paused.viewer.server.leave(paused.client),
    ],
    ids=["continue", "Ctrl-C", "the browser is closed"],
)
def test_pause_ends(fake_viser, monkeypatch, happens):
    monkeypatch.setattr(server, "DESERTED", 0.0)
    paused = Paused(monkeypatch, happens)
    assert paused.waits >= 3 and (not paused.training.paused or paused.interrupted)


def test_a_pause_while_a_frame_is_drawn_is_told(fake_viser, monkeypatch):
    trainer, interrupted = Trainer(some_scene(), TrainConfig(iterations=10)), []
    viewer, training = watch_training(trainer, Run(None, 0.0))
    viewer.server.enter(FakeClient(1, trainer.scene.train[0].camera))
    draw = viewer.draw

    def draw_and_click():
        if not training.paused:
            training._toggle()
        return draw()

    monkeypatch.setattr(viewer, "draw", draw_and_click)
    monkeypatch.setattr(viewer, "wait", lambda seconds: interrupted.append(2))
    training.between_steps(interrupted)
    assert training.paused and "paused" in training._facts.content


def test_the_end_is_shown_once_to_everybody(fake_viser):
    """Also while one drags on and on, and where Pause was clicked during the last step."""
    trainer, run = Trainer(some_scene(), TrainConfig(iterations=10)), Run(None, 0.0, iteration=10)
    viewer, training = watch_training(trainer, run)
    clients = [FakeClient(number, trainer.scene.train[0].camera) for number in (1, 2)]
    for client in clients:
        viewer.server.enter(client)
    receive = clients[0].scene.set_background_image

    def dragged(frame, **options):
        receive(frame, **options)
        clients[0].moved()

    clients[0].scene.set_background_image = dragged
    training._toggle()
    training.show_end()
    assert [len(client.frames) for client in clients] == [1, 1]
    assert training._button.disabled and "paused" not in training._facts.content


class Visited(FakeServer):
    """With a browser from the start, which leaves at the second wait."""

    def on_client_disconnect(self, handler):
        super().on_client_disconnect(handler)
        self.client, self.waits, self.seen = FakeClient(1, PHOTO), 0, []
        self.enter(self.client)
        Visited.last = self

    def wait(self):
        self.waits += 1
        if self.waits == 2:
            self.leave(self.client)


def test_a_training_is_watched_to_its_end(fake_viser, monkeypatch, tmp_path, capsys):
    """From the command line: frames while it trains, the end before it is evaluated, and then it lingers."""
    root = write_colmap(tmp_path / "scene")
    (root / "sparse" / "0" / "points3D.txt").write_text("# none\n")
    monkeypatch.setattr(sys.modules["viser"], "ViserServer", Visited)
    monkeypatch.setattr(server, "DESERTED", 0.0)
    monkeypatch.setattr("warp_splat.viewer.training.REFRESH", 0.0)
    monkeypatch.setattr("warp_splat.viewer.training.SHARE", 1e9)
    monkeypatch.setattr(server.Viewer, "wait", lambda viewer, seconds: viewer.server.wait())
    at_rest(monkeypatch)

    def evaluated(*_):
        seen = Visited.last
        seen.seen = [len(seen.client.frames), seen.gui.add_button().disabled]
        return finish(*_)

    monkeypatch.setattr("warp_splat.train.finish", evaluated)
    assert main(["train", "-s", str(root), "-m", str(tmp_path / "model"), "--viewer", "--iterations", "3"]) == 0
    seen, said = Visited.last, capsys.readouterr()
    assert seen.seen == [3, True] and seen.waits == 2 and seen.stopped  # after two steps and at the end
    assert "Viewer at http" in said.out and "The viewer stays at" in said.out
    assert "no points to start from" in said.out and "Done after 3 iterations" in said.out


# commands ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (ViewConfig(), "MODEL: expected the folder"),
        (ViewConfig("no/such/folder"), "is it a model folder"),
        (ViewConfig("no/such.ply"), "no/such.ply"),
        (ViewConfig("no/such.ply", port=0), "--port: expected"),
    ],
)
def test_what_cannot_be_viewed(config, message):
    with pytest.raises(InputError, match=message):
        view(config)


@pytest.mark.parametrize("source", ["", "scene"])
def test_a_file_of_a_scene_in_linear_light(fake_viser, monkeypatch, tmp_path, source):
    """A file does not say what light it was trained in; its scene does."""
    root = write_colmap(tmp_path / "scene", ["a.exr", "b.exr"], np.full((32, 48, 3), 0.2, np.float32))
    save_gaussians(tmp_path / "a.ply", SplatFile(some_gaussians(50)))
    draws = []

    @contextmanager
    def served(draw, *_):
        draws.append(draw)
        yield SimpleNamespace(announcement="")

    monkeypatch.setattr("warp_splat.viewer.run.Viewer", served)
    monkeypatch.setattr("warp_splat.viewer.run.interruptible", lambda: nullcontext([2]))
    assert view(ViewConfig(str(tmp_path / "a.ply"), str(root) if source else "")) == 0
    draws.append(make_draw(GaussianModel.from_splats(some_gaussians(50)), {}))
    drawn, plain = (draw(PHOTO, False).image for draw in draws)
    assert plain.std() > 0.1
    torch.testing.assert_close(drawn, to_srgb(plain.clamp(0, 1), torch.where) if source else plain)


def test_flags_of_training(capsys):
    assert main(["train", "--viewer", "--port", "70000"]) == 1
    assert "--port: expected 1 to 65535" in capsys.readouterr().err
    assert main(["train", "--disable_viewer"]) == 1
    assert "unless --viewer asks" in capsys.readouterr().err

"""The viewer with the place of viser and of browsers taken: for the tests that need neither."""

import asyncio
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
from scipy.spatial.transform import Rotation

from warp_splat.camera import Camera
from warp_splat.scene.types import Decoded, Scene, View
from warp_splat.viewer import watcher

ROTATION = Rotation.from_euler("xyz", (0.3, -0.5, 0.2)).as_matrix()
PHOTO = Camera(300, 200, 250.0, 260.0, 140.0, 110.0, ROTATION, np.array([0.1, -0.2, 4.0]))


def wxyz(camera):
    """Camera to world, as browsers say it."""
    return np.roll(Rotation.from_matrix(camera.rotation.T).as_quat(), 1)


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
            done = handler(SimpleNamespace(target=SimpleNamespace(**target)))
            if asyncio.iscoroutine(done):
                asyncio.run(done)

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
            add_checkbox=lambda label, value, **_: Control(value),
            add_markdown=lambda text: SimpleNamespace(content=text),
        )
        self.scene = MagicMock(set_background_image=self.receive)
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


def some_scene():
    turned = Rotation.from_rotvec([0, 0.3, 0]).as_matrix()
    cameras = [Camera(60, 60, 70, 70, 30, 30, r, [0, 0, 4.0]) for r in (np.eye(3), turned, turned @ turned)]
    image = np.random.default_rng(6).integers(0, 256, (60, 60, 3)).astype(np.uint8)
    views = [View(f"{i}.png", camera, Decoded(image), camera) for i, camera in enumerate(cameras)]
    points = np.random.default_rng(7).uniform(-1, 1, (200, 3)).astype(np.float32)
    return Scene(views[:2], views[2:], points, np.full((200, 3), 90, np.uint8))


def entered(viewer, camera=PHOTO, size=(96, 64), number=1):
    """A browser that has come."""
    client = FakeClient(number, camera, size)
    viewer.server.enter(client)
    return client


def drawn(viewer):
    """Draw until nothing is due; how many frames that took."""
    return sum(1 for _ in iter(viewer.draw, False))


def at_rest(monkeypatch):
    monkeypatch.setattr(watcher, "REST", -1.0)

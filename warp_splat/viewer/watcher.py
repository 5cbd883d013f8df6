"""A browser that looks on: its controls, its camera, and what it has been shown."""

import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from warp_splat.camera import Camera
from warp_splat.scene.types import View
from warp_splat.viewer.browser_camera import Box, browser_camera, fitting_fov, framed, is_at, pivot, sized
from warp_splat.viewer.measure import Ruler
from warp_splat.viewer.picture import KINDS

if TYPE_CHECKING:
    import viser

REST = 0.25  # seconds without a movement after which a frame is drawn sharp
FREE = "none"  # in the list of photographs
FRAME_SECONDS = 0.1  # to draw one while moving: 10 per second, of which the way to the browser may take half
LARGEST = Camera(1920, 1080, 1.0, 1.0, 0.0, 0.0, np.eye(3), np.zeros(3))  # a frame at rest has at most its area
FEWEST, MOST = 100 * 100, LARGEST.width * LARGEST.height  # pixels
CHANGE = (0.25, 1.5)  # from one frame to the next: down quickly, up slowly
STEPS = {"previous": -1, "again": 0, "next": 1}


def pixels_after(seconds: float, pixels: int) -> float:
    """The pixels that the next moving frame may have, where the last one's ``pixels`` took ``seconds``.

    A frame also has costs without any pixel. That only makes the steps too short: the size still settles where a frame
    takes FRAME_SECONDS, or at a bound.
    """
    change = min(max(FRAME_SECONDS / max(seconds, 1e-6), CHANGE[0]), CHANGE[1])
    return min(max(pixels * change, FEWEST), MOST)


class Watcher:
    """A browser that looks on: its controls, and what it has been shown.

    Args:
        client: viser's handle.
        views: the photographs that it can jump to, by name.
        subject: what they show, [3], world.
        wake: called whenever something has changed.
    """

    def __init__(
        self, client: "viser.ClientHandle", views: Mapping[str, View], subject: np.ndarray, wake: Callable[[], None]
    ):
        self.client, self.views, self.subject, self.wake = client, views, subject, wake
        self.pixels = 0.25 * MOST  # that a moving frame may have
        self.changed, self.sharp = True, False  # since the last frame; whether that was one at rest
        self.moved_at = self.drawn_at = 0.0  # on time.monotonic
        gui = client.gui
        self.kind = gui.add_dropdown("Show", KINDS)
        self.kind.on_update(self._touched)
        if views:
            self.view = gui.add_dropdown("Photograph", (FREE, *views), hint="jump to the camera that took it")
            self.opacity = gui.add_slider("Its opacity", 0.0, 1.0, 0.05, 0.0, hint="of the photograph, over the frame")
            self.steps = gui.add_button_group("Go to", tuple(STEPS))
            self.view.on_update(self._jump)
            self.opacity.on_update(self._touched)
            self.steps.on_click(self._step)
        self.ruler = Ruler(client, subject, self._touched)
        self.note = gui.add_markdown("")
        client.camera.on_update(self._touched)
        self._touched()

    @property
    def moving(self) -> bool:
        """Whether its camera or its controls moved a moment ago."""
        return time.monotonic() - self.moved_at < REST

    def _touched(self, _=None) -> None:
        self.moved_at, self.changed, self.sharp = time.monotonic(), True, False
        self.wake()

    def _step(self, event) -> None:
        names = list(self.views)
        place = names.index(self.view.value) if self.view.value in names else -(event.target.value == "next")
        if (chosen := names[(place + STEPS[event.target.value]) % len(names)]) == self.view.value:
            self._jump()
        else:
            self.view.value = chosen  # which calls _jump

    def _jump(self, _=None) -> None:
        """Move the browser's camera to the photograph's; its answer brings the frame."""
        view, camera = self.views.get(self.view.value), self.client.camera
        if view is not None:
            with self.client.atomic():
                camera.position = view.camera.center
                camera.wxyz = np.roll(Rotation.from_matrix(view.camera.rotation.T).as_quat(), 1)
                camera.look_at = pivot(view.camera, self.subject)
                camera.fov = fitting_fov(view.camera, max(camera.image_width, 1), max(camera.image_height, 1))
        self._touched()

    def camera(self, pixels: float) -> tuple[Camera, View | None, Box]:
        """The camera for a frame of at most ``pixels``, and the photograph that was taken there, with its place.

        Raises:
            InputError: if the browser has none: a window of no size.
        """
        browser = self.client.camera
        free = browser_camera(browser.wxyz, browser.position, browser.fov, browser.image_width, browser.image_height)
        free = sized(free, pixels)
        if (view := self.views.get(self.view.value) if self.views else None) is not None:
            if is_at(free, view.camera, float(np.linalg.norm(np.asarray(browser.look_at) - view.camera.center))):
                camera, box = framed(view.camera, free.width, free.height)
                return camera, view, box
        return free, None, np.s_[:, :]

"""The server of the page, by viser: its controls, and the frames that they ask for.

Viser answers browsers in threads of its own. They only note that something changed. One thread draws every frame, the
one that calls :meth:`Viewer.draw`, because two must not launch kernels. What is async runs in viser's event loop, in
order: a browser must not leave before it has entered.
"""

import errno
import socket
import threading
import time
import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

import numpy as np

from warp_splat.camera import Camera
from warp_splat.config import LAST_PORT, TILE
from warp_splat.errors import InputError
from warp_splat.formats.exposures import Exposures
from warp_splat.gaussians import GaussianModel
from warp_splat.raster.api import RenderOutput
from warp_splat.rendering.camera_paths import focus_point, overview
from warp_splat.rendering.finished import as_photographed
from warp_splat.runtime.devices import memory_explained
from warp_splat.scene.types import Scene
from warp_splat.viewer.browser_camera import USUAL_WINDOW, fitting_fov, pivot
from warp_splat.viewer.picture import KINDS, overlay, paint
from warp_splat.viewer.watcher import LARGEST, MOST, Watcher, pixels_after

if TYPE_CHECKING:
    import viser

HOST = "127.0.0.1"  # only this machine; from another, through ssh -L
PORTS = 100  # that are tried, from the one asked for
IDLE = 0.2  # seconds between two looks at Ctrl-C
DESERTED = 10.0  # seconds after the last browser has left; one that loads the page again takes less
MOVING_QUALITY, SHARP_QUALITY = 75, 95  # of JPEG
ADVICE = "view fewer Gaussians (train with --max_gaussians), or in a smaller window"
AS_GIVEN = ", as given"  # behind the name of a photograph whose camera was refined


class Viewer(AbstractContextManager):
    """Serves the page, and draws what its browsers ask for.

    Args:
        draw: renders a camera, with or without depth; with ``median=True``, with the median depth.
        model: the Gaussians as they are at present.
        scene: its photographs can be jumped to; None if there are none.
        port: where to serve; if it is busy, the next free one.
        linear: the colors are in linear light.
        exposures: how photographs were exposed, as far as it is known at present: so are frames of their cameras.

    Raises:
        InputError: if no port is free.
    """

    def __init__(
        self,
        draw: Callable[..., RenderOutput],
        model: GaussianModel,
        scene: Scene | None,
        port: int,
        linear: bool = False,
        exposures: Callable[[], Exposures | None] = lambda: None,
    ):
        self.draw_camera, self.model, self.linear, self.exposures = draw, model, linear, exposures
        self.unit = " m" if scene and scene.coordinates else ""
        self.views = {view.name: view for view in (*scene.train, *scene.test)} if scene else {}
        if scene:
            self.subject, up, _ = focus_point(scene)
            camera = scene.train[0].camera
        else:
            camera, self.subject = overview(model.parameters["means"].detach().cpu().numpy())
            up = -camera.rotation[1]
        self.watchers: dict[int, Watcher] = {}
        self.left_at = -DESERTED  # when the last browser did, on time.monotonic
        self._woken = threading.Event()
        self._warm_up()
        self.server = _serve(free_port(port))
        served = self.server.get_port()
        self.address = f"http://{HOST}:{served}"
        self.announcement = f"Viewer at {self.address}" + f" (port {port} is taken)" * (served != port)
        self.gui = self.server.gui
        self.gui.configure_theme(show_share_button=False)  # a click on it would show the page to the internet
        self._facts = self.gui.add_markdown("")
        self.refresh()
        self.server.scene.set_up_direction(up)
        start = self.server.initial_camera
        start.position, start.look_at, start.up = camera.center, pivot(camera, self.subject), up
        start.fov = fitting_fov(camera, *USUAL_WINDOW)
        self.server.on_client_connect(self._enter)
        self.server.on_client_disconnect(self._leave)

    def _warm_up(self) -> None:
        """Compile and load the kernels of every kind of frame, so that no frame waits for them."""
        camera = Camera(TILE, TILE, TILE, TILE, 0.5 * TILE, 0.5 * TILE, np.eye(3), np.zeros(3))
        with memory_explained(self.model.device, self.model, [LARGEST], ADVICE):
            for kind in KINDS:
                paint(self.draw_camera(camera, kind == "depth"), kind, self.linear)
            self.draw_camera(camera, median=True)

    def __exit__(self, *_) -> None:
        self.server.stop()

    @property
    def deserted(self) -> bool:
        """Whether nobody has been looking for DESERTED seconds."""
        return not self.watchers and time.monotonic() - self.left_at >= DESERTED

    async def _enter(self, client: "viser.ClientHandle") -> None:
        self.watchers[client.client_id] = Watcher(client, self.views, self.subject, self.wake)

    async def _leave(self, client: "viser.ClientHandle") -> None:
        self.watchers.pop(client.client_id, None)
        self.left_at = time.monotonic()
        self.wake()

    def wake(self) -> None:
        """End :meth:`wait`."""
        self._woken.set()

    def wait(self) -> None:
        """Wait until something changes, or until one looks at Ctrl-C again."""
        self._woken.wait(IDLE)
        self._woken.clear()

    def refresh(self) -> None:
        """The Gaussians have changed: draw again what was drawn at rest."""
        self._facts.content = f"{len(self.model):,} Gaussians"
        for watcher in self._present():
            watcher.sharp = False

    @property
    def moving(self) -> bool:
        """Whether somebody moves, or waits for the frame that a movement asked for."""
        return any(watcher.moving or watcher.changed for watcher in self._present())

    def draw(self) -> bool:
        """Draw the frame that has waited longest and send it; whether there was one."""
        for watcher in sorted(self._present(), key=lambda watcher: watcher.drawn_at):
            moving = watcher.moving
            if watcher.changed or not (moving or watcher.sharp):
                self._draw(watcher, moving)
                return True
        return False

    def _present(self) -> list[Watcher]:
        return list(self.watchers.values())  # in one step, since viser's threads add and remove

    def _draw(self, watcher: Watcher, moving: bool) -> None:
        start = time.perf_counter()
        watcher.changed, watcher.sharp, watcher.drawn_at = False, not moving, time.monotonic()
        try:
            with memory_explained(self.model.device, self.model, [LARGEST], ADVICE):
                frame, note = self._frame(watcher, watcher.pixels if moving else MOST)
        except InputError as error:  # a folded window, a lens, no memory, a photograph that cannot be read
            watcher.note.content = str(error)
            return
        if watcher.client.client_id not in self.watchers:
            return
        quality = MOVING_QUALITY if moving else SHARP_QUALITY
        watcher.client.scene.set_background_image(frame, format="jpeg", jpeg_quality=quality)
        watcher.client.flush()
        seconds = time.perf_counter() - start
        if moving:
            watcher.pixels = pixels_after(seconds, frame.shape[0] * frame.shape[1])
        else:
            size = f"{frame.shape[1]} x {frame.shape[0]} px in {1e3 * seconds:.0f} ms"
            watcher.note.content = "  \n".join([size, *filter(None, [note])])

    def _frame(self, watcher: Watcher, pixels: float) -> tuple[np.ndarray, str]:
        """What ``watcher`` sees, of at most ``pixels``, and a note on it."""
        camera, view, box = watcher.camera(pixels)
        watcher.ruler.answer(self.draw_camera, camera, self.unit)
        kind = watcher.kind.value
        out = self.draw_camera(camera, kind == "depth")
        if view is not None:
            name = view.name.removesuffix(AS_GIVEN)
            out.image[box] = as_photographed(self.exposures(), out.image[box].clone(), name)
        frame, note = paint(out, kind, self.linear)
        if view is not None and watcher.opacity.value > 0:
            frame = overlay(frame, view.picture, box, watcher.opacity.value)
        return frame, note


def free_port(port: int) -> int:
    """The first free port from ``port`` on. Raises InputError if there is none among PORTS."""
    for number in range(port, min(port + PORTS, LAST_PORT + 1)):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server does
            try:
                probe.bind((HOST, number))
                return number
            except OSError as error:
                if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                    raise
    raise InputError(f"--port {port}: expected a free port, but it and those after it are taken; choose another.")


def _serve(port: int) -> "viser.ViserServer":
    """A server without its own messages."""
    import rich  # noqa: PLC0415 - of viser, which takes half a second to load
    import viser  # noqa: PLC0415

    from warp_splat.viewer.own_page import only_own_page  # noqa: PLC0415 - of viser as well

    rich.get_console().quiet = True
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection")  # a browser that left a moment ago
    with only_own_page():
        return viser.ViserServer(host=HOST, port=port, label="warp_splat", verbose=False)

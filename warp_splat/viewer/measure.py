"""Measuring in the page: distances between clicked points, and a box whose numbers ``--crop`` takes."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from warp_splat.camera import Camera
from warp_splat.config import TILE

if TYPE_CHECKING:
    import viser

COLOR = (255, 200, 0)
REACH = 0.1  # of a box's gizmos and of its first size, of the distance to what one looks at


def point_at(draw: Callable, camera: Camera, place: tuple[float, float]) -> np.ndarray | None:
    """What ``camera`` sees at ``place``, [3], world: where half of the light is gone; None where that is nowhere.

    Args:
        draw: renders a camera; with ``median=True``, with the median depth.
        camera: of the frame.
        place: in the frame, 0..1 from the left and from the top.
    """
    pixel = np.array(place) * (camera.width, camera.height)
    left, top = pixel - (TILE + 1) / 2  # to the middle of its pixel TILE // 2
    near = replace(camera, width=TILE, height=TILE, cx=camera.cx - left, cy=camera.cy - top)
    depth = float(draw(near, median=True).median_depth[TILE // 2, TILE // 2])
    ray = camera.rays(pixel[None])[0]
    if not camera.lens or not camera.lens.family.wide:
        ray = ray / ray[2]
    return camera.center + camera.rotation.T @ (depth * ray) if depth else None


class Ruler:
    """The controls of a browser that measures.

    Args:
        client: viser's handle.
        subject: where the box begins, [3], world.
        touched: called when a click waits for its point.
    """

    def __init__(self, client: "viser.ClientHandle", subject: np.ndarray, touched: Callable[[], None]):
        self.client, self.scene, self.touched = client, client.scene, touched
        self.clicks: list[tuple[float, float]] = []  # that wait for their points
        self.points: list[np.ndarray] = []
        self.measuring = client.gui.add_checkbox("Measure", False, hint="click on two points")
        self.boxed = client.gui.add_checkbox("Box", False, hint="drag two corners around what --crop is to keep")
        self.note = client.gui.add_markdown("")
        self.subject = subject
        self.measuring.on_update(self._switch)  # what is async runs in order, however quickly one switches
        self.boxed.on_update(self._show_box)

    async def _switch(self, _) -> None:
        self.points = []
        if self.measuring.value:
            self.marks = self.scene.add_frame("/distance", show_axes=False)
            self.scene.on_click()(self._click)
        else:
            self.scene.remove_click_callback()
            self.marks.remove()

    def _click(self, event) -> None:
        self.clicks.append(event.screen_pos)
        self.touched()

    def answer(self, draw: Callable, camera: Camera, unit: str) -> None:
        """Find the points that were clicked in a frame of ``camera``, and tell how far the last two are apart.

        ``unit``: of the scene's coordinates, " m" or nothing.
        """
        while self.clicks:
            point = point_at(draw, camera, self.clicks.pop(0))
            if point is not None and self.measuring.value:
                self.points = points = [*self.points, point] if len(self.points) < 2 else [point]
                self._show(points, unit)  # which a switch may take away meanwhile

    def _show(self, points: list[np.ndarray], unit: str) -> None:
        text, ends = " ".join(f"{value:.6g}" for value in points[0]), np.array([points[0], points[-1]])
        if len(points) == 2:
            text = f"{np.linalg.norm(ends[1] - ends[0]):.4g}{unit}"
        self.scene.add_line_segments("/distance/line", ends[None], COLOR, thickness=2.0, thickness_units="screen")
        self.scene.add_label("/distance/label", text, position=ends[1])
        self.note.content = text

    async def _show_box(self, _) -> None:
        """Show two corners that can be dragged, or let them go."""
        if not self.boxed.value:
            self.box.remove()
            self.note.content = ""
            return
        self.box = self.scene.add_frame("/box", show_axes=False)
        reach = REACH * float(np.linalg.norm(self.subject - np.asarray(self.client.camera.position)))
        options = {"scale": reach, "disable_rotations": True}
        self.corners: list[viser.TransformControlsHandle] = []
        for i, side in enumerate((-1, 1)):
            corner = self.scene.add_transform_controls(f"/box/{i}", position=self.subject + side * reach, **options)
            corner.on_update(self._frame)
            self.corners.append(corner)
        await self._frame()

    async def _frame(self, _=None) -> None:
        """Draw the box between the corners, and say it as a flag."""
        if not self.boxed.value:  # dragged as it went
            return
        ends = np.sort([corner.position for corner in self.corners], axis=0)
        self.scene.add_box("/box/edges", COLOR, dimensions=ends[1] - ends[0], position=ends.mean(0), wireframe=True)
        self.note.content = f"`--crop {' '.join(f'{value:.6g}' for value in ends.ravel())}`"

"""What a loaded scene is: cameras with their photographs, and sparse points."""

from dataclasses import dataclass

import numpy as np

from warp_splat.camera import Camera


def visible(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Which of ``points`` [P, 3] lie in front of the camera and inside its image, [P] bool."""
    x, y, z = camera.rotation @ points.T + camera.translation[:, None]
    in_width = (x * camera.fx + z * camera.cx >= 0) & (x * camera.fx + z * camera.cx <= z * camera.width)
    in_height = (y * camera.fy + z * camera.cy >= 0) & (y * camera.fy + z * camera.cy <= z * camera.height)
    return (z > 0) & in_width & in_height


@dataclass(frozen=True, eq=False)
class View:
    """One photograph and the camera that took it."""

    name: str  # as in the scene's files, with sub-folder and extension
    camera: Camera  # scaled to `image`
    image: np.ndarray  # [H, W, 3] uint8, alpha already composited on the background
    original: Camera  # before the resize of `-r` (after undistortion)


@dataclass(frozen=True, eq=False)
class Scene:
    """Views to train on, views held out, and the points to start from."""

    train: list[View]
    test: list[View]
    points: np.ndarray  # [P, 3] float32, world coordinates
    colors: np.ndarray  # [P, 3] uint8

    @property
    def evaluated(self) -> tuple[str, list[View]]:
        """The views to judge by, with their name: those held out, or those for training if none are."""
        return ("test", self.test) if self.test else ("train", self.train)

    @property
    def extent(self) -> float:
        """1.1 x the largest distance of a training camera's centre from their mean (the reference's getNerfppNorm).

        Where all cameras stand at one place that is 0, and nothing could learn: then 1.1 x the median distance of the
        points from there.
        """
        centers = np.stack([view.camera.center for view in self.train])
        extent = np.linalg.norm(centers - centers.mean(0), axis=1).max()
        if extent < 1e-6 * np.abs(centers).max() or extent == 0:
            extent = np.median(np.linalg.norm(self.points - centers.mean(0), axis=1))
        return float(1.1 * extent)

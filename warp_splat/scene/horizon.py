"""What points say of photographs: whether these show a sky, and how many of them show the same.

A sky are directions above the horizon in which structure from motion found no point.
"""

from collections.abc import Sequence

import numpy as np

from warp_splat.camera import Camera
from warp_splat.scene.types import Scene, visible

CELLS = 24  # along the longer side of a photograph
NEEDED = 0.015  # share from which on a sky is worth to learn; indoors plain walls make up to 0.010
VIEWS, POINTS = 60, 100_000  # that are looked at, at most


def share_of_sky(cameras: Sequence[Camera], points: np.ndarray, up: np.ndarray) -> float:
    """The share of the photographs' cells that look up, and have no point [P, 3] in them, beside them or above them.

    ``up`` [3]: away from the ground. A plain ceiling looks the same.
    """
    points = points[:: -(-len(points) // POINTS) or 1].astype(np.float64)
    return float(np.mean([_sky(camera, points, up).mean() for camera in cameras[:: -(-len(cameras) // VIEWS)]]))


def _sky(camera: Camera, points: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The cells of one photograph that show sky, [rows, columns] bool."""
    longest = max(camera.width, camera.height)
    columns, rows = (max(round(CELLS * size / longest), 1) for size in (camera.width, camera.height))
    shown = points[visible(camera, points)] @ camera.rotation.T + camera.translation
    column, row = np.minimum(camera.pixels(shown) / longest * CELLS, (columns - 1, rows - 1)).astype(np.int64).T
    free = np.ones((rows + 2, columns + 2), bool)
    for down, right in np.ndindex(3, 3):
        free[row + down, column + right] = False
    x, y = (np.arange(columns) + 0.5) * longest / CELLS, (np.arange(rows) + 0.5) * longest / CELLS
    rays = camera.rays(np.stack(np.broadcast_arrays(x, y[:, None]), -1).reshape(-1, 2)) @ camera.rotation
    sky = free[1:-1, 1:-1] & (rays @ up > 0).reshape(rows, columns)  # not, where a lens sees nothing
    right, down = (camera.rotation @ up)[:2]
    turns = (0 if down < 0 else 2) if abs(down) > abs(right) else (1 if right > 0 else 3)  # until up is up
    return np.rot90(np.logical_and.accumulate(np.rot90(sky, turns)), -turns)


def few_photographs(scene: Scene, limit: int) -> tuple[bool, str]:
    """Whether half of the points lie in fewer training photographs than ``limit``, and a sentence with the figure.

    Hidden points count. They are not asked where the scene does not say which of them its photographs saw, since they
    may be made up.
    """
    if not any(view.name in scene.tracks for view in scene.train):
        return False, "the scene does not say which points its photographs saw"
    points = scene.points.astype(np.float64)
    shown = float(np.median(sum(visible(view.camera, points).astype(int) for view in scene.train)))
    where = f"all {len(scene.train)} photographs" if shown >= len(scene.train) else f"{shown:.0f} photographs or fewer"
    return shown < limit, f"half of its points lie in {where} (limit {limit})"

"""How many photographs show the same."""

from __future__ import annotations

import numpy as np

from warp_splat.scene.types import Scene, visible


def shown_in(scene: Scene) -> float | None:
    """In how many training photographs half of the scene's points lie, or in fewer; hidden ones count.

    None if the scene does not say which points its photographs saw, so that its points may be made up.
    """
    if not any(view.name in scene.tracks for view in scene.train):
        return None
    points = scene.points.astype(np.float64)
    return float(np.median(sum(visible(view.camera, points).astype(int) for view in scene.train)))


def few_photographs(scene: Scene, limit: int) -> tuple[bool, str]:
    """Whether half of the points lie in fewer training photographs than ``limit``, and a sentence with the figure."""
    shown = shown_in(scene)
    if shown is None:
        return False, "the scene does not say which points its photographs saw"
    if shown >= len(scene.train):
        return shown < limit, f"half of its points lie in all {len(scene.train)} photographs"
    return shown < limit, f"half of its points lie in {shown:.0f} photographs or fewer"

"""How many photographs show the same."""

import numpy as np

from warp_splat.scene.types import Scene, visible


def few_photographs(scene: Scene, limit: int) -> tuple[bool, str]:
    """Whether half of the points lie in fewer training photographs than ``limit``, and a sentence with the figure.

    Hidden points count. They are not asked where the scene does not say which of them its photographs saw, since they
    may be made up.
    """
    if not any(view.name in scene.tracks for view in scene.train):
        return False, "the scene does not say which points its photographs saw"
    points = scene.points.astype(np.float64)
    shown = float(np.median(sum(visible(view.camera, points).astype(int) for view in scene.train)))
    if shown >= len(scene.train):
        return shown < limit, f"half of its points lie in all {len(scene.train)} photographs"
    return shown < limit, f"half of its points lie in {shown:.0f} photographs or fewer"

"""What photographs have that were taken side by side: guessed of one from those nearest to it."""

from collections.abc import Sequence

import numpy as np

from warp_splat.camera import Camera

#: Cameras from which it is guessed. Tried, PSNR of held-out views of two scenes with exposures that were learned,
#: 31.45 and 20.15 dB without:
#: - 27.73 and 22.89 dB: none guessed
#: - 31.77 and 22.90 dB: one
#: - 31.94 and 22.90 dB: two
#: - 31.86 and 22.74 dB: four
#: - 31.82 and 21.51 dB: the two between which a photograph is by name, as they are
NEAREST = 2


def guessed(values: np.ndarray, known: Sequence[Camera], others: Sequence[Camera], extent: float) -> np.ndarray:
    """Values at ``others``, [Q, ...] float64: of the nearest, weighted by nearness, and times a factor for all.

    The factor, from 0 to 1, is that which fits best where the values are known, each guessed from the rest. So it is 0
    where neighbors have nothing in common.

    Args:
        values: with mean 0, [P, ...].
        known: cameras that have them, [P].
        others: cameras [Q].
        extent: of the cameras, world units; as far apart counts as much as one radian.
    """
    values = np.asarray(values, np.float64)
    if len(known) < 2 or not others:
        return np.zeros((len(others), *values.shape[1:]))
    again = _mean_of_nearest(values, distances(known, known, extent) + np.diag(np.full(len(known), np.inf)))
    factor = np.clip((again * values).sum() / max((again * again).sum(), 1e-30), 0.0, 1.0)
    return factor * _mean_of_nearest(values, distances(others, known, extent))


def distances(some: Sequence[Camera], others: Sequence[Camera], extent: float) -> np.ndarray:
    """From each to each of ``others`` [Q, P]: of their places, in extents, plus the angle between them [rad]."""
    places, other_places = (np.array([camera.center for camera in cameras]) for cameras in (some, others))
    ahead, other_ahead = (np.array([camera.forward for camera in cameras]) for cameras in (some, others))
    apart = np.linalg.norm(places[:, None] - other_places, axis=2) / max(extent, 1e-12)
    return apart + np.arccos(np.clip((ahead[:, None] * other_ahead).sum(2), -1.0, 1.0))


def _mean_of_nearest(values: np.ndarray, distances: np.ndarray) -> np.ndarray:
    """For each row of ``distances`` [Q, P], the mean of NEAREST ``values`` [P, ...], weighted by 1 / distance."""
    nearest = np.argsort(distances, axis=1, kind="stable")[:, :NEAREST]
    weights = 1.0 / (np.take_along_axis(distances, nearest, 1) + 1e-9)
    weights /= weights.sum(1, keepdims=True)
    return np.einsum("qk,qk...->q...", weights, values[nearest])

"""Fewer Gaussians that look like many: what a page draws while the others are on their way, or the camera moves.

Groups of neighbors are found by cutting the set in two, again and again. Each becomes the Gaussian with its mean, its
covariance and its cover (moment matching, as in hierarchies of Gaussians: Goldberger and Roweis 2004, Kerbl et al.
2024).
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from warp_splat.camera import Camera
from warp_splat.config import FRUSTUM_MARGIN, NEAR
from warp_splat.formats.splats import SplatArrays, sizes
from warp_splat.formats.stored import LOG_SCALES, logit, sigmoid, unit_quats
from warp_splat.scene.types import visible

POWER = 0.4  # of a Gaussian's importance: its weight where sets are cut in halves; measured: 0.25 and 0.5 are alike
ALONE = 10  # one group of so many is a single one of the largest, which would swallow its neighbors: up to 0.9 dB
MOST_CAMERAS = 16  # that are asked what is important
FLATTEST = 1e-37  # least variance, world units squared


def merged(splats: SplatArrays, count: int, cameras: Sequence[Camera]) -> tuple[SplatArrays, SplatArrays, np.ndarray]:
    """The Gaussians group by group, one for each group (degree 0 only), and where groups start [count].

    Args:
        splats: finite Gaussians, at least ``count``.
        count: how many groups to make.
        cameras: groups are small where these see much of a Gaussian.
    """
    bounded = splats._replace(scales=np.clip(splats.scales, *LOG_SCALES))
    alone, rest = np.split(np.argsort(-sizes(bounded), kind="stable"), [count // ALONE])
    rest.sort()
    points, important = splats.means[rest].astype(np.float64), importance(bounded, cameras)[rest]
    order, starts = groups(points, important, count - len(alone))
    order, starts = np.append(alone, rest[order]), np.append(np.arange(len(alone)), len(alone) + starts)
    return splats.take(order), _matched(bounded.take(order), starts), starts


def importance(splats: SplatArrays, cameras: Sequence[Camera]) -> np.ndarray:
    """Opacity times the area of the largest section [N]: in the images of some ``cameras``, summed.

    Without cameras, in world units.
    """
    total = np.zeros(len(splats.means))
    for camera in cameras[:: -(-len(cameras) // MOST_CAMERAS) or 1]:
        away = np.linalg.norm(splats.means - camera.center, axis=1)
        inside = (away > NEAR) & visible(camera, splats.means, 0.5 * FRUSTUM_MARGIN)  # just outside reaches into it
        total += np.where(inside, camera.fx * camera.fy / np.maximum(away, NEAR) ** 2, 0.0)
    return sizes(splats) * (total if cameras else 1.0)


def groups(points: np.ndarray, important: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """An order of points in which groups of neighbors lie together, and where these start [count].

    Args:
        points: [N, 3], at least ``count``.
        important: not negative [N]; groups hold alike sums of powers of these.
        count: how many groups.
    """
    total = len(points)
    weights = (important / max(important.max(), 1e-300) + 1e-9) ** POWER
    order, starts, parts = np.arange(total), np.array([0]), np.array([count])
    while (parts > 1).any():
        ends = np.append(starts[1:], total)
        group = np.repeat(np.arange(len(starts)), ends - starts)
        here, weight = points[order], weights[order]
        middle = np.add.reduceat(here, starts) / (ends - starts)[:, None]
        spread = np.add.reduceat(weight[:, None] * (here - middle[group]) ** 2, starts)
        order = order[np.lexsort((here[np.arange(total), spread.argmax(axis=1)[group]], group))]
        sums = np.append(0.0, np.cumsum(weights[order]))
        first = parts // 2
        cuts = np.searchsorted(sums, sums[starts] + (sums[ends] - sums[starts]) * first / parts)
        cuts = np.clip(cuts, starts + first, ends - (parts - first))
        kept = np.stack([first > 0, parts > 0], axis=1)
        starts = np.stack([starts, np.where(first > 0, cuts, starts)], axis=1)[kept]
        parts = np.stack([first, parts - first], axis=1)[kept]
    return order, starts


def sections(scales: np.ndarray) -> np.ndarray:
    """The mean area [N] of the three sections, over pi, of logarithms of scales [N, 3]."""
    logs = scales.astype(np.float64)
    return np.exp(logs.sum(axis=1, keepdims=True) - logs).mean(axis=1)


def _matched(splats: SplatArrays, starts: np.ndarray) -> SplatArrays:
    """One Gaussian for each group of consecutive ones."""
    weights = sigmoid(splats.opacities.astype(np.float64)) * sections(splats.scales)
    sums = np.add.reduceat(weights, starts)
    group = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(weights))))

    def average(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(weights[:, None] * values, starts) / sums[:, None]

    axes = Rotation.from_quat(unit_quats(splats.quats), scalar_first=True).as_matrix()
    axes *= np.exp(splats.scales.astype(np.float64))[:, None]
    means = average(splats.means.astype(np.float64))
    offsets = splats.means - means[group]
    covariances = axes @ axes.transpose(0, 2, 1) + offsets[:, :, None] * offsets[:, None]
    variances, axes = np.linalg.eigh(average(covariances.reshape(-1, 9)).reshape(-1, 3, 3))
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    scales = (0.5 * np.log(np.maximum(variances, FLATTEST))).astype(np.float32)
    opacities = logit(np.minimum(sums / sections(scales), 1.0))
    colors = average(splats.sh[:, 0].astype(np.float64))[:, None].astype(np.float32)
    quats = Rotation.from_matrix(axes).as_quat(scalar_first=True).astype(np.float32)
    return SplatArrays(means.astype(np.float32), colors, opacities, scales, quats)

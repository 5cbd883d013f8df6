"""How bright each photograph is beside the others: from the colors that points have in several of them.

In linear light, the color of a point in a photograph is the point's own times the photograph's gain, but for shine and
for what is in front. So the logarithms are sums of two numbers, one of the point and one of the photograph. They are
fitted to all at once with small absolute errors, which shine and occlusion do not pull far.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from warp_splat.color import from_srgb
from warp_splat.scene.decoding import in_turn
from warp_splat.scene.types import Scene

LONG = 480  # px, of the images from which colors are taken: means over several pixels of larger ones
DARKEST, BRIGHTEST = 0.003, 0.9  # light that counts: the rest is noise, the foot of sRGB's curve, or saturated
GREEN = 1  # the channel of exposure: white balance is red and blue beside it
FEWEST = 30  # points of a photograph
MOST = 300  # photographs that are looked at, evenly among more: each is decoded for it
ROUNDS, SMALLEST = 12, 0.02  # of the fit; residuals [stops] below which it takes squares
NEEDED = 0.05  # stops: an unlikeness of gains from which on it is worth to learn them


class Sample(NamedTuple):
    """Points in a photograph."""

    ids: np.ndarray  # [M] int64, the same for a point in every photograph
    light: np.ndarray  # [M, 3] linear light, of those that count


class Gains(NamedTuple):
    """What photographs make of the light of the same points."""

    stops: dict[str, np.ndarray]  # of red, green and blue [3], by name; their mean is 0
    unlike: float  # root mean square of the difference between a photograph's and the mean of those with its points


def take_sample(image: np.ndarray, ids: np.ndarray, places: np.ndarray) -> Sample:
    """The light of points in a photograph.

    Args:
        image: [H, W, 3] uint8 as a screen shows it, or float32 in linear light.
        ids: [M] int64.
        places: [M, 2] x and y as shares of the photograph's width and height.
    """
    block = max(max(image.shape[:2]) // LONG, 1)
    height, width = (size // block for size in image.shape[:2])
    column, row = np.floor(places * (width, height)).astype(np.int64).T
    inside, within = (column >= 0) & (column < width) & (row >= 0) & (row < height), np.arange(block)
    rows, columns = (block * place[inside, None] + within for place in (row, column))
    light = image[rows[:, :, None], columns[:, None]]  # where points are, a block each
    light = from_srgb(np.arange(256) / 255, np.where)[light] if image.dtype == np.uint8 else light
    found = light.mean((1, 2), dtype=np.float64)
    counts = ((found > DARKEST) & (found < BRIGHTEST)).all(1)
    return Sample(ids[inside][counts], found[counts])


def fit_gains(samples: Mapping[str, Sample]) -> Gains:
    """Gains of all photographs that share points with others; those with few points are left out."""
    samples = {name: sample for name, sample in samples.items() if len(sample.ids) >= FEWEST}
    if len(samples) < 2:
        return Gains({}, 0.0)
    view = np.repeat(np.arange(len(samples)), [len(sample.ids) for sample in samples.values()])
    _, point = np.unique(np.concatenate([sample.ids for sample in samples.values()]), return_inverse=True)
    stops = np.log2(np.concatenate([sample.light for sample in samples.values()]))
    gains = np.stack([_fit(view, point, channel) for channel in stops.T], 1)
    gains -= gains.mean(0)
    together, seen = _shared(view, point, np.ones(len(view)))
    unlike = gains - together @ gains / seen[:, None]
    return Gains(dict(zip(samples, gains, strict=True)), float(np.sqrt(np.mean(unlike**2))))


def _fit(view: np.ndarray, point: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """The numbers of the photographs [V], in rounds of least squares whose weights are 1 / residual."""
    weights, gains = np.ones(len(stops)), np.zeros(view.max() + 1)
    for _ in range(ROUNDS):
        of_points = np.bincount(point, weights)
        together, seen = _shared(view, point, weights)
        rest = weights * (stops - (np.bincount(point, weights * stops) / of_points)[point])
        # the points' numbers are eliminated; what no photograph tells stays 0
        gains = np.linalg.lstsq(np.diag(seen) - together, np.bincount(view, rest), rcond=1e-9)[0]
        own = np.bincount(point, weights * (stops - gains[view])) / of_points
        weights = 1.0 / np.maximum(np.abs(stops - gains[view] - own[point]), SMALLEST)
    return gains


def _shared(view: np.ndarray, point: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The weight of each photograph's points, by how other photographs share in it [V, V], and its sum [V]."""
    shares = csr_array((weights / np.bincount(point, weights)[point], (view, point)))
    together = (shares @ csr_array((weights, (view, point))).T).toarray()
    return together, together.sum(1)


def gains_of(scene: Scene) -> Gains:
    """:func:`fit_gains` of the photographs that train; none if the scene does not say what they saw of its points."""
    samples, views = {}, [view for view in scene.train if scene.tracks.get(view.name)]
    for view in in_turn(views[:: -(-len(views) // MOST) or 1]):
        seen, camera = scene.tracks[view.name], view.camera
        rays = np.concatenate([seen.slopes, np.ones_like(seen.slopes[:, :1])], 1)
        places = np.nan_to_num(camera.pixels(rays), nan=-1.0) / (camera.width, camera.height)
        samples[view.name] = take_sample(view.image, seen.ids, places)
    return fit_gains(samples)

"""When photographs double their size in a training from coarse to fine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warp_splat.scene.types import View
from warp_splat.training.options import LearnOptions

SAMPLED = 12  # photographs whose frequencies are looked at
DIGITS = 3  # of a share: the same on every processor


def shares_of_size(learn: LearnOptions, views: Sequence[View]) -> tuple[float, ...]:
    """Of ``--coarse_until_iter``, where each size but the full one ends, from the coarsest on.

    ``--coarse_by detail`` gives a size the share of the photographs' spectrum (sum of magnitudes) that it can show
    (Chen et al. 2025, "DashGaussian"); ``steps`` gives all sizes as much.
    """
    levels = learn.coarse.bit_length() - 1
    if learn.coarse_by == "steps" or not levels:
        return tuple((level + 1) / levels for level in range(levels))
    chosen = views[:: -(-len(views) // SAMPLED)]
    found = np.mean([_shown(view.picture, [learn.coarse >> level for level in range(levels)]) for view in chosen], 0)
    return tuple(round(float(share), DIGITS) for share in found)


def _shown(image: np.ndarray, shrinks: Sequence[int]) -> list[float]:
    """The share of an image's spectrum, without its mean, in the frequencies of each smaller size."""
    gray = image.astype(np.float64).mean(2)
    spectrum = np.abs(np.fft.fft2(gray - gray.mean()))
    down, across = (np.abs(np.fft.fftfreq(size)) for size in gray.shape)
    reach = np.maximum(down[:, None], across)
    whole = spectrum.sum()
    return [spectrum[reach < 0.5 / shrink].sum() / whole if whole else 1.0 / shrink for shrink in shrinks]


def shrink_at(learn: LearnOptions, shares: Sequence[float], iteration: float) -> int:
    """By how much the edges of photographs are divided in this step."""
    return learn.coarse >> sum(iteration >= learn.coarse_until_iter * share for share in shares)

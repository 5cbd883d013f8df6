"""Which photograph a step sees; on its device and at its size, which may double from coarse to fine."""

import random
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch.nn import functional

from warp_splat.camera import Camera
from warp_splat.errors import InputError
from warp_splat.formats.checkpoint import Checkpoint
from warp_splat.runtime.timers import stage
from warp_splat.scene.types import View
from warp_splat.training.options import LearnOptions, TrainConfig

SAMPLED = 12  # photographs whose frequencies are looked at
DIGITS = 3  # of a share: the same on every processor


class Photograph(NamedTuple):
    """A photograph on a device, at the size of this iteration."""

    image: torch.Tensor  # [H, W, 3], as in View
    alpha: torch.Tensor | None  # [H, W, 1] uint8, if it is needed
    mask: torch.Tensor | None  # [H, W, 1] uint8


class Photographs:
    """Those that were used, kept until their size changes; for a GPU, there or in page-locked memory of the host.

    Args:
        config: says how coarse they are, and where they are kept.
        views: those to train on.
        device: where they are compared.
        with_alpha: whether they bring their transparency along.
    """

    def __init__(self, config: TrainConfig, views: Sequence[View], device: torch.device, with_alpha: bool):
        self.config, self.device, self.with_alpha = config, device, with_alpha
        self.shares = shares_of_size(config.learn, views)
        self.kept: dict[View, Photograph] = {}
        self._shrink = 1  # of those that are kept

    @property
    def full_size_from(self) -> float:
        """The step from which photographs have their full size."""
        return self.config.learn.coarse_until_iter * self.shares[-1] if self.shares else 0.0

    def camera_at(self, view: View, iteration: int) -> Camera:
        """The camera of ``view`` at the size of this iteration."""
        shrink = shrink_at(self.config.learn, self.shares, iteration)
        if shrink != self._shrink:
            self._shrink = shrink
            self.kept.clear()
        width, height = (max(size // shrink, 1) for size in (view.camera.width, view.camera.height))
        return view.camera if shrink == 1 else view.camera.resized(width, height)

    def at_size(self, view: View, iteration: int) -> tuple[Camera, Photograph]:
        """Camera and photograph of ``view`` at the size of this iteration, the photograph on the device."""
        camera = self.camera_at(view, iteration)
        if view not in self.kept:
            with stage("photographs"):
                alpha = view.alpha if self.with_alpha else None
                planes = [view.image, *(None if p is None else p[..., None] for p in (alpha, view.mask))]
                self.kept[view] = Photograph(
                    *(None if p is None else self._resized(p, camera.height, camera.width) for p in planes)
                )
        here = (None if p is None else p.to(self.device, non_blocking=True) for p in self.kept[view])
        return camera, Photograph(*here)

    def _resized(self, pixels: np.ndarray, height: int, width: int) -> torch.Tensor:
        kept = torch.from_numpy(pixels).to(self.config.machine.data_device)
        if kept.shape[:2] != (height, width):
            planes = kept.permute(2, 0, 1)[None].float()
            means = functional.interpolate(planes, (height, width), mode="area")[0].permute(1, 2, 0)
            kept = (means.round() if kept.dtype == torch.uint8 else means).to(kept.dtype).contiguous()
        return kept if kept.device.type == self.device.type else kept.pin_memory()


class Deck:
    """Views in random order, each once before any comes again; all processes deal alike."""

    def __init__(self, views: Sequence[View], seed: int):
        self.views, self.left, self.random = views, list[View](), random.Random(seed)

    def deal(self, count: int) -> list[View]:
        """The views of the next step."""
        dealt: list[View] = []
        while len(dealt) < count:
            if not self.left:
                self.left = list(self.views)
            index = self.random.randrange(len(self.left))
            if self.left[index] not in dealt:  # a new deck holds those of this step again
                dealt.append(self.left.pop(index))
        return dealt

    def state(self) -> dict[str, list[int]]:
        """What :meth:`restore` needs, as values of JSON."""
        places = {view: place for place, view in enumerate(self.views)}
        return {"deck": [places[view] for view in self.left], "random.views": list(self.random.getstate()[1])}

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on dealing. Raises InputError if what is in the checkpoint does not fit."""
        places, words = checkpoint.fact("deck", list), checkpoint.fact("random.views", list)
        try:
            self.left = list(dict.fromkeys(self.views[place] for place in places))
            self.random.setstate((3, tuple(words), None))
        except (TypeError, ValueError, LookupError, OverflowError) as error:
            raise InputError(
                f"{checkpoint.path}: expected a deck of views and a random state, found other values ({error!s:.100})."
            ) from error


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

"""Which photograph a step sees; on its device and at its size, which may double from coarse to fine."""

import copy
import io
import math
import os
import random
import shutil
import tempfile
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import NamedTuple

import numpy as np
import torch
from torch.nn import functional

from warp_splat.camera import Camera
from warp_splat.errors import refusing
from warp_splat.formats.checkpoint import Checkpoint
from warp_splat.formats.model_folder import prepare_folder
from warp_splat.runtime.timers import stage
from warp_splat.scene.decoding import AHEAD, in_turn
from warp_splat.scene.images import THREADS
from warp_splat.scene.types import Scene, View
from warp_splat.training.options import LearnOptions, TrainConfig

SAMPLED = 12  # photographs whose frequencies are looked at
DIGITS = 3  # of a share: the same on every processor
ON_DISK = 0.5  # of the room on the disk, for photographs that do not fit in memory


class Photograph(NamedTuple):
    """A photograph on a device, at the size of this iteration."""

    image: torch.Tensor  # [H, W, 3], as in View
    alpha: torch.Tensor | None  # [H, W, 1] uint8, if it is needed
    mask: torch.Tensor | None  # [H, W, 1] uint8

    @property
    def nbytes(self) -> int:
        """Of all planes."""
        return sum(plane.nbytes for plane in self if plane is not None)

    def each(self, change: Callable) -> "Photograph":
        """With its planes changed."""
        return Photograph(*(None if plane is None else change(plane) for plane in self))


class PhotoFile:
    """Photographs in a file without a name, as far as its disk has room: one is read sooner than decoded."""

    def __init__(self, folder: Path):
        self._file, self._lock, self._folder = tempfile.TemporaryFile(dir=folder, buffering=0), Lock(), folder
        self._spared = (1 - ON_DISK) * shutil.disk_usage(folder).free
        self._places: dict[tuple[View, int], tuple[int, list[bool]]] = {}  # where each begins, and what it has

    def read(self, view: View, shrink: int) -> Photograph | None:
        """On the host; None: it was not written."""
        with self._lock:
            if (place := self._places.get((view, shrink))) is None:
                return None
            self._file.seek(place[0])
            return Photograph(*(torch.from_numpy(np.load(self._file)) if there else None for there in place[1]))

    def write(self, view: View, shrink: int, made: Photograph) -> None:
        """Keep it, if there is room."""
        content = io.BytesIO()
        for plane in filter(torch.is_tensor, made):
            np.save(content, plane.cpu().numpy())  # to a file, NumPy does not tell when the end is missing
        with self._lock, suppress(OSError):
            if shutil.disk_usage(self._folder).free - made.nbytes >= self._spared:
                begin = self._file.seek(0, os.SEEK_END)
                if self._file.write(content.getbuffer()) == content.tell():
                    self._places[view, shrink] = begin, [plane is not None for plane in made]


class Photographs:
    """Those that were used, kept until their size changes; for a GPU, there or in page-locked memory of the host.

    Args:
        config: says how coarse they are, where they are kept, and in which folder those that do not fit.
        scene: says how many may be kept.
        device: where they are compared.
        with_alpha: whether they bring their transparency along.
    """

    def __init__(self, config: TrainConfig, scene: Scene, device: torch.device, with_alpha: bool):
        self.config, self.device, self.with_alpha = config, device, with_alpha
        self.shares = shares_of_size(config.learn, scene.train)
        self.kept: dict[View, Photograph] = {}
        self._limit = scene.memory.limit
        folder = config.report.model_path
        self._file = PhotoFile(prepare_folder(folder)) if folder and self._limit < math.inf else None
        self._size = 0  # bytes of those that are kept
        self._shrink = 1  # likewise
        self._pool = ThreadPoolExecutor(THREADS)
        self._expected: deque[tuple[View, int]] = deque()
        self._coming: dict[tuple[View, int], Future[Photograph]] = {}  # by their shrink

    def expect(self, views: Iterable[tuple[View, int]]) -> None:
        """Say which come next, and in which iterations, so that threads decode them ahead."""
        self._expected = deque(views)
        wanted = {(view, shrink_at(self.config.learn, self.shares, iteration)) for view, iteration in self._expected}
        for other in self._coming.keys() - wanted:
            self._coming.pop(other).cancel()
        self._read_ahead()

    def _read_ahead(self) -> None:
        while self._expected and len(self._coming) < AHEAD:
            view, iteration = self._expected.popleft()
            shrink = shrink_at(self.config.learn, self.shares, iteration)
            if (view, shrink) not in self._coming and not (shrink == self._shrink and view in self.kept):
                self._coming[view, shrink] = self._pool.submit(self._made, view, shrink)

    def camera_at(self, view: View, iteration: int) -> Camera:
        """The camera of ``view`` at the size of this iteration."""
        if (shrink := shrink_at(self.config.learn, self.shares, iteration)) != self._shrink:
            self._shrink, self._size = shrink, 0
            self.kept.clear()
        return view.camera if shrink == 1 else view.camera.resized(*_shrunk(view, shrink))

    def at_size(self, view: View, iteration: int) -> tuple[Camera, Photograph]:
        """Camera and photograph of ``view`` at the size of this iteration, the photograph on the device."""
        camera, found = self.camera_at(view, iteration), self.kept.get(view)
        if found is None:
            with stage("photographs"):
                coming = self._coming.pop((view, self._shrink), None)
                with suppress(ValueError):
                    self._expected.remove((view, iteration))  # it has come, and must not be read again
                self._read_ahead()
                found = coming.result() if coming else self._made(view, self._shrink)
            if self._size + found.nbytes <= self._limit:
                self.kept[view], self._size = found, self._size + found.nbytes
        return camera, found.each(lambda plane: plane.to(self.device, non_blocking=True))

    def _made(self, view: View, shrink: int) -> Photograph:
        """Decoded and resized, or as it was then."""
        if not self._file or (made := self._file.read(view, shrink)) is None:
            (width, height), (image, alpha, mask) = _shrunk(view, shrink), view.pixels
            planes = [image, *(None if p is None else p[..., None] for p in (alpha if self.with_alpha else None, mask))]
            made = Photograph(*planes).each(lambda plane: self._resized(plane, height, width))
            if self._file and self._size + made.nbytes > self._limit:
                self._file.write(view, shrink, made)
        return made if self.config.machine.data_device == self.device.type else made.each(torch.Tensor.pin_memory)

    def _resized(self, pixels: np.ndarray, height: int, width: int) -> torch.Tensor:
        kept = torch.from_numpy(pixels).to(self.config.machine.data_device)
        if kept.shape[:2] != (height, width):
            planes = kept.permute(2, 0, 1)[None].float()
            means = functional.interpolate(planes, (height, width), mode="area")[0].permute(1, 2, 0)
            kept = (means.round() if kept.dtype == torch.uint8 else means).to(kept.dtype).contiguous()
        return kept


def _shrunk(view: View, shrink: int) -> tuple[int, int]:
    """Width and height."""
    return max(view.camera.width // shrink, 1), max(view.camera.height // shrink, 1)


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

    def coming(self, count: int, steps: int) -> list[list[View]]:
        """The views of each of the next steps, which stay to be dealt."""
        twin = copy.copy(self)
        twin.left, twin.random = list(self.left), copy.copy(self.random)
        return [twin.deal(count) for _ in range(steps)]

    def state(self) -> dict[str, list[int]]:
        """What :meth:`restore` needs, as values of JSON."""
        places = {view: place for place, view in enumerate(self.views)}
        return {"deck": [places[view] for view in self.left], "random.views": list(self.random.getstate()[1])}

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on dealing. Raises InputError if what is in the checkpoint does not fit."""
        places, words = checkpoint.fact("deck", list), checkpoint.fact("random.views", list)
        problem = f"{checkpoint.path}: expected a deck of views and a random state, found other values"
        with refusing((TypeError, ValueError, LookupError, OverflowError), problem):
            self.left = list(dict.fromkeys(self.views[place] for place in places))
            self.random.setstate((3, tuple(words), None))


def shares_of_size(learn: LearnOptions, views: Sequence[View]) -> tuple[float, ...]:
    """Of ``--coarse_until_iter``, where each size but the full one ends, from the coarsest on.

    ``--coarse_by detail`` gives a size the share of the photographs' spectrum (sum of magnitudes) that it can show
    (Chen et al. 2025, "DashGaussian"); ``steps`` gives all sizes as much.
    """
    levels = learn.coarse.bit_length() - 1
    if learn.coarse_by == "steps" or not levels:
        return tuple((level + 1) / levels for level in range(levels))
    chosen = views[:: -(-len(views) // SAMPLED)]
    sizes = [learn.coarse >> level for level in range(levels)]
    found = np.mean([_shown(view.picture, sizes) for view in in_turn(chosen)], 0)
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

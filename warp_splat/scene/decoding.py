"""Photographs as views: kept in memory as far as they fit, and otherwise decoded whenever they are asked for.

JPEG's own decoding at a fraction of the size is not used: it rounds otherwise than the means of pixels that a coarse
step compares with, and a trained model must not depend on how much memory there is.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache, partial

import torch

from warp_splat.camera import Camera
from warp_splat.errors import InputError
from warp_splat.runtime.launch import available_memory
from warp_splat.scene.images import PIXELS_MOST, THREADS, Photo, decode, read_kind, target_size
from warp_splat.scene.types import PhotoMemory, Stored, View

SHARE = 0.25  # of the memory that is free, for photographs
AHEAD = 4  # photographs that are decoded before they are asked for
RECENT = 2  # that stay decoded in any case: image and mask of one are asked for by turns
AT_ONCE = 100_000_000  # pixels of files, some seconds: so few are decoded before anything else, and what is broken told


def photo_memory(gib: float = 0.0, processes: int = 1) -> float:
    """Bytes for the photographs of each of so many processes: GiB as given, or for 0 a share of what is free."""
    return gib * 2**30 or SHARE * available_memory(torch.device("cpu")) / processes


def load_views(
    photos: Sequence[Photo], resolution: int, white_background: bool, invert_masks: bool, memory: float | None
) -> tuple[list[View], PhotoMemory]:
    """``photos`` at the size that ``resolution`` asks for (see :func:`target_size`), in their order.

    Args:
        photos: of one scene.
        resolution: see there.
        white_background: composite images with alpha on white instead of black.
        invert_masks: the dark part of masks counts.
        memory: bytes that they may take; None: whatever they take, and all are decoded now.

    Returns:
        The views, and what memory they take.

    Raises:
        InputError: if a file cannot be read, or that size is absurd.
    """
    cameras = {photo: _resized(photo, resolution) for photo in photos}
    kinds = {photo: (*read_kind(photo.path), photo.mask is not None) for photo in photos}
    sizes = [
        cameras[photo].width * cameras[photo].height * ((12 if linear else 3) + alpha + mask)
        for photo, (linear, alpha, mask) in kinds.items()
    ]
    fits = memory is None or sum(sizes) <= memory
    read = lru_cache(None if fits else RECENT)(lambda p: decode(p, cameras[p], white_background, invert_masks))
    if at_once := memory is None or (fits and sum(p.camera.width * p.camera.height for p in photos) <= AT_ONCE):
        with ThreadPoolExecutor(THREADS) as pool:
            list(pool.map(read, photos))
    stored = {photo: Stored(partial(read, photo), *kinds[photo]) for photo in photos}
    views = [View(p.name, cameras[p], stored[p], p.camera, p.sampling is not None) for p in photos]
    if memory is None or fits:
        return views, PhotoMemory(later=0.0 if at_once else sum(sizes))
    return views, PhotoMemory(max(memory - (AHEAD + RECENT) * max(sizes), 0.0), memory)


def _resized(photo: Photo, resolution: int) -> Camera:
    """The camera of a photograph at the size that is asked for."""
    camera = photo.camera.resized(*target_size(photo.camera.width, photo.camera.height, resolution))
    if camera.width * camera.height > PIXELS_MOST:
        raise InputError(
            f"{photo.path}: expected at most {PIXELS_MOST} pixels, got {camera.width} x {camera.height} from "
            f"-r {resolution}, which is a width in px; name a smaller one."
        )
    return camera


def in_turn(views: Sequence[View]) -> Iterator[View]:
    """The views with their photographs in memory, of which threads decode the next ones meanwhile."""
    coming: deque[Future[View]] = deque()
    with ThreadPoolExecutor(THREADS) as pool:
        for view in views:
            coming.append(pool.submit(lambda view: replace(view, photograph=view.pixels), view))
            if len(coming) > AHEAD:
                yield coming.popleft().result()
        yield from (each.result() for each in coming)

"""The cheapest cuts whose bound stays below a tolerance. Tiles where they were too hopeful are drawn again."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch

from warp_splat.camera import Camera
from warp_splat.config import TILE, RasterOptions
from warp_splat.errors import InputError
from warp_splat.raster.bin import balanced_slices
from warp_splat.raster.blend import Blending
from warp_splat.raster.certificate import FAINT, SURE, Certificate
from warp_splat.raster.data import Bins, Pixels, Splats2D

#: From which tolerance on the exponential's polynomial may be of that degree; its error is a tenth at most.
#: Where opacities are cut at 1/255, that error also decides what is cut, so it stays well below ``BAND``, unless a user
#: asks for a lower degree.
DEGREES = {"ideal": ((3, 2e-3), (4, 1e-4)), "trained": ((4, 1e-4),)}
FIRST = 1.0 / 70.0  # the cut that is tried first, as a share of the tolerance: mostly it is small enough
STOP = 0.0007  # where pixels stop, likewise: the Gaussian that crosses it may take 100 times as much
LOWER = 0.6  # of what the bound asks for, the cut of tiles that are drawn again
MOST_ROUNDS = 4
PER_PIXEL = ("bound", "rounding")  # of a certificate


class Painted(NamedTuple):
    """Some tiles of a picture, and how wrong they may be."""

    pixels: Pixels
    splats: Splats2D  # as drawn
    blending: Blending
    certificate: Certificate | None


def paint_within(
    paint: Callable[[RasterOptions, torch.Tensor | None], Painted], options: RasterOptions, camera: Camera
) -> Painted:
    """The picture, no pixel of which the cuts make more wrong than ``options.tolerance`` allows.

    ``paint``: draws with other options, and only some tiles, [T] bool.

    Raises:
        InputError: if the tolerance is an array of another size than the image.
    """
    allowed = torch.as_tensor(options.tolerance, dtype=torch.float32).detach()
    if allowed.dim() and allowed.shape != (camera.height, camera.width):
        wanted, given = f"[{camera.height}, {camera.width}]", list(allowed.shape)
        raise InputError(f"options.tolerance: expected a number, or one for each pixel {wanted}, got {given}.")
    allowed = allowed.expand(camera.height, camera.width)
    degree = next((degree for degree, least in DEGREES[options.of] if float(allowed.min()) >= least), 5)
    by_polynomial = {} if options.exp_degree is None else {"exp_degree": min(degree, options.exp_degree)}
    cut, least = max(FIRST * float(allowed.max()), FAINT), 0.5 * float(allowed.min())
    done = paint(replace(options, bound=True, **_cuts(options, cut), **by_polynomial), None)
    for left in range(MOST_ROUNDS, 0, -1):
        assert done.certificate
        cuts = done.certificate.bound - done.certificate.rounding
        shares = cuts / allowed.to(cuts.device)
        worst = torch.nn.functional.max_pool2d(shares[None], TILE, ceil_mode=True).flatten()  # of each tile
        tiles = worst > 1.0
        stop = _cuts(options, cut)["t_min"] / (1.0 - options.alpha_max) * done.certificate.fields["brightest"]
        hopeless = options.of == "trained" and stop < least  # for its cut cannot be smaller
        if cut <= FAINT or hopeless or not tiles.any():
            break
        cut = max(cut * LOWER / float(worst[tiles].quantile(0.9)), FAINT) if left > 1 else FAINT
        found = paint(replace(options, bound=True, **_cuts(options, cut), **by_polynomial), tiles)
        done = _merged(done, found, found.blending.bins.by_pixel(tiles, camera.width))
    return done


def _cuts(options: RasterOptions, cut: float) -> dict[str, float]:
    """Where opacities are cut and where pixels stop."""
    return {"alpha_min": SURE if options.of == "trained" else min(cut, 0.5), "t_min": min(STOP / FIRST * cut, 0.5)}


def _merged(done: Painted, found: Painted, mask: torch.Tensor) -> Painted:
    """The pixels of ``found`` where ``mask`` [H, W] says, else those of ``done``."""

    def pick(new: torch.Tensor, old: torch.Tensor) -> torch.Tensor:
        return torch.where(mask if new.dim() == 2 else mask[..., None], new, old) if new.numel() else new

    pixels = Pixels(*map(pick, found.pixels, done.pixels))
    assert found.certificate and done.certificate
    names = {name: pick(getattr(found.certificate, name), getattr(done.certificate, name)) for name in PER_PIXEL}
    return done._replace(pixels=pixels, certificate=replace(done.certificate, **names))


def only(bins: Bins, tiles: torch.Tensor) -> Bins:
    """The lists of some tiles [T] alone."""
    lengths = (bins.ranges[:, 1] - bins.ranges[:, 0]).long()
    order = torch.argsort(bins.ranges[:, 0], stable=True)
    listed = torch.repeat_interleave(tiles[order], lengths[order])
    kept = torch.nn.functional.pad(listed, (0, len(bins.instances) - len(listed)))
    before = torch.nn.functional.pad(kept.cumsum(0, dtype=torch.int32), (1, 0))
    chosen = kept[bins.places.long()]
    places_before = torch.nn.functional.pad(chosen.cumsum(0, dtype=torch.int32), (1, 0))
    ranges = before[bins.ranges.long()]
    return replace(
        bins,
        instances=bins.instances[kept],
        places=before[bins.places[chosen].long()],
        place_begins=places_before[bins.place_begins.long()],
        ranges=ranges,
        slices=balanced_slices(ranges[:, 1].numpy()) if bins.slices else [],
    )

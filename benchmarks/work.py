"""How much there is to do in a training step: bytes and operations that no implementation can do without.

Bytes: each array that a stage must read or write, once; what it keeps for itself in between (lists by tile while
sorting, a row of gradients per tile instance, blurred planes) is not counted. Operations: on single numbers, a
multiply-add, a comparison with its selection, a conversion as one each, a division as four (estimate, Newton step).

Per pair of a Gaussian and a pixel that it is blended into (the kernels' ``splat.py``, ``falloff.py``, ``step.py``):

    forward   offset 2, exponent 5, exponential 11 (bound, whole, fraction 2, polynomial 5, exponent bits 2), alpha 3,
              transmittance 4, weight 2, color 3, where the pixel stops 1
    adjoint   offset 2, exponent 5, exponential 11, alpha 4, odds 5, weight and transmittance 2, color . u 3,
              dL/dalpha 2, its cut 2, what is behind 1, dL/dopacity 1, moments 8, color 3

Pairs are counted exactly: alpha is at least ``alpha_min`` and the pixel has not stopped. Sixteen of them fill a
vector; a driver that looks at whole blocks of pixels does more, as ``looked_at`` tells.
"""

from dataclasses import astuple, dataclass

import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.kernels.compiler import FORWARD_ONLY
from warp_splat.kernels.cpu.blend import BLOCKS, offset_x, offset_y, reach
from warp_splat.kernels.falloff import make_exp
from warp_splat.kernels.simd import LANES, total, vec16, where_less
from warp_splat.kernels.splat import alpha_of, exponent
from warp_splat.kernels.structs import BinsView
from warp_splat.raster.data import Gaussians, alphas_of
from warp_splat.raster.drivers import CPU
from warp_splat.raster.project import camera_view, project
from warp_splat.runtime.launch import launch, view

FORWARD, ADJOINT = 31, 49  # operations per pair
PROJECT = 240  # per Gaussian drawn, two thirds of them for its shape; its adjoint: again, and twice that, at most
LOSS, ADJOINT_OF_LOSS = 159, 73  # per channel of a pixel: five planes blurred along rows and columns; three

exp2_minus = make_exp(RasterOptions().exp_degree)


@wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
def count_pairs(
    first: int,
    bins: BinsView,
    alphas: wp.vec2,
    count: wp.array2d[vec16],  # [T, BLOCKS] instances walked before the pixel stopped
    width: float,
    height: float,
    # out
    pairs_out: wp.array2d[wp.int64],  # [T, 3] blended, and looked at in blocks, by the adjoint
):
    tile = first + wp.tid()
    start = bins.ranges[tile][0]
    x0 = float((tile % bins.tiles_x) * 16) + 0.5
    y0 = float((tile // bins.tiles_x) * 16) + 0.5
    longest = wp.max(count[tile, 0])
    for block in range(1, BLOCKS):
        longest = wp.max(longest, wp.max(count[tile, block]))
    blended = wp.int64(0)
    looked_at = wp.int64(0)
    by_adjoint = wp.int64(0)
    for k in range(start, start + int(longest)):
        splat = bins.splats[bins.instances[k]]
        box = reach(splat.mean, splat.extent, x0, y0)
        hits = vec16(0.0)
        for by in range(box[2], box[3] + 1):
            for bx in range(box[0], box[1] + 1):
                dx = offset_x(splat.mean, x0, bx)
                dy = offset_y(splat.mean, y0, by)
                fall = exp2_minus(exponent(dx, dy, splat.root[0], splat.root[1], splat.root[2]))
                alpha = alpha_of(fall * splat.opacity, alphas)
                hit = where_less(vec16(0.0), alpha, vec16(1.0), vec16(0.0))
                hit = where_less(vec16(float(k - start)), count[tile, 4 * by + bx], hit, vec16(0.0))
                hit = where_less(vec16(splat.mean[0]) - dx, vec16(width), hit, vec16(0.0))
                hits += where_less(vec16(splat.mean[1]) - dy, vec16(height), hit, vec16(0.0))
                looked_at += wp.int64(LANES)
        blended += wp.int64(total(hits))
        for block in range(BLOCKS):
            by_adjoint += wp.int64(LANES) * wp.int64((bins.blocks[k] >> block) & 1)
    pairs_out[tile, 0] = blended
    pairs_out[tile, 1] = looked_at
    pairs_out[tile, 2] = by_adjoint


@dataclass(frozen=True)
class Counts:
    """What a step has to do with; means over views, if of several."""

    gaussians: float
    coefficients: float  # of spherical harmonics, active, per channel
    drawn: float  # Gaussians
    pixels: float
    instances: float  # Gaussians in tiles
    pairs: float  # Gaussians in pixels, blended
    looked_at: float  # Gaussians in pixels of blocks of 4 x 4
    by_adjoint: float  # of these, what the adjoint looks at


def count(gaussians: Gaussians, camera: Camera, options: RasterOptions) -> Counts:
    """Of one view on the CPU; ``gaussians`` as :func:`warp_splat.raster.api.render` takes them."""
    with torch.no_grad():
        bins = CPU.bin(project(gaussians, camera, options), camera, options)
        _, (_, stopped, blocks, _) = CPU.blend(bins, camera, torch.zeros(3), options, False)
        pairs = torch.empty(len(bins.ranges), 3, dtype=torch.int64)
        inputs = [bins.view(blocks=blocks), alphas_of(options), view(stopped, vec16), camera.width, camera.height]
        launch(count_pairs, len(pairs), inputs, [view(pairs, wp.int64)], bounds=bins.slices)
    pixels = camera.width * camera.height
    coefficients = (camera_view(camera, gaussians.sh_rest.shape[1], options, camera).sh_degree + 1) ** 2
    drawn, instances = len(bins.gaussians), len(bins.instances)
    return Counts(len(gaussians.means), coefficients, drawn, pixels, instances, *pairs.sum(0).tolist())


def mean(counts: list[Counts]) -> Counts:
    return Counts(*(sum(values) / len(counts) for values in zip(*map(astuple, counts), strict=True)))


def work_of(counts: Counts) -> dict[str, tuple[float, float]]:
    """Bytes and operations of each stage; ``host`` has nothing that must be done.

    Per Gaussian of 44 bytes (mean 12, quaternion 16, scales 12, opacity 4) and 12 per SH coefficient; projected, of 48
    (mean 8, conic 12, opacity 4, color 12, depth 4, extent 8) and a radius of 4.
    """
    n, drawn, pixels = counts.gaussians, counts.drawn, counts.pixels
    sh = 12 * counts.coefficients
    gradient2d = 40  # all of a projected Gaussian but its extent
    return {
        # shapes in; radii out; of those drawn, SH in and the rest out
        "project": (n * (44 + 4) + drawn * (sh + 48), PROJECT * drawn),
        # radii and projected Gaussians in; splats, where each came from and where its places begin, and the instances
        # (splat 4, place 4) out
        "bin": (n * 4 + drawn * (48 + 48 + 8) + counts.instances * 8, 0),
        # instances and Gaussians in; image, alpha, and for the adjoint final T and count out
        "blend": (counts.instances * 4 + drawn * 48 + pixels * 24, FORWARD * counts.pairs),
        # image (float32) and photograph (uint8) in; for the adjoint, these and the gradient of the image
        "loss": (pixels * 15, LOSS * 3 * pixels),
        "adjoint of loss": (pixels * 27, ADJOINT_OF_LOSS * 3 * pixels),
        # as the blend, with places and the gradient of the image in, and gradients of the projected Gaussians out
        "adjoint of blend": (counts.instances * 8 + drawn * (48 + gradient2d) + pixels * 20, ADJOINT * counts.pairs),
        # radii in; of those drawn, shapes, SH and gradients in; gradients of all out
        "adjoint of project": (n * (4 + 44 + sh) + drawn * (44 + sh + gradient2d), 3 * PROJECT * drawn),
        # radii in; of those drawn, the gradient of the mean in, its sum and the number of views in and out
        "densify": (n * 4 + drawn * (8 + 16), 0),
        # value, gradient and two moments in; all but the gradient out
        "Adam": (n * (44 + sh) * 7, 12 * n * (11 + 3 * counts.coefficients)),
        "host": (0, 0),
    }

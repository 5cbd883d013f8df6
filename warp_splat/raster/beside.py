"""What is blended beside the color: features of the user's own, normals; and which Gaussians a pixel shows.

The color is blended first. These kernels repeat its weights, from what it has found (:class:`.blend.Blending`), and so
cost nothing where they are not asked for. Channels go in groups, so that memory does not grow with their number.
"""

from collections.abc import Iterator
from typing import NamedTuple

import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.kernels.slots import CHANNEL
from warp_splat.raster.blend import Blending
from warp_splat.raster.camera_parameters import CameraParameters
from warp_splat.raster.data import LESS, Bins, Gaussians, Splats2D, variant_of
from warp_splat.raster.drivers import Driver
from warp_splat.raster.seam import Crossing, with_copies
from warp_splat.runtime.launch import check_memory
from warp_splat.runtime.timers import adjoint_of

WIDTHS = (4, 16, 32)  # columns of a slot that channels take: as many kernels sum them up
MANY = 2**28  # bytes of a group's gradients from which on it is asked whether there is room for them


class Group(NamedTuple):
    """Channels that a kernel takes at once."""

    begin: int  # the first of them
    count: int
    rows: torch.Tensor  # of the splats [V, at once], filled up with zeros; [0, 0] where their weights are looked at


def blend_beside(
    features: torch.Tensor | None,
    gaussians: Gaussians,
    splats: Splats2D,
    camera: Camera | CameraParameters,
    blending: Blending,
    crossing: Crossing,
) -> dict[str, torch.Tensor]:
    """What is asked for beside the color, by its name in :class:`warp_splat.RenderOutput`.

    ``splats`` have copies of the Gaussians that cross the seam of a panorama (:mod:`.seam`).
    """
    channels, found, options = {} if features is None else {"features": features}, {}, blending.options
    if options.normals:
        center = (camera.camera if isinstance(camera, CameraParameters) else camera).center.tolist()
        # number by number, since a copy of the center would make a GPU wait; it may be far from the origin
        means = gaussians.means.double().unbind(1)
        away = torch.stack([mean - value for mean, value in zip(means, center, strict=True)], 1).float()
        normals = normals_of(gaussians, away.detach())
        channels |= {"normals": normals, "planes": (normals * away).sum(1, keepdim=True)}
    if channels:
        widths = [channel.shape[1] for channel in channels.values()]
        together = torch.cat(list(channels.values()), 1) if len(channels) > 1 else next(iter(channels.values()))
        together = with_copies(together, crossing)
        image = blend_channels(splats, together, blending)
        parts = image.split(widths, 2) if len(widths) > 1 else [image]  # the adjoint of a split copies
        found |= zip(channels, parts, strict=True)
    if options.strongest or options.median_depth:
        numbers, weights, median_depth = find_strongest(splats, blending)
        if options.strongest:
            owners = with_copies(torch.arange(len(gaussians.means), device=splats.means2d.device), crossing)
            numbers = torch.where(numbers < 0, numbers, owners[numbers]) if crossing and len(owners) else numbers
            found |= {"strongest": numbers, "strongest_weights": weights}
        if options.median_depth:
            found["median_depth"] = median_depth
    return found


def blend_channels(splats: Splats2D, features: torch.Tensor, blending: Blending) -> torch.Tensor:
    """Sums of weight times ``features`` [N, C], [H, W, C]; differentiable in them and in the splats."""
    return Channels.apply(splats.means2d, splats.conics, splats.opacities, features, blending)


def find_strongest(splats: Splats2D, blending: Blending) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Which Gaussians a pixel shows; weights are differentiable in the splats, the median in z.

    Returns:
        The k Gaussians of the largest weights, [H, W, k] int64, the strongest first, of equal ones the nearest, -1
        where there is none; opacity times transmittance of these, 0 there; and the depth of the Gaussian at which half
        of the light is gone, [H, W], 0 where it is not.
    """
    bins, camera, options = blending.bins, blending.camera, blending.options
    shape, most, device = (camera.height, camera.width), options.strongest, splats.means2d.device
    ranks = torch.empty(*shape, most, dtype=torch.int32, device=device)
    weights = torch.empty(*shape, most, dtype=torch.float32, device=device)
    median = torch.empty(shape, dtype=torch.int32, device=device)
    _launch(blending, weights, Group(0, 0, weights.new_empty(0, 0)), (ranks, median))
    gaussians, middle = _gaussians_of(bins, camera, ranks), _gaussians_of(bins, camera, median[..., None])
    if most:
        weights = Weights.apply(splats.means2d, splats.conics, splats.opacities, weights, ranks, blending)
    # an embedding, whose adjoint sums in one order, on a GPU as well; the last row is that of no Gaussian
    depths = torch.cat([splats.depths, splats.depths.new_zeros(1)])[:, None]
    return gaussians, weights, torch.nn.functional.embedding(middle % len(depths), depths).view(shape)


def _launch(blending: Blending, pixels: torch.Tensor, group: Group, strongest: tuple[torch.Tensor, ...] = ()) -> None:
    """Fill ``pixels`` [H, W, C] with a group of channels; or, with ``strongest``, ranks and median, with weights."""
    none = torch.empty(0, 0, 0, dtype=torch.int32, device=pixels.device)
    ranks, median = strongest or (none, none.flatten(1))
    at_most = ranks.shape[2] if strongest else None
    kernel = blending.driver.kernels.channels.make_beside(variant_of(blending.options), at_most)
    inputs = [*blending.view_lists(), blending.saved.count, blending.steps, group.rows, group.begin, group.count]
    blending.driver.launch_tiles(blending.bins, (kernel, inputs, [pixels, ranks, median]))


def _gaussians_of(bins: Bins, camera: Camera, ranks: torch.Tensor) -> torch.Tensor:
    """Gaussians [H, W, k] of places in the lists of the pixels' tiles; -1 stays."""
    begins = bins.by_pixel(bins.ranges[:, 0], camera.width)[..., None]
    none = torch.full_like(ranks, -1).long()
    if not len(bins.instances):
        return none
    splats = bins.instances[(begins + ranks.clamp_min(0)).clamp_max(len(bins.instances) - 1).long()].long()
    return torch.where(ranks >= 0, wp.to_torch(bins.gaussians)[splats].long(), none)


def normals_of(gaussians: Gaussians, away: torch.Tensor) -> torch.Tensor:
    """The shortest axis of each Gaussian in the world, turned against ``away`` [N, 3], [N, 3] of length 1.

    Differentiable in the quaternions.
    """
    axes = rotations(gaussians.quats).mT
    normals = axes.gather(1, gaussians.scales.detach().argmin(1)[:, None, None].expand(-1, 1, 3)).squeeze(1)
    return torch.where((normals.detach() * away).sum(1, keepdim=True) > 0, -normals, normals)


def rays(camera: Camera, device: torch.device) -> torch.Tensor:
    """Of a pinhole's pixels, in the world, from its center to depth 1, [H, W, 3]."""
    columns, rows = (torch.arange(n, dtype=torch.float32, device=device) for n in (camera.width, camera.height))
    y, x = torch.meshgrid((rows + 0.5 - camera.cy) / camera.fy, (columns + 0.5 - camera.cx) / camera.fx, indexing="ij")
    return torch.stack([x * right + y * down + forward for right, down, forward in camera.rotation.T.tolist()], -1)


def rotations(quats: torch.Tensor) -> torch.Tensor:
    """Matrices [..., 3, 3] of quaternions w first, any norm; of zero, the identity."""
    # brought to a length of about 1 by a power of two, which changes no bit: squares of 1e-20 underflow
    quats = torch.ldexp(quats, -torch.frexp(quats.detach().abs().amax(-1, keepdim=True)).exponent)
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


class Channels(torch.autograd.Function):
    """Features to pixels; the adjoint walks the lists back to front, once for every group of channels."""

    @staticmethod
    def forward(ctx, means2d, conics, opacities, features, blending):
        camera, driver, features = blending.camera, blending.driver, features.contiguous()
        image = features.new_empty(camera.height, camera.width, features.shape[1])
        for group in _groups(blending.bins, features, driver):
            _launch(blending, image, group)
        ctx.save_for_backward(features)
        ctx.blending = blending
        return image

    @staticmethod
    @adjoint_of("channels")
    def backward(ctx, adj_image):
        (features,) = ctx.saved_tensors
        adj_image = _without_bad(adj_image, ctx.blending)
        adj_features = torch.empty_like(features)
        total: list[torch.Tensor] = []
        for group in _groups(ctx.blending.bins, features, ctx.blending.driver):
            geometry, part = _differentiate(ctx.blending, group, adj_image)
            adj_features[:, group.begin : group.begin + group.count] = part
            total = [a.add_(b) for a, b in zip(total, geometry, strict=True)] if total else geometry
        return *total, adj_features, None


class Weights(torch.autograd.Function):
    """The weights of the strongest Gaussians, which a kernel has found already, tied to the splats."""

    @staticmethod
    def forward(ctx, means2d, conics, opacities, weights, ranks, blending):
        ctx.save_for_backward(ranks)
        ctx.blending = blending
        return weights.clone()

    @staticmethod
    @adjoint_of("channels")
    def backward(ctx, adj_weights):
        (ranks,) = ctx.saved_tensors
        group = Group(0, ranks.shape[2], adj_weights.new_empty(0, 0))
        geometry, _ = _differentiate(ctx.blending, group, _without_bad(adj_weights, ctx.blending), ranks)
        return *geometry, None, None, None


def _groups(bins: Bins, features: torch.Tensor, driver: Driver) -> Iterator[Group]:
    """The channels of ``features`` [N, C]."""
    gaussians, size = wp.to_torch(bins.gaussians).long(), driver.kernels.channels.AT_ONCE
    for begin in range(0, features.shape[1], size):
        part = features[:, begin : begin + size]
        count = part.shape[1]
        yield Group(begin, count, torch.nn.functional.pad(part[gaussians], (0, size - count)))


def absolute_gradients(channels: torch.Tensor, adj_pixels: torch.Tensor, blending: Blending) -> torch.Tensor:
    """Sums over pixels of the magnitudes of the 2D means' gradients, [N, 2].

    By all that a pixel blends: ``channels`` [N, C] of one group, with their upstream gradients [H, W, C].
    """
    (group,) = _groups(blending.bins, channels, blending.driver)
    (means2d, *_), _ = _differentiate(blending, group, adj_pixels.contiguous().resolve_neg(), mode="absolute")
    return means2d


def _differentiate(
    blending: Blending, group: Group, adj_pixels: torch.Tensor, ranks: torch.Tensor | None = None, mode: str = ""
) -> tuple[list[torch.Tensor], torch.Tensor]:
    """Gradients of means2d, conics and opacities, and those of a group of channels [N, count].

    With ``ranks``, by the weights of those Gaussians instead of channels. Raises InputError if there is no room.
    """
    bins, options, driver = blending.bins, blending.options, blending.driver
    mode = mode or ("manual" if blending.adjoint == "manual" else "stepwise")
    most = 0 if ranks is None else group.count
    width = 0 if most or mode == "absolute" else next(width for width in WIDTHS if width >= group.count)
    count, columns = len(bins.instances), CHANNEL + width
    if (needed := 4 * count * columns) > MANY:
        check_memory(f"rasterize: the gradients of {count} tile instances take", needed, bins.instances.device, LESS)
    slots = adj_pixels.new_empty(count, columns)  # a row per tile instance
    kernel = driver.kernels.channels.make_adj_channels(mode, variant_of(options), most)
    ranks = slots.new_empty(0, 0, 0) if ranks is None else ranks.float()
    inputs = [*blending.view_lists(), *blending.saved[:2], blending.steps]
    driver.launch_tiles(bins, (kernel, [*inputs, group.rows, ranks, group.begin, group.count, adj_pixels], [slots]))
    tables = [slots.new_empty(bins.gaussian_count, size) for size in (2, 3, 1, width) if size]
    return driver.gather(bins, slots, tables)[:3], tables[-1][:, : group.count]


def _without_bad(adj_pixels: torch.Tensor, blending: Blending) -> torch.Tensor:
    """Upstream gradients [H, W, C]; those of a pixel are dropped and counted, where one of them is not finite."""
    adj_pixels = adj_pixels.contiguous().resolve_neg()
    if blending.driver.peeks and bool(adj_pixels.sum().isfinite()):
        return adj_pixels
    bad = ~adj_pixels.isfinite().all(2)
    blending.dropped.pixel_count += bad.sum()
    return torch.where(bad[..., None], 0.0, adj_pixels)

"""From 3D Gaussians to an image, differentiable in torch: project, bin, blend, and the adjoints of the first and last.

Two autograd functions, so that what lies between them (the 2D means above all, whose gradient steers densification)
are torch tensors with gradients of their own.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.checks import check_gaussians, check_options, explain_invalid
from warp_splat.config import FRUSTUM_MARGIN, TILE, RasterOptions
from warp_splat.errors import InputError
from warp_splat.kernels import tiles
from warp_splat.kernels.blend import Splat2D
from warp_splat.kernels.blend_lanes import BLOCKS, make_blend
from warp_splat.kernels.lanes import vec16
from warp_splat.kernels.project import UNSEEN, CameraView, project, quarantine
from warp_splat.launch import even_slices, get_threads, launch, stage, view

MAX_INSTANCES = 2**31 - 1  # kernels index instances with 32 bits
SLICES_PER_THREAD = 8  # of the blends: tiles differ in cost by more than their number of instances says


@dataclass
class Dropped:
    """What the adjoint refused to spread: counted during ``backward``."""

    pixels: int = 0  # whose upstream gradient was not finite
    gaussians: int = 0  # whose own gradient was not finite


@dataclass
class RenderOutput:
    """What :func:`rasterize` returns; H x W pixels, N Gaussians."""

    image: torch.Tensor  # [H, W, 3]
    alpha: torch.Tensor  # [H, W], 1 - transmittance
    depth: torch.Tensor | None  # [H, W] world units, expected z (0 where alpha is 0), if asked for
    means2d: torch.Tensor  # [N, 2] px; 0 if culled
    radii: torch.Tensor  # [N] int32, px from the mean to the farthest point where alpha >= 1/255; 0 if culled
    invalid: int  # Gaussians left out because an input was not finite or a quaternion was zero
    dropped: Dropped = field(default_factory=Dropped)


def rasterize(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    sh: torch.Tensor | tuple[torch.Tensor, torch.Tensor],
    camera: Camera,
    background: torch.Tensor | tuple[float, float, float] = (0.0, 0.0, 0.0),
    adjoint: str = "manual",
    options: RasterOptions | None = None,
) -> RenderOutput:
    """Render Gaussians through a camera (Kerbl et al. 2023), differentiable in every tensor given.

    Args:
        means: centres, [N, 3] float32, world units.
        quats: rotations (w, x, y, z), [N, 4], any norm; a Gaussian whose quaternion is zero is left out.
        scales: standard deviations along the axes, [N, 3], positive, world units.
        opacities: [N], in 0..1.
        sh: spherical-harmonics coefficients, [N, K, 3] with K = 1, 4, 9 or 16; or the pair ([N, 1, 3], [N, K-1, 3])
            as trainers keep them, which saves a copy. Color = max(0, 0.5 + sum of coefficients times basis).
        camera: pinhole camera, world to camera in COLMAP's axes.
        background: RGB behind everything; a tensor [3] receives a gradient.
        adjoint: how the pixel loop is differentiated; "manual" (by hand, transmittance recovered by division).
        options: what to compute; see :class:`RasterOptions`.

    Returns:
        A :class:`RenderOutput`. ``image``, ``alpha``, ``depth`` and ``means2d`` carry gradients. A pixel whose
        upstream gradient is not finite is dropped, as is a Gaussian's gradient that is not finite; both are counted
        in ``dropped``.

    Raises:
        InputError: if a shape, dtype, device or value is not as stated; the message names the argument.
    """
    options = check_options(adjoint, options, camera)
    gaussians = check_gaussians(means, quats, scales, opacities, sh)
    background = _background(background)
    out = render(gaussians, camera, background, options)
    if out.invalid:
        explain_invalid(*gaussians)
    return out


def render(gaussians: tuple[torch.Tensor, ...], camera: Camera, background: torch.Tensor, options: RasterOptions) -> RenderOutput:
    """:func:`rasterize` without its checks: Gaussians that are not finite are left out and counted."""
    dropped = Dropped()
    with stage("project"):
        means2d, conics, opacities2d, colors, depths, extents, radii = Project.apply(
            *gaussians, camera_view(camera, gaussians[5].shape[1], options), dropped
        )
    with stage("bin"):
        bins = bin_tiles(means2d, conics, opacities2d, colors, depths, extents, radii, camera)
    with stage("blend"):
        image, alpha, depth = Blend.apply(
            means2d, conics, opacities2d, colors, depths, background, bins, camera, options, dropped
        )
    if options.depth:
        depth = depth / alpha.clamp_min(1e-10)
    return RenderOutput(image, alpha, depth if options.depth else None, means2d, radii.clamp_min(0), bins.invalid, dropped)


def camera_view(camera: Camera, rest: int, options: RasterOptions) -> CameraView:
    """The camera as kernels read it; ``rest`` is the number of coefficients beyond the first."""
    degree = {0: 0, 3: 1, 8: 2, 15: 3}[rest]
    focal, principal = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    size = np.array([camera.width, camera.height])
    margin = FRUSTUM_MARGIN * 0.5 * size / focal
    cam = CameraView()
    cam.rotation = wp.mat33(*camera.rotation.ravel())
    center = camera.center.astype(np.float32)
    cam.center, cam.center_low = wp.vec3(*center), wp.vec3(*(camera.center - center))
    cam.focal, cam.principal, cam.size = wp.vec2(*focal), wp.vec2(*principal), wp.vec2(*size)
    cam.slope_min = wp.vec2(*(-principal / focal - margin))
    cam.slope_max = wp.vec2(*((size - principal) / focal + margin))
    cam.sh_degree = degree if options.sh_degree is None else min(degree, options.sh_degree)
    cam.antialiasing = int(options.antialiasing)
    return cam


def _background(background) -> torch.Tensor:
    if not isinstance(background, torch.Tensor):
        try:
            background = torch.tensor([float(value) for value in background])
        except (TypeError, ValueError):
            raise InputError(f"background: expected three numbers or a tensor [3], got {background!r}.") from None
    if background.shape != (3,) or background.dtype != torch.float32 or not bool(torch.isfinite(background).all()):
        raise InputError(
            f"background: expected three finite numbers (a tensor: float32 [3]), got {background.dtype} "
            f"{list(background.shape)}: {background.tolist()}."
        )
    return background


class Project(torch.autograd.Function):
    """3D to 2D; the adjoint is generated by Warp from the forward kernel."""

    @staticmethod
    def forward(ctx, means, quats, scales, opacities, sh_dc, sh_rest, cam, dropped):
        count, new = means.shape[0], means.new_zeros
        inputs = (means, quats, scales, opacities, sh_dc, sh_rest)
        outputs = (new(count, 2), new(count, 3), new(count), new(count, 3), new(count), new(count, 2))
        radii = torch.full((count,), int(UNSEEN), dtype=torch.int32)
        launch(project, count, [cam, *_views3d(inputs)], [*_views2d(outputs), view(radii, wp.int32)])
        ctx.save_for_backward(*inputs, *outputs, radii)
        ctx.cam, ctx.dropped = cam, dropped
        ctx.mark_non_differentiable(outputs[5], radii)
        return *outputs, radii

    @staticmethod
    def backward(ctx, *adj_outputs):
        with stage("adjoint of project"):
            saved = ctx.saved_tensors
            inputs, outputs, radii = saved[:6], saved[6:12], saved[12]
            adj_outputs = [adj.contiguous() for adj in adj_outputs[:5]]
            adj_inputs = [torch.zeros_like(tensor, memory_format=torch.contiguous_format) for tensor in inputs]
            adj_views = _views3d(adj_inputs)
            launch(
                project,
                len(radii),
                [ctx.cam, *_views3d(inputs)],
                [*_views2d(outputs), view(radii, wp.int32)],
                adj_inputs=[ctx.cam, *adj_views],
                adj_outputs=[*_views2d(adj_outputs), None, None],
            )
            bad = torch.zeros_like(radii)
            launch(quarantine, len(radii), [view(radii, wp.int32)], [*adj_views, view(bad, wp.int32)])
            ctx.dropped.gaussians += int(np.count_nonzero(bad.numpy()))
        wanted = zip(adj_inputs, ctx.needs_input_grad[:6], strict=True)
        return *(adj if wants else None for adj, wants in wanted), None, None


def _views3d(tensors) -> list:
    types = (wp.vec3, wp.vec4, wp.vec3, wp.float32, wp.vec3, wp.vec3)
    return [view(tensor, dtype) for tensor, dtype in zip(tensors, types, strict=True)]


def _views2d(tensors) -> list:
    types = (wp.vec2, wp.vec3, wp.float32, wp.vec3, wp.float32, wp.vec2)
    return [view(tensor, dtype) for tensor, dtype in zip(tensors, types, strict=False)]


@dataclass
class Bins:
    """Tile lists: V Gaussians drawn, M tile instances, T tiles."""

    order: wp.array  # [V] Gaussian, nearest first
    splats: wp.array  # [V] Splat2D
    slot_ends: wp.array  # [V] int64, inclusive scan of a Gaussian's instances
    instances: torch.Tensor  # [M, 2] int32 (rank, slot), by tile, nearest first
    ranges: torch.Tensor  # [T, 2] int32, first and last instance
    slices: list[int]  # bounds of slices of tiles with about equal work
    tiles_x: int
    invalid: int


def bin_tiles(means2d, conics, opacities, colors, depths, extents, radii, camera: Camera) -> Bins:
    """Sort the drawn Gaussians by depth (ties by index) and list those of each tile."""
    tiles_x, tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
    tile_count = tiles_x * tiles_y
    invalid = int(np.count_nonzero(radii.numpy() < 0))
    order = sort_by_depth(depths, radii)
    drawn = len(order)
    splats = wp.empty(drawn, dtype=Splat2D, device="cpu")
    row_ends = wp.empty(drawn, dtype=wp.int64, device="cpu")
    slot_ends = wp.empty(drawn, dtype=wp.int64, device="cpu")
    tensors = _views2d((means2d, conics, opacities, colors, depths, extents))
    launch(tiles.pack, drawn, [order, *tensors, camera.height], [splats, row_ends])
    rows = _scan(row_ends)
    _check_count(rows, camera, drawn)
    spans = wp.empty(rows, dtype=wp.vec2i, device="cpu")
    launch(
        tiles.find_spans, drawn, [splats, row_ends, camera.width, camera.height, tiles_x], [spans, slot_ends]
    )
    count = _scan(slot_ends)
    _check_count(count, camera, drawn)
    # bands of Gaussians, one per thread: each counts its instances of every tile, then writes them after those of
    # the bands before it
    ranks = np.array(even_slices(drawn), dtype=np.int32)
    bands = len(ranks) - 1
    ends = np.concatenate([[0], row_ends.numpy()])
    band_rows = wp.array(ends[ranks].astype(np.int32), dtype=int, device="cpu")
    counts = np.zeros((bands, tile_count), dtype=np.int32)
    one_each = list(range(bands + 1))
    launch(tiles.count_tiles, bands, [band_rows, spans], [wp.array(counts, dtype=int, copy=False, device="cpu")], bounds=one_each)
    places = np.cumsum(counts.T.ravel(), dtype=np.int64).reshape(tile_count, bands)
    cursor = wp.array((places - counts.T).T.astype(np.int32), dtype=int, device="cpu")
    instances = torch.empty((count, 2), dtype=torch.int32)
    launch(
        tiles.scatter,
        bands,
        [wp.array(ranks, dtype=int, device="cpu"), spans, row_ends, slot_ends],
        [cursor, view(instances, wp.vec2i)],
        bounds=one_each,
    )
    ends = places[:, -1]
    ranges = torch.from_numpy(np.stack([ends - counts.sum(0), ends], 1).astype(np.int32))
    return Bins(order, splats, slot_ends, instances, ranges, balanced_slices(ends), tiles_x, invalid)


def sort_by_depth(depths: torch.Tensor, radii: torch.Tensor) -> wp.array:
    """Indices of the drawn Gaussians, nearest first, ties by index, [V] int32."""
    drawn = np.flatnonzero(radii.numpy() > 0).astype(np.int32)
    count = len(drawn)
    if count == 0:
        return wp.empty(0, dtype=int, device="cpu")
    keys = np.empty(2 * count, dtype=np.float32)  # the sort works in twice the space
    values = np.empty(2 * count, dtype=np.int32)
    keys[:count] = depths.detach().numpy()[drawn]
    values[:count] = drawn
    order = wp.array(values, dtype=int, copy=False, device="cpu")
    wp.utils.radix_sort_pairs(wp.array(keys, dtype=float, copy=False, device="cpu"), order, count)
    return order[:count]


def _scan(counts: wp.array) -> int:
    """Inclusive scan in place, in 64 bits (a 32-bit one wraps without a word); returns the total."""
    if not len(counts):
        return 0
    wp.utils.array_scan(counts, counts, inclusive=True)
    return int(counts.numpy()[-1])


def _check_count(count: int, camera: Camera, drawn: int) -> None:
    if count > MAX_INSTANCES:
        raise InputError(
            f"rasterize: {drawn} Gaussians on {camera.width} x {camera.height} pixels touch tiles {count} times, more "
            f"than the {MAX_INSTANCES} that fit; render a smaller image or fewer, smaller Gaussians."
        )


def balanced_slices(ends: np.ndarray) -> list[int]:
    """Bounds of slices of tiles with about the same number of instances; an empty tile counts a little, too."""
    work = ends + 32 * np.arange(1, len(ends) + 1)
    parts = SLICES_PER_THREAD * get_threads() if get_threads() > 1 else 1
    inner = np.searchsorted(work, work[-1] * np.arange(1, parts) / parts)
    return [0, *inner.tolist(), len(ends)]


class Blend(torch.autograd.Function):
    """2D Gaussians to pixels; the adjoint walks each tile's list back to front."""

    @staticmethod
    def forward(ctx, means2d, conics, opacities, colors, depths, background, bins, camera, options, dropped):
        height, width = camera.height, camera.width
        image, alpha = torch.empty(height, width, 3), torch.empty(height, width)
        depth = torch.empty(height, width) if options.depth else torch.empty(0, 0)
        tile_count = len(bins.ranges)
        final, count = torch.empty(tile_count, BLOCKS, 16), torch.empty(tile_count, BLOCKS, 16)
        background = background.contiguous()
        launch(
            make_blend(options.depth).forward,
            tile_count,
            _blend_inputs(bins, background),
            [*_pixel_views(image, alpha, depth), view(final, vec16), view(count, vec16)],
            bounds=bins.slices,
        )
        ctx.save_for_backward(background, final, count)
        ctx.bins, ctx.options, ctx.dropped, ctx.gaussian_count = bins, options, dropped, len(means2d)
        return image, alpha, depth

    @staticmethod
    def backward(ctx, adj_image, adj_alpha, adj_depth):
        with stage("adjoint of blend"):
            background, final, count = ctx.saved_tensors
            bins, options = ctx.bins, ctx.options
            adj_image, adj_alpha, adj_depth = (adj.contiguous() for adj in (adj_image, adj_alpha, adj_depth))
            slots = torch.empty(len(bins.instances), 10 if options.depth else 9)
            adj_background = torch.empty(len(bins.ranges), 3)
            bad = torch.empty(len(bins.ranges), dtype=torch.int32)
            launch(
                make_blend(options.depth).adjoint,
                len(bins.ranges),
                [*_blend_inputs(bins, background), view(final, vec16), view(count, vec16)]
                + _pixel_views(adj_image, adj_alpha, adj_depth),
                [view(slots, wp.float32), view(adj_background, wp.float32), view(bad, wp.int32)],
                bounds=bins.slices,
            )
            ctx.dropped.pixels += int(bad.numpy().sum())
            rows, new = ctx.gaussian_count, slots.new_zeros
            grads = (new(rows, 2), new(rows, 3), new(rows), new(rows, 3), new(rows))
            launch(tiles.gather, len(bins.order), [bins.order, bins.slot_ends, view(slots, wp.float32)], _views2d(grads))
            adj_background = torch.from_numpy(adj_background.numpy().sum(0))
        return *grads, adj_background, None, None, None, None


def _blend_inputs(bins: Bins, background: torch.Tensor) -> list:
    ranges, instances = view(bins.ranges, wp.vec2i), view(bins.instances, wp.vec2i)
    return [bins.tiles_x, ranges, instances, bins.splats, view(background, wp.float32)]


def _pixel_views(image: torch.Tensor, alpha: torch.Tensor, depth: torch.Tensor) -> list:
    return [view(tensor, wp.float32) for tensor in (image, alpha, depth)]

"""The training loss: (1 - lambda) L1 + lambda (1 - SSIM), on a CPU and on a GPU."""

import functools
import math
from numbers import Real

import numpy as np
import torch
import warp as wp

from warp_splat.color import to_srgb
from warp_splat.errors import InputError
from warp_splat.kernels import ssim
from warp_splat.kernels.cuda.comparison import BAND, STRIP, PicturesView, adj_compare_block, compare_block
from warp_splat.kernels.simd import LANES, vec16
from warp_splat.kernels.window import CHANNELS, MOMENTS, RADIUS, RING, ROWS, SLOPES, WEIGHTS, WINDOW
from warp_splat.raster.drivers import DRIVERS, driver_of
from warp_splat.runtime.launch import launch, launch_blocks, pack_struct, view
from warp_splat.runtime.pool import even_slices
from warp_splat.runtime.timers import adjoint_of, stage

LOG_FLOOR = 1e-3  # light below which differences stop to count by their ratio (Mildenhall et al. 2022, RawNeRF)
#: Under these, light is compared: 0 stays 0 and 1 stays 1, negative counts as black, brighter than 1 goes on.
LOSS_CURVES = {
    "srgb": lambda linear: to_srgb(linear.clamp_min(0.0), torch.where),
    "log": lambda linear: torch.log1p(linear.clamp_min(0.0) / LOG_FLOOR) / math.log1p(1.0 / LOG_FLOOR),
}
FAR_APART = 10.0  # in units of an image's usual range
SMALLEST_SLICE = 64  # rows; besides its own, a slice blurs ten of its neighbors'
HALVES = functools.cache(functools.partial(torch.full, (2,), 0.5))  # by device: the centers of images of bytes


def image_loss(
    image: torch.Tensor,
    target: torch.Tensor,
    lambda_dssim: float = 0.2,
    mask: torch.Tensor | None = None,
    clamped: bool = False,
) -> torch.Tensor:
    """(1 - lambda) mean |image - target| + lambda (1 - SSIM) (Kerbl et al. 2023, eq. 7), a scalar.

    With a mask, both images are black where it is 0. Nothing there has an influence or a gradient, and windows of SSIM
    across its border compare only what counts. The means are over all pixels: a pixel weighs the same however many are
    masked, and thresholds of gradients keep their meaning.

    Args:
        image: [H, W, 3] float32, differentiable.
        target: [H, W, 3] float32, or uint8 to be divided by 255; gets no gradient.
        lambda_dssim: share of the structural term, 0..1.
        mask: [H, W, 1] uint8, 0 for pixels that do not count.
        clamped: compare the image within 0..1, without a gradient where it lies outside.

    Raises:
        InputError: if the shapes differ, are not [H, W, 3] or hold no pixel, a type is another, or ``lambda_dssim``
            lies outside 0..1.
    """
    if problem := _problem(image, target, lambda_dssim, mask):
        raise InputError(f"image_loss: expected {problem}.")
    if mask is not None:
        counts = mask != 0
        image, target = (torch.where(counts, picture, picture.new_zeros(())) for picture in (image, target))
    loss = LossInBlocks if driver_of(image.device).lanes == 1 else ImageLoss
    return loss.apply(image, target, lambda_dssim, wp.vec2(0.0, 1.0) if clamped else wp.vec2(-math.inf, math.inf))


def _problem(image, target, lambda_dssim: float, mask) -> str | None:
    """What :func:`image_loss` expects of its arguments, and what it got; None if that is the same."""
    if not isinstance(image, torch.Tensor) or not isinstance(target, torch.Tensor):
        return f"two tensors, got {type(image).__name__} and {type(target).__name__}; convert them"
    for tensor in (image, target, mask):
        if isinstance(tensor, torch.Tensor) and (tensor.layout, tensor.device) != (torch.strided, image.device):
            found = f"one of {tensor.layout} on {tensor.device} beside an image on {image.device}"
            return f"dense tensors on one device, got {found}; convert it"
    if image.device.type not in DRIVERS:
        return f"tensors on the CPU or an NVIDIA GPU, got one on {image.device}; convert it"
    if not isinstance(lambda_dssim, Real) or not 0.0 <= lambda_dssim <= 1.0:
        return f"lambda_dssim to be a number, 0 to 1, got {lambda_dssim!r}"
    if image.dtype != torch.float32 or target.dtype not in (torch.float32, torch.uint8):
        return f"an image of float32, a target of float32 or uint8, got {image.dtype} and {target.dtype}; convert them"
    if image.shape != target.shape or image.dim() != 3 or image.shape[2] != CHANNELS or not image.numel():
        return f"two images [H, W, 3] of one size, 1 x 1 or more, got {list(image.shape)} and {list(target.shape)}"
    wanted, is_tensor = [*image.shape[:2], 1], isinstance(mask, torch.Tensor)
    if mask is None or (is_tensor and mask.dtype == torch.uint8 and list(mask.shape) == wanted):
        return None
    found = f"{list(mask.shape)} of {mask.dtype}" if is_tensor else type(mask).__name__
    return f"a mask, a tensor {wanted} of uint8, 0 for pixels that do not count, got {found}"


class ImageLoss(torch.autograd.Function):
    """See :func:`image_loss`: on the CPU, one pass over the rows of two images."""

    @staticmethod
    def forward(ctx, image, target, lambda_dssim, limits):
        with stage("loss"):
            height, length = image.shape[0], image.shape[1] * image.shape[2]
            groups, centers = -(-length // LANES), _centers(image, target).tolist()
            if target.is_inference():  # which autograd does not keep
                target = target.clone()
            image, target = (p.detach().reshape(height, length).contiguous().resolve_neg() for p in (image, target))
            bounds, bands = _bands(height)
            padded, ring = _lanes(bands, 2, groups + 2), _lanes(bands, RING, groups, MOMENTS)
            blurred, slopes = _lanes(bands, ROWS, groups, MOMENTS), _lanes(height, SLOPES, groups + 2)
            sums = image.new_empty(height, 2)
            pictures, missing = _pictures(image, limits, target, centers), _missing(groups, length)
            outputs = [padded, ring, blurred, sums, slopes]
            launch(ssim.compare, bands, [bounds, pictures, missing], outputs, bounds=list(range(bands + 1)))
            l1, similarity = sums.numpy().sum(0, dtype="float64") / (height * length)
            ctx.save_for_backward(image, target, slopes)
            ctx.lambda_dssim, ctx.limits, ctx.centers = lambda_dssim, limits, centers
            return image.new_tensor((1.0 - lambda_dssim) * l1 + lambda_dssim * (1.0 - similarity))

    @staticmethod
    @adjoint_of("loss")
    def backward(ctx, adj_loss):
        image, target, slopes = ctx.saved_tensors
        height, groups = len(image), slopes.shape[2] - 2
        bounds, bands = _bands(height)
        ring, blurred = (_lanes(bands, rows, groups, SLOPES) for rows in (RING, ROWS))
        adj, scale = torch.empty_like(image), adj_loss.item() / image.numel()
        weights = [scale * (1.0 - ctx.lambda_dssim), -scale * ctx.lambda_dssim]
        pictures = _pictures(image, ctx.limits, target, ctx.centers)
        inputs, outputs = [bounds, pictures, slopes, *weights], [ring, blurred, adj, _taps(adj)]
        launch(ssim.adj_compare, bands, inputs, outputs, bounds=list(range(bands + 1)))
        return adj.view(height, -1, CHANNELS), None, None, None


class LossInBlocks(torch.autograd.Function):
    """See :func:`image_loss`: on a GPU, two kernels, and nothing that the host waits for."""

    @staticmethod
    def forward(ctx, image, target, lambda_dssim, limits):
        with stage("loss"):
            height, length = image.shape[0], image.shape[1] * image.shape[2]
            image, target = (p.detach().reshape(height, length).contiguous().resolve_neg() for p in (image, target))
            ctx.pictures = (image, target, _centers(image, target), limits)
            ctx.weights = wp.vec3((1.0 - lambda_dssim) / image.numel(), -lambda_dssim / image.numel(), lambda_dssim)
            ctx.blocks = -(-height // int(BAND)) * -(-length // int(STRIP))
            sums, ctx.slopes = image.new_empty(ctx.blocks), image.new_empty(SLOPES, height, length)
            inputs, outputs = [_dense(*ctx.pictures), ctx.weights], [sums, ctx.slopes]
            launch_blocks(compare_block, ctx.blocks, inputs, outputs, image.device)
            return sums.sum()

    @staticmethod
    @adjoint_of("loss")
    def backward(ctx, adj_loss):
        adj = torch.empty_like(ctx.pictures[0])
        inputs = [_dense(*ctx.pictures), ctx.weights, ctx.slopes, adj_loss.reshape(1)]
        launch_blocks(adj_compare_block, ctx.blocks, inputs, [adj], adj.device)
        return adj.view(len(adj), -1, 3), None, None, None


def _lanes(*shape: int) -> torch.Tensor:
    return torch.empty(*shape, LANES, dtype=torch.float32, device="cpu")


def _bands(height: int) -> tuple[torch.Tensor, int]:
    """Bounds of bands of rows, one for each thread [B + 1], and their number.

    Rows that are blurred together are the same in any number of bands: what is not finite has an influence on both.
    """
    bounds = even_slices(height, SMALLEST_SLICE)
    bounds[1:-1] = [bound - bound % ROWS for bound in bounds[1:-1]]
    return torch.tensor(bounds, dtype=torch.int32, device="cpu"), len(bounds) - 1


def _pictures(image: torch.Tensor, limits: wp.vec2, target: torch.Tensor, centers) -> ssim.Pictures:
    """What both kernels read of [H, L]: the target as floats or as bytes, the other is empty."""
    floats, levels = _by_type(target)
    return pack_struct(
        ssim.Pictures, image=image, image_taps=_taps(image), limits=limits, centers=wp.vec2(*centers),
        target=floats, target_taps=_taps(floats), levels=levels, level_taps=_taps(levels, ssim.vec16b),
    )  # fmt: skip


def _dense(image: torch.Tensor, target: torch.Tensor, centers: torch.Tensor, limits: wp.vec2):
    """Likewise for the kernels of a GPU."""
    floats, levels = _by_type(target)
    return pack_struct(PicturesView, image=image, limits=limits, target=floats, levels=levels, centers=centers)


def _by_type(target: torch.Tensor) -> list[torch.Tensor]:
    """The target as floats and as bytes; one of them is empty."""
    types = (torch.float32, torch.uint8)
    return [target if target.dtype == dtype else target.new_empty(0, 0, dtype=dtype) for dtype in types]


def _centers(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """What to subtract from the two images, [2]: any numbers are right, the middles of their ranges keep most digits.

    One number for both unless they lie far apart, so that equal pixels stay equal.
    """
    if target.dtype == torch.uint8:
        return HALVES(device=image.device)
    own, other = _middle(image), _middle(target)
    return torch.stack([torch.where((own - other).abs() > FAR_APART, own, other), other])


def _middle(image: torch.Tensor) -> torch.Tensor:
    low, high = image.aminmax()
    middle = 0.5 * low + 0.5 * high
    return torch.where(middle.isfinite(), middle, 0.5)


@functools.cache
def _missing(groups: int, length: int) -> torch.Tensor:
    """The share of the window beyond the ends of a row, by place in the row, [G, LANES]."""
    columns = length // CHANNELS
    tap = np.arange(columns)[:, None] + np.arange(WINDOW) - RADIUS
    share = (((tap < 0) | (tap >= columns)) * np.array(list(WEIGHTS))).sum(1)  # in one order, unlike a product
    missing = np.pad(np.repeat(share, CHANNELS), (0, groups * LANES - length)).reshape(groups, LANES)
    return torch.from_numpy(missing.astype(np.float32))


def _taps(rows: torch.Tensor, dtype=vec16):
    """[..., P] numbers as [..., P - 15] overlapping groups of sixteen: an unaligned load of any sixteen neighbors."""
    return view(rows.unfold(-1, LANES, 1) if rows.shape[-1] >= LANES else rows.new_empty(0, 0, LANES), dtype)

"""How a camera shows an image: a map of its colors and how its lens darkens it, differentiable in torch."""

import torch
from torch.nn import functional

from warp_splat.kernels.color_map import make_adj_map_colors, make_map_colors, vec12
from warp_splat.raster.drivers import driver_of
from warp_splat.runtime.launch import launch_in_lanes, view
from warp_splat.runtime.sums import in_pairs
from warp_splat.runtime.timers import adjoint_of


def expose(
    image: torch.Tensor, kind: str, numbers: torch.Tensor, falloff: torch.Tensor | None, pivot: float
) -> torch.Tensor:
    """The image through a map, differentiable in all three tensors.

    Args:
        image: [H, W, 3].
        kind: of COLOR_MAPS.
        numbers: of its shape there.
        falloff: a and b of 1 + a r^2 + b r^4, with the distance r to the image's middle as a share of that to its
            corner, [2]; None: 0.
        pivot: the map acts on value + pivot: PIVOT, or 0 in linear light.
    """
    if falloff is not None:
        near, far = _Spread.apply(falloff, image.shape[:2])
        height, width = image.shape[:2]
        y, x = (torch.arange(size, device=image.device) + 0.5 - 0.5 * size for size in (height, width))
        square = ((y * y)[:, None] + x * x) / (0.25 * (height * height + width * width))
        image = (image + pivot) * (1.0 + (near + far * square) * square)[..., None] - pivot
    if kind == "bilateral":
        if numbers.requires_grad:  # no pixel that is not finite may spoil the cells
            numbers.register_hook(lambda grad: grad.nan_to_num(0.0, 0.0, 0.0))
        return _through_grid(image, numbers, pivot)
    return _ColorMap.apply(image, color_matrix(kind, numbers, pivot))


def color_matrix(kind: str, numbers: torch.Tensor, pivot: float) -> torch.Tensor:
    """Columns of a matrix and a constant, [12], of a gain or an affine map."""
    none = torch.zeros_like(numbers[:1])
    n = [numbers if i % 4 == 0 else none for i in range(12)] if kind == "gain" else list(numbers.split(1))
    diagonal = [1.0 + n[i] if i % 4 == 0 else n[i] for i in range(9)]
    return torch.cat(diagonal + [n[9 + k] + pivot * ((n[k] + n[3 + k]) + n[6 + k]) for k in range(3)])


def _through_grid(image: torch.Tensor, numbers: torch.Tensor, pivot: float) -> torch.Tensor:
    """By the affine map that is sliced for each pixel, from its place and its brightness."""
    height, width, _ = image.shape
    r, g, b = (image + pivot).unbind(-1)
    brightness = (r + g + b) * (2.0 / 3.0) - (1.0 + 2.0 * pivot)
    # not by linspace, which rounds differently by processor
    rows, columns = ((torch.arange(n, device=image.device) + 0.5) * (2.0 / n) - 1.0 for n in (height, width))
    places = torch.stack([columns.expand(height, width), rows[:, None].expand(height, width), brightness], -1)
    n = functional.grid_sample(numbers[None], places[None, None], padding_mode="border", align_corners=True)[0, :, 0]
    return image + torch.stack([(n[k] * r + n[3 + k] * g) + (n[6 + k] * b + n[9 + k]) for k in range(3)], -1)


class _ColorMap(torch.autograd.Function):
    """An image [H, W, 3] by an affine map [12]."""

    @staticmethod
    def forward(ctx, image, numbers):
        image = image.detach().contiguous()
        ctx.save_for_backward(image, numbers)
        mapped, lanes = torch.empty_like(image), driver_of(image.device).lanes
        inputs = [view(numbers.detach().view(1, 12), vec12), image.view(-1, 3)]
        launch_in_lanes(make_map_colors, lanes, inputs, [mapped.view(-1, 3)])
        return mapped

    @staticmethod
    @adjoint_of("exposure")
    def backward(ctx, adj):
        image, numbers = ctx.saved_tensors
        adj_image, lanes = torch.empty_like(image), driver_of(image.device).lanes
        inputs = [view(numbers.view(1, 12), vec12), image.view(-1, 3), adj.contiguous().view(-1, 3)]
        sums = launch_in_lanes(make_adj_map_colors, lanes, inputs, [adj_image.view(-1, 3)], sums=12)
        return adj_image, in_pairs(sums).to(numbers.dtype).nan_to_num(0.0, 0.0, 0.0)


class _Spread(torch.autograd.Function):
    """Numbers [K] at every pixel, [K, H, W]. Their gradient is summed in one order, unlike torch's by expand."""

    @staticmethod
    def forward(ctx, numbers, size):
        return numbers.detach()[:, None, None].expand(-1, *size)

    @staticmethod
    @adjoint_of("numbers")
    def backward(ctx, adj):
        return in_pairs(adj.flatten(1).T).to(adj.dtype).nan_to_num(0.0, 0.0, 0.0), None

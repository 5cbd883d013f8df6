"""The dictionary that gsplat's function returns beside the images: what its strategies read."""

from typing import Any

import torch
import warp as wp

from warp_splat.config import TILE
from warp_splat.gsplat.arguments import Request
from warp_splat.gsplat.seen import Seen
from warp_splat.raster.data import Bins


def show(request: Request, seen: Seen) -> tuple[dict[str, torch.Tensor], Seen]:
    """What is seen as the caller gets it, and the same made of that: its gradients are those of the images.

    Per Gaussian [nnz, ...] if packed, else [..., C, N, ...].
    """
    shown, changed = {"radii": _placed(request, seen, seen.radii)}, {}
    for name in ("means2d", "depths", "conics", "opacities"):
        tensor = getattr(seen, name)
        shown[name] = _placed(request, seen, tensor)
        if request.packed:
            changed[name] = torch.zeros_like(tensor).index_put(seen.drawn.nonzero().unbind(1), shown[name])
        else:
            changed[name] = shown[name].view(tensor.shape)
    return shown, seen._replace(**changed)


class _Thinned(torch.autograd.Function):
    """The same; its gradient is a sparse tensor of what any camera sees."""

    @staticmethod
    def forward(ctx, tensor, drawn):
        ctx.drawn = drawn
        return tensor.clone()

    @staticmethod
    def backward(ctx, adj):
        seen = ctx.drawn[0].any(1).view(adj.shape[:-1])
        return torch.sparse_coo_tensor(
            seen.nonzero().T, adj[seen], adj.shape, is_coalesced=True, check_invariants=True
        ), None


def thin(tensor: torch.Tensor, drawn: list[torch.Tensor]) -> torch.Tensor:
    """``tensor`` with sparse gradients; ``drawn`` gets the mask [S, C, N] of those that are seen before they come."""
    return _Thinned.apply(tensor, drawn)


def tell(request: Request, seen: Seen, lists: list[Bins]) -> dict[str, Any]:
    """What else gsplat tells, by its names."""
    scenes, cameras, count = seen.drawn.shape
    tiles_x, tiles_y = -(-request.width // TILE), -(-request.height // TILE)
    shape = (*request.batch, cameras)
    ids: dict[str, Any] = {"batch_ids": None, "camera_ids": None, "gaussian_ids": None}
    numbers = torch.arange(scenes * cameras * count, device=seen.drawn.device)
    if request.packed:
        ids = dict(zip(ids, seen.drawn.nonzero().unbind(1), strict=True))
        numbers = seen.drawn.flatten().cumsum(0) - 1  # of those that are packed
    listed, depths, sizes, begins = [], [], [], 0
    per_gaussian = torch.zeros(scenes * cameras, count, dtype=torch.int32, device=numbers.device)
    offsets = torch.empty(scenes * cameras, tiles_x * tiles_y, dtype=torch.int32, device=numbers.device)
    for view, bins in enumerate(lists):
        gaussians = wp.to_torch(bins.gaussians).long()[bins.instances.long()]
        listed.append(numbers[gaussians + view * count])
        depths.append(seen.depths.detach().flatten(0, 1)[view, gaussians])
        sizes.append(bins.ranges[:, 1] - bins.ranges[:, 0])
        per_gaussian[view] = torch.bincount(gaussians, minlength=count).int()
        offsets[view] = bins.ranges[:, 0] + begins
        begins += len(gaussians)
    keys = torch.arange(scenes * cameras * tiles_x * tiles_y, device=numbers.device)
    bits = max((tiles_x * tiles_y - 1).bit_length(), 1)
    keys = ((keys // (tiles_x * tiles_y)) << bits | keys % (tiles_x * tiles_y)).repeat_interleave(torch.cat(sizes))
    return {
        **ids,
        "tile_width": tiles_x,
        "tile_height": tiles_y,
        "tiles_per_gauss": _placed(request, seen, per_gaussian.view(scenes, cameras, count)),
        "isect_ids": (keys << 32) | torch.cat(depths).view(torch.int32).long(),
        "flatten_ids": torch.cat(listed).int(),
        "isect_offsets": offsets.view(*shape, tiles_y, tiles_x),
        "width": request.width,
        "height": request.height,
        "tile_size": TILE,
        "n_batches": scenes,
        "n_cameras": cameras,
    }


def _placed(request: Request, seen: Seen, tensor: torch.Tensor) -> torch.Tensor:
    """Those that are seen, or all in the dimensions of the call."""
    return tensor[seen.drawn] if request.packed else tensor.view(*request.batch, *tensor.shape[1:])

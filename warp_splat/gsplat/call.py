"""``rasterization`` as gsplat 1.5.3 has it: its parameters in its order, its three results, one a dictionary."""

from typing import Any

import torch
import warp as wp

from warp_splat.config import TILE
from warp_splat.gsplat.arguments import Request, check_request
from warp_splat.gsplat.pixels import draw
from warp_splat.gsplat.seen import Seen, colors_of, see
from warp_splat.raster.data import Bins


def rasterization(
    means: torch.Tensor,
    quats: torch.Tensor | None,
    scales: torch.Tensor | None,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: torch.Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: torch.Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: torch.Tensor | None = None,
    tangential_coeffs: torch.Tensor | None = None,
    thin_prism_coeffs: torch.Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Images of N Gaussians through C cameras, for each of any number of scenes (the dimensions "...").

    Differentiable in every tensor, ``viewmats`` and ``Ks`` included. The projection is computed by torch, which gives
    each of their entries its gradient; lists and pixels by this package's kernels. Alpha is clamped to 0.999.

    Args:
        means: [..., N, 3] float32, world units, like all tensors on one device.
        quats: [..., N, 4], w first, any norm but zero.
        scales: [..., N, 3]; their signs do not matter.
        opacities: [..., N], 0 to 1.
        colors: [..., (C,) N, D], D from 1 to 512; or with ``sh_degree`` coefficients [..., (C,) N, K, 3].
        viewmats: world to camera, [..., C, 4, 4].
        Ks: intrinsics [px], [..., C, 3, 3]; without skew.
        width: of the images [px].
        height: of the images [px].
        near_plane: Gaussians whose center is nearer are left out [world units].
        far_plane: or farther.
        radius_clip: Gaussians whose radius on the image is at most this are left out [px].
        eps2d: added to both variances on the image [px^2].
        sh_degree: of the harmonics that are used, 0 to 4; None: ``colors`` are colors.
        packed: what meta holds per Gaussian are only those that are seen, [nnz, ...]; else all, [..., C, N, ...].
        tile_size: of no effect: tiles have 16 pixels, as meta says.
        backgrounds: [..., C, D]; of no effect on a depth.
        render_mode: "RGB", "D" (sum of weight times z), "ED" (mean z), "RGB+D" or "RGB+ED".
        sparse_grad: the gradients of means, quats and scales are sparse tensors; only where ``packed``.
        absgrad: ``backward`` writes the sums of the magnitudes of the pixels' gradients to ``meta["means2d"].absgrad``
            (Ye et al. 2024); at most 30 channels of color then, 14 on a GPU.
        rasterize_mode: "classic" or "antialiased".
        channel_chunk: of no effect: how many channels go at once is the kernels' choice.
        distributed: must be False.
        camera_model: "pinhole", "ortho" or "fisheye" (equidistant, if it has no coefficients).
        segmented: of no effect: it chooses how gsplat sorts.
        covars: covariances [..., N, 3, 3], whose upper triangles are read, instead of ``quats`` and ``scales``, which
            may be None then; not with ``with_ut``.
        with_ut: project by an unscented transform (Wu et al. 2025), which sees through lenses; not with "ortho".
        with_eval3d: must be False.
        radial_coeffs: OpenCV's k1 to k6, [..., C, 6], of a fisheye k1 to k4, [..., C, 4]; only with ``with_ut``, like
            those that follow.
        tangential_coeffs: OpenCV's p1 and p2, [..., C, 2]; of a pinhole camera.
        thin_prism_coeffs: OpenCV's s1 to s4, [..., C, 4]; of a pinhole camera.
        ftheta_coeffs: must be None.
        rolling_shutter: one of gsplat's ``RollingShutterType``; None: all rows at once. Only with ``with_ut``.
        viewmats_rs: where the camera is at the end, [..., C, 4, 4]; ``viewmats`` are then those of the start.

    Returns:
        Images [..., C, H, W, D, and 1 more with a depth], alphas [..., C, H, W, 1], and a dictionary as gsplat's.

    Raises:
        InputError: if an argument is not as stated; the message names it.
    """
    given = dict(locals())
    drawn: list[torch.Tensor] = []
    if sparse_grad and packed:
        shapes = {"means": 1, "quats": 1, "scales": 1, "covars": 2}  # dimensions of what each Gaussian has
        tensors = {name: given[name] for name in shapes if isinstance(given[name], torch.Tensor)}
        given |= {name: _Thinned.apply(tensor, drawn, shapes[name]) for name, tensor in tensors.items()}
    request = check_request(Request(**given))
    seen = see(request)
    drawn.append(seen.drawn)
    shown, seen = _show(request, seen)
    magnitudes = None
    if absgrad:
        magnitudes = torch.zeros_like(shown["means2d"].detach())
        setattr(shown["means2d"], "absgrad", magnitudes)  # noqa: B010 - which a tensor does not have
    images, alphas, bins = draw(request, seen, colors_of(request, seen), magnitudes)
    return images, alphas, shown | _tell(request, seen, bins)


def _show(request: Request, seen: Seen) -> tuple[dict[str, torch.Tensor], Seen]:
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
    """The same; its gradient is a sparse tensor of what any camera sees.

    ``drawn`` gets the mask [S, C, N] of that before gradients come; ``own``: the last dimensions, of each Gaussian.
    """

    @staticmethod
    def forward(ctx, tensor, drawn, own):
        ctx.drawn, ctx.own = drawn, own
        return tensor.clone()

    @staticmethod
    def backward(ctx, adj):
        seen = ctx.drawn[0].any(1).view(adj.shape[: -ctx.own])
        places, values = seen.nonzero().T, adj[seen]
        return torch.sparse_coo_tensor(places, values, adj.shape, is_coalesced=True, check_invariants=True), None, None


def _tell(request: Request, seen: Seen, lists: list[Bins]) -> dict[str, Any]:
    """What else gsplat tells, by its names."""
    scenes, cameras, count = seen.drawn.shape
    tiles_x, tiles_y = -(-request.width // TILE), -(-request.height // TILE)
    ids: dict[str, Any] = {"batch_ids": None, "camera_ids": None, "gaussian_ids": None}
    numbers = torch.arange(scenes * cameras * count, device=seen.drawn.device)
    if request.packed:
        ids = dict(zip(ids, seen.drawn.nonzero().unbind(1), strict=True))
        numbers = seen.drawn.flatten().cumsum(0) - 1  # of those that are packed
    listed = [wp.to_torch(bins.gaussians)[bins.instances.long()].long() for bins in lists]
    gaussians = torch.cat([places + view * count for view, places in enumerate(listed)])  # of all views
    sizes = torch.cat([bins.ranges[:, 1] - bins.ranges[:, 0] for bins in lists])
    per_gaussian = torch.bincount(gaussians, minlength=len(numbers)).int()
    keys = torch.arange(scenes * cameras * tiles_x * tiles_y, device=numbers.device)
    bits = (tiles_x * tiles_y).bit_length()  # as gsplat reads them
    keys = ((keys // (tiles_x * tiles_y)) << bits | keys % (tiles_x * tiles_y)).repeat_interleave(sizes)
    return {
        **ids,
        "tile_width": tiles_x,
        "tile_height": tiles_y,
        "tiles_per_gauss": _placed(request, seen, per_gaussian.view(seen.drawn.shape)),
        "isect_ids": (keys << 32) | seen.depths.detach().flatten()[gaussians].view(torch.int32).long(),
        "flatten_ids": numbers[gaussians].int(),
        "isect_offsets": (sizes.cumsum(0) - sizes).int().view(*request.batch, cameras, tiles_y, tiles_x),
        "width": request.width,
        "height": request.height,
        "tile_size": TILE,
        "n_batches": scenes,
        "n_cameras": cameras,
    }


def _placed(request: Request, seen: Seen, tensor: torch.Tensor) -> torch.Tensor:
    """Those that are seen, or all in the dimensions of the call."""
    return tensor[seen.drawn] if request.packed else tensor.view(*request.batch, *tensor.shape[1:])

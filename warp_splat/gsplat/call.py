"""``rasterization`` as gsplat 1.5.3 has it: its parameters in its order, its three results."""

from typing import Any

import torch

from warp_splat.gsplat.arguments import Request, check_request
from warp_splat.gsplat.harmonics_torch import colors_of
from warp_splat.gsplat.meta import show, tell, thin
from warp_splat.gsplat.pixels import draw
from warp_splat.gsplat.seen import see


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
        shapes = ("means", "quats", "scales", "covars")
        given |= {name: thin(given[name], drawn) for name in shapes if given[name] is not None}
    request = check_request(Request(**{name: given[name] for name in Request._fields[:-1]}), given)
    seen = see(request)
    drawn.append(seen.drawn)
    shown, seen = show(request, seen)
    magnitudes = None
    if absgrad:
        magnitudes = torch.zeros_like(shown["means2d"].detach())
        setattr(shown["means2d"], "absgrad", magnitudes)  # noqa: B010 - which a tensor does not have
    images, alphas, bins = draw(request, seen, colors_of(request, seen), magnitudes)
    return images, alphas, shown | tell(request, seen, bins)

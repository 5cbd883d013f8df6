"""From 3D Gaussians to an image, differentiable in torch: project, bin, blend.

The first and the last are autograd functions. So what lies between them are torch tensors with gradients of their own:
above all the 2D means, whose gradient steers densification.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.raster import checks
from warp_splat.raster.behind import put_behind
from warp_splat.raster.beside import blend_beside
from warp_splat.raster.blend import Blending, blend
from warp_splat.raster.camera_parameters import CameraParameters
from warp_splat.raster.certificate import certify, drawing, far_reaching, looking
from warp_splat.raster.data import Dropped, Gaussians, Room, Splats2D
from warp_splat.raster.drivers import driver_of
from warp_splat.raster.project import project
from warp_splat.raster.seam import around, find_crossing
from warp_splat.raster.tolerance import Painted, only, paint_within
from warp_splat.runtime.timers import stage


@dataclass
class RenderOutput:
    """What :func:`rasterize` returns; H x W pixels, N Gaussians."""

    image: torch.Tensor  # [H, W, 3]
    alpha: torch.Tensor  # [H, W], 1 - transmittance
    depth: torch.Tensor | None  # [H, W] world units, expected depth (0 where alpha is 0; off by 1e-7 / alpha), or None
    means2d: torch.Tensor  # [N, 2] px; 0 if culled
    radii: torch.Tensor  # [N] int32, px from the mean to the farthest point where alpha >= alpha_min; 0 if culled
    conics: torch.Tensor  # [N, 3] 1/px^2, (xx, xy, yy) of the inverse 2D covariance; 0 if culled, as all that follow
    colors: torch.Tensor  # [N, 3]
    depths: torch.Tensor  # [N] world units, z in the camera; through a wide lens, the distance
    opacities2d: torch.Tensor  # [N] after antialiasing
    invalid_count: int | torch.Tensor  # see `invalid`; on a GPU, reading it waits for the image
    gaussians: Gaussians  # that were rendered
    dropped: Dropped = field(default_factory=Dropped)
    features: torch.Tensor | None = None  # [H, W, C] sum of weight times feature, if given
    normals: torch.Tensor | None = None  # [H, W, 3] sum of weight times normal, in the world, if asked for
    planes: torch.Tensor | None = None  # [H, W, 1] likewise: minus the plane's distance from the camera
    median_depth: torch.Tensor | None = None  # [H, W] world units, where half of the light is gone; 0 where it is not
    strongest: torch.Tensor | None = None  # [H, W, k] int64, Gaussians of the largest weights; -1 where there is none
    strongest_weights: torch.Tensor | None = None  # [H, W, k] share of them in the pixel
    bound: torch.Tensor | None = None  # [H, W] how far the image may be from the ideal in any channel; no gradient
    rounding: torch.Tensor | None = None  # [H, W] the part of the bound that is rounding

    @property
    def invalid(self) -> int:
        """Gaussians left out because an input was not finite or a quaternion was zero."""
        return int(self.invalid_count)


def rasterize(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    sh: torch.Tensor | tuple[torch.Tensor, torch.Tensor],
    camera: Camera | CameraParameters,
    background: torch.Tensor | tuple[float, float, float] = (0.0, 0.0, 0.0),
    adjoint: str = "manual",
    options: RasterOptions | None = None,
    features: torch.Tensor | None = None,
) -> RenderOutput:
    """Render Gaussians through a camera (Kerbl et al. 2023), differentiable in every tensor given.

    Args:
        means: centers, [N, 3] float32, world units.
        quats: rotations (w, x, y, z), [N, 4], any norm; a Gaussian whose quaternion is zero is left out.
        scales: standard deviations along the axes, [N, 3], positive, world units.
        opacities: [N], in 0..1.
        sh: spherical-harmonics coefficients, [N, K, 3] with K = 1, 4, 9 or 16; or the pair ([N, 1, 3], [N, K-1, 3])
            as trainers keep them, which saves a copy. Color = max(0, 0.5 + sum of coefficients times basis).
        camera: world to camera in COLMAP's axes, with or without a lens or a rolling shutter;
            :class:`CameraParameters`, if it wants gradients.
        background: RGB behind everything; a tensor [3] receives a gradient.
        adjoint: how the pixel loop is differentiated; one image, one gradient up to rounding. "manual": by hand.
            "stepwise": reverse loop by hand, its body by Warp. "reversible": the whole loop by Warp, transmittance
            recovered by division, as in the two before. "stored": likewise, every transmittance kept in memory.
        options: what to compute; see :class:`RasterOptions`.
        features: any numbers, [N, C] with C from 1 to 512, blended as color is, on black. Their adjoint is by hand
            where ``adjoint`` is "manual"; in the other modes Warp derives a step of it, as in "stepwise".

    Returns:
        A :class:`RenderOutput`. ``image``, ``alpha``, ``depth``, ``features``, ``normals``, ``median_depth`` (in
        ``depths`` only), ``strongest_weights`` and all that lies on the way to them (``means2d``,
        ``conics``, ``colors``, ``depths``, ``opacities2d``) carry gradients. A pixel whose
        upstream gradient is not finite is dropped, as is a Gaussian's gradient that is not finite; both are counted
        in ``dropped``.

    Raises:
        InputError: if a shape, dtype, device or value is not as stated (the message names the argument), or if the
            memory does not suffice.
    """
    return rasterize_views(means, quats, scales, opacities, sh, [camera], background, adjoint, options, features)[0]


def rasterize_views(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    sh: torch.Tensor | tuple[torch.Tensor, torch.Tensor],
    cameras: Sequence[Camera | CameraParameters],
    background: torch.Tensor | tuple[float, float, float] = (0.0, 0.0, 0.0),
    adjoint: str = "manual",
    options: RasterOptions | None = None,
    features: torch.Tensor | None = None,
) -> list[RenderOutput]:
    """:func:`rasterize` through each of ``cameras``, which may differ in size; the Gaussians are checked but once.

    Outputs and gradients are those of separate calls, bit for bit. Without gradients an output keeps 56 bytes per
    Gaussian besides its image, and all share one copy of harmonics that come as one tensor; with gradients it keeps
    what its adjoint reads, until that has run.

    Args:
        means: as in :func:`rasterize`, like all but ``cameras``.
        quats: [N, 4].
        scales: [N, 3].
        opacities: [N].
        sh: [N, K, 3], or the pair.
        cameras: any number.
        background: RGB, the same in all images.
        adjoint: how the pixel loop is differentiated.
        options: what to compute.
        features: [N, C].

    Returns:
        A :class:`RenderOutput` for each camera, in their order.

    Raises:
        InputError: as :func:`rasterize` does.
    """
    bases = checks.bases_of(cameras)
    options = checks.check_options(adjoint, options)
    gaussians = checks.check_gaussians(means, quats, scales, opacities, sh)
    background = checks.check_background(background, means.device)
    checks.check_tolerance(options, features)
    if features is not None:
        checks.check_features(features, means)
    outputs = []
    for base in bases:
        checks.check_hidden_from(options, base, means.device)
    with checks.explained(options, means, bases):
        for camera in cameras:
            outputs.append(render(gaussians, camera, background, options, adjoint, features))
            outputs[-1].invalid_count = outputs[-1].invalid  # a GPU is waited for once
            checks.explain_invalid(outputs[-1].invalid, gaussians.quats)
    return outputs


def render(
    gaussians: Gaussians,
    camera: Camera | CameraParameters,
    background: torch.Tensor,
    options: RasterOptions,
    adjoint: str = "manual",
    features: torch.Tensor | None = None,
    room: Room | None = None,
    splats: Splats2D | None = None,
) -> RenderOutput:
    """:func:`rasterize` without its checks: Gaussians that are not finite are left out and counted.

    The background may be harmonics [16, 3], too: see :func:`put_behind`. With ``room`` for tile instances, a GPU need
    not stop for their number; if there is too little, the view is rendered again. ``splats``: what others projected.
    """
    dropped, driver = Dropped(), driver_of(gaussians.means.device)
    with stage("project"):
        found = splats or project(gaussians, camera, far_reaching(options), dropped=dropped)
    seen = camera.base if isinstance(camera, CameraParameters) else camera  # from here on, its size alone counts
    crossing = find_crossing(found, seen)
    copied = around(found, seen, crossing)
    color = background if background.dim() == 1 else background.new_zeros(3)

    def paint(chosen: RasterOptions, tiles: torch.Tensor | None = None) -> Painted:
        with stage("bin"):
            drawn, certificate = copied, None
            if chosen.bound:
                drawn, certificate = certify(copied, gaussians, crossing, seen, background, chosen)
            # 'stored' keeps 1 KiB of each instance: too much for some that there are not
            bins = driver.bin(drawn, seen, looking(chosen), None if adjoint == "stored" else room)
            bins = bins if tiles is None else only(bins, tiles)
            if certificate:
                bins.bound = certificate.view(bins)
        with stage("blend"):
            blending = Blending(bins, seen, drawing(chosen), driver, adjoint, dropped)
            return Painted(blend(drawn, color, blending), drawn, blending, certificate)

    painted = paint(options) if options.tolerance is None else paint_within(paint, options, seen)
    (image, alpha, depth), drawn, blending, certificate = painted
    if background.dim() == 2:
        image = put_behind(image, alpha, background, camera)
    more = {}
    if features is not None or options.normals or options.median_depth or options.strongest:
        with stage("channels"):
            more = blend_beside(features, gaussians, drawn, camera, blending, crossing)
    if room and room.overflowed():
        return render(gaussians, camera, background, options, adjoint, features, room, splats)
    if certificate:
        more |= {"bound": certificate.bound, "rounding": certificate.rounding}
        found = found._replace(radii=drawn.radii[: len(found.radii)])
    invalid = blending.bins.invalid
    all_valid = isinstance(invalid, int) and not invalid  # a GPU would have to stop for the answer
    return RenderOutput(
        image=image,
        alpha=alpha,
        depth=torch.where(alpha > 0, depth / alpha.clamp_min(1e-10), 0.0) if options.depth else None,
        means2d=found.means2d,
        radii=found.radii if all_valid else found.radii.clamp_min(0),
        conics=found.conics,
        colors=found.colors,
        depths=found.depths,
        opacities2d=found.opacities,
        invalid_count=invalid,
        gaussians=gaussians,
        dropped=dropped,
        **more,
    )

"""Truth for the renderer: float64 torch, every Gaussian at every pixel, gradients by torch.autograd.

Written from the papers (Kerbl et al. 2023; Zwicker et al. 2001 for the projection), without a look at the kernels. It
has no tiles, no early exit (only its effect) and no inverse. It shares nothing with the package but ``Camera``. It
knows pinholes that stand still; benchmarks/exact_cameras.py teaches it lenses and cameras that move.

A renderer in float32 may decide otherwise where a quantity lies within rounding of a threshold. ``Render.fragile``
marks the pixels where that could be seen, so that a test can leave them out, and count them.
"""

from typing import NamedTuple

import torch

BLACK = (0.0, 0.0, 0.0)
NEAR = 0.2  # Gaussians nearer than this are culled
BLUR = 0.3  # low-pass filter, px^2
ALPHA_MAX = 0.99
ALPHA_MIN = 1 / 255
STOP = 1e-4  # a Gaussian that would take the transmittance below is not blended, nor is any behind it
OUTLINE = 2.0  # standard deviations of the ellipsoid whose outline is taken
OUTLINE_REACH = 3.0  # of the one that must not reach the plane of the camera
SIDE = 0.3  # the Jacobian sees x/z at most this share of the half width beyond the image

ROUNDING = 2.0**-24  # float32, half a unit in the last place
UNSEEN = 1e-5  # a blending weight (and its gradient) too small to tell, a tenth of the error allowed
BAND = 1e-3  # a Gaussian whose largest alpha is this close (relative) to 1/255 may be culled or not


class Splats(NamedTuple):
    """Projected Gaussians, [N] each; ``live`` is False where the rest means nothing."""

    means2d: torch.Tensor  # [N, 2] px
    z: torch.Tensor  # depth in the camera, of a wide lens the distance
    cov2d: torch.Tensor  # [N, 2, 2] px^2, low-pass filter included
    opacity: torch.Tensor  # [N] times the antialiasing factor
    color: torch.Tensor  # [N, 3]
    live: torch.Tensor  # [N] bool


class Render(NamedTuple):
    """What the renderer should return, and how sure we are."""

    image: torch.Tensor  # [H, W, 3]
    alpha: torch.Tensor  # [H, W]
    depth: torch.Tensor  # [H, W] expected z, 0 where alpha is 0
    means2d: torch.Tensor  # [N, 2] on the way to the image: retain_grad() works
    fragile: torch.Tensor  # [H, W] bool, float32 may see another decision here
    touches: torch.Tensor  # [N] bool, reaches a pixel beyond doubt
    order: torch.Tensor  # [M] Gaussians that a pixel sees, nearest first
    weights: torch.Tensor  # [H, W, M] their shares in the pixels
    splats: Splats  # [N], or of a panorama [3 N]: those that leave it come in at the other side


def rotation_matrices(quats):
    """Rotations [N, 3, 3] of quaternions wxyz of any norm but zero (those give the identity)."""
    norm = quats.norm(dim=1, keepdim=True)
    w, x, y, z = torch.where(norm > 0, quats / norm.clamp_min(1e-300), quats.new_tensor([1.0, 0, 0, 0])).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


def covariances(quats, scales):
    """Sigma = R S S^T R^T in the world, [N, 3, 3] (Kerbl et al. 2023, eq. 6)."""
    rotation = rotation_matrices(quats)
    return rotation @ torch.diag_embed(scales**2) @ rotation.transpose(1, 2)


def sh_basis(directions, degree):
    """Real spherical harmonics at unit ``directions`` [N, 3], [N, (degree + 1)^2], signs as in the reference's code."""
    x, y, z = directions.unbind(1)
    xx, yy, zz = x * x, y * y, z * z
    terms = [
        0.28209479177387814 * torch.ones_like(x),
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    return torch.stack(terms[: (degree + 1) ** 2], 1)


def jacobians(points, camera):
    """d(pixel) / d(camera point) at ``points`` [N, 3], [N, 2, 3]; x/z and y/z limited to a frame around the image.

    The frame stands still: no gradient of the camera flows through it.
    """
    z = points[:, 2]
    entries = []
    sides = (camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height)
    for axis, (focal, center, size) in enumerate(sides):
        held = _double(focal).item()
        margin, middle = SIDE * size / (2 * held), _double(center).item() / held
        slope = (points[:, axis] / z).clamp(-middle - margin, size / held - middle + margin)
        row = [torch.zeros_like(z), torch.zeros_like(z), -focal * slope / z]
        row[axis] = focal / z
        entries.append(torch.stack(row, 1))
    return torch.stack(entries, 1)


def outlines(points, sigma, live, camera):
    """Centers [N, 2] and covariances [N, 2, 2] of the ellipses that ellipsoids show, by the dual conic.

    The dual quadric of an ellipsoid projects linearly: its outline's dual conic is K (Sigma - p p^T) K^T (Hartley and
    Zisserman 2004, 8.3), and that of an ellipse with center c and covariance S is
    a multiple of [S - c c^T, -c; -c^T, -1].
    """
    rows = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    calibration = torch.stack([torch.stack([_double(entry) for entry in row]) for row in rows])
    dual = OUTLINE**2 * sigma - points[:, :, None] * points[:, None, :]
    dual = torch.where(live[:, None, None], dual, -torch.eye(3, dtype=dual.dtype))
    dual = calibration @ dual @ calibration.T
    dual = dual / -dual[:, 2:, 2:]
    center = -dual[:, :2, 2]
    return center.clone(), (dual[:, :2, :2] + center[:, :, None] * center[:, None, :]) / OUTLINE**2


def _double(value):
    """As a float64 tensor; what is one keeps its gradient."""
    return value.double() if isinstance(value, torch.Tensor) else torch.tensor(value, dtype=torch.float64)


class Pinhole:
    """How a pinhole that stands still sees Gaussians."""

    def place(self, points, turned, camera, near):
        """Of points [N, 3]: as the camera sees them, how the world is turned then, their depth, which are in view."""
        return points, turned, points[:, 2], True

    def shape(self, points, turned, quats, scales, live, camera, projection, near):
        """Of Gaussians at points [N, 3] in the camera: means [N, 2], covariances [N, 2, 2] px^2, which are drawn."""
        sigma, (x, y, z) = turned @ covariances(quats, scales) @ turned.mT, points.unbind(1)
        if projection == "ellipsoid":
            live = live & (z**2 > OUTLINE_REACH**2 * sigma[:, 2, 2])
            return *outlines(points, sigma, live, camera), live
        means2d = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], 1)
        to_pixels = jacobians(points, camera)
        return means2d, to_pixels @ sigma @ to_pixels.transpose(1, 2), live

    def repeat(self, splats, camera):
        """What shows more than once, as often as it shows."""
        return splats


PINHOLE = Pinhole()


def exact_splats(
    means, quats, scales, opacities, sh, camera, sh_degree=None, antialiasing=False, projection="affine",
    near=NEAR, blur=BLUR, eye=PINHOLE,
):  # fmt: skip
    """Gaussians as the camera sees them. Its numbers may be tensors that want gradients."""
    world_to_camera, translation = _double(camera.rotation), _double(camera.translation)
    points = means @ world_to_camera.T + translation
    points, turned, depth, live = eye.place(points, world_to_camera, camera, near)
    live = live & (depth > near) & (quats.norm(dim=1) > 0)
    points = torch.where(live[:, None], points, points.new_tensor([0.3, 0, 1]))  # no division by zero, no gradient
    means2d, sharp, live = eye.shape(points, turned, quats, scales, live, camera, projection, near)
    cov2d = sharp + blur * torch.eye(2, dtype=torch.float64)
    if antialiasing:
        ratio = torch.linalg.det(sharp) / torch.linalg.det(cov2d)
        opacities = opacities * ratio.clamp_min(2.5e-5).sqrt()  # the floor is the reference's

    center = -world_to_camera.T @ translation
    degree = int(sh.shape[1] ** 0.5) - 1
    degree = degree if sh_degree is None else min(degree, sh_degree)
    basis = sh_basis(torch.nn.functional.normalize(means - center, dim=1), degree)
    color = ((basis[:, :, None] * sh[:, : basis.shape[1]]).sum(1) + 0.5).clamp_min(0)
    return Splats(means2d, depth, cov2d, opacities, color, live)


def _alphas(splats, order, camera, pixels):
    """Alpha of each pixel and splat before any decision, [P, M], and a bound on its relative error in float32."""
    cov = splats.cov2d[order]
    det = cov[:, 0, 0] * cov[:, 1, 1] - cov[:, 0, 1] ** 2
    xx, xy, yy = cov[:, 1, 1] / det, -cov[:, 0, 1] / det, cov[:, 0, 0] / det  # the inverse's diagonal is swapped
    dx = splats.means2d[order, 0] - (pixels[:, 1:] + 0.5)
    dy = splats.means2d[order, 1] - (pixels[:, :1] + 0.5)
    alpha = splats.opacity[order] * torch.exp(-0.5 * (xx * dx**2 + yy * dy**2) - xy * dx * dy)
    with torch.no_grad():
        terms = 0.5 * (xx * dx**2 + yy * dy**2) + (xy * dx * dy).abs()  # what rounds when the exponent is summed
        slope = (xx * dx + xy * dy).abs() + (xy * dx + yy * dy).abs()  # and when the mean is a rounded number
        size = splats.means2d[order].abs().amax(1) + max(camera.width, camera.height)
        error = 2e-5 + 8 * ROUNDING * (terms + slope * size)
    return alpha, error


def _decide(alpha, error, alpha_min, alpha_max, t_min):
    """Which pairs are blended [P, M], and which pixels hang on rounding [P]. No gradient flows through a decision."""
    solid = torch.where(alpha >= alpha_min, alpha.clamp_max(alpha_max), torch.zeros_like(alpha))
    after = torch.cumprod(1 - solid, 1)  # transmittance if nothing stopped it: it can only fall
    before = after / (1 - solid)
    blended = (solid > 0) & (after >= t_min)

    drift = torch.cumsum(error * solid / (1 - solid), 1) + 1e-5  # relative error of the transmittance
    reached = before >= t_min * (1 - drift)
    at_threshold = (alpha / alpha_min).log().abs().minimum((alpha / alpha_max).log().abs()) < error
    at_stop = (solid > 0) & ((after / t_min).log().abs() < drift)
    seen = before * alpha.clamp_max(alpha_max) > UNSEEN
    return blended, ((at_threshold | at_stop) & reached & seen).any(1)


def _swappable(alpha, blended, depth, alpha_max):
    """Pixels that blend two neighbors whose depths differ by less than float32 knows: a renderer may swap them, [P]."""
    gap = (depth[1:] - depth[:-1]).abs()
    close = (gap > 0) & (gap < 8 * ROUNDING * depth[1:].abs())  # equal ones are ordered by index, everywhere
    both = blended[:, 1:] & blended[:, :-1] & close
    before = torch.cumprod(1 - torch.where(blended, alpha.clamp_max(alpha_max), 0), 1)[:, 1:]
    return (both & (before * alpha[:, :-1] * alpha[:, 1:] > UNSEEN)).any(1)


def exact_render(
    means, quats, scales, opacities, sh, camera, background=BLACK, alpha_min=ALPHA_MIN, alpha_max=ALPHA_MAX, t_min=STOP,
    pixels=None, eye=PINHOLE, **view,
):  # fmt: skip
    """The image of N Gaussians (float64, activated values), differentiable in all inputs and the background.

    Keywords are those of :class:`warp_splat.RasterOptions`; thresholds of 0 blend everything. With ``pixels`` [P, 2]
    (row, column) only those are computed, and what is [H, W] otherwise is [P].
    """
    shape = (camera.height, camera.width) if pixels is None else (len(pixels),)
    if pixels is None:
        pixels = torch.cartesian_prod(torch.arange(camera.height), torch.arange(camera.width))
    once = exact_splats(means, quats, scales, opacities, sh, camera, eye=eye, **view)
    splats = eye.repeat(once, camera)
    copies = 1 if splats is once else 3
    key = splats.z.detach().float()  # the renderer's order: float32 depth, ties by index
    order = torch.sort(key, stable=True).indices
    order = order[splats.live[order]]
    with torch.no_grad():
        raw, error = _alphas(splats, order, camera, pixels)
        blended, fragile = _decide(raw, error, alpha_min, alpha_max, t_min)
        fragile |= _swappable(raw, blended, splats.z.detach()[order], alpha_max)
        touches = torch.zeros_like(splats.live)
        touches[order] = (raw >= alpha_min * (1 + BAND)).any(0)
        seen = blended.any(0)  # the others have no gradient, and need no memory for it
    order, blended = order[seen], blended[:, seen]
    raw, _ = _alphas(splats, order, camera, pixels)
    alpha = torch.where(blended, raw.clamp_max(alpha_max), torch.zeros_like(raw))
    through = torch.cat([torch.ones_like(raw[:, :1].sum(1, keepdim=True)), torch.cumprod(1 - alpha, 1)], 1)
    weight = alpha * through[:, :-1]
    background = torch.as_tensor(background, dtype=torch.float64)
    image = weight @ splats.color[order] + through[:, -1:] * background
    total = weight.sum(1)
    depth = torch.where(total > 0, weight @ splats.z[order] / torch.where(total > 0, total, 1), 0)
    return Render(
        image=image.reshape(*shape, 3),
        alpha=(1 - through[:, -1]).reshape(shape),
        depth=depth.reshape(shape),
        means2d=once.means2d,
        fragile=fragile.reshape(shape),
        touches=touches.reshape(copies, len(means)).any(0),
        order=order,
        weights=weight.reshape(*shape, len(order)),
        splats=splats,
    )

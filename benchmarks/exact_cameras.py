"""Truth for lenses and for cameras that move: float64 torch, derivatives by torch.autograd.

With it, :mod:`warp_splat.compare.oracle` renders through any camera: :func:`exact_render`, :func:`exact_splats` here.

Lenses are those of the papers. A camera that moves learns its pose and numbers, or has a rolling shutter. The whole
truth of that is a picture of which each row is rendered by a camera that stands still (``Camera.at``). This is what
splatting makes of it: a Gaussian at its own time, its surroundings linear.
"""

import math
from functools import partial
from types import SimpleNamespace

import torch

from warp_splat.camera import Camera
from warp_splat.compare import oracle

FIELD = 1.3  # of the angle of view: beyond, a lens that is not wide is continued as straight as it is there
AROUND = "EQUIRECTANGULAR"
WIDE = ("OPENCV_FISHEYE", AROUND)
WIDEST = 0.4  # of a panorama's width: no standard deviation is larger
NEAR = 0.2  # points of a Gaussian are seen as if no nearer


def bend(rays, lens):
    """Where points [..., 3] in the camera are seen, in focal lengths from the principal point, [..., 2]."""
    x, y, z = rays.unbind(-1)
    if lens is None:
        return torch.stack([x / z, y / z], -1)
    if lens.model == AROUND:
        return torch.stack([torch.atan2(x, z), torch.atan2(y, (x * x + z * z).sqrt())], -1)
    if lens.model == "OPENCV_FISHEYE":
        radius = (x * x + y * y).sqrt()
        theta = torch.atan2(radius, z)
        length = theta + sum(k * theta ** (2 * i + 3) for i, k in enumerate(lens.coefficients))
        return rays[..., :2] * (length / radius)[..., None]
    if lens.model == "OPENCV":
        k1, k2, p1, p2 = lens.coefficients
        x, y = x / z, y / z
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2
        return torch.stack(
            [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2), y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y], -1
        )
    raise NotImplementedError(lens.model)


def depths_of(points, lens):
    """What Gaussians are ordered by [N], and whether the lens sees them [N]."""
    if not is_wide(lens):
        return points[..., 2], points[..., 2] > 0
    distance = points.norm(dim=-1)
    least = -math.inf if lens.model == AROUND else math.cos(lens.limit)
    return distance, points[..., 2] > least * distance


def is_wide(lens):
    """Whether it sees beside and behind the camera."""
    return lens is not None and lens.model in WIDE


def held_in_view(points, camera):
    """Points [..., 3] no farther from the axis than the lens is followed, and by how much those beyond are, [...]."""
    if is_wide(camera.lens):
        return points, torch.ones_like(points[..., 2])
    slope = points[..., :2].norm(dim=-1) / points[..., 2]
    most = min(FIELD * math.tan(camera.reach), math.tan(camera.lens.limit) if camera.lens else math.inf)
    excess = (slope / most).clamp_min(1)
    return torch.cat([points[..., :2] / excess[..., None], points[..., 2:]], -1), excess


def on_image(points, camera):
    """Where points [..., 3] in the camera are seen, [..., 2] px."""
    held, excess = held_in_view(points, camera)
    focal, middle = (_numbers(camera, *names) for names in (("fx", "fy"), ("cx", "cy")))
    return focal * bend(held, camera.lens) * excess[..., None] + middle


def _numbers(camera, *names):
    """Of the camera, which may be tensors that want gradients."""
    return torch.stack([torch.as_tensor(getattr(camera, name), dtype=torch.float64) for name in names])


@torch.enable_grad()
def seen(points, camera):
    """Means [N, 2] px of points in the camera [N, 3], and the derivatives [N, 2, 3] px per world unit."""
    means2d = on_image(points, camera)
    held, _ = held_in_view(points.clone(), camera)
    held = held if held.requires_grad else held.requires_grad_()
    places = _numbers(camera, "fx", "fy") * bend(held, camera.lens)
    rows = [torch.autograd.grad(column.sum(), held, create_graph=True)[0] for column in places.unbind(1)]
    jacobian = torch.stack(rows, 1)
    return means2d, jacobian if means2d.requires_grad else jacobian.detach()


def narrowed(covariances, camera):
    """Covariances [N, 2, 2] px^2, those wider than a panorama shows held at that width."""
    if camera.lens.model != AROUND:
        return covariances
    shrunk = (WIDEST * camera.width / covariances[:, 0, 0].sqrt()).clamp_max(1)
    factors = torch.stack([shrunk, torch.ones_like(shrunk)], 1)
    return factors[:, :, None] * covariances * factors[:, None, :]


def unscented(points, axes, camera, near=NEAR):
    """Means [N, 2] px and covariances [N, 2, 2] px^2 of Gaussians around ``points``, by Wu et al. 2025, section 4.1.

    Args:
        points: [N, 3] in the camera.
        axes: [N, 3, 3], columns: the Gaussian's axes in the camera, a standard deviation long.
        camera: that looks at them.
        near: points are seen as if no nearer.
    """
    offsets = (3**0.5 * axes).transpose(1, 2)  # of alpha = 1, beta = 2, kappa = 0 in three dimensions
    sigma_points = torch.cat([points[:, None], points[:, None] + offsets, points[:, None] - offsets], 1)  # [N, 7, 3]
    if is_wide(camera.lens):
        _, visible = depths_of(sigma_points, camera.lens)
        sigma_points = torch.where(visible[..., None], sigma_points, points[:, None])
    else:
        sigma_points = torch.cat([sigma_points[..., :2], sigma_points[..., 2:].clamp_min(near)], -1)
    places = on_image(sigma_points, camera)
    if camera.lens is not None and camera.lens.model == AROUND:
        turns = ((places[..., 0] - places[:, :1, 0]) / camera.width).detach().round()
        places = torch.stack([places[..., 0] - camera.width * turns, places[..., 1]], -1)
    of_mean, of_covariance = (torch.tensor([center, *[1 / 6] * 6], dtype=torch.float64) for center in (0.0, 2.0))
    mean = (of_mean[:, None] * places).sum(1)
    off = places - mean[:, None]
    return mean.clone(), torch.einsum("p,npi,npj->nij", of_covariance, off, off)


class AnyCamera(oracle.Pinhole):
    """How cameras with lenses and rolling shutters see Gaussians, and in which projections."""

    def place(self, points, turned, camera, near):
        if getattr(camera, "shutter", None):
            points, along = exposed(points, camera, near)
            turned = along @ turned
        if camera.lens is None:
            return super().place(points, turned, camera, near)
        return points, turned, *depths_of(points, camera.lens)

    def shape(self, points, turned, quats, scales, live, camera, projection, near):
        if projection == "unscented":
            axes = turned @ oracle.rotation_matrices(quats) * scales[:, None]
            return *unscented(points, axes, camera, near), live
        if camera.lens is None or projection == "ellipsoid":
            return super().shape(points, turned, quats, scales, live, camera, projection, near)
        sigma = turned @ oracle.covariances(quats, scales) @ turned.mT
        means2d, to_pixels = seen(points, camera)
        return means2d, narrowed(to_pixels @ sigma @ to_pixels.transpose(1, 2), camera), live

    def repeat(self, splats, camera):
        """A panorama once more, a turn to the left and to the right: [3 N]."""
        if camera.lens is None or camera.lens.model != AROUND:
            return splats
        again = oracle.Splats(*(torch.cat([part] * 3) for part in splats))
        shift = torch.tensor([[camera.width, 0]], dtype=torch.float64)
        shown = torch.cat([splats.means2d, splats.means2d + shift, splats.means2d - shift])
        return again._replace(means2d=shown)


EYE = AnyCamera()
exact_splats = partial(oracle.exact_splats, eye=EYE)
exact_render = partial(oracle.exact_render, eye=EYE)


LATEST = 0.65  # time from the middle row to where the motion ends, beyond the picture
LEAST_GAIN = 0.25  # of rows read over rows passed
EDGE = 1e-3  # of the cosine of the angle up to which a wide lens is asked for a row
STEPS = 2  # of Newton's method


def exposed(points, camera, near=NEAR):
    """Points [N, 3] of the camera's middle row as it sees them in time, and the derivative of that [N, 3, 3]."""
    time, later = torch.zeros_like(points[:, 0]), torch.zeros_like(points)
    for _ in range(STEPS):
        time, later = _step(points, time, camera, near)
    placed, turned, velocity = _at(points, time, camera)
    return placed, turned + velocity[:, :, None] * later[:, None, :]


def _step(points, time, camera, near):
    """Newton's next time [N], and how points change it [N, 3]: not where it ends."""
    placed, turned, velocity = _at(points, time, camera)
    pixels, jacobian = seen(_held_in_view(placed, camera.lens, near), camera)
    rate = jacobian[:, 1] / camera.height
    gain = (1 - (rate * velocity).sum(1)).clamp_min(LEAST_GAIN)
    time = time + (pixels[:, 1] / camera.height - 0.5 - time) / gain
    later = torch.einsum("nij,ni->nj", turned, rate) / gain[:, None]
    return time.clamp(-LATEST, LATEST), torch.where((time.abs() < LATEST)[:, None], later, 0)


def _held_in_view(points, lens, near):
    """Points that a row's camera sees, though it may not be that row's that sees them."""
    across, z = points[:, :2].norm(dim=1, keepdim=True), points[:, 2:]
    if not is_wide(lens):
        z = z.clamp_min(near)
    elif lens.model != AROUND:
        angle = math.acos(math.cos(lens.limit) + EDGE)
        z = torch.where(torch.atan2(across, z) > angle, across / math.tan(angle), z)
    return torch.cat([points[:, :2], z], 1)


def _at(points, time, camera):
    """Points as the camera sees them at ``time`` [N], the rotation since the middle row, and the points' velocity."""
    turn, shift = (torch.as_tensor(part, dtype=torch.float64) for part in (camera.shutter.turn, camera.shutter.shift))
    across = _across(turn)
    turned = torch.linalg.matrix_exp(time[:, None, None] * across)
    placed = torch.einsum("nij,nj->ni", turned, points - time[:, None] * shift)
    return placed, turned, placed @ across.T - turned @ shift


def exact_camera(
    base: Camera,
    twist: torch.Tensor,
    intrinsics: torch.Tensor,
    last_twist: torch.Tensor | None = None,
    coefficients: torch.Tensor | None = None,
) -> SimpleNamespace:
    """The camera of :class:`warp_splat.CameraParameters` as torch has it, by its own exponential and logarithm.

    How far the lens is followed stays. A rolling shutter turns by more than nothing.
    """
    fx, fy, cx, cy = intrinsics
    given = {"width": base.width, "height": base.height, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    given |= {"lens": base.lens, "reach": base.reach}
    if coefficients is not None:
        assert base.lens is not None
        given["lens"] = SimpleNamespace(model=base.lens.model, coefficients=coefficients, limit=base.lens.limit)
    first, begin = _pose(base.at(-0.5), twist)
    if last_twist is None:
        return SimpleNamespace(**given, rotation=first, translation=-first @ begin, shutter=None)
    last, end = _pose(base.at(base.height - 0.5), last_twist)
    turned = last @ first.T
    sine = 0.5 * torch.stack([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]])
    w = sine * (sine.norm().asin() / sine.norm())
    rotation = _turn(0.5 * w) @ first
    shutter = SimpleNamespace(turn=w, shift=rotation @ (end - begin))
    return SimpleNamespace(**given, rotation=rotation, translation=-rotation @ (0.5 * (begin + end)), shutter=shutter)


def _pose(camera: Camera, twist: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rotation and center [3] of a camera that is turned and moved by a twist."""
    rotation = _turn(twist[:3]) @ torch.tensor(camera.rotation)
    return rotation, -rotation.T @ (_turn(twist[:3]) @ torch.tensor(camera.translation) + twist[3:])


def _turn(w: torch.Tensor) -> torch.Tensor:
    """The rotation by a vector."""
    return torch.linalg.matrix_exp(_across(w))


def _across(w: torch.Tensor) -> torch.Tensor:
    """What the product with a vector does, as a matrix."""
    return torch.linalg.cross(w.expand(3, 3), torch.eye(3, dtype=torch.float64)).T

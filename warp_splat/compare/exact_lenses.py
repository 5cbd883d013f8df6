"""Truth for lenses: float64 torch, from the papers, derivatives by torch.autograd. Part of :mod:`.oracle`."""

import math

import torch

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


def shown_thrice(means2d, camera):
    """Means [3 N, 2] px of what shows once more, a turn to the left and to the right."""
    shift = torch.tensor([[camera.width, 0]], dtype=torch.float64)
    return torch.cat([means2d, means2d + shift, means2d - shift])

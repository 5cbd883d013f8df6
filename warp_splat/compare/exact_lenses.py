"""Truth for lenses: float64 torch, from the papers, derivatives by torch.autograd. Part of :mod:`.oracle`."""

import math

import torch

FIELD = 1.3  # of the angle of view: beyond, a lens that is not wide is continued as straight as it is there
WIDE = ("OPENCV_FISHEYE", "EQUIRECTANGULAR")


def bend(rays, lens):
    """Where points [N, 3] in the camera are seen, in focal lengths from the principal point, [N, 2]."""
    x, y, z = rays.unbind(1)
    if lens.model == "EQUIRECTANGULAR":
        return torch.stack([torch.atan2(x, z), torch.atan2(y, (x * x + z * z).sqrt())], 1)
    if lens.model == "OPENCV_FISHEYE":
        radius = (x * x + y * y).sqrt()
        theta = torch.atan2(radius, z)
        length = theta + sum(k * theta ** (2 * i + 3) for i, k in enumerate(lens.coefficients))
        return rays[:, :2] * (length / radius)[:, None]
    if lens.model == "OPENCV":
        k1, k2, p1, p2 = lens.coefficients
        x, y = x / z, y / z
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2
        return torch.stack(
            [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2), y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y], 1
        )
    raise NotImplementedError(lens.model)


def depths_of(points, lens):
    """What Gaussians are ordered by [N], and whether the lens sees them [N]."""
    if lens.model not in WIDE:
        return points[:, 2], points[:, 2] > 0
    distance = points.norm(dim=1)
    return distance, points[:, 2] > math.cos(lens.limit) * distance


def seen(points, camera):
    """Means [N, 2] px of points in the camera [N, 3], and the derivatives [N, 2, 3] px per world unit."""
    held = points.clone()
    if camera.lens.model not in WIDE:
        slope = points[:, :2].norm(dim=1) / points[:, 2]
        most = math.tan(min(FIELD * camera.reach, camera.lens.limit))
        shrunk = torch.where(slope > most, most / slope, torch.ones_like(slope))
        held = torch.cat([points[:, :2] * shrunk[:, None], points[:, 2:]], 1)
    wanted = held.requires_grad
    held = held if wanted else held.requires_grad_()
    focal, middle = torch.tensor([[camera.fx, camera.fy], [camera.cx, camera.cy]], dtype=torch.float64)
    means = focal * bend(held, camera.lens) + middle
    rows = [torch.autograd.grad(column.sum(), held, create_graph=True)[0] for column in means.unbind(1)]
    jacobian = torch.stack(rows, 1)
    means = means + (jacobian @ (points - held)[:, :, None])[:, :, 0]
    return (means, jacobian) if wanted else (means.detach(), jacobian.detach())

"""gsplat's unscented transform through lenses and rolling shutters, against its textbook form in float64."""

import math

import pytest
import torch
from hostile import refusal
from test_gsplat import call_of, check_agreement, theirs

from warp_splat.gsplat import rasterization

gsplat = pytest.importorskip("gsplat")
from gsplat.cuda._wrapper import RollingShutterType as Rolling  # noqa: E402

ALPHA, BETA, BLUR = 0.1, 2.0, 0.3
SPREAD = 3 * ALPHA**2
PINHOLE = {"radial_coeffs": [0.1, -0.05, 0.02, 0.03, -0.02, 0.01], "tangential_coeffs": [0.01, -0.02]}
PINHOLE |= {"thin_prism_coeffs": [0.01, -0.004, -0.02, 0.006]}
FISHEYE = {"radial_coeffs": [0.05, -0.03, 0.01, -0.002]}
LENSES = [("pinhole", {}), ("pinhole", PINHOLE), ("fisheye", {}), ("fisheye", FISHEYE)]
LEAVES = ("means", "quats", "scales", "viewmats", "Ks")


def lens_of(coefficients, cameras=2):
    return {name: torch.tensor([numbers] * cameras, requires_grad=True) for name, numbers in coefficients.items()}


def corner_of(call):
    """The angle at which the picture's farthest corner lies, without distortion."""
    (fx, _, cx), (_, fy, cy), _ = call["Ks"][0].tolist()
    return math.hypot(max(call["width"] - cx, cx), max(call["height"] - cy, cy)) / min(fx, fy)


def opencv(points, Ks, corner=None, radial_coeffs=None, tangential_coeffs=None, thin_prism_coeffs=None):
    """Pixels [C, N, 7, 2] of points in the camera (OpenCV's documentation); ``corner``: a fisheye's largest angle."""
    x, y = (points[..., axis] / points[..., 2] for axis in (0, 1))
    r = (x * x + y * y).sqrt()
    none = Ks.new_zeros(len(Ks), 6)
    k, p, s = (none if given is None else given for given in (radial_coeffs, tangential_coeffs, thin_prism_coeffs))
    k, p, s = ([part[:, None, None] for part in given.unbind(1)] for given in (k, p, s))
    if corner:
        theta = torch.atan(r).clamp_max(corner)
        scale = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8) / r
        u, v = scale * x, scale * y
    else:
        scale = (1 + k[0] * r**2 + k[1] * r**4 + k[2] * r**6) / (1 + k[3] * r**2 + k[4] * r**4 + k[5] * r**6)
        u = x * scale + 2 * p[0] * x * y + p[1] * (r**2 + 2 * x**2) + s[0] * r**2 + s[1] * r**4
        v = y * scale + p[0] * (r**2 + 2 * y**2) + 2 * p[1] * x * y + s[2] * r**2 + s[3] * r**4
    (fx, fy), (cx, cy) = ((Ks[:, 0, i, None, None], Ks[:, 1, j, None, None]) for i, j in ((0, 1), (2, 2)))
    return torch.stack([fx * u + cx, fy * v + cy], -1)


def sigma_points(means, quats, scales):
    """Seven points [N, 7, 3] of each Gaussian (Wan and van der Merwe 2000)."""
    offsets = SPREAD**0.5 * (theirs._quat_to_rotmat(quats) * scales[:, None]).mT
    return torch.cat([means[:, None], means[:, None] + offsets, means[:, None] - offsets], 1)


def moments(places):
    """Mean and covariance of what seven points [C, N, 7, 2] show; around the first, which has a large weight."""
    off, weight = places[:, :, 1:] - places[:, :, :1], 0.5 / SPREAD
    moved = weight * off.sum(2)
    covariance = weight * torch.einsum("cnpi,cnpj->cnij", off, off)
    return places[:, :, 0] + moved, covariance + (BETA - ALPHA**2) * moved[..., :, None] * moved[..., None, :]


def conics_of(covariance):
    return torch.linalg.inv(covariance).flatten(2)[..., [0, 1, 3]]


def in_float64(leaves):
    return {name: leaf.detach().double().requires_grad_() for name, leaf in leaves.items()}


@pytest.mark.parametrize(("model", "coefficients"), LENSES)
def test_means_and_covariances_through_lenses(model, coefficients):
    lens = lens_of(coefficients)
    call = call_of(packed=False, with_ut=True, camera_model=model, rasterize_mode="antialiased", **lens)
    meta = rasterization(**call)[2]
    leaves = {name: call[name] for name in LEAVES} | lens
    exact = in_float64(leaves)
    means, quats, scales, viewmats, Ks, *_ = exact.values()
    points = torch.einsum("cij,npj->cnpi", viewmats[:, :3, :3], sigma_points(means, quats, scales))
    points = points + viewmats[:, None, None, :3, 3]
    bent = {name: exact[name] for name in lens}
    mean, sharp = moments(opencv(points, Ks, corner_of(call) if model == "fisheye" else None, **bent))
    blurred = sharp + BLUR * torch.eye(2, dtype=torch.float64)
    share = (torch.linalg.det(sharp) / torch.linalg.det(blurred)).sqrt()
    truth = {"means2d": mean, "depths": points[:, :, 0, 2], "conics": conics_of(blurred)}
    check_agreement(truth | {"opacities": call["opacities"].detach() * share}, meta, leaves, exact)


def test_of_small_gaussians_it_is_the_linear_projection():
    call = call_of("degree1", packed=False)
    call["scales"] = 0.01 * call["scales"].detach()
    one, other = (rasterization(**call, with_ut=with_ut)[0] for with_ut in (False, True))
    assert (one - other).abs().max() < 1e-3 < one.max()


def test_a_fisheye_is_followed_up_to_its_fold():
    """Beyond, everything is seen where the fold is, which is outside of the picture."""
    call = call_of("degree1", cameras=1, packed=False, with_ut=True, camera_model="fisheye")
    call["viewmats"], call["sh_degree"] = torch.eye(4)[None], None
    call["Ks"] = torch.tensor([[[100.0, 0, 0], [0, 100, 0], [0, 0, 1]]])
    angles = torch.tensor([0.3, 0.7, 1.0, 1.3])
    call["means"] = torch.stack([angles.sin(), 0 * angles, angles.cos()], 1)
    call |= {"quats": torch.eye(4)[[0] * 4], "scales": torch.full((4, 3), 1e-3), "opacities": torch.ones(4)}
    call |= {"colors": torch.ones(4, 3), "width": 200, "height": 20}
    fold = (1 / 1.5) ** 0.5  # where 1 - 3 theta^2 / 2 is zero
    meta = rasterization(**call, radial_coeffs=torch.tensor([[-0.5, 0, 0, 0]]))[2]
    expected = 100 * (angles.clamp_max(fold) - 0.5 * angles.clamp_max(fold) ** 3)
    assert (meta["means2d"][0, :, 0] - expected).abs().max() < 1e-2


def quaternion(matrix):
    w = 0.5 * (1 + matrix.diagonal(dim1=-2, dim2=-1).sum(-1)).sqrt()
    x, y, z = (matrix[..., i, j] - matrix[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    return torch.stack([w, x / (4 * w), y / (4 * w), z / (4 * w)], -1)


def turned(first, last, time):
    """Rotations at times between those of two poses: spherical interpolation of quaternions (Shoemake 1985)."""
    one, other = (quaternion(pose[..., :3, :3]) for pose in (first, last))
    angle = torch.arccos((one * other).sum(-1, keepdim=True))
    quats = torch.sin((1 - time) * angle) * one + torch.sin(time * angle) * other
    return theirs._quat_to_rotmat(quats / torch.sin(angle))


def moved_on(first, *quats):
    """Where cameras stand when the last row is read."""
    last = first.detach().clone()
    last[:, :3, :3] = theirs._quat_to_rotmat(torch.tensor(quats)) @ last[:, :3, :3]
    last[:, :3, 3] += torch.tensor([0.05, -0.04, 0.1])
    return last


def tangent(gradient, pose):
    """What of a gradient moves a pose: along rotations, and its translation."""
    part = pose[:, :3, :3].mT.double() @ gradient[:, :3, :3].double()
    return torch.cat([(part - part.mT).flatten(1), gradient[:, :3, 3]], 1)


@pytest.mark.parametrize("shutter", ["TOP_TO_BOTTOM", "LEFT_TO_RIGHT", "BOTTOM_TO_TOP", "RIGHT_TO_LEFT"])
def test_means_covariances_and_gradients_of_a_rolling_shutter(shutter):
    """Each point is seen from where the camera stands when its row or column is read."""
    axis, reverse = int("TOP" in shutter), shutter.startswith(("BOTTOM", "RIGHT"))
    call = call_of(packed=False, with_ut=True, rolling_shutter=Rolling[f"ROLLING_{shutter}"])
    last = moved_on(call["viewmats"], [1.0, 0.02, -0.03, 0.01], [1.0, -0.01, 0.02, 0.02])
    call["viewmats_rs"] = last.requires_grad_()
    meta = rasterization(**call)[2]
    leaves = {name: call[name] for name in (*LEAVES, "viewmats_rs")}
    exact = in_float64(leaves)
    means, quats, scales, first, Ks, last = exact.values()
    first, last, size = first[:, None, None], last[:, None, None], (call["width"], call["height"])[axis]
    points = sigma_points(means, quats, scales)[None].expand(len(first), -1, -1, -1)
    places = torch.zeros(*points.shape[:-1], 2).double()
    for _ in range(40):
        share = (places[..., axis, None] - 0.5) / (size - 1)
        time = 1 - share if reverse else share
        seen = (turned(first, last, time) @ points[..., None])[..., 0]
        places = opencv(seen + (1 - time) * first[..., :3, 3] + time * last[..., :3, 3], Ks)
    mean, covariance = moments(places)
    drawn = (meta["radii"] > 0).all(-1)
    still = rasterization(**call | {"rolling_shutter": None, "viewmats_rs": None})[2]["means2d"]
    assert (still - meta["means2d"])[drawn].abs().max() > 1.0  # px
    tangents = lambda name, gradient: tangent(gradient, call[name].detach()) if "viewmats" in name else gradient  # noqa: E731
    truth = {"means2d": mean, "conics": conics_of(covariance + BLUR * torch.eye(2))}
    check_agreement(truth, meta, leaves, exact, tangents)


def test_a_camera_that_stands_still_sees_as_ever():
    """Also in the image, whose colors are those of the middle of the way."""
    call = call_of("degree1", with_ut=True)
    image = rasterization(**call)[0]
    rolling = {"rolling_shutter": Rolling.ROLLING_TOP_TO_BOTTOM, "viewmats_rs": call["viewmats"].detach()}
    same = rasterization(**call, **rolling)[0]
    assert (image - same).abs().max() < 1e-5
    same.sum().backward()
    assert all(call[name].grad.isfinite().all() for name in LEAVES)


def test_the_image_is_that_of_cameras_that_stand_still_row_by_row():
    """Up to the shear that one Gaussian cannot show."""
    call = call_of("degree2", cameras=1, with_ut=True)
    first, rows = call["viewmats"].detach(), call["height"]
    last = moved_on(first, [1.0, 0.02, -0.03, 0.01])
    rolling = {"rolling_shutter": Rolling.ROLLING_BOTTOM_TO_TOP, "viewmats_rs": last}
    with torch.no_grad():
        image, still = (rasterization(**call | more)[0][0] for more in (rolling, {}))
        by_rows = torch.zeros_like(image)
        for row in range(rows):
            time = 1 - row / (rows - 1)
            pose = torch.lerp(first, last, time)
            pose[:, :3, :3] = turned(first.double(), last.double(), time).float()
            by_rows[row] = rasterization(**call | {"viewmats": pose})[0][0, row]
    assert (image - by_rows).abs().mean() < 0.1 * (still - by_rows).abs().mean()


UNSCENTED, ROLLING = {"with_ut": True}, {"rolling_shutter": Rolling.ROLLING_LEFT_TO_RIGHT}
FISHEYE_CAMERA = UNSCENTED | {"camera_model": "fisheye"}
NEEDS = "rolling_shutter: expected with_ut=True and viewmats_rs"


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"radial_coeffs": torch.zeros(2, 6)}, "radial_coeffs: expected None without with_ut=True"),
        (UNSCENTED | {"radial_coeffs": torch.zeros(2, 4)}, r"radial_coeffs: expected shape \[2, 6\]"),
        (FISHEYE_CAMERA | {"tangential_coeffs": torch.zeros(2, 2)}, "tangential_coeffs: .* and camera_model pinhole"),
        (UNSCENTED | {"camera_model": "ortho"}, "camera_model: expected pinhole or fisheye where with_ut is True"),
        (ROLLING | UNSCENTED, f"{NEEDS} with ROLLING_LEFT_TO_RIGHT"),
        (ROLLING | {"viewmats_rs": torch.eye(4).repeat(2, 1, 1)}, NEEDS),
        (ROLLING | UNSCENTED | {"viewmats_rs": torch.zeros(2, 4, 4)}, "viewmats_rs: expected matrices from world to"),
    ],
)
def test_bad_input(changes, found):
    refusal(lambda: rasterization(**call_of() | changes), match=found)

"""gsplat's rolling shutter: seven points, each seen from where the camera stands when their row or column is read."""

import pytest
import torch
from test_gsplat import call_of, check_agreement, theirs

from warp_splat import InputError
from warp_splat.gsplat import rasterization

gsplat = pytest.importorskip("gsplat")
from gsplat.cuda._wrapper import RollingShutterType  # noqa: E402

LEAVES = ("means", "quats", "scales", "viewmats", "viewmats_rs", "Ks")
SIGMA = 0.1 * 3**0.5  # of the points, in standard deviations


def quaternion(matrix):
    w = 0.5 * (1 + matrix.diagonal(dim1=-2, dim2=-1).sum(-1)).sqrt()
    x, y, z = (matrix[..., i, j] - matrix[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    return torch.stack([w, x / (4 * w), y / (4 * w), z / (4 * w)], -1)


def between(first, last, time, points):
    """Points [C, N, 7, 3] in cameras at times [C, N, 7]: spherical interpolation of quaternions (Shoemake 1985)."""
    one, other = (quaternion(pose[:, :3, :3])[:, None, None] for pose in (first, last))
    angle = torch.arccos((one * other).sum(-1, keepdim=True))
    time = time[..., None]
    turned = (torch.sin((1 - time) * angle) * one + torch.sin(time * angle) * other) / torch.sin(angle)
    shift = (1 - time) * first[:, None, None, :3, 3] + time * last[:, None, None, :3, 3]
    return (theirs._quat_to_rotmat(turned) @ points[..., None])[..., 0] + shift


def textbook(means, quats, scales, viewmats, viewmats_rs, Ks, time_of):
    offsets = SIGMA * (theirs._quat_to_rotmat(quats) * scales[:, None]).mT
    points = torch.cat([means[:, None], means[:, None] + offsets, means[:, None] - offsets], 1)[None]
    points = points.expand(len(viewmats), *points.shape[1:])
    places = torch.zeros(*points.shape[:-1], 2).double()
    for _ in range(40):
        x, y, z = between(viewmats, viewmats_rs, time_of(places), points).unbind(-1)
        fx, fy, cx, cy = (Ks[:, i, j, None, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        places = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    off = places[:, :, 1:] - places[:, :, :1]
    weight = 1 / 0.06
    moved = weight * off.sum(2)
    covariance = weight * torch.einsum("cnpi,cnpj->cnij", off, off)
    return places[:, :, 0] + moved, covariance + (2 - 0.01) * moved[..., :, None] * moved[..., None, :]


def tangent(gradient, pose):
    """What of a gradient moves a pose: along rotations, and its translation."""
    part = pose[:, :3, :3].mT.double() @ gradient[:, :3, :3].double()
    return torch.cat([(part - part.mT).flatten(1), gradient[:, :3, 3]], 1)


@pytest.mark.parametrize(
    ("shutter", "axis", "reverse"),
    [("TOP_TO_BOTTOM", 1, False), ("LEFT_TO_RIGHT", 0, False), ("BOTTOM_TO_TOP", 1, True), ("RIGHT_TO_LEFT", 0, True)],
)
def test_means_covariances_and_gradients(shutter, axis, reverse):
    call = call_of(packed=False, with_ut=True, rolling_shutter=RollingShutterType[f"ROLLING_{shutter}"])
    turn = theirs._quat_to_rotmat(torch.tensor([[1.0, 0.02, -0.03, 0.01], [1.0, -0.01, 0.02, 0.02]]))
    last = call["viewmats"].detach().clone()
    last[:, :3, :3] = turn @ last[:, :3, :3]
    last[:, :3, 3] += torch.tensor([0.05, -0.04, 0.1])
    call["viewmats_rs"] = last.requires_grad_()
    meta = rasterization(**call)[2]
    size = (call["width"], call["height"])[axis]

    def time_of(places):
        share = (places[..., axis] - 0.5) / (size - 1)
        return 1 - share if reverse else share

    leaves = {name: call[name] for name in LEAVES}
    exact = {name: leaf.detach().double().requires_grad_() for name, leaf in leaves.items()}
    mean, covariance = textbook(**exact, time_of=time_of)
    conic = torch.linalg.inv(covariance + 0.3 * torch.eye(2)).flatten(2)[..., [0, 1, 3]]
    drawn = (meta["radii"] > 0).all(-1)
    still = rasterization(**call | {"rolling_shutter": None, "viewmats_rs": None})[2]["means2d"]
    assert (still - meta["means2d"])[drawn].abs().max() > 1.0  # px
    truth = {"means2d": mean, "conics": conic}
    tangents = lambda name, gradient: tangent(gradient, call[name].detach()) if "viewmats" in name else gradient  # noqa: E731
    check_agreement(truth, meta, leaves, exact, tangents)


def test_a_camera_that_stands_still_sees_as_ever():
    """Also in the image, whose colors are those of the middle of the way."""
    call = call_of("degree1", with_ut=True)
    image = rasterization(**call)[0]
    rolling = RollingShutterType.ROLLING_TOP_TO_BOTTOM
    same = rasterization(**call, rolling_shutter=rolling, viewmats_rs=call["viewmats"].detach())[0]
    assert (image - same).abs().max() < 1e-5
    same.sum().backward()
    assert all(call[name].grad.isfinite().all() for name in LEAVES if name in call)


def test_the_image_is_that_of_cameras_that_stand_still_row_by_row():
    """Up to the shear that one Gaussian cannot show."""
    call = call_of("degree2", cameras=1, with_ut=True)
    first = call["viewmats"].detach()
    last = first.clone()
    last[:, :3, :3] = theirs._quat_to_rotmat(torch.tensor([[1.0, 0.02, -0.03, 0.01]])) @ last[:, :3, :3]
    last[:, :3, 3] += torch.tensor([0.05, -0.04, 0.1])
    rolling = {"rolling_shutter": RollingShutterType.ROLLING_BOTTOM_TO_TOP, "viewmats_rs": last}
    ends = [quaternion(pose[:, :3, :3].double()) for pose in (first, last)]
    angle, rows = torch.arccos((ends[0] * ends[1]).sum()), call["height"]
    with torch.no_grad():
        image, still = (rasterization(**call | more)[0][0] for more in (rolling, {}))
        by_rows = torch.zeros_like(image)
        for row in range(rows):
            time = 1 - row / (rows - 1)
            turned = torch.sin((1 - time) * angle) * ends[0] + torch.sin(time * angle) * ends[1]
            pose = torch.lerp(first, last, time)
            pose[:, :3, :3] = theirs._quat_to_rotmat(turned).float()
            by_rows[row] = rasterization(**call | {"viewmats": pose})[0][0, row]
    assert (image - by_rows).abs().mean() < 0.1 * (still - by_rows).abs().mean()


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"with_ut": True}, "rolling_shutter: expected with_ut=True and viewmats_rs with ROLLING_LEFT_TO_RIGHT"),
        ({"viewmats_rs": torch.eye(4).repeat(2, 1, 1)}, "rolling_shutter: expected with_ut=True and viewmats_rs"),
        ({"with_ut": True, "viewmats_rs": torch.eye(4)}, r"viewmats_rs: expected a tensor \[2, 4, 4\]"),
        ({"with_ut": True, "viewmats_rs": torch.zeros(2, 4, 4)}, "viewmats_rs: expected matrices from world to camera"),
    ],
)
def test_bad_input(changes, found):
    with pytest.raises(InputError, match=found):
        rasterization(**call_of(rolling_shutter=RollingShutterType.ROLLING_LEFT_TO_RIGHT) | changes)

"""gsplat's unscented transform through lenses, against its textbook form and OpenCV's formulas in float64."""

import math

import pytest
import torch
from test_gsplat import call_of, check_agreement, theirs

from warp_splat import InputError
from warp_splat.gsplat import rasterization

ALPHA, BETA, KAPPA, BLUR = 0.1, 2.0, 0.0, 0.3
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


def opencv(points, Ks, corner, radial_coeffs=None, tangential_coeffs=None, thin_prism_coeffs=None):
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


def textbook(means, quats, scales, viewmats, Ks, corner, **coefficients):
    """Means and covariances of what seven points show (Wan and van der Merwe 2000)."""
    axes = theirs._quat_to_rotmat(quats) * scales[:, None]
    spread = ALPHA**2 * (3 + KAPPA)
    offsets = spread**0.5 * axes.mT
    points = torch.cat([means[:, None], means[:, None] + offsets, means[:, None] - offsets], 1)
    points = torch.einsum("cij,npj->cnpi", viewmats[:, :3, :3], points) + viewmats[:, None, None, :3, 3]
    places = opencv(points, Ks, corner, **coefficients)
    weights = torch.full((7,), 0.5 / spread, dtype=torch.float64)
    weights[0] = 1 - 3 / spread
    mean = torch.einsum("p,cnpi->cni", weights, places)
    weights = weights + (1 - ALPHA**2 + BETA) * (torch.arange(7) == 0)
    off = places - mean[:, :, None]
    return mean, torch.einsum("p,cnpi,cnpj->cnij", weights, off, off), points[:, :, 0, 2]


@pytest.mark.parametrize(("model", "coefficients"), LENSES)
def test_means_and_covariances(model, coefficients):
    lens = lens_of(coefficients)
    call = call_of(packed=False, with_ut=True, camera_model=model, rasterize_mode="antialiased", **lens)
    meta = rasterization(**call)[2]
    leaves = {name: call[name] for name in LEAVES} | lens
    exact = {name: leaf.detach().double().requires_grad_() for name, leaf in leaves.items()}
    mean, sharp, depth = textbook(**exact, corner=corner_of(call) if model == "fisheye" else None)
    blurred = sharp + BLUR * torch.eye(2, dtype=torch.float64)
    conic = torch.linalg.inv(blurred).flatten(2)[..., [0, 1, 3]]
    share = (torch.linalg.det(sharp) / torch.linalg.det(blurred)).sqrt()
    truth = {"means2d": mean, "depths": depth, "conics": conic, "opacities": call["opacities"].detach() * share}
    check_agreement(truth, meta, leaves, exact)


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


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"radial_coeffs": torch.zeros(2, 6)}, "radial_coeffs: expected None without with_ut=True"),
        ({"with_ut": True, "radial_coeffs": torch.zeros(2, 4)}, r"radial_coeffs: expected a tensor \[2, 6\]"),
        ({"with_ut": True, "thin_prism_coeffs": torch.full((2, 4), torch.nan)}, "thin_prism_coeffs: expected finite"),
        (
            {"with_ut": True, "camera_model": "fisheye", "tangential_coeffs": torch.zeros(2, 2)},
            "tangential_coeffs: expected None without with_ut=True and camera_model pinhole",
        ),
        ({"with_ut": True, "camera_model": "ortho"}, "camera_model: expected pinhole or fisheye where with_ut is True"),
    ],
)
def test_bad_input(changes, found):
    with pytest.raises(InputError, match=found):
        rasterization(**call_of() | changes)

"""Small named scenes, each for one thing that a renderer gets wrong. Deterministic: every scene has its seed.

``SCENES[name]()`` builds one. Depths keep gaps well above float32 rounding (except in ``ties``), so that the order is
a fact of the scene and not of a rounding; a bug fix brings the scene that failed before it.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
import torch

from warp_splat import Shutter
from warp_splat.camera import Camera
from warp_splat.compare import oracle
from warp_splat.compare.scenes import at_pixels, distinct_depths, make_camera, to_world
from warp_splat.lenses import Lens
from warp_splat.lenses.formulas import MODELS
from warp_splat.raster.data import Gaussians

FAINTEST = 1e-37  # about the least normal number of float32, the cut where there is none
C0 = 0.28209479177387814  # color = C0 * sh[0] + 0.5 at degree 0
OPENCV, FISHEYE = Lens("OPENCV", (-0.12, 0.02, 0.01, -0.006)), Lens("OPENCV_FISHEYE", (0.03, -0.01, 0.004, -0.001))
PARAMETERS = ("means", "quats", "scales", "opacities", "sh")


SMALL = (0.06, -0.03, 0.004, -0.006, 0.02, -0.01, 0.015, 0.005, 0.003, -0.002, 0.004, 0.001)
OTHERS = {"FOV": (0.9,), "EUCM": (0.6, 1.1)}
LENSES = {model: Lens(model, OTHERS.get(model, SMALL[:count])) for model, (_, count) in MODELS.items()}
SHUTTER = Shutter((0.02, 0.05, -0.03), (0.05, 0.02, -0.08))


@dataclass(frozen=True, eq=False)
class Scene:
    """Activated Gaussians (float32, torch), a camera and a background."""

    means: torch.Tensor  # [N, 3]
    quats: torch.Tensor  # [N, 4] wxyz
    scales: torch.Tensor  # [N, 3]
    opacities: torch.Tensor  # [N]
    sh: torch.Tensor  # [N, K, 3]
    camera: Camera
    background: torch.Tensor  # [3]

    def to(self, device, dtype=None):
        """The same scene elsewhere or in another precision."""
        tensors = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "camera"}
        return replace(self, **{name: tensor.to(device, dtype) for name, tensor in tensors.items()})

    def parameters(self):
        """The five inputs in the order of the renderer's arguments."""
        return [getattr(self, name) for name in PARAMETERS]

    def gaussians(self):
        """The same as the renderer's kernels take them."""
        *shapes, sh = self.parameters()
        return Gaussians(*shapes, sh[:, :1], sh[:, 1:])


def pack(means, scales, opacities, sh, camera, rng, quats=None, background=(0.2, 0.4, 0.7)):
    """A Scene of NumPy arrays, with random rotations unless given."""
    quats = rng.normal(size=(len(means), 4)) if quats is None else quats
    arrays = (means, quats, scales, opacities, sh)
    tensors = [torch.tensor(np.ascontiguousarray(array), dtype=torch.float32) for array in arrays]
    return Scene(*tensors, camera, torch.tensor(background, dtype=torch.float32))


def colors(rng, count, degree, low=0.0, high=1.0, rest=0.15):
    """SH coefficients [N, K, 3]: base colors in low..high, the rest normal."""
    sh = rng.normal(size=(count, (degree + 1) ** 2, 3)) * rest
    sh[:, 0] = (rng.uniform(low, high, (count, 3)) - 0.5) / C0
    return sh


def cloud(
    seed, count, camera, degree=0, z=(2, 8), sigma=(0.6, 6), aspect=0.15, opacity=(0.05, 0.95), frame=0.15, **sh_options
):
    """Random Gaussians over the image and a ``frame`` around it (a share of its size).

    ``sigma``: range of the largest standard deviation on the image [px]; ``aspect``: least ratio of the others to it.
    """
    rng = np.random.default_rng(seed)
    depth = distinct_depths(rng, count, *z)
    pixels = rng.uniform(-frame, 1 + frame, (count, 2)) * [camera.width, camera.height]
    size = np.exp(rng.uniform(*np.log(sigma), count)) * np.abs(depth) / camera.fx
    ratios = np.exp(rng.uniform(np.log(aspect), 0, (count, 3)))
    ratios[np.arange(count), rng.integers(0, 3, count)] = 1
    opacities = rng.uniform(*opacity, count)
    sh = colors(rng, count, degree, **sh_options)
    return pack(at_pixels(pixels, depth, camera), size[:, None] * ratios, opacities, sh, camera, rng)


def through_lens(seed, count, lens, size, focal, most, sigma=(0.6, 6.0), degree=1):
    """Random Gaussians all around the axis of a camera with a lens, up to ``most`` degrees from it."""
    rng, base = np.random.default_rng(seed), make_camera(*size, fx=focal, fy=1.1 * focal, seed=seed)
    middle = {"cx": base.cx + 1.3, "cy": base.cy - 0.8}
    if lens.model == "EQUIRECTANGULAR":
        middle = {"cx": size[0] / 2, "cy": size[1] / 2, "fy": focal}
    camera = replace(base, **middle, lens=lens)
    cosine = rng.uniform(np.cos(np.radians(most)), 1, count)
    around, sine = rng.uniform(0, 2 * np.pi, count), np.sqrt(1 - cosine**2)
    distance = distinct_depths(rng, count, 2, 8)
    points = np.stack([sine * np.cos(around), sine * np.sin(around), cosine], 1) * distance[:, None]
    longest = np.exp(rng.uniform(*np.log(sigma), count)) * distance / focal
    ratios = np.exp(rng.uniform(np.log(0.15), 0, (count, 3)))
    sh = colors(rng, count, degree)
    return pack(to_world(points, camera), longest[:, None] * ratios, rng.uniform(0.05, 0.95, count), sh, camera, rng)


def near_and_behind():
    """Depths from far behind to in front, with both sides of the near plane at 0.2."""
    scene = cloud(21, 150, make_camera(44, 35), degree=1, z=(-3, 3), sigma=(1, 5))
    near = cloud(22, 40, scene.camera, degree=1, z=(0.1, 0.3), sigma=(1, 8), opacity=(0.05, 0.3))
    return join(scene, near)


def inside():
    """A wide camera in the middle of a cloud: Gaussians beyond the frame reach in, the Jacobian's clamp is active."""
    camera, rng, count = make_camera(45, 37, fx=14, fy=16, seed=3), np.random.default_rng(23), 160
    z = distinct_depths(rng, count, 0.25, 3)
    angle = rng.uniform(0, 2 * np.pi, count)
    slope = rng.uniform(0, 5, count)  # the image ends at 1.6, the clamp at 2.1
    points = np.stack([slope * np.cos(angle) * z, slope * np.sin(angle) * z, z], 1)
    scales = np.exp(rng.uniform(np.log(0.05), np.log(0.5), (count, 3))) * z[:, None]
    return pack(to_world(points, camera), scales, rng.uniform(0.1, 0.7, count), colors(rng, count, 2), camera, rng)


def join(first, second):
    """Both scenes' Gaussians, seen by the first one's camera."""
    tensors = {name: torch.cat([getattr(first, name), getattr(second, name)]) for name in PARAMETERS}
    return replace(first, **tensors)


def needles(stretch=1):
    """Scale ratios of 10,000 at every angle on the image, and some in any direction; ``stretch`` times 3 to 9 px.

    The longer, the more digits the conic's quadratic form cancels off the axis: errors grow tenfold at 10.
    """
    camera, rng, count = make_camera(47, 41, seed=None), np.random.default_rng(24), 48
    z = distinct_depths(rng, count, 3, 6)
    pixels = rng.uniform(0.1, 0.9, (count, 2)) * [47, 41]
    length = stretch * rng.uniform(3, 9, count) / camera.fx * z
    scales = length[:, None] * np.array([1, 1e-4, 1e-4])
    half = np.linspace(0, np.pi, count, endpoint=False) / 2
    quats = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], 1)
    quats[::6] = rng.normal(size=quats[::6].shape)
    opacities, sh = rng.uniform(0.3, 0.9, count), colors(rng, count, 0)
    return pack(at_pixels(pixels, z, camera), scales, opacities, sh, camera, rng, quats)


def pancakes():
    """Flat Gaussians, one axis 10,000 times shorter than the others: seen from the front, aslant and edge-on."""
    scene = cloud(25, 60, make_camera(43, 39), degree=1, sigma=(2, 7), aspect=0.6)
    flat = torch.ones_like(scene.scales)
    flat[torch.arange(60), torch.arange(60) % 3] = 1e-4
    return replace(scene, scales=scene.scales * flat)


def ties():
    """Every Gaussian at the same depth, many at the same place: the index decides. World axes keep z exact."""
    scene = cloud(26, 40, make_camera(33, 30, seed=None), sigma=(3, 6), opacity=(0.3, 0.9), frame=0)
    means = scene.means / scene.means[:, 2:] * 4
    means[:, 2] = 4
    means[1::2] = means[::2]
    return replace(scene, means=means)


def huge():
    """One Gaussian far larger than the image in front of small ones, one behind them."""
    scene = cloud(27, 40, make_camera(50, 34), degree=1)
    big = cloud(28, 2, scene.camera, degree=1, z=(1, 20), sigma=(900, 1100), aspect=0.5, opacity=(0.3, 0.6), frame=0)
    return join(scene, big)


def faint():
    """Opacities on both sides of 1/255, none within rounding of it."""
    scene = cloud(29, 120, make_camera(40, 31), sigma=(2, 6))
    opacities = torch.linspace(0.2, 3, 120) / 255
    return replace(scene, opacities=opacities)


def quat_norms():
    """Quaternions of norm 1e-3 to 1e3."""
    scene = cloud(30, 60, make_camera(37, 33), degree=1)
    norms = torch.logspace(-3, 3, 60)[:, None]
    return replace(scene, quats=scene.quats / scene.quats.norm(dim=1, keepdim=True) * norms)


def dense_tile():
    """450 Gaussians in the first tile (more than one batch of 256), 250 over the rest."""
    camera = make_camera(48, 35)
    scene = cloud(31, 250, camera, degree=1, opacity=(0.02, 0.4))
    rng = np.random.default_rng(32)
    z = distinct_depths(rng, 450, 1, 1.9)
    pixels = rng.uniform(1, 15, (450, 2))
    scales = rng.uniform(0.3, 1.5, (450, 3)) / camera.fx * z[:, None]
    tile = pack(at_pixels(pixels, z, camera), scales, rng.uniform(0.02, 0.2, 450), colors(rng, 450, 1), camera, rng)
    return join(scene, tile)


def empty():
    """No Gaussian at all."""
    scene = cloud(0, 1, make_camera(20, 18), degree=1)
    return replace(scene, **{name: getattr(scene, name)[:0] for name in PARAMETERS})


def one_gaussian(device, mean, scale):
    """The five inputs of one that is round and light."""
    one = torch.ones(1, 1, device=device)
    quats = one * torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device)
    shapes = [one * torch.tensor([mean], device=device), quats, scale * one.expand(1, 3), 0.9 * one[0]]
    return [tensor.clone().requires_grad_() for tensor in (*shapes, one.expand(1, 1, 3))]


def _clouds(degree):
    return lambda: cloud(10 + degree, 120, make_camera(37, 29, seed=degree), degree=degree)


SCENES = {
    **{f"degree{degree}": _clouds(degree) for degree in range(4)},
    "off_center": lambda: cloud(1, 120, make_camera(50, 31, fx=60, fy=41, cx=38.3, cy=7.2, seed=5), degree=1),
    "principal_outside": lambda: cloud(2, 120, make_camera(40, 24, cx=-25.5, cy=44.2, seed=6), degree=1),
    "focal_ratio": lambda: cloud(3, 100, make_camera(45, 38, fx=33, fy=101, seed=7), degree=1, sigma=(0.5, 3)),
    "size_1x1": lambda: cloud(4, 30, make_camera(1, 1, fx=2), sigma=(0.5, 2), opacity=(0.05, 0.4)),
    "size_17x33": lambda: cloud(5, 100, make_camera(17, 33), frame=0.5),
    "size_50x31": lambda: cloud(6, 100, make_camera(50, 31), frame=0.5),
    "size_100x3": lambda: cloud(7, 100, make_camera(100, 3), frame=0.3),
    "near_and_behind": near_and_behind,
    "inside": inside,
    "opaque": lambda: cloud(8, 60, make_camera(40, 33), degree=1, sigma=(1, 4), opacity=(0.99, 1)),
    "saturated": lambda: cloud(9, 120, make_camera(36, 30), degree=1, sigma=(6, 20), opacity=(0.6, 0.95)),
    "layers_4000": lambda: cloud(
        14, 4000, make_camera(18, 13), z=(1, 9), sigma=(30, 60), aspect=0.5, opacity=(0.0042, 0.007), frame=0
    ),
    "needles": needles,
    "needles_long": lambda: needles(10),
    "pancakes": pancakes,
    "ties": ties,
    "subpixel": lambda: cloud(15, 300, make_camera(34, 30), degree=1, sigma=(0.001, 0.5)),
    "huge": huge,
    "opencv": lambda: through_lens(40, 150, OPENCV, (47, 35), 22.0, 75),
    "panorama": lambda: through_lens(42, 150, Lens("EQUIRECTANGULAR"), (60, 30), 30 / np.pi, 180, sigma=(0.6, 4.0)),
    "fisheye": lambda: through_lens(41, 200, FISHEYE, (45, 43), 13.0, 180),
    "faint": faint,
    "empty": empty,
    "single": lambda: cloud(16, 1, make_camera(21, 19), degree=3, sigma=(3, 4), opacity=(0.8, 0.9), frame=-0.4),
    "dense_tile": dense_tile,
    "quat_norms": quat_norms,
    "far_world": lambda: cloud(17, 100, make_camera(41, 34, seed=8, center=(1000.3, -900.7, 1100.2)), degree=1),
    "negative_color": lambda: cloud(18, 120, make_camera(39, 28), degree=1, low=-1.0, high=1.0, rest=0.4),
}


def scene_of(name):
    """By its name; "rolling ..." moves while its rows are read."""
    scene = SCENES[name.removeprefix("rolling ")]()
    return replace(scene, camera=replace(scene.camera, shutter=SHUTTER)) if "rolling" in name else scene


@torch.no_grad()
def culling(out, camera, alpha_min: float = oracle.ALPHA_MIN) -> tuple[torch.Tensor, torch.Tensor]:
    """Of a render of the oracle, by Gaussian: whether it is seen or nearly, and how far it reaches.

    [N] bool, the box around alpha >= ``alpha_min`` overlaps the image, or nearly; [N] px, the long half axis of the
    ellipse where alpha is that, 0 where there is none.
    """
    splats, count, least = out.splats, len(out.means2d), max(alpha_min, FAINTEST)
    level = 2 * torch.log((splats.opacity / least).clamp_min(1))  # d' conic d on the edge of the ellipse
    half = (level[:, None] * torch.diagonal(splats.cov2d, dim1=1, dim2=2)).sqrt() + 0.01
    low, high = splats.means2d - half, splats.means2d + half
    size = splats.means2d.new_tensor([camera.width, camera.height])
    inside = ((high > 0) & (low < size)).all(1) & splats.live & (splats.opacity > least * (1 - oracle.BAND))
    reach = (level * torch.linalg.eigvalsh(splats.cov2d)[:, 1]).sqrt() * splats.live
    copies = 3 if len(inside) > count else 1
    return inside.reshape(copies, count).any(0), reach[:count]

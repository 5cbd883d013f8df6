"""A slow renderer in plain torch whose every rule can be broken: what an audit has to find out."""

import os
import threading
import time
from dataclasses import dataclass

import torch

from warp_splat.audit.probes import decoded_srgb, srgb
from warp_splat.compare import oracle


@dataclass(frozen=True)
class Wrong:
    """Rules; the defaults are right."""

    alpha_min: float = 1 / 255
    alpha_max: float = 0.99
    t_min: float = 1e-4
    near: float = 0.2
    blur: float = 0.3
    antialiasing: bool = False
    extent: float = 0.0  # standard deviations, 0: as far as alpha reaches
    rotation: str = "wxyz"
    flipped: tuple = ()  # coefficients of the other sign
    swapped: tuple = ()  # two coefficients that change places
    order: str = "depth"
    space: str = "as is"
    background: str = "asked"
    shift: float = 0.0
    projection: str = "affine"
    rounded: bool = False  # to 8 bits after each Gaussian, from the farthest on


def draw(rules, means, quats, scales, opacities, sh, camera, background):
    means, quats, scales, opacities, sh = (each.double() for each in (means, quats, scales, opacities, sh))
    quats = {"wxyz": quats, "xyzw": quats[:, [3, 0, 1, 2]], "inverse": quats * torch.tensor([1, -1, -1, -1])}[
        rules.rotation
    ]
    sh = sh.clone()
    for k in rules.flipped:
        sh[:, k : k + 1] *= -1
    if rules.swapped and max(rules.swapped) < sh.shape[1]:
        sh[:, list(rules.swapped)] = sh[:, list(rules.swapped)[::-1]]
    view = {"antialiasing": rules.antialiasing, "near": rules.near, "blur": rules.blur}
    view["projection"] = rules.projection
    splats = oracle.exact_splats(means, quats, scales, opacities, sh, camera, **view)
    key = {
        "depth": splats.z,
        "distance": (means - torch.tensor(camera.center)).norm(dim=1),
        "reversed": -splats.z,
        "file": torch.arange(len(means)),
    }[rules.order]
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    image, through = torch.zeros(camera.height, camera.width, 3).double(), torch.ones(x.shape).double()
    layers = []
    going = torch.ones_like(through, dtype=torch.bool)
    colors = from_torch(decoded_srgb, splats.color) if rules.space in ("decoded", "linear") else splats.color
    for i in torch.argsort(key, stable=True).tolist():
        if not splats.live[i]:
            continue
        away = torch.stack([x, y], -1) - splats.means2d[i] - rules.shift
        power = (away @ torch.linalg.inv(splats.cov2d[i]) * away).sum(-1)
        alpha = (splats.opacity[i] * torch.exp(-0.5 * power)).clamp_max(rules.alpha_max)
        used = (alpha >= rules.alpha_min) & going
        if rules.extent:
            used = used & (power <= rules.extent**2)
        alpha = torch.where(used, alpha, 0.0)
        after = through * (1 - alpha)
        going = going & ~(used & (after < rules.t_min))
        alpha = torch.where(going, alpha, 0.0)
        layers.append((alpha[..., None], colors[i]))
        image = image + (through * alpha)[..., None] * colors[i]
        through = through * (1 - alpha)
    behind = {"asked": background.double(), "black": torch.zeros(3), "white": torch.ones(3)}[rules.background]
    image = image + through[..., None] * behind
    if rules.rounded:
        image = behind.expand(image.shape)
        for alpha, color in reversed(layers):
            image = (255 * (alpha * color + (1 - alpha) * image)).round() / 255
    return from_torch(srgb, image) if rules.space in ("encoded", "linear") else image


def from_torch(curve, tensor):
    return torch.from_numpy(curve(tensor.detach().numpy()))


def right(*given):
    return draw(Wrong(), *given)


def eight_bit(*given):
    return (right(*given).clamp(0, 1) * 255).round().to(torch.uint8)


def hangs(*given):
    time.sleep(1000)


def crashes(*given):
    os._exit(7)


def draws_nothing(means, quats, scales, opacities, sh, camera, background):
    return background.expand(camera.height, camera.width, 3)


def ends_early(*given):
    raise EOFError("no data left")


def dies_later(means, quats, scales, opacities, sh, camera, background):
    """After its answer."""
    threading.Timer(0.05, os._exit, [7]).start()
    return torch.zeros((camera.height, camera.width, 3))


def counts(means, quats, scales, opacities, sh, camera, background):
    """Whole numbers, of which nobody knows whether 1 or 255 is white."""
    return torch.zeros((camera.height, camera.width, 3), dtype=torch.int64)

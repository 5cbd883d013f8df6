"""Extremes outside the pixel loop: SSIM, Adam, and more tile instances than fit."""

import re
from functools import partial

import torch

from warp_splat.compare.scenes import cloud, look, tensors
from warp_splat.compare.stability import verdict as check
from warp_splat.compare.stability.verdict import GRADIENT_LIMIT, Case, Outcome, bounded, relative_error
from warp_splat.config import TILE, RasterOptions
from warp_splat.errors import InputError
from warp_splat.gaussians import GaussianModel
from warp_splat.raster.api import rasterize
from warp_splat.raster.bin import MAX_INSTANCES
from warp_splat.training.loss import image_loss
from warp_splat.training.optimizer import EPS as ADAM_EPS
from warp_splat.training.optimizer import Optimizer
from warp_splat.training.options import LearnOptions

STEPS = 5  # of Adam
LOSS_LIMIT = 1e-5  # variances are differences of squares, 4 eps / 4 off where images are 1/2; over C2, times 0.2
SIDE = 65_536  # px, of an image whose tiles are too many


def exact_loss(image: torch.Tensor, target: torch.Tensor, share: float = 0.2) -> torch.Tensor:
    """(1 - share) L1 + share (1 - SSIM) of images [H, W, 3] (Wang et al. 2004; 11 x 11, sigma 1.5, zeros outside)."""
    x, y = (picture.permute(2, 0, 1)[:, None] for picture in (image, target))
    bell = torch.exp(-((torch.arange(11, dtype=image.dtype) - 5) ** 2) / (2 * 1.5**2))
    window = (torch.outer(bell, bell) / bell.sum() ** 2)[None, None]

    def mean(picture: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.conv2d(picture, window, padding=5)

    mean_x, mean_y = mean(x), mean(y)
    variances, covariance = mean(x * x) + mean(y * y) - mean_x**2 - mean_y**2, mean(x * y) - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    ssim = (2 * mean_x * mean_y + c1) * (2 * covariance + c2) / ((mean_x**2 + mean_y**2 + c1) * (variances + c2))
    return (1 - share) * (x - y).abs().mean() + share * (1 - ssim.mean())


def loss(scale: float, noise: float, _mode: str) -> Outcome:
    """Value and gradient of the training loss on ``scale`` times (a constant, plus ``noise`` of the image)."""
    generator = torch.Generator().manual_seed(3)
    image, target = (scale * (level + noise * torch.rand(32, 40, 3, generator=generator)) for level in (0.4, 0.5))
    leaf, exact = image.clone().requires_grad_(), image.double().requires_grad_()
    value, truth = image_loss(leaf, target), exact_loss(exact, target.double())
    value.backward()
    truth.backward()
    assert leaf.grad is not None and exact.grad is not None
    value_error = abs(value.item() - truth.item()) / max(1.0, truth.item())
    gradient_error = relative_error(leaf.grad, exact.grad, exact.grad.norm().item())
    says = f"loss {truth.item():.6g}, gradient to {exact.grad.abs().max().item():.1e}"
    outcome = bounded(says, "loss", value_error, LOSS_LIMIT)
    failures = outcome.failures + bounded(says, "gradient", gradient_error, GRADIENT_LIMIT).failures
    failures += () if value.isfinite().all() and leaf.grad.isfinite().all() else ("not finite",)
    return outcome._replace(gradient_error=gradient_error, gradient_limit=GRADIENT_LIMIT, failures=failures)


def exact_adam(gradient: float, rate: float, sparse: bool) -> float:
    """Where a parameter of 0 stands after ``STEPS`` equal gradients (Kingma and Ba 2015), in float64.

    Without correction of the moments' bias if ``sparse``, as in the reference's sparse_adam.
    """
    value = first = second = 0.0
    for step in range(1, STEPS + 1):
        first = 0.9 * first + 0.1 * gradient
        second = 0.999 * second + 0.001 * gradient**2
        bias1, bias2 = (1.0, 1.0) if sparse else (1 - 0.9**step, 1 - 0.999**step)
        value -= rate * (first / bias1) / ((second / bias2) ** 0.5 + ADAM_EPS)
    return value


def adam(gradient: float, kind: str, _mode: str) -> Outcome:
    """Every parameter's way under equal gradients, against float64; no way where its square overflows."""
    count = 3
    shapes = {"means": (3,), "sh_dc": (1, 3), "sh_rest": (3, 3), "opacities": (), "scales": (3,), "quats": (4,)}
    model = GaussianModel({name: torch.zeros(count, *shape) for name, shape in shapes.items()})
    optimizer = Optimizer(model, LearnOptions(optimizer_type="default" if kind == "adam" else kind), 1.0)
    for _ in range(STEPS):
        for parameter in model.parameters.values():
            parameter.grad = torch.full_like(parameter, gradient)
        optimizer.step(torch.ones(count, dtype=torch.int32))
    overflows, sparse = 0.001 * gradient**2 > check.FLOAT_MAX, kind == "sparse_adam"
    found, exact, stuck = [], [], 0
    for table in optimizer.tables.values():
        found.append(table.leaf.detach().double().flatten() / table.rate)
        exact.append(torch.full_like(found[-1], 0.0 if overflows else exact_adam(gradient, 1.0, sparse)))
        stuck += int(table.moments[1].isinf().sum())
    says = f"moves by {exact_adam(gradient, 1.0, sparse):.3g} rates"
    error = relative_error(torch.cat(found), torch.cat(exact))
    return bounded(says, "steps", error, 1e-5, check.count_text(overflows=stuck))


def too_many_tiles(_mode: str) -> Outcome:
    """More tile instances than 32 bits number: refused with the numbers, before anything of that size is allocated."""
    camera = look(SIDE, SIDE)
    tiles = (SIDE // TILE) ** 2
    count = MAX_INSTANCES // tiles + 2
    gaussians = tensors(cloud(50, count, camera, sigma=(2.0 * SIDE, 3.0 * SIDE), opacity=(0.9, 1.0), aspect=0.9))
    sh = gaussians.pop("sh_dc"), gaussians.pop("sh_rest")
    says = f"{count} x {tiles} = {count * tiles} instances"
    try:
        rasterize(**gaussians, sh=sh, camera=camera, options=RasterOptions())
    except InputError as error:
        numbers = {int(number) for number in re.findall(r"\d+", str(error))}
        missing = {count, SIDE, count * tiles, MAX_INSTANCES} - numbers
        failures = (f"the message lacks {sorted(missing)}: {error}",) if missing else ()
        return Outcome(says, counted=f"instances {count * tiles}", failures=failures)
    return Outcome(says, failures=("not refused",))


LOSSES = {"constant": (1.0, 0.0), "1e-8": (1e-8, 1.0), "1e4": (1e4, 1.0), "1e4_constant": (1e4, 0.0)}  # scale, noise
GRADIENTS = dict.fromkeys((1e-20, 1e20), "as in float64")
GRADIENTS |= {1e30: "the second moment overflows: the parameter stays where it is"}
TABLE = {
    "loss": {f"loss_{name}": ("value and gradient as in float64", partial(loss, *of)) for name, of in LOSSES.items()},
    "optimizer": {
        f"{kind}_{gradient:g}": (claim, partial(adam, gradient, kind))
        for kind in ("adam", "sparse_adam")
        for gradient, claim in GRADIENTS.items()
    },
    "memory": {"instances_2^31": ("counted in 64 bits, refused with the numbers", too_many_tiles)},
}
CASES = tuple(Case(name, group, *case, False) for group, cases in TABLE.items() for name, case in cases.items())

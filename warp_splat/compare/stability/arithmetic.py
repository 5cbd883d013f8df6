"""Extremes outside the pixel loop: the determinant of needles, SSIM, Adam, and more tile instances than fit."""

from __future__ import annotations

import functools
import re
from fractions import Fraction
from functools import partial

import numpy as np
import torch

from warp_splat.compare.scenes import cloud, look, tensors
from warp_splat.compare.stability import verdict as check
from warp_splat.compare.stability.verdict import EPS, GRADIENT_LIMIT, Case, Outcome, relative_error
from warp_splat.config import ALPHA_MAX, BLUR, TILE, RasterOptions
from warp_splat.errors import InputError
from warp_splat.gaussians import GaussianModel
from warp_splat.raster.api import rasterize
from warp_splat.raster.bin import MAX_INSTANCES
from warp_splat.training.loss import image_loss
from warp_splat.training.optimizer import EPS as ADAM_EPS
from warp_splat.training.optimizer import Optimizer
from warp_splat.training.options import LearnOptions

RATIOS = tuple(10.0**power for power in np.arange(0, 8.5, 0.5))
SHORT = 0.1  # px, short axis
ANGLES = 37  # of the needle in the image, and as many to it
STEPS = 5  # of Adam
LOSS_LIMIT = 1e-5  # variances are differences of squares, 4 eps / 4 off where images are 1/2; over C2, times 0.2
SIDE = 65_536  # px, of an image whose tiles are too many


def needle_rows(ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows a1, a2 [A, 3] (float32, px) of J W R S for a needle at every angle in and to the image."""
    angle, tilt = np.meshgrid(np.linspace(0, np.pi, ANGLES), np.radians(np.linspace(0, 89, ANGLES)))
    c, s, up, out = np.cos(angle), np.sin(angle), np.cos(tilt), np.sin(tilt)
    scales = SHORT * np.array([ratio, 1.0, 1.0])
    a1 = np.stack([up * c, -s, -out * c], -1).reshape(-1, 3) * scales
    a2 = np.stack([up * s, c, -out * s], -1).reshape(-1, 3) * scales
    return a1.astype(np.float32), a2.astype(np.float32)


def usual_determinant(a1: np.ndarray, a2: np.ndarray) -> np.ndarray:
    """(a1.a1 + e) (a2.a2 + e) - (a1.a2)^2 in the precision of its arguments [A, 3], px^4."""
    blur = a1.dtype.type(BLUR)
    xx, yy, xy = (np.sum(left * right, -1, dtype=a1.dtype) for left, right in ((a1, a1), (a2, a2), (a1, a2)))
    return (xx + blur) * (yy + blur) - xy * xy


def our_determinant(a1: np.ndarray, a2: np.ndarray) -> np.ndarray:
    """|a1 x a2|^2 + e (|a1|^2 + |a2|^2) + e^2, as ``kernels.project`` computes it, px^4."""
    blur = a1.dtype.type(BLUR)
    area = np.cross(a1, a2)
    sharp, xx, yy = (np.sum(row * row, -1, dtype=a1.dtype) for row in (area, a1, a2))
    return sharp + blur * (xx + yy) + blur * blur


def exact_determinant(a1: np.ndarray, a2: np.ndarray) -> list[Fraction]:
    """The same by the usual formula in rational numbers: no rounding at all."""
    blur = Fraction(float(np.float32(BLUR)))

    def dot(left, right) -> Fraction:
        return sum((Fraction(float(x)) * Fraction(float(y)) for x, y in zip(left, right, strict=True)), Fraction(0))

    return [
        (dot(left, left) + blur) * (dot(right, right) + blur) - dot(left, right) ** 2
        for left, right in zip(a1, a2, strict=True)
    ]


@functools.cache
def determinant_errors() -> dict[str, list[float]]:
    """Largest relative error over all angles for each of ``RATIOS``, by formula, in float32."""
    errors: dict[str, list[float]] = {"usual": [], "ours": []}
    for ratio in RATIOS:
        rows = needle_rows(ratio)
        exact = exact_determinant(*rows)
        for name, formula in (("usual", usual_determinant), ("ours", our_determinant)):
            found = [Fraction(float(value)) for value in formula(*rows)]
            errors[name].append(max(float(abs(value / truth - 1)) for value, truth in zip(found, exact, strict=True)))
    return errors


@functools.cache
def recovery_error(layers: int) -> float:
    """|T - 1| after a chain of ``layers`` and its inverse, by the pieces of the kernels in float32 on 64 pixels.

    Opacities are random and small enough that T falls to about 0.01.
    """
    rng, one = np.random.default_rng(layers), np.float32(1.0)
    alphas = rng.uniform(0.0, 9.0 / layers, (layers, 64)).clip(0.0, ALPHA_MAX).astype(np.float32)
    t = np.ones(64, dtype=np.float32)
    for alpha in alphas:
        t = t - alpha * t
    for alpha in alphas[::-1]:
        t = t + t * (alpha / (one - alpha))
    return float(np.abs(t - one).max())


def recovery(layers: int, _mode: str) -> Outcome:
    """T recovered by division through the whole chain; rounding may grow like n eps, two roundings a step each way."""
    error, limit = recovery_error(layers), 4 * layers * EPS
    failures = () if error < limit else (f"T off by {error:.1e} > {limit:.1e}",)
    return Outcome("T = 1 in front of all", error, limit, None, 0.0, "-", failures)


def determinant(_mode: str) -> Outcome:
    """Ours has a few roundings of error at every angle and ratio, where the usual formula has no digit left."""
    errors = determinant_errors()
    ours, usual, limit = max(errors["ours"]), max(errors["usual"]), 16 * EPS
    failures = () if ours < limit else (f"determinant off by {ours:.1e} > {limit:.1e}",)
    return Outcome(f"usual formula off by {usual:.0e}", ours, limit, None, 0.0, "-", failures)


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
    base = torch.ones(32, 40, 3)
    image, target = (
        scale * (level * base + noise * torch.rand(base.shape, generator=generator)) for level in (0.4, 0.5)
    )
    leaf, exact = image.clone().requires_grad_(), image.double().requires_grad_()
    value, truth = image_loss(leaf, target), exact_loss(exact, target.double())
    value.backward()
    truth.backward()
    assert leaf.grad is not None and exact.grad is not None
    value_error = abs(value.item() - truth.item()) / max(1.0, truth.item())
    gradient_error = relative_error(leaf.grad, exact.grad, exact.grad.norm().item())
    failures = []
    if not (value.isfinite().all() and leaf.grad.isfinite().all()):
        failures.append("not finite")
    if not value_error < LOSS_LIMIT:
        failures.append(f"loss off by {value_error:.1e} > {LOSS_LIMIT:.1e}")
    if not gradient_error < GRADIENT_LIMIT:
        failures.append(f"gradient off by {gradient_error:.1e} > {GRADIENT_LIMIT:.1e}")
    says = f"loss {truth.item():.6g}, gradient to {exact.grad.abs().max().item():.1e}"
    return Outcome(says, value_error, LOSS_LIMIT, gradient_error, GRADIENT_LIMIT, "-", tuple(failures))


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
    error, limit = relative_error(torch.cat(found), torch.cat(exact)), 1e-5
    failures = () if error < limit else (f"steps off by {error:.1e} > {limit:.1e}",)
    says = f"moves by {exact_adam(gradient, 1.0, sparse):.3g} rates"
    return Outcome(says, error, limit, None, 0.0, check.count_text(overflows=stuck), failures)


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
        return Outcome(says, 0.0, 0.0, None, 0.0, f"instances {count * tiles}", failures)
    return Outcome(says, 0.0, 0.0, None, 0.0, "-", ("not refused",))


CASES = (
    *(
        Case(f"recovery_{layers}", "numbers", "T back at 1 within 4 n eps", partial(recovery, layers), False)
        for layers in (100, 1_000, 10_000, 100_000)
    ),
    Case("determinant", "numbers", "needles to 1e8 at every angle: error below 16 eps in float32", determinant, False),
    *(
        Case(name, "loss", "value and gradient as in float64", partial(loss, scale, noise), False)
        for name, scale, noise in (
            ("loss_constant", 1.0, 0.0),
            ("loss_1e-8", 1e-8, 1.0),
            ("loss_1e4", 1e4, 1.0),
            ("loss_1e4_constant", 1e4, 0.0),
        )
    ),
    *(
        Case(f"{kind}_{gradient:g}", "optimizer", claim, partial(adam, gradient, kind), False)
        for kind in ("adam", "sparse_adam")
        for gradient, claim in (
            (1e-20, "as in float64"),
            (1e20, "as in float64"),
            (1e30, "the second moment overflows: the parameter stays where it is"),
        )
    ),
    Case("instances_2^31", "memory", "counted in 64 bits, refused with the numbers", too_many_tiles, False),
)

"""Extremes outside the pixel loop: the determinant of needles, SSIM, Adam, and more tile instances than fit."""

import functools
import re
from dataclasses import replace
from fractions import Fraction
from functools import partial

import numpy as np
import torch

from warp_splat.compare.scenes import cloud, look, tensors
from warp_splat.compare.stability import verdict as check
from warp_splat.compare.stability.verdict import EPS, GRADIENT_LIMIT, Case, Outcome, bounded, relative_error
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
RATIONAL = np.frompyfunc(lambda number: Fraction(float(number)), 1, 1)  # of an array
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
    blur = RATIONAL(np.float32(BLUR)) if a1.dtype == object else a1.dtype.type(BLUR)
    xx, yy, xy = (np.sum(left * right, -1, dtype=a1.dtype) for left, right in ((a1, a1), (a2, a2), (a1, a2)))
    return (xx + blur) * (yy + blur) - xy * xy


def our_determinant(a1: np.ndarray, a2: np.ndarray) -> np.ndarray:
    """|a1 x a2|^2 + e (|a1|^2 + |a2|^2) + e^2, as ``kernels.project`` computes it, px^4."""
    blur = a1.dtype.type(BLUR)
    area = np.cross(a1, a2)
    sharp, xx, yy = (np.sum(row * row, -1, dtype=a1.dtype) for row in (area, a1, a2))
    return sharp + blur * (xx + yy) + blur * blur


def exact_determinant(a1: np.ndarray, a2: np.ndarray) -> np.ndarray:
    """The same by the usual formula in rational numbers: no rounding at all."""
    return usual_determinant(RATIONAL(a1), RATIONAL(a2))


@functools.cache
def determinant_errors() -> dict[str, list[float]]:
    """Largest relative error over all angles for each of ``RATIOS``, by formula, in float32."""
    errors: dict[str, list[float]] = {"usual": [], "ours": []}
    for ratio in RATIOS:
        rows = needle_rows(ratio)
        exact = exact_determinant(*rows)
        for name, formula in (("usual", usual_determinant), ("ours", our_determinant)):
            found = formula(*rows).astype(np.float64)
            errors[name].append(max(float(abs(Fraction(v) / truth - 1)) for v, truth in zip(found, exact, strict=True)))
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
    return bounded("T = 1 in front of all", "T", recovery_error(layers), 4 * layers * EPS)


def determinant(_mode: str) -> Outcome:
    """Ours has a few roundings of error at every angle and ratio, where the usual formula has no digit left."""
    ours, usual = (max(determinant_errors()[name]) for name in ("ours", "usual"))
    return bounded(f"usual formula off by {usual:.0e}", "determinant", ours, 16 * EPS)


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
    says = f"loss {truth.item():.6g}, gradient to {exact.grad.abs().max().item():.1e}"
    outcome = bounded(says, "loss", value_error, LOSS_LIMIT)
    failures = outcome.failures + bounded(says, "gradient", gradient_error, GRADIENT_LIMIT).failures
    failures += () if value.isfinite().all() and leaf.grad.isfinite().all() else ("not finite",)
    return replace(outcome, gradient_error=gradient_error, gradient_limit=GRADIENT_LIMIT, failures=failures)


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
GRADIENTS = {
    1e-20: "as in float64",
    1e20: "as in float64",
    1e30: "the second moment overflows: the parameter stays where it is",
}
TABLE = {
    "numbers": {
        **{
            f"recovery_{layers}": ("T back at 1 within 4 n eps", partial(recovery, layers))
            for layers in (100, 1_000, 10_000, 100_000)
        },
        "determinant": ("needles to 1e8 at every angle: error below 16 eps in float32", determinant),
    },
    "loss": {f"loss_{name}": ("value and gradient as in float64", partial(loss, *of)) for name, of in LOSSES.items()},
    "optimizer": {
        f"{kind}_{gradient:g}": (claim, partial(adam, gradient, kind))
        for kind in ("adam", "sparse_adam")
        for gradient, claim in GRADIENTS.items()
    },
    "memory": {"instances_2^31": ("counted in 64 bits, refused with the numbers", too_many_tiles)},
}
CASES = tuple(Case(name, group, *case, False) for group, cases in TABLE.items() for name, case in cases.items())

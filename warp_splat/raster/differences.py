"""Finite differences of the loss along a direction, and the gradient of the same loss: what check_gradients compares.

The loss L is the sum of image, alpha and depth times fixed normal weights, in float64; I is one pixel of them. For a
random direction, central differences and their extrapolation (Richardson 1911) stand against gradient times direction:

    D(h) = (L(h) - L(-h)) / 2h,   R = (4 D(h/2) - D(h)) / 3

Decisions (alpha_min, t_min, depth order, culling, clamps) make jumps and kinks. Where I is smooth,

    odd  = I(h) - I(-h) - 2 (I(h/2) - I(-h/2)) = O(h^3)
    even = I(h) + I(-h) - 4 (I(h/2) + I(-h/2)) + 6 I(0) = O(h^4)

while a jump enters at least one of them whole. A pixel where either is far above its median, or far above rounding,
leaves the loss, in the differences as in the gradient. That looks at images only, so it hides no wrong gradient. What
D(h) and D(h/2) differ by, sqrt(sum odd^2) / 2h on average over the weights, holds rounding, curvature and the jumps
that were not found. Twice that is the uncertainty of R; the step is the one where it is least.

Steps are rounded so that value + step is exact in float32: a mean far from the origin has no room for small ones.
An intermediate is moved alone, with the tile lists built anew: its differences see binning and blend, not projection.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.raster.api import RenderOutput, render
from warp_splat.raster.camera_parameters import CameraParameters
from warp_splat.raster.camera_parts import INTRINSICS, natural_size, parts_of, put_together
from warp_splat.raster.data import Gaussians, Splats2D
from warp_splat.raster.project import project

SHAPES = ("means", "quats", "scales", "opacities")
INPUTS = (*SHAPES, "sh", "background")
INTERMEDIATES = ("means2d", "conics", "opacities2d", "colors", "depths")
LEAST = 2.0**-14  # the smallest step, relative to a parameter's natural size
RUNGS = range(1, 10)  # steps h tried: LEAST times 2^rung
ROUNDING = 2.0**-23  # float32, the last place of 1
CUT = 8.0  # times the median (or rounding, if that is more), above which a pixel is not smooth
JUMP = 100 * ROUNDING  # nor above this, lest the median is one of jumps
SHARES = (1.0, 1 / 8, 1 / 64, 1 / 512)  # of the Gaussians that move in a direction
LONE = 8  # Gaussians at least


@dataclass(frozen=True)
class Quotient:
    """Finite differences of the loss along one direction from one pair of steps, h and h / 2."""

    rung: int
    value: float
    uncertainty: float
    kept: torch.Tensor  # [H, W] bool, pixels in the loss
    pixels: float  # their share of the pixels that move
    rank: float  # the less the better


@dataclass(frozen=True)
class Trial:
    """A direction, the best quotient along it, and the gradient of the same loss."""

    step: torch.Tensor  # shaped like the parameter: what it moves by at LEAST
    quotient: Quotient
    gradient: torch.Tensor
    analytic: float  # gradient times direction

    @property
    def gap(self) -> float:
        """How far gradient and differences are apart; never NaN."""
        return min(math.inf, abs(self.analytic - self.quotient.value))  # in this order, by which NaN is not less


def inputs_of(camera: Camera | CameraParameters) -> tuple[str, ...]:
    """The names of what is given: of the Gaussians, and of a camera that learns; a panorama's intrinsics are fixed."""
    around = isinstance(camera, CameraParameters) and camera.base.lens and camera.base.lens.family.around
    return *INPUTS, *(name for name in parts_of(camera) if not (around and name in INTRINSICS))


class MovableScene:
    """The scene rendered once with gradients, and again with one parameter moved."""

    def __init__(
        self,
        gaussians: Gaussians,
        background: torch.Tensor,
        camera: Camera | CameraParameters,
        options: RasterOptions,
        adjoint: str,
        seed: int,
    ):
        self.options, self.adjoint = options, adjoint
        values = {name: getattr(gaussians, name) for name in (*SHAPES, "sh")} | {"background": background}
        self.camera = camera.base if isinstance(camera, CameraParameters) else camera
        values |= parts_of(camera)
        self.inputs = {name: value.detach().clone().requires_grad_() for name, value in values.items()}
        with torch.enable_grad():
            self.out = self._render(self.inputs)
            # rounding of alpha is divided by alpha in the expected depth: times alpha, all channels round alike
            deepest = self.out.depths.detach().max() if len(self.out.depths) else 1.0
            self.depth_weight = (self.out.alpha / deepest).detach()
            self.picture = self._stack(self.out)
        with torch.no_grad():
            self.splats = project(_gaussians(self.inputs), put_together(self.camera, self.inputs), options)
        self.generator = torch.Generator().manual_seed(seed)
        random = torch.randn(self.picture.shape, generator=self.generator, dtype=torch.float32, device="cpu")
        self.weights = random.to(self.picture.device)

    def tensor(self, name: str) -> torch.Tensor:
        """The parameter in the graph of ``picture``."""
        return self.inputs[name] if name in self.inputs else getattr(self.out, name)

    def gradient(self, name: str, kept: torch.Tensor) -> torch.Tensor:
        """Of the loss over the pixels ``kept`` [H, W], float64, shaped like the parameter."""
        upstream = self.weights * kept[..., None]
        keep = {"retain_graph": True, "materialize_grads": True}
        return torch.autograd.grad(self.picture, self.tensor(name), upstream, **keep)[0].double()

    @torch.no_grad()
    def draw(self, name: str, step: torch.Tensor) -> torch.Tensor:
        """The picture, [H, W, C] float64, with ``step`` added to a parameter."""
        moved = self.tensor(name) + step
        if name in self.inputs:
            return self._stack(self._render(self.inputs | {name: moved})).double()
        key = "opacities" if name == "opacities2d" else name
        extents = (self.splats.extents * _growth(self, name, step)).float()
        return self._stack(self._render(self.inputs, self.splats._replace(extents=extents, **{key: moved}))).double()

    def _render(self, inputs: dict[str, torch.Tensor], splats: Splats2D | None = None) -> RenderOutput:
        given = _gaussians(inputs), put_together(self.camera, inputs), inputs["background"]
        return render(*given, self.options, self.adjoint, splats=splats)

    def _stack(self, out: RenderOutput) -> torch.Tensor:
        """[H, W, 4 or 5], all of about the same size."""
        channels = [out.image, out.alpha[..., None]]
        return torch.cat(channels if out.depth is None else [*channels, (out.depth * self.depth_weight)[..., None]], 2)


def _gaussians(inputs: dict[str, torch.Tensor]) -> Gaussians:
    """As the renderer takes them."""
    sh = inputs["sh"]
    return Gaussians(*(inputs[name] for name in SHAPES), sh_dc=sh[:, :1], sh_rest=sh[:, 1:])


def _growth(scene: MovableScene, name: str, step: torch.Tensor) -> torch.Tensor:
    """By how much the boxes where alpha >= alpha_min grow with ``step``, [N, 2] or 1.

    They belong to conics and opacities, and the blend reads the last entry of the conic's root from their height. The
    determinant's growth comes from det(I + covariance step): the entries of a needle's conic cancel in the determinant.
    """
    if name not in ("conics", "opacities2d"):
        return step.new_ones(1)
    least = max(scene.options.alpha_min, 1e-37)
    opacities = scene.out.opacities2d.double()
    reach = (2 * (opacities / least).log()).clamp_min(1e-6)
    if name == "opacities2d":
        return ((2 * ((opacities + step) / least).log()).clamp_min(1e-6) / reach).sqrt()[:, None]
    xx, xy, yy = scene.out.conics.double().unbind(1)
    dxx, dxy, dyy = step.double().unbind(1)
    cov_xx, cov_yy = (scene.splats.extents.double() ** 2 / reach[:, None]).unbind(1)
    cov_xy = -xy * cov_yy / xx
    trace = cov_xx * dxx + 2 * cov_xy * dxy + cov_yy * dyy
    det = (1 + trace + cov_yy / xx * (dxx * dyy - dxy**2)).clamp_min(1e-3)
    return (torch.stack([1 + dyy / yy, 1 + dxx / xx], 1) / det[:, None]).clamp_min(1e-3).sqrt()


def _natural(scene: MovableScene, name: str) -> torch.Tensor | float:
    """The size of a large step of each value, broadcasts to the parameter's shape."""
    value = scene.tensor(name)
    if name in ("scales", "opacities", "opacities2d"):
        return value
    if name == "quats":
        return value.norm(dim=1, keepdim=True)
    if name == "sh":
        return float(value.square().mean().sqrt()) or 1.0
    pixel = scene.out.depths / scene.camera.fx  # at the Gaussian, world units
    if name not in (*INPUTS, *INTERMEDIATES):
        return natural_size(scene.camera, name, float(pixel[pixel > 0].median()) if (pixel > 0).any() else 1.0)
    if name == "means":  # the short axis, which is no less than half a pixel wide on the image
        return torch.hypot(scene.inputs["scales"].amin(1), 0.5 * pixel)[:, None]
    xx, xy, yy = scene.out.conics.unbind(1)
    short = (0.5 * (xx + yy + torch.hypot(xx - yy, 2 * xy))).clamp_min(1e-10).rsqrt()  # px
    if name == "means2d":
        return short[:, None]
    return short * pixel if name == "depths" else 16.0  # colors and background: linear, so that any step is small


@torch.no_grad()
def _random_step(scene: MovableScene, name: str, share: float) -> torch.Tensor:
    """The step at LEAST: random signs times the natural size, such that value + step is exact.

    Only a ``share`` of the rows moves.
    """
    value = scene.tensor(name)
    signs = 2.0 * torch.randint(0, 2, value.shape, generator=scene.generator, device="cpu").to(value) - 1
    if name == "conics":  # root' signs root: the ellipse changes by the same share along either axis
        xx, xy, yy = value.double().unbind(1)
        a = xx.sqrt()
        b = xy / a
        c = (yy - b * b).clamp_min(0).sqrt()
        s, t, u = signs.unbind(1)
        wanted = torch.stack([a * a * s, a * b * s + a * c * t, b * b * s + 2 * b * c * t + c * c * u], 1)
    else:
        wanted = signs * _natural(scene, name)
    place = torch.nextafter(value.abs(), value.new_tensor(math.inf)) - value.abs()  # the last one
    step = wanted.sign() * torch.maximum(LEAST * wanted.abs(), 4 * place)
    step = torch.nan_to_num((value + step.float()) - value)
    if share < 1:
        drawn = torch.rand(len(step), generator=scene.generator, dtype=torch.float32, device="cpu")
        step[(drawn >= share).to(step.device)] = 0
    return step


def _is_smooth(differences: torch.Tensor, largest: float) -> torch.Tensor:
    """[H, W] bool: pixels that are not far above the median of those that are reached."""
    size = differences.abs().amax(2) / largest
    reached = size[size > 0]
    return size <= min(CUT * max(float(reached.median()) if len(reached) else 0.0, ROUNDING), JUMP)


def _extrapolate(scene: MovableScene, rung: int, far: tuple, near: tuple) -> Quotient:
    """From the pictures moved by +h and -h, and those moved by half of it (see the module's docstring)."""
    (plus, minus), (near_plus, near_minus) = far, near
    base = scene.picture.detach().double()
    largest, h = max(float(base.abs().max()), 1.0), LEAST * 2.0**rung
    odd = (plus - minus) - 2 * (near_plus - near_minus)
    kept = _is_smooth(odd, largest) & _is_smooth((plus + minus) - 4 * (near_plus + near_minus) + 6 * base, largest)
    moved = ((plus != base) | (minus != base)).any(2)
    pixels = int((kept & moved).sum()) / int(moved.sum()) if moved.any() else 1.0
    spread, quotient = odd[kept] / (2 * h), (near_plus - near_minus)[kept] / h
    value = float(((quotient - spread / 3) * scene.weights[kept]).sum())
    rounded = max(int((kept & moved).sum()), 1)
    uncertainty = 2 * math.hypot(float(spread.norm()), ROUNDING * largest * math.sqrt(rounded) / (2 * h))
    size = float(quotient.norm())
    rank = (uncertainty / size if size else 1.0) / pixels if pixels else math.inf
    return Quotient(rung, value, uncertainty, kept, pixels, rank)


def try_direction(scene: MovableScene, name: str, step: torch.Tensor, rungs: Sequence[int]) -> Trial:
    """Gradient against differences along ``step``, with the best of ``rungs``, which follow each other."""
    sizes = (2.0**rung for rung in range(rungs[0] - 1, rungs[-1] + 1))
    pairs = (tuple(scene.draw(name, sign * size * step) for sign in (1, -1)) for size in sizes)
    steps = zip(rungs, itertools.pairwise(pairs), strict=True)
    quotients = [_extrapolate(scene, rung, far, near) for rung, (near, far) in steps]
    best = min(quotients, key=lambda quotient: quotient.rank)
    gradient = scene.gradient(name, best.kept)
    return Trial(step, best, gradient, float((gradient * step).sum()) / LEAST)


def try_directions(scene: MovableScene, name: str, count: int, tolerance: float) -> list[Trial]:
    """``count`` random directions; the first finds the step, relative to the natural size, for all.

    Where many layers lie over each other, every pixel meets a jump before the differences rise above rounding. Then
    a share of the Gaussians moves: the fewer, the larger their steps may be.
    """
    rows = len(scene.tensor(name))
    firsts = {}
    for share in [share for share in SHARES if share == 1 or share * rows >= LONE]:
        firsts[share] = try_direction(scene, name, _random_step(scene, name, share), RUNGS)
        if firsts[share].quotient.rank < tolerance:
            break
    share, first = min(firsts.items(), key=lambda item: item[1].quotient.rank)
    rungs = (first.quotient.rung,)
    return [first, *(try_direction(scene, name, _random_step(scene, name, share), rungs) for _ in range(count - 1))]

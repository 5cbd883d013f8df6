"""Growth as a Markov chain that samples the scene (Kheradmand et al. 2024): for scenes without points, above all.

Faint Gaussians move at random (stochastic gradient Langevin dynamics), dead ones go to where others are, and prices on
opacity and size let what is not needed die. Index logic, no kernels. The numbers of the paper: section 4, and its
supplement. Prices are on means over the Gaussians, not on sums, so that they do not depend on their number.
"""

import math
from decimal import Decimal

import numpy as np
import torch

from warp_splat.formats.checkpoint import Checkpoint
from warp_splat.gaussians import activate, logarithm
from warp_splat.raster.data import Gaussians
from warp_splat.raster.drivers import driver_of
from warp_splat.runtime.sums import in_pairs
from warp_splat.training.growth import ReferenceOptions, check_budget
from warp_splat.training.growth.reference import LEVELS, PRUNE_OPACITY, normals, rotate, survivors
from warp_splat.training.optimizer import Optimizer
from warp_splat.training.seams import Change, Setting

NOISE = 5e5  # times the means' rate and the covariance
SHARPNESS = 100.0  # of the fall of the noise around the opacity at which a Gaussian is dead
STILL = 0.15  # opacity from which on the noise is below 1e-6 of the largest, and left out
PRICE_OPACITY, PRICE_SCALE = 0.01, 0.01  # in the loss
EXTENT = 4.0  # world units: about that of scenes from COLMAP, as the paper's; lengths of others count in its unit
GAIN = 0.05  # share by which the set grows at once
DRAWS = 2**53  # levels of a uniform random number
ROUNDS = 60  # of Newton's method for a root, from above: 1e-12 to the power 1 / n is found for every n
#: Places x > 0 and values exp(-x^2) of a trapezoid rule, by a function that rounds the same on every processor.
SPACING = 0.125
BELLS = [float((-((Decimal(SPACING) * place) ** 2)).exp()) for place in range(49)]


class Mcmc:
    """Up to ``--max_gaussians``, a twentieth more at each densification."""

    def __init__(self, options: ReferenceOptions, setting: Setting, optimizer: Optimizer):
        self.options, self.setting, self.optimizer = options, setting, optimizer
        self.model, self.processes, self.unit = setting.model, setting.processes, setting.scene.extent / EXTENT
        self.random = torch.Generator().manual_seed(setting.seed)
        check_budget("mcmc", setting.max_gaussians, self.processes.total(len(self.model)))

    def price(self, gaussians: Gaussians) -> torch.Tensor:
        """On opacity and on size (equation 14)."""
        opacities, scales = gaussians.opacities, gaussians.scales
        count = max(self.processes.total(len(self.model)), 1)
        price = PRICE_OPACITY * in_pairs(opacities.nan_to_num()) / count
        return price + PRICE_SCALE / self.unit * in_pairs(scales.nan_to_num().reshape(-1)) / (3 * count)

    @torch.no_grad()
    def after_step(self, iteration: int) -> None:
        """Move the means of faint Gaussians at random, by their covariances (equation 9)."""
        raw = self.model.parameters
        scales, opacities = activate(raw["scales"].detach(), raw["opacities"].detach())
        if driver_of(scales.device).peeks or self.processes.sharded:
            faint = (opacities < STILL).nonzero()[:, 0]
            drawn = normals()[self.processes.draw(self.random, LEVELS, [len(faint)])].to(scales)
        else:  # the host would wait for their number: a GPU draws for all, and their gates tell them apart
            faint, seed = slice(None), int(torch.randint(2**62, (), generator=self.random))
            random = torch.Generator(scales.device).manual_seed(seed)
            drawn = torch.randn(scales.shape, generator=random, device=scales.device)
        scales, quats, opacities = scales[faint], raw["quats"].detach()[faint], opacities[faint]
        gate = activate(scales, SHARPNESS * (PRUNE_OPACITY - opacities))[1] * (opacities < STILL)
        # the covariance R S S R' times a normal vector is R S S times another
        rate = NOISE * self.optimizer.tables["means"].rate / self.unit**2
        moved = rotate(quats, scales * scales * drawn) * (rate * gate)[:, None]
        means = raw["means"].detach()
        means[faint] = means[faint] + moved.nan_to_num(0.0, 0.0, 0.0)

    def update(self, iteration: int) -> Change | None:
        """Send dead Gaussians to live ones and add some, if it is time."""
        options, step = self.options, self.processes.images
        within = options.densify_from_iter < iteration < options.densify_until_iter
        if not within or iteration % options.densification_interval >= step:
            return None
        raw = {name: tensor.detach() for name, tensor in self.model.parameters.items()}
        keep = survivors(raw)
        kept, before = (self.processes.total(count) for count in (int(keep.sum()), len(keep)))
        due = max(min(math.ceil((1.0 + GAIN) * before), self.setting.max_gaussians), before)
        if not kept or due == kept:
            return None if kept else Change(0, 0, 0, refused=True)
        alive = keep.nonzero()[:, 0]
        opacities = activate(raw["scales"], raw["opacities"])[1][alive]
        begin, edges, end = self.processes.running_sums(opacities.cpu().double().numpy())
        drawn = torch.randint(DRAWS, (due - kept,), generator=self.random).double().numpy() / DRAWS
        drawn = np.minimum(drawn * end, np.nextafter(end, 0.0))
        drawn = drawn[(drawn >= begin) & (drawn < edges[-1:].sum())]  # where own Gaussians are
        chosen = np.searchsorted(edges, drawn, side="right")  # likelier, if more opaque
        sources, times = np.unique(chosen, return_counts=True)
        rows = alive[torch.from_numpy(sources).to(alive.device)]
        keep[rows] = False
        self.optimizer.replace(keep.nonzero()[:, 0], crowds(raw, rows, torch.from_numpy(times + 1)))
        self.optimizer.arrange(self.model.arranging(self.processes, [int(keep.sum()), int((times + 1).sum())]))
        return Change(due - kept, 0, before - kept)

    def grows(self, iterations: int) -> bool:
        """Whether a training of this length adds Gaussians."""
        return min(iterations, self.options.densify_until_iter) > self.options.densify_from_iter

    def state(self) -> dict[str, torch.Tensor]:
        """The random state."""
        return {"random.densification": self.random.get_state()}

    def restore(self, checkpoint: Checkpoint) -> None:
        """Take what :meth:`state` gave from a checkpoint."""
        self.random.set_state(torch.from_numpy(checkpoint.generator("random.densification")))


def crowds(raw: dict[str, torch.Tensor], rows: torch.Tensor, counts: torch.Tensor) -> dict[str, torch.Tensor]:
    """``counts`` [S] equal Gaussians in the place of each of ``rows``, which together look like it (equation 12).

    Their opacity b is such that n of them are as opaque as the one, (1 - b)^n = 1 - a; they are smaller by a factor, so
    that the opacity along any line through the middle sums up to as much.

    Args:
        raw: parameters before activation, by name.
        rows: indices [S].
        counts: of each, at least 1.

    Returns:
        Rows by name, as many as the sum of ``counts``.
    """
    scales, opacities = (part.contiguous() for part in (raw["scales"][rows], raw["opacities"][rows]))
    a = activate(scales, opacities)[1].cpu().double().numpy().clip(1e-12, 1.0 - 1e-6)
    n = counts.numpy()
    clear = whole_root(1.0 - a, n)
    b = 1.0 - clear
    shares = 1.0 - whole_power(1.0 - b * np.array(BELLS)[:, None], n)  # of n in a row, at each distance
    width = SPACING * (2.0 * shares.sum(0) - shares[0])  # integral over the line; of the one: a sqrt(pi)
    narrower = logarithm(a * math.sqrt(math.pi) / width)
    crowded = {name: tensor[rows] for name, tensor in raw.items()}
    crowded["opacities"] = torch.from_numpy(logarithm(b) - logarithm(clear)).to(opacities)
    crowded["scales"] = scales + torch.from_numpy(narrower).to(scales)[:, None]
    return {name: tensor.repeat_interleave(counts.to(tensor.device), 0) for name, tensor in crowded.items()}


def whole_power(x: np.ndarray, n: np.ndarray) -> np.ndarray:
    """X to the power of whole numbers n >= 1, by squares: the C library's power differs by processor."""
    result, square = np.ones_like(x), x
    for bit in range(int(n.max(initial=1)).bit_length()):
        result = np.where(n >> bit & 1, result * square, result)
        square = square * square
    return result


def whole_root(c: np.ndarray, n: np.ndarray) -> np.ndarray:
    """The n-th root of ``c``, 0 to 1, by Newton's method from 1."""
    x = np.ones_like(c)
    for _ in range(ROUNDS):
        x = x - x * (1.0 - c / whole_power(x, n)) / n
    return x

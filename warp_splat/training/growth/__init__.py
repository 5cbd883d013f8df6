"""How the set of Gaussians grows and shrinks: the options of each growth, and the table. Standard library only."""

from dataclasses import dataclass

from warp_splat.errors import InputError
from warp_splat.flags import growing
from warp_splat.training.seams import Entry


@dataclass(frozen=True)
class ReferenceOptions:
    """Densification of the reference (Kerbl et al. 2023), with its names and defaults; others take its schedule."""

    densify_from_iter: int = growing(500, "densify after this step", least=-1, schedule=True)
    densify_until_iter: int = growing(15_000, "densify before this step", least=-1, schedule=True)
    densification_interval: int = growing(100, "steps between two densifications", least=1)
    densify_grad_threshold: float = growing(0.0002, "mean gradient of the 2D mean (NDC units) above which to densify")
    percent_dense: float = growing(0.01, "share of the scene's extent above which a Gaussian splits, and is not cloned")
    opacity_reset_interval: int = growing(3000, "steps between resets of all opacities to 0.01", least=1, schedule=True)
    prune_screen_size: int = growing(0, "prune Gaussians wider than this radius in px; 0: never, as in the reference")


def check_budget(growth: str, budget: int, start: int = 1) -> None:
    """Raise InputError if --max_gaussians is not what a growth can end with: ``start`` or more."""
    if budget < start:
        raise InputError(
            f"--max_gaussians {budget}: expected the number of Gaussians that --growth {growth} ends with, at least "
            f"{start}; raise it, or take --growth reference."
        )


GROWTHS: dict[str, Entry] = {
    "reference": Entry(ReferenceOptions, "warp_splat.training.growth.reference.Reference"),
    "budget": Entry(ReferenceOptions, "warp_splat.training.growth.budget.Budget"),
    "mcmc": Entry(ReferenceOptions, "warp_splat.training.growth.mcmc.Mcmc"),
}

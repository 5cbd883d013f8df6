"""Pictures as a photograph was exposed."""

import torch

from warp_splat.formats.exposures import Exposures
from warp_splat.raster.expose import expose


def as_photographed(image: torch.Tensor, exposures: Exposures | None, name: str) -> torch.Tensor:
    """The image [H, W, 3] as the photograph of this name shows it; as it is, if that one is not known."""
    if exposures is None or name not in exposures.maps:
        return image
    numbers, falloff = (torch.from_numpy(n).to(image.device) for n in (exposures.maps[name], exposures.falloff))
    return expose(image, exposures.kind, numbers, falloff if falloff.any() else None, exposures.pivot)

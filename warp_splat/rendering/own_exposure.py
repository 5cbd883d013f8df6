"""A picture as a photograph's camera would have taken it, by the map of colors that was learned for that photograph."""

from __future__ import annotations

from collections.abc import Callable

import torch

from warp_splat.formats.exposures import read_exposures
from warp_splat.formats.model_folder import find_iteration, is_file_of_gaussians

Exposed = Callable[[torch.Tensor, str], torch.Tensor]


def own_exposure(model_path: str, iteration: int, trained: dict) -> Exposed:
    """A function from an image [H, W, 3] and the name of a photograph to that image with its exposure.

    Of held-out photographs, and of models without maps, the image stays as it is. The maps are those of the last saved
    iteration, so of others it stays, too.

    Raises:
        InputError: if the file of the maps is damaged.
    """
    learned = "exposure" in str(trained.get("parts", "")).split(",") or bool(trained.get("exposure"))
    last = learned and not is_file_of_gaussians(model_path) and iteration == find_iteration(model_path)
    maps = read_exposures(model_path) if last else {}

    def exposed(image: torch.Tensor, name: str) -> torch.Tensor:
        if name not in maps:
            return image
        numbers = torch.from_numpy(maps[name]).to(image)
        r, g, b = image.unbind(-1)
        channels = [r * red + g * green + b * blue for red, green, blue in numbers[:, :3].T]
        return torch.stack(channels, -1) + numbers[:, 3]

    return exposed

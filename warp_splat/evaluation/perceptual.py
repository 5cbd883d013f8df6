"""How different people would find two images: FLIP and LPIPS, by the packages of their authors.

FLIP (Andersson et al. 2020) is made for renders and needs no weights. LPIPS (Zhang et al. 2018) needs those of a
network that was trained on photographs. Its package would download them; here they are read from disk.
"""

import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warp_splat.errors import refusing
from warp_splat.evaluation.metrics import METRICS, Metric, masked, unit_images
from warp_splat.formats.files import Unexpected, reading

SMALLEST = 32  # px; the networks halve what they see too often for less
WEIGHTS = "torchvision's weights of VGG16 or AlexNet, such as vgg16-397923af.pth"
#: By network: its name in the results, the layer that tells it from the others, and whether images go from -1 to 1.
#: VGG16 as in the reference's metrics.py, which leaves them at 0 to 1; AlexNet as in gsplat and the metric's authors'.
NETWORKS = {"vgg": ("LPIPS", "features.28.weight", False), "alex": ("LPIPS_ALEX", "features.10.weight", True)}


def flip(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """FLIP of images as seen on a screen, 0 (equal) to 1: the mean of its map at 67 pixels per degree.

    Args:
        image: [H, W, 3] uint8.
        reference: [H, W, 3] uint8.
        mask: as for :func:`warp_splat.evaluation.metrics.ssim`.

    Raises:
        InputError: if the shapes differ or the type is not uint8.
    """
    import flip_evaluator  # noqa: PLC0415 - not on every platform

    image, reference = (array.astype(np.float32) for array in masked(mask, *unit_images(image, reference)))
    error, _, _ = flip_evaluator.evaluate(reference, image, "LDR", applyMagma=False, computeMeanError=False)
    return float(np.mean(error if mask is None else error[mask > 0], dtype=np.float64))


def choose_metrics(lpips_weights: str) -> tuple[dict[str, Metric], list[str]]:
    """All metrics that can be had here by name, and a sentence for each that cannot.

    Args:
        lpips_weights: torchvision's weights of VGG16 or AlexNet; empty: LPIPS is left out.

    Raises:
        InputError: if weights are named that are not there, or the package lpips is not installed.
    """
    metrics, absent = dict(METRICS), []
    if find_spec("flip_evaluator"):
        metrics["FLIP"] = flip
    else:
        absent.append("FLIP is left out: the package flip-evaluator is not installed (pip install flip-evaluator).")
    if lpips_weights:
        metrics |= _load_lpips(lpips_weights)
    else:
        absent.append("LPIPS is left out: no weights were named (--lpips_weights).")
    return metrics, absent


def _load_lpips(path: str) -> dict[str, Metric]:
    """LPIPS by the network whose weights these are, by its name."""
    weights = _load_weights(Path(path))
    problem = "--lpips_weights: LPIPS needs the packages lpips and torchvision"
    advice = "; install them with `pip install lpips torchvision`, or leave this flag out."
    # it calls torchvision as one did before 2022
    with refusing(ImportError, problem, advice), warnings.catch_warnings(action="ignore"):
        from lpips import LPIPS  # noqa: PLC0415 - optional, seconds to load

        network = next(network for network, (_, layer, _) in NETWORKS.items() if layer in weights)
        model = LPIPS(net=network, pnet_rand=True, verbose=False)  # without weights, or it would download them
    # "slice2.5.weight" is the layer "features.5.weight" of torchvision
    layers = {layer: f"features.{layer.partition('.')[2]}" for layer in model.net.state_dict()}
    with refusing((KeyError, RuntimeError), f"{path}: expected {WEIGHTS}, found others"):
        model.net.load_state_dict({layer: weights[theirs] for layer, theirs in layers.items()})
    name, _, signed = NETWORKS[network]

    def measure(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
        if min(image.shape[:2]) < SMALLEST:
            return np.nan
        arrays = masked(mask, *unit_images(image, reference))
        pair = [torch.from_numpy(array.astype(np.float32)).permute(2, 0, 1)[None] for array in arrays]
        with torch.no_grad():
            return float(model(*pair, normalize=signed))

    return {name: measure}


def _load_weights(path: Path) -> dict[str, Any]:
    """The state of a network; nothing in the file is run."""
    with reading(path, WEIGHTS), open(path, "rb") as file:
        try:
            weights = torch.load(file, map_location="cpu", weights_only=True)
        except Exception as error:  # what torch raises for another file depends on its first bytes
            raise Unexpected("a file that torch does not read as weights") from error
        if not isinstance(weights, dict) or not any(layer in weights for _, layer, _ in NETWORKS.values()):
            raise Unexpected("something else")
        return weights

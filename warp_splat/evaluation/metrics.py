"""How close renders are to photographs: PSNR and SSIM of 8-bit images, and the files they are kept in.

Both are those of the reference's ``metrics.py`` (Kerbl et al. 2023), in float64. CC_PSNR is PSNR after a fit of colors.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from warp_splat.errors import InputError
from warp_splat.formats.files import read_optional_json, write_json
from warp_splat.formats.png import check_image

# Wang et al. 2004, section III.C: an 11-tap Gaussian window of sigma 1.5, C1 = (0.01 L)^2, C2 = (0.03 L)^2, here L = 1.
RADIUS, SIGMA = 5, 1.5
C1, C2 = 1e-4, 9e-4
ROUNDS = 5  # of the fit of colors; rounds and threshold as in multinerf's color_correct (Mildenhall et al. 2022)
SATURATED = 0.5 / 255  # values nearer to 0 or 1 say little of the light


def psnr(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio in dB, over all pixels and channels at once; infinite for equal images.

    Args:
        image: [H, W, 3] uint8.
        reference: [H, W, 3] uint8.
        mask: [H, W], not 0 for at least one pixel; those that are 0 do not count.

    Raises:
        InputError: if the shapes differ or the type is not uint8.
    """
    image, reference = unit_images(image, reference)
    squares = (image - reference) ** 2
    return _decibels(squares if mask is None else squares[mask > 0])


def ssim(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Structural similarity (Wang et al. 2004, eq. 13) with zeros outside the image; mean over pixels and channels.

    Args:
        image: [H, W, 3] uint8.
        reference: [H, W, 3] uint8.
        mask: as for :func:`psnr`; both images are black where it is 0, and the mean is over the other pixels.

    Raises:
        InputError: if the shapes differ or the type is not uint8.
    """
    x, y = masked(mask, *unit_images(image, reference))
    mean_x, mean_y = _blur(x), _blur(y)
    var_x, var_y = _blur(x * x) - mean_x**2, _blur(y * y) - mean_y**2
    covariance = _blur(x * y) - mean_x * mean_y
    similarity = (2 * mean_x * mean_y + C1) * (2 * covariance + C2)
    similarity /= (mean_x**2 + mean_y**2 + C1) * (var_x + var_y + C2)
    return float(np.mean(similarity if mask is None else similarity[mask > 0]))


def cc_psnr(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """:func:`psnr` after the affine map of the image's colors that suits the reference best, cut to 0..1, not rounded.

    Each channel becomes a weighted sum of all three and 1, by least squares over its values that are saturated neither
    in the image, nor in the reference, nor in what the round before made of it. Without any, it stays as it is.

    Args:
        image: [H, W, 3] uint8.
        reference: [H, W, 3] uint8.
        mask: as for :func:`psnr`; what is 0 takes no part in the fit either.

    Raises:
        InputError: if the shapes differ or the type is not uint8.
    """
    pair = unit_images(image, reference)
    colors, wanted = (values.reshape(-1, 3) if mask is None else values[mask > 0] for values in pair)
    terms = np.column_stack([colors, np.ones(len(colors))])
    difference, usable = wanted - colors, _unsaturated(colors) & _unsaturated(wanted)
    corrected = colors
    for _ in range(ROUNDS):
        used = (usable & _unsaturated(corrected)).T
        pairs = [(terms[rows], column[rows]) for rows, column in zip(used, difference.T, strict=True)]
        # the smallest weights: gray images leave some of them open
        changes = [np.linalg.lstsq(some.T @ some, some.T @ aim, rcond=1e-12)[0] for some, aim in pairs]
        corrected = np.clip(colors + terms @ np.column_stack(changes), 0.0, 1.0)
    return _decibels((corrected - wanted) ** 2)


def _decibels(squares: np.ndarray) -> float:
    error = np.mean(squares)
    return float(-10 * np.log10(error)) if error > 0 else np.inf


def _unsaturated(values: np.ndarray) -> np.ndarray:
    return (values >= SATURATED) & (values <= 1.0 - SATURATED)


Metric = Callable[[np.ndarray, np.ndarray, np.ndarray | None], float]  # of an image, its reference, a mask as for psnr
METRICS: dict[str, Metric] = {"SSIM": ssim, "PSNR": psnr, "CC_PSNR": cc_psnr}  # those that need nothing but this file


def write_results(
    model_folder: str | Path, iteration: int, figures: Mapping[str, Any], per_view: Mapping[str, Mapping[str, float]]
) -> None:
    """Put the metrics of one iteration into ``results.json`` and ``per_view.json``, under ``ours_<iteration>``.

    Entries of other iterations stay, and so does what training said of this one (seconds, memory, ...); its metrics are
    replaced. JSON has no infinity: a value that is not finite, such as the PSNR of equal images, becomes ``null``.

    Args:
        model_folder: the model folder.
        iteration: the iteration that was rendered.
        figures: what ``results.json`` keeps: means of each metric, number of Gaussians, seconds, iterations per second.
        per_view: values of each metric for each image.

    Raises:
        InputError: if an older file is not a JSON object (it is left alone), or a file cannot be written.
    """
    results_path, views_path = Path(model_folder) / "results.json", Path(model_folder) / "per_view.json"
    results, views, name = _read_object(results_path), _read_object(views_path), f"ours_{iteration}"
    kept = {key: value for key, value in results.get(name, {}).items() if not key.isupper()}  # no old LPIPS
    write_json(results_path, {**results, name: {**kept, **figures}})
    write_json(views_path, {**views, name: per_view})


def _read_object(path: Path) -> dict:
    expected = "a JSON object with entries ours_N (otherwise move it away and run again)"
    return read_optional_json(path, expected, lambda found: {k: {**v} for k, v in found.items()}) or {}


def _blur(image: np.ndarray) -> np.ndarray:
    """Weighted mean over the window around each pixel, with zeros outside the image."""
    return gaussian_filter(image, SIGMA, radius=RADIUS, axes=(0, 1), mode="constant")


def unit_images(image: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both images in float64, 0..1.

    Raises:
        InputError: if the shapes differ or the type is not uint8.
    """
    check_image(image)
    check_image(reference)
    if image.shape != reference.shape:
        raise InputError(f"image: expected the shape of the reference, {reference.shape}, got {image.shape}.")
    return image / 255.0, reference / 255.0


def masked(mask: np.ndarray | None, *images: np.ndarray) -> tuple[np.ndarray, ...]:
    """The images, black where the mask is 0."""
    return images if mask is None else tuple(image * (mask > 0)[..., None] for image in images)

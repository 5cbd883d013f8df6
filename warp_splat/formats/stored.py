"""How numbers of Gaussians are stored: activations, rotations in few bytes, ranges of formats."""

import numpy as np

from warp_splat.text import Report

SH_C0 = 0.28209479177387814  # color = SH_C0 * (coefficient of degree 0) + 0.5
LOG_SCALES = (-87.0, 88.0)  # exp() of these, and of what lies between, is a normal number in float32
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # than one of four


def sigmoid(logits: np.ndarray) -> np.ndarray:
    """Opacities 0..1 from logits."""
    with np.errstate(over="ignore"):
        return 1.0 / (1.0 + np.exp(-logits))


def logit(opacities: np.ndarray) -> np.ndarray:
    """Logits from opacities; 0 and 1, to which formats round, give the last finite ones of float32: -87 and 16.6."""
    info = np.finfo(np.float32)
    inside = np.clip(opacities.astype(np.float64), info.tiny, 1.0 - info.epsneg)
    return np.log(inside / (1.0 - inside)).astype(np.float32)


def log_scales(scales: np.ndarray) -> np.ndarray:
    """Logarithms of standard deviations; 0 (a flat Gaussian) gives the last finite one, less gives NaN.

    Called while a file is read: then NumPy does not warn.
    """
    return np.log(np.where(scales == 0, np.finfo(np.float32).tiny, scales)).astype(np.float32)


def unit_quats(quats: np.ndarray) -> np.ndarray:
    """Quaternions of unit length, w x y z; the identity for those of no length."""
    quats = quats.astype(np.float64)
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    return np.where(norms > 0, quats / np.where(norms > 0, norms, 1), [1.0, 0.0, 0.0, 0.0]).astype(np.float32)


def smallest_three(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which of w x y z is largest [N], and the others [N, 3] in that order, as -0.5..0.5, where it is positive."""
    unit = unit_quats(quats).astype(np.float64)
    largest = np.abs(unit).argmax(axis=1)
    unit *= np.where(unit[np.arange(len(unit)), largest] < 0, -1, 1)[:, None]
    return largest, np.take_along_axis(unit, OTHERS[largest], axis=1) * np.sqrt(0.5)


def from_smallest_three(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """The rotations [N, 4] w x y z of :func:`smallest_three`."""
    quats = np.zeros((len(others), 4))
    np.put_along_axis(quats, OTHERS[largest], others * np.sqrt(2), axis=1)
    quats[np.arange(len(quats)), largest] = np.sqrt(np.maximum(0, 1 - (quats * quats).sum(axis=1)))
    return quats.astype(np.float32)


def clipped(what: str, values: np.ndarray, low: float, high: float, report: Report) -> np.ndarray:
    """``values`` [N, ...] moved into a format's range; ``report`` is told of how many Gaussians if there are any."""
    if (outside := (values < low) | (values > high)).any():
        rows = np.count_nonzero(outside.any(axis=tuple(range(1, values.ndim))))
        report(f"{what} of {rows} of {len(values)} Gaussians moved into {low:.4g}..{high:.4g}")
    return np.clip(values, low, high)

"""Gaussians in memory, as every file format reads and writes them, and their axes.

The frame is that of the scene's files, as trained (COLMAP: x right, y down, z forward). Formats with axes of their own
turn the Gaussians on writing and back on reading (:func:`turned`).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from warp_splat.color import harmonics_at
from warp_splat.errors import InputError
from warp_splat.formats.files import Unexpected
from warp_splat.formats.stored import sigmoid
from warp_splat.text import Report

COEFFICIENTS = (1, 4, 9, 16)  # of the spherical harmonics up to degree 0, 1, 2, 3
AXIS = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}
SOME_MIP = "only some of its parts are antialiased; all are drawn as if none were"
EVEN = 1e-4  # by how much the axes of a transform may differ in length, or lean


class SplatArrays(NamedTuple):
    """Gaussians as stored, float32: before sigmoid, exp and normalization."""

    means: np.ndarray  # [N, 3] world units
    sh: np.ndarray  # [N, K, 3] spherical harmonics, K = 1, 4, 9 or 16
    opacities: np.ndarray  # [N] logits
    scales: np.ndarray  # [N, 3] natural logarithms of world units
    quats: np.ndarray  # [N, 4] w x y z, not necessarily of unit length

    def take(self, rows: np.ndarray | slice) -> "SplatArrays":
        """Some of the Gaussians."""
        return SplatArrays(*(array[rows] for array in self))


class SplatFile(NamedTuple):
    """What a file of Gaussians says."""

    splats: SplatArrays
    antialiased: bool = False  # trained, and to be rendered, with the opacities of Mip-Splatting (Yu et al. 2024)
    coordinates: dict | None = None  # where in the world they are (formats/coordinates.py)
    linear: bool = False  # colors in linear light, not as a screen shows them


def check_shapes(splats: SplatArrays) -> None:
    """Raise InputError if a shape disagrees with the others."""
    count = len(splats.means)
    shapes = {"means": (count, 3), "opacities": (count,), "scales": (count, 3), "quats": (count, 4)}
    for name, shape in shapes.items():
        if (found := getattr(splats, name).shape) != shape:
            raise InputError(f"{name}: expected shape {shape}, got {found}.")
    if splats.sh.shape not in [(count, coefficients, 3) for coefficients in COEFFICIENTS]:
        raise InputError(f"sh: expected shape ({count}, 1|4|9|16, 3), got {splats.sh.shape}.")


def finite_rows(splats: SplatArrays, path, report: Report) -> SplatArrays:
    """Leave out Gaussians with a value that is not finite, or a quaternion of zero; ``report`` says so.

    One of the first can spoil a whole image. The others would be in none, but formats store them as the identity.
    """
    finite = np.all([np.isfinite(array).all(axis=tuple(range(1, array.ndim))) for array in splats], axis=0)
    finite &= splats.quats.any(axis=1)
    if finite.all():
        return splats
    lost = np.count_nonzero(~finite)
    report(f"{path}: left out {lost} of {len(finite)} Gaussians that are not finite or have no rotation.")
    return splats.take(finite)


def cropped(splats: SplatArrays, box: Sequence[float]) -> SplatArrays:
    """Those with their center in a box: smallest x, y, z, then largest [world units]; all, if it is empty.

    Raises:
        InputError: if that is no box, or there are none.
    """
    if not box or not len(splats.means):
        return splats
    if len(box) != 6 or not np.less(box[:3], box[3:]).all():
        found = " ".join(f"{value:g}" for value in box)
        raise InputError(f"--crop: expected six numbers, the smallest x, y and z, then the largest; got {found}.")
    if not (inside := within(splats.means, box)).any():
        around = " ".join(f"{value:.3g}" for value in (*splats.means.min(0), *splats.means.max(0)))
        raise InputError(f"--crop: expected a box with Gaussians in it, found none; all of them lie in {around}.")
    return splats.take(inside)


def within(means: np.ndarray, box: Sequence[float]) -> np.ndarray:
    """Whether each of ``means`` [N, 3] lies in a box as :func:`cropped` takes it: [N] bool."""
    return np.all((means >= box[:3]) & (means <= box[3:]), axis=1)


def sizes(splats: SplatArrays) -> np.ndarray:
    """Opacity times the area of the largest section [N]: what can be said of a Gaussian without any camera."""
    areas = np.sort(splats.scales.astype(np.float64), axis=1)[:, 1:].sum(axis=1)
    return sigmoid(splats.opacities.astype(np.float64)) * np.exp(np.minimum(areas, 700.0))


def frame(letters: str) -> np.ndarray:
    """The matrix [3, 3] that takes coordinates in axes named by ``letters`` to ours, which are "RDF".

    Args:
        letters: what x, y and z point to, of Right, Left, Up, Down, Forward, Back: "RUB" for OpenGL, "LUF" for glTF.
    """
    return np.array([AXIS[letter] for letter in letters], np.float64).T


def turned(
    splats: SplatArrays, turn: np.ndarray, translation: np.ndarray | None = None, scale: float = 1.0
) -> SplatArrays:
    """The Gaussians in another frame, x_new = scale * turn @ x + translation, with their rotations and colors.

    Args:
        splats: the Gaussians.
        turn: [3, 3], orthogonal; mirrors too: a Gaussian is its own mirror image but for rotation and color.
        translation: [3], in units of the new frame.
        scale: new units per old unit, positive.
    """
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - most conversions turn nothing

    x, y, z, w = Rotation.from_matrix(turn * np.linalg.det(turn)).as_quat()
    product = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    count, coefficients, _ = splats.sh.shape
    # rounded, so that a turn by half a circle only flips signs, and back again gives the same bytes
    basis = _turn_harmonics(turn, coefficients).round(12).astype(np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite, or no longer is, the reader leaves out
        colors = splats.sh.transpose(0, 2, 1).reshape(count * 3, coefficients) @ basis.T
        means = scale * (splats.means @ turn.T)
        return SplatArrays(
            means=(means if translation is None else means + translation).astype(np.float32),
            sh=colors.reshape(count, 3, coefficients).transpose(0, 2, 1),
            opacities=splats.opacities,
            scales=(splats.scales + np.log(scale)).astype(np.float32),
            quats=splats.quats @ product.round(12).astype(np.float32).T,
        )


def placed(splats: SplatArrays, matrix: np.ndarray, axes: np.ndarray, report: Report, unit=1.0) -> SplatArrays:
    """The Gaussians after a transform, in our axes; a mirror is part of its rotation.

    Args:
        splats: as the file has them.
        matrix: the transform [4, 4], to axes of the file.
        axes: from these to ours, [3, 3]; see :func:`frame`.
        report: is told of a place that float32 rounds by more than a thousandth of ours.
        unit: of the file, in ours.

    Raises:
        Unexpected: if it stretches or shears, which would need other Gaussians.
    """
    linear = matrix[:3, :3]
    scale = float(np.linalg.norm(linear)) / math.sqrt(3)
    turn = linear / scale if 0 < scale < math.inf else np.zeros((3, 3))
    if not np.allclose(turn.T @ turn, np.eye(3), atol=EVEN):
        raise Unexpected("a node that stretches or shears; apply its transform to the Gaussians before the export")
    if (step := 2.0**-23 * unit * np.abs(matrix[:3, 3]).max()) > 2e-3:
        report(f"so far from the origin, positions are rounded to steps of about {step:.1g}; move it nearer")
    u, _, v = np.linalg.svd(turn)
    return turned(splats, axes @ (u @ v), unit * (axes @ matrix[:3, 3]), unit * scale)


def concatenated(parts: Sequence[SplatArrays]) -> SplatArrays:
    """One set of Gaussians; those of a lower SH degree get zeros."""
    most = max(part.sh.shape[1] for part in parts)
    padded = [part._replace(sh=np.pad(part.sh, ((0, 0), (0, most - part.sh.shape[1]), (0, 0)))) for part in parts]
    return SplatArrays(*(np.concatenate(arrays) for arrays in zip(*padded, strict=True)))


def of_parts(path: object, parts: Sequence[SplatArrays], mip: list[bool], notes: list[str], say: Report) -> SplatFile:
    """The Gaussians of a file's parts, of which ``mip`` tells which are antialiased; ``say`` gets each note once."""
    notes = [*notes, *[SOME_MIP] * (any(mip) and not all(mip))]
    for note in dict.fromkeys(notes):
        say(f"{path}: {note}.")
    return SplatFile(concatenated(parts), all(mip))


def _turn_harmonics(turn: np.ndarray, coefficients: int) -> np.ndarray:
    """[K, K]: new coefficients from old, so that the color seen along ``turn @ d`` is what was seen along d.

    Real harmonics with the Condon-Shortley phase, as in the reference; exact, since a turn keeps each degree.
    """
    directions = np.random.default_rng(0).normal(size=(64, 3))
    here, there = _harmonics(directions, coefficients), _harmonics(directions @ turn, coefficients)
    return np.linalg.lstsq(here, there)[0]


def _harmonics(directions: np.ndarray, coefficients: int) -> np.ndarray:
    """Real spherical harmonics [M, K] along ``directions`` [M, 3] of any length."""
    x, y, z = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).T
    return np.stack(harmonics_at(x, y, z, COEFFICIENTS.index(coefficients)), axis=1)

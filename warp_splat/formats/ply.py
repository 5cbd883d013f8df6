"""Splats and points as PLY files, in the layout of the reference implementation (Kerbl et al. 2023).

One element ``vertex`` of little-endian float32: ``x y z nx ny nz f_dc_0..2 f_rest_0..n opacity scale_0..2 rot_0..3``.
Values are stored before their activation: opacity as a logit, scales as natural logarithms, quaternions w x y z of any
length. ``f_rest`` is channel-major: all coefficients of red, then of green, then of blue; here they are [N, K, 3].
"""

from collections.abc import Iterable
from itertools import chain
from pathlib import Path

import numpy as np

from warp_splat.errors import InputError
from warp_splat.formats.compressed_ply import is_compressed, read_compressed
from warp_splat.formats.coordinates import comments_of, of_comments
from warp_splat.formats.files import reading
from warp_splat.formats.ply_container import ANTIALIASED, PlyTables, columns_of, write_parts, write_tables
from warp_splat.formats.splats import SplatArrays, SplatFile, check_shapes, finite_rows
from warp_splat.text import Report

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")  # zeros; only there because readers of the reference's files may expect them
F_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
COLOR = ("red", "green", "blue")
GRAY = 127  # of points without colors
REST_COUNTS = (0, 9, 24, 45)  # f_rest properties at SH degree 0, 1, 2, 3

EXPECTED = "a PLY file with an element 'vertex'"
ANTIALIASED_READ = {ANTIALIASED, "antialiased 1"}  # the second is Postshot's


def save_ply(path: str | Path, file: SplatFile, report: Report = print) -> None:
    """Write Gaussians as stored (see :class:`SplatArrays`); equal arrays give equal bytes.

    Args:
        path: the file to write.
        file: the Gaussians, float32.
        report: not called: the format holds everything.

    Raises:
        InputError: if a shape disagrees with the others; if the file cannot be written.
    """
    comments = [ANTIALIASED] * file.antialiased + comments_of(file.coordinates)
    write_tables(path, {"vertex": _table_of(file.splats)}, comments)


def save_ply_parts(path: str | Path, count: int, parts: Iterable[SplatArrays], antialiased: bool = False) -> None:
    """:func:`save_ply` of ``count`` Gaussians that come in parts; raises InputError as that does."""
    tables = map(_table_of, parts)
    first = next(tables)
    write_parts(path, {"vertex": (count, first.dtype)}, chain([first], tables), [ANTIALIASED] * antialiased)


def _table_of(splats: SplatArrays) -> np.ndarray:
    """Gaussians as rows of the file."""
    check_shapes(splats)
    means, sh, opacities, scales, quats = splats
    count, coefficients, _ = sh.shape
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (coefficients - 1))
    columns = (means, np.zeros((count, 3)), sh[:, 0], rest, opacities[:, None], scales, quats)
    names = (*POSITION, *NORMAL, *F_DC, *_rest_names(rest.shape[1]), "opacity", *SCALE, *ROTATION)
    return np.concatenate(columns, axis=1, dtype="<f4").view([(name, "<f4") for name in names])[:, 0]


def save_points(path: str | Path, points: np.ndarray, colors: np.ndarray) -> None:
    """Write a colored point cloud as the reference's ``input.ply``: x y z, zero normals, red green blue.

    Args:
        path: the file to write.
        points: positions, [P, 3], world units.
        colors: colors 0..255, [P, 3] uint8.

    Raises:
        InputError: if the shapes are not both [P, 3]; if the file cannot be written.
    """
    points, colors = np.asarray(points), np.asarray(colors)
    if points.ndim != 2 or points.shape[1] != 3 or colors.shape != points.shape:
        raise InputError(f"points, colors: expected shapes (P, 3) twice, got {points.shape} and {colors.shape}.")
    rows = np.zeros(len(points), [(name, "<f4") for name in POSITION + NORMAL] + [(name, "u1") for name in COLOR])
    for axis in range(3):
        rows[POSITION[axis]], rows[COLOR[axis]] = points[:, axis], colors[:, axis]
    write_tables(path, {"vertex": rows})


def load_points(path: str | Path, report: Report = print) -> tuple[np.ndarray, np.ndarray]:
    """Read a point cloud: x y z and, if there are any, red green blue (0..255, or 0..1 as floats; gray otherwise).

    Returns:
        Positions [P, 3] float32, finite; colors [P, 3] uint8.

    Raises:
        InputError: if the file is missing, damaged, or has no positions.
    """
    with reading(path, EXPECTED), open(path, "rb") as file:
        vertex = PlyTables(file).rows("vertex")
        if not set(POSITION) <= set(names := vertex.dtype.names or ()):
            found = f"{', '.join(names):.200}"
            raise InputError(f"{path}: expected a point cloud with properties x, y and z, found {found}.")
        points = columns_of(vertex, POSITION)
        colors = np.full(points.shape, GRAY, np.uint8)
        if set(COLOR) <= set(names):
            unit = [255 if vertex.dtype[name].kind == "f" else 1 for name in COLOR]
            values = np.stack([vertex[name] * np.float64(u) for name, u in zip(COLOR, unit, strict=True)], axis=1)
            colors = np.nan_to_num(values).clip(0, 255).round().astype(np.uint8)
    if not (finite := np.isfinite(points).all(axis=1)).all():
        report(f"{path}: left out {np.count_nonzero(~finite)} of {len(points)} points that are not finite.")
    return points[finite], colors[finite]


def load_ply(path: str | Path, report: Report = print) -> SplatFile:
    """Read Gaussians, compressed ones or by property name: any order, with or without normals, SH degree 0 to 3.

    Rows with a value that is not finite (as a float32) are left out, since one of them can spoil a whole image.

    Args:
        path: a PLY file, binary or text.
        report: called with one line if rows were left out.

    Returns:
        The Gaussians as stored; what comments say of them.

    Raises:
        InputError: if the file is missing, damaged, or not a PLY file of 3D Gaussians.
    """
    with reading(path, EXPECTED), open(path, "rb") as file:
        tables = PlyTables(file)
        told = not ANTIALIASED_READ.isdisjoint(tables.comments), of_comments(tables.comments)
        if is_compressed(tables):
            return SplatFile(finite_rows(read_compressed(tables), path, report), *told)
        vertex = tables.rows("vertex")
        names = vertex.dtype.names or ()
        if (rest_count := sum(name.startswith("f_rest_") for name in names)) not in REST_COUNTS:
            raise InputError(
                f"{path}: expected 0, 9, 24 or 45 properties f_rest_* (SH degree 0 to 3), found {rest_count}; "
                "export the Gaussians with a degree of at most 3."
            )
        columns = (POSITION, F_DC, _rest_names(rest_count), ("opacity",), SCALE, ROTATION)
        if missing := [name for group in columns for name in group if name not in names]:
            raise InputError(
                f"{path}: expected a PLY file of 3D Gaussians, but the properties {', '.join(missing)} are "
                "missing; export it as 'PLY (standard)' or train again."
            )
        means, base, rest, opacities, scales, quats = (columns_of(vertex, group) for group in columns)
        rest = rest.reshape(len(vertex), 3, rest_count // 3).transpose(0, 2, 1)
        splats = SplatArrays(means, np.concatenate([base[:, None], rest], axis=1), opacities[:, 0], scales, quats)
        return SplatFile(finite_rows(splats, path, report), *told)


def _rest_names(count: int) -> list[str]:
    return [f"f_rest_{index}" for index in range(count)]

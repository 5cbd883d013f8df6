"""Gaussians as OpenUSD stages (.usd, .usda, .usdc, .usdz): prims ParticleField3DGaussianSplat, since OpenUSD 26.03.

Attributes are linear: positions, orientations, scales (standard deviations), opacities 0..1, and the harmonics, splat
by splat. Each may be in half precision, under a name that ends in h. Axes of the stages that we write: right, up, back.
The schema has no word for Mip-Splatting, nor for where in the world a scene is: data of our own keep both.
"""

# pyright: reportAttributeAccessIssue=false
# usd-core has no types
import errno
import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from zipfile import is_zipfile

import numpy as np

from warp_splat.errors import InputError
from warp_splat.formats.coordinates import kept
from warp_splat.formats.files import Unexpected, atomic_write, reading
from warp_splat.formats.gltf import COORDINATES, RENDER_MODE
from warp_splat.formats.splats import COEFFICIENTS, SplatArrays, SplatFile, frame, of_parts, placed, turned
from warp_splat.formats.stored import LOG_SCALES, clipped, log_scales, logit, sigmoid, unit_quats
from warp_splat.text import Report

AXES = {"Y": "RUB", "Z": "RFU"}  # by what a stage calls up
COLORS = "radiance:sphericalHarmonicsCoefficients"
DEGREE = "radiance:sphericalHarmonicsDegree"
HINTS = {"projectionModeHint": "perspective", "sortingModeHint": "zDepth"}  # what this renderer does
MOST_DEGREE = 10  # of harmonics that are read, of which the first 3 are kept
FINITE = float(np.finfo(np.float32).max)
REACH = 3  # standard deviations within the extent
PACKED_AT = (1989, 1, 5, 0, 0, 0, 0, 0, 0)  # local time that a package tells: the same bytes, whenever it is written


def save_usd(path: str | Path, file: SplatFile, report: Report = print) -> None:
    """Write Gaussians as a stage with one prim, y up, units of a meter.

    Args:
        path: the file to write; .usda is text, .usdz a package of one .usdc.
        file: the Gaussians.
        report: called with a part of a sentence for each kind of value that the format cannot hold.

    Raises:
        InputError: if the file cannot be written, or the package usd-core is not there.
    """
    failed = OSError(errno.ENOSPC, "by USD: its disk, or that of temporary files, may be full")
    with atomic_write(path) as temporary, TemporaryDirectory() as folder, _library(path, lambda _: failed):
        from pxr import Usd, UsdGeom, UsdUtils, UsdVol, Vt  # noqa: PLC0415 - optional

        temporary.touch()  # tells why nothing can be written there, as USD does not
        stage = Usd.Stage.CreateInMemory()
        UsdGeom.SetStageUpAxis(stage, "Y")
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/Gaussians").GetPrim()
        stage.SetDefaultPrim(prim)
        means, sh, opacities, scales, quats = turned(file.splats, frame(AXES["Y"]).T)
        scales = np.exp(clipped("log scale", scales, *LOG_SCALES, report).astype(np.float64))
        values = {
            "positions": (Vt.Vec3fArray, means),
            "orientations": (Vt.QuatfArray, unit_quats(quats)[:, [1, 2, 3, 0]]),  # as they lie in memory
            "scales": (Vt.Vec3fArray, scales),
            "opacities": (Vt.FloatArray, sigmoid(opacities.astype(np.float64))),
            COLORS: (Vt.Vec3fArray, sh.reshape(-1, 3)),
        }
        if len(means):
            values["extent"] = (Vt.Vec3fArray, _extent(means, scales, quats))
        for name, (kind, array) in values.items():
            prim.GetAttribute(name).Set(kind.FromNumpy(np.ascontiguousarray(array, np.float32)))
        for name, value in {**HINTS, DEGREE: COEFFICIENTS.index(sh.shape[1])}.items():
            prim.GetAttribute(name).Set(value)
        if file.antialiased:
            prim.SetCustomDataByKey(RENDER_MODE, "mip")
        layer = stage.GetRootLayer()
        if coordinates := kept(file.coordinates, "x east, y up, z south"):
            layer.customLayerData = {COORDINATES: json.dumps(coordinates)}
        package = temporary.suffix.lower() == ".usdz"
        inner = f"{folder}/gaussians.usdc" if package else str(temporary)
        if (written := layer.Export(inner)) and package:
            os.utime(inner, 2 * (time.mktime(PACKED_AT),))
            # it does not tell when the end is missing
            written = UsdUtils.CreateNewUsdzPackage(inner, str(temporary)) and is_zipfile(temporary)
        if not written:
            raise failed


def load_usd(path: str | Path, report: Report = print) -> SplatFile:
    """Read the Gaussians of all visible prims of a stage, as their parents place them, at its earliest time.

    Args:
        path: the file; what it refers to is read as well.
        report: called with a line for what is drawn otherwise than the stage says.

    Raises:
        InputError: if the file is missing, damaged, holds no Gaussians, or stretches them, or the package usd-core is
            not there.
    """
    notes: list[str] = []
    with reading(path, "a USD stage of Gaussians (ParticleField3DGaussianSplat)"), _library(path):
        from pxr import Usd, UsdGeom, UsdVol  # noqa: PLC0415 - optional

        Path(path).stat()
        stage, now = Usd.Stage.Open(str(path)), Usd.TimeCode.EarliestTime()
        stage.Reload()  # an open stage would show it as it was
        if errors := stage.GetCompositionErrors():
            raise Unexpected(f"one that is not whole: {errors[0]!s:.200}")
        prims = [
            prim
            for prim in stage.Traverse(Usd.TraverseInstanceProxies())
            if prim.HasAPI(UsdVol.ParticleFieldKernelGaussianEllipsoidAPI)
            and UsdGeom.Imageable(prim).ComputeVisibility(now) == UsdGeom.Tokens.inherited
            and UsdGeom.Imageable(prim).ComputePurpose() in (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)
        ]
        if any(prim.IsA(UsdGeom.PointInstancer) for prim in stage.Traverse(Usd.TraverseInstanceProxies())):
            notes.append("its point instancers repeat nothing here; make instances of them to draw all")
        if not prims:
            raise Unexpected("none that is visible")
        up, unit = UsdGeom.GetStageUpAxis(stage), 1.0
        if up not in AXES:
            raise Unexpected(f"one whose axis {up} is up")
        axes = frame(AXES[up])
        if UsdGeom.StageHasAuthoredMetersPerUnit(stage) and (unit := UsdGeom.GetStageMetersPerUnit(stage)) != 1:
            notes.append(f"its units of {unit:g} m became meters")
        if not 0 < unit < np.inf:
            raise Unexpected(f"units of {unit:g} m")
        parts, places = [], UsdGeom.XformCache(now)
        for prim in prims:
            world = np.array(places.GetLocalToWorldTransform(prim)).T  # USD multiplies from the left
            parts.append(placed(_read_prim(prim, now, notes.append), world, axes, notes.append, unit))
        mip = [prim.GetCustomDataByKey(RENDER_MODE) == "mip" for prim in prims]
        told = stage.GetRootLayer().customLayerData.get(COORDINATES, "null")
        coordinates = kept(json.loads(told)) if isinstance(told, str) else None
    return of_parts(path, parts, mip, notes, report)._replace(coordinates=coordinates)


def _read_prim(prim, now, report: Report) -> SplatArrays:
    """The Gaussians of one prim in its own frame; what it does not say is what the schema says in its place."""

    def values(name: str, count: int | None, default: np.ndarray) -> np.ndarray:
        """[count, ...]; a longer array is cut, a shorter one ignored."""
        found = (prim.GetAttribute(full).Get(now) for full in (name, f"{name}h") if prim.HasAttribute(full))
        array = next((np.array(value, np.float32) for value in found if value), default[:0])
        if count is None or len(array) >= count:
            return array[:count]
        if len(array):
            report(f"{name} are fewer than the Gaussians, and are left out, as the schema says")
        return np.repeat(default, count, 0)

    for name, ours in HINTS.items():
        hint = prim.GetAttribute(name).Get(now) if prim.HasAttribute(name) else ours
        if hint != ours:
            report(f"its {name} is {hint}; this renderer knows {ours} alone")
    means = values("positions", None, np.zeros((1, 3)))
    count, degree = len(means), prim.GetAttribute(DEGREE).Get(now) if prim.HasAttribute(DEGREE) else 0
    if not isinstance(degree, int) or not 0 <= degree <= MOST_DEGREE:
        raise Unexpected(f"harmonics of degree {degree}")
    size = (degree + 1) ** 2
    sh = values(COLORS, count * size, np.zeros((1, 3))).reshape(count, size, 3)
    if degree >= len(COEFFICIENTS):
        report("harmonics above degree 3 are left out")
    return SplatArrays(
        means=means,
        sh=sh[:, : COEFFICIENTS[-1]],
        opacities=logit(clipped("opacity", values("opacities", count, np.ones(1)), 0.0, 1.0, report)),
        scales=log_scales(values("scales", count, np.ones((1, 3)))),
        quats=values("orientations", count, np.array([[0.0, 0.0, 0.0, 1.0]]))[:, [3, 0, 1, 2]].astype(np.float32),
    )


def _extent(means: np.ndarray, scales: np.ndarray, quats: np.ndarray) -> np.ndarray:
    """The box [2, 3] of all ellipsoids of REACH standard deviations."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - slow to load

    axes = Rotation.from_quat(unit_quats(quats), scalar_first=True).as_matrix() * scales[:, None]
    reach = REACH * np.linalg.norm(axes, axis=2)
    return np.stack([(means - reach).min(0), (means + reach).max(0)]).clip(-FINITE, FINITE)


@contextmanager
def _library(path: str | Path, error_of: Callable[[str], Exception] = ValueError) -> Iterator[None]:
    """Make of what usd-core says an error that ``reading`` or ``atomic_write`` tell.

    Raises:
        InputError: if it is not installed, or older than the schema.
    """
    try:
        from pxr import Tf  # noqa: PLC0415 - optional
        from pxr.UsdVol import ParticleField3DGaussianSplat  # noqa: F401, PLC0415 - not in older ones
    except ImportError as error:
        raise InputError(f"{path}: USD files need the package usd-core; `pip install 'usd-core>=26.3'`.") from error
    try:
        yield
    except Tf.ErrorException as error:
        raise error_of(str(error).split(" : '")[-1].strip("\n\t'")) from error

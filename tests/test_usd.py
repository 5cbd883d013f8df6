"""Gaussians as USD stages: what the schema says, stages of others, transforms, and what is refused."""

import os
import shlex
import subprocess
import sys
import zipfile

import numpy as np
import pytest
from hostile import refusal
from scipy.spatial.transform import Rotation
from splat_files import covariances, sigmoid, silent, some_file, some_splats

from warp_splat.formats.exchange import load_gaussians, save_gaussians
from warp_splat.formats.ply import save_ply
from warp_splat.formats.splats import SplatFile, turned

pxr = pytest.importorskip("pxr", reason="usd-core is not installed")
from pxr import Gf, Usd, UsdGeom, UsdUtils, UsdValidation, UsdVol, Vt  # noqa: E402 - behind the question for it

ENDINGS = (".usd", ".usda", ".usdc", ".usdz")
HALF_TURN = np.diag([1.0, -1.0, -1.0])  # from our axes to right, up, back
COLORS = "radiance:sphericalHarmonicsCoefficients"


def stage_of(tmp_path, up="Y", meters=1.0):
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    UsdGeom.SetStageUpAxis(stage, up)
    UsdGeom.SetStageMetersPerUnit(stage, meters)
    return stage


def add(stage, path, splats, half=()):
    """A prim with the numbers of ``splats`` as they are; those named in ``half`` under names that end in h."""
    prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, path).GetPrim()
    quats = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
    values = {
        "positions": (Vt.Vec3fArray, Vt.Vec3hArray, splats.means),
        "orientations": (Vt.QuatfArray, Vt.QuathArray, quats[:, [1, 2, 3, 0]]),
        "scales": (Vt.Vec3fArray, Vt.Vec3hArray, np.exp(splats.scales)),
        "opacities": (Vt.FloatArray, Vt.HalfArray, sigmoid(splats.opacities)),
        COLORS: (Vt.Vec3fArray, Vt.Vec3hArray, splats.sh.reshape(-1, 3)),
    }
    for name, (*kinds, numbers) in values.items():
        halved = name in half
        array = np.ascontiguousarray(numbers, np.float16 if halved else np.float32)
        assert prim.GetAttribute(name + "h" * halved).Set(kinds[halved].FromNumpy(array))
    prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(round(splats.sh.shape[1] ** 0.5) - 1)
    return prim


def same(found, wanted, rtol=1e-6):
    np.testing.assert_allclose(found.means, wanted.means, rtol=rtol, atol=rtol)
    np.testing.assert_allclose(found.sh, wanted.sh, rtol=rtol, atol=rtol)
    np.testing.assert_allclose(sigmoid(found.opacities), sigmoid(wanted.opacities), rtol=rtol, atol=rtol)
    scale = covariances(wanted)
    np.testing.assert_allclose(covariances(found), scale, rtol=10 * rtol, atol=3 * rtol * np.abs(scale).max())


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
@pytest.mark.parametrize("ending", ENDINGS)
def test_a_stage_holds_what_the_schema_says_and_comes_back(tmp_path, ending, coefficients):
    where = {"origin": [4e5, 5e6, 100.0], "axes": "x east, y down, z north", "reference": "EPSG:32632"}
    file = SplatFile(some_splats(200, coefficients), True, where)
    save_gaussians(tmp_path / f"a{ending}", file, report=silent)
    stage, wanted = Usd.Stage.Open(str(tmp_path / f"a{ending}")), turned(file.splats, HALF_TURN)
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1.0)
    prim = stage.GetDefaultPrim()
    assert prim.IsA(UsdVol.ParticleField3DGaussianSplat)
    got = {name: prim.GetAttribute(name).Get() for name in ("positions", "orientations", "scales", "opacities", COLORS)}
    np.testing.assert_array_equal(got["positions"], wanted.means)
    np.testing.assert_array_equal(got[COLORS], wanted.sh.reshape(-1, 3))
    np.testing.assert_array_equal(got["scales"], np.exp(wanted.scales.astype(np.float64)).astype(np.float32))
    np.testing.assert_array_equal(got["opacities"], sigmoid(wanted.opacities).astype(np.float32))
    unit = wanted.quats / np.linalg.norm(wanted.quats, axis=1, keepdims=True)
    found = [[quat.real, *quat.imaginary] for quat in got["orientations"]]
    np.testing.assert_allclose(found, unit, atol=1e-7)
    reach = 3 * np.sqrt(np.diagonal(covariances(wanted), axis1=1, axis2=2))
    box = [(wanted.means - reach).min(0), (wanted.means + reach).max(0)]
    np.testing.assert_allclose(prim.GetAttribute("extent").Get(), box, rtol=1e-5)
    errors = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    assert not [error.GetMessage() for error in errors.Validate(stage)]
    assert UsdUtils.ComputeAllDependencies(str(tmp_path / f"a{ending}"))[2] == []
    after = load_gaussians(tmp_path / f"a{ending}", report=silent)
    np.testing.assert_array_equal(sigmoid(after.splats.opacities).astype("f4"), got["opacities"])
    np.testing.assert_allclose(np.exp(after.splats.scales.astype("f8")), got["scales"], rtol=2**-23)


def test_fields_are_joined_as_their_parents_place_them(tmp_path):
    """Z up and centimeters; one field moved, turned and scaled, one mirrored, one hidden, in half precision."""
    stage, parts = stage_of(tmp_path, "Z", 0.01), [some_splats(30, 16, 1), some_splats(20, 4, 2)]
    turn = Rotation.from_rotvec([0.3, 1.0, -0.4])
    parent = UsdGeom.Xform.Define(stage, "/World")
    parent.AddTranslateOp().Set((100, 200, 300))
    parent.AddOrientOp().Set(Gf.Quatf(*turn.as_quat(scalar_first=True).tolist()))
    parent.AddScaleOp().Set((2, 2, 2))
    add(stage, "/World/first", parts[0], half=("scales", "opacities"))
    mirror = add(stage, "/mirrored", parts[1], half=("positions", "orientations", COLORS))
    UsdGeom.Xformable(mirror).AddScaleOp().Set((-1, 1, 1))
    UsdGeom.Imageable(add(stage, "/hidden", parts[0])).MakeInvisible()
    stage.Save()
    lines = []
    found = load_gaussians(tmp_path / "a.usda", lines.append).splats
    assert lines == [f"{tmp_path / 'a.usda'}: its units of 0.01 m became meters."]
    axes = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # right, forward, up to ours
    first = turned(parts[0], axes @ turn.as_matrix(), 0.01 * axes @ [100, 200, 300], 0.02)
    second = turned(parts[1], axes @ np.diag([-1.0, 1, 1]), None, 0.01)
    np.testing.assert_array_equal(found.sh[30:, 4:], 0)
    same(found.take(slice(30)), first, 1e-3)
    second = second._replace(sh=np.pad(second.sh, ((0, 0), (0, 12), (0, 0))))
    same(found.take(slice(30, None)), second, 2e-3)


def test_only_what_is_to_be_drawn_is_read(tmp_path):
    """Of four purposes two; an instance of an instance, mirrored; a point instancer's prototype once, and a line."""
    stage, splats, lines = stage_of(tmp_path), some_splats(5, 16), []
    for number, purpose in enumerate(("default", "render", "proxy", "guide")):
        UsdGeom.Imageable(add(stage, f"/part{number}", some_splats(3, 16, number))).GetPurposeAttr().Set(purpose)
    stage.CreateClassPrim("/_inner"), add(stage, "/_inner/splats", splats), stage.CreateClassPrim("/_outer")
    for path, source in (("/_outer/one", "/_inner"), ("/two", "/_outer")):
        place = UsdGeom.Xform.Define(stage, path)
        place.AddTranslateOp().Set((1, 2, 3)), place.AddScaleOp().Set((-1, 1, 1))
        place.GetPrim().GetReferences().AddInternalReference(source), place.GetPrim().SetInstanceable(True)
    stage.Save()
    found = load_gaussians(tmp_path / "a.usda", lines.append).splats
    assert len(found.means) == 3 + 3 + 5 and not lines
    expected = turned(turned(splats, np.eye(3), np.array([0.0, 4, 6])), HALF_TURN)  # mirrored twice
    same(found.take(slice(6, None)), expected)
    UsdGeom.PointInstancer.Define(stage, "/forest"), add(stage, "/forest/tree", splats), stage.Save()
    stage.GetPrimAtPath("/part0").SetCustomDataByKey("SplatRenderMode", "mip"), stage.Save()
    file = load_gaussians(tmp_path / "a.usda", lines.append)
    assert (len(file.splats.means), file.antialiased) == (16, False)
    assert "only some of its parts are antialiased; all are drawn as if none were" in lines.pop()
    assert len(lines) == 1 and "its point instancers repeat nothing here" in lines[0]


def test_what_a_stage_leaves_out_is_what_the_schema_says(tmp_path):
    stage = stage_of(tmp_path)
    prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/a").GetPrim()
    prim.GetAttribute("positions").Set(Vt.Vec3fArray([(1, 2, 3), (4, 5, 6)]))
    prim.GetAttribute("scales").Set(Vt.Vec3fArray([(2, 2, 2)]))
    prim.GetAttribute("opacities").Set(Vt.FloatArray([0.25, 0.5, 0.75]))
    prim.GetAttribute("projectionModeHint").Set("tangential")
    stage.Save()
    lines = []
    splats = load_gaussians(tmp_path / "a.usda", lines.append).splats
    np.testing.assert_array_equal(splats.means, [[1, -2, -3], [4, -5, -6]])
    np.testing.assert_array_equal(splats.scales, 0)
    np.testing.assert_array_equal(splats.sh[:, 0], 0)
    np.testing.assert_allclose(sigmoid(splats.opacities), [0.25, 0.5])
    np.testing.assert_array_equal(covariances(splats), np.eye(3)[None].repeat(2, 0))
    assert len(lines) == 2 and "is tangential" in lines[0] and "scales are fewer" in lines[1]


def test_refused_in_one_sentence(tmp_path, monkeypatch):
    path = tmp_path / "a.usda"

    def refuse(sentence):
        refusal(lambda: load_gaussians(path), str(path), match=sentence)

    refuse("no such file")
    stage = stage_of(tmp_path)
    UsdGeom.Xformable(add(stage, "/a", some_splats(3))).AddScaleOp().Set((1, 2, 1))
    stage.Save()
    refuse("stretches or shears")
    for key, value, sentence in (("upAxis", '"X"', "one whose axis X is up"), ("metersPerUnit", "0", "units of 0 m")):
        path.write_text(f'#usda 1.0\n({key} = {value})\ndef ParticleField3DGaussianSplat "a" {{}}\n')
        refuse(sentence)
    path.write_text("#usda 1.0\n( garbage")
    refuse("the file is damaged or cut short")
    path.write_text('#usda 1.0\ndef "a" (references = @none.usda@) {}\n')
    refuse("one that is not whole: .*none.usda")
    path.write_text('#usda 1.0\ndef "a" {}\n')
    refuse("none that is visible")
    monkeypatch.setitem(sys.modules, "pxr", None)
    refuse("need the package usd-core; `pip install")
    refusal(lambda: save_gaussians(tmp_path / "b.usdz", some_file()), "need the package usd-core")


def test_a_package_does_not_tell_when_it_was_written(tmp_path):
    save_gaussians(tmp_path / "a.usdz", some_file())
    with zipfile.ZipFile(tmp_path / "a.usdz") as package:
        (stage,) = package.infolist()
    assert stage.date_time[:2] == (1989, 1)


@pytest.mark.parametrize("ending", [".usda", ".usdz"])
@pytest.mark.parametrize("coefficients", [1, 16])
def test_what_nvidias_converter_writes(tmp_path, ending, coefficients):
    """It keeps the axes of the PLY file, unless told otherwise; then it turns all but the harmonics."""
    if not (command := os.environ.get("WARP_SPLAT_GSPLAT2USD")):
        pytest.skip("WARP_SPLAT_GSPLAT2USD is not set: see docs/formats.md")
    file = some_file(50, coefficients)
    save_ply(tmp_path / "a.ply", file)
    source, target = str(tmp_path / "a.ply"), tmp_path / f"b{ending}"
    subprocess.run([*shlex.split(command), "-i", source, "-o", str(target)], check=True, capture_output=True)
    same(load_gaussians(target, report=silent).splats, turned(file.splats, HALF_TURN))

"""Gaussians as glTF: what the extension says, nodes that place them, pieces, and what others write."""

import copy
import json
from types import SimpleNamespace

import numpy as np
import pytest
from hostile import refusal
from scipy.spatial.transform import Rotation
from splat_files import covariances, glb_attributes, glb_bytes, glb_parts, sigmoid, silent, some_file

from warp_splat.formats.exchange import load_gaussians, save_gaussians
from warp_splat.formats.splats import turned
from warp_splat.rendering.finished import Finished

NAME = "KHR_gaussian_splatting"


@pytest.mark.parametrize("ending", [".glb", ".gltf"])
def test_gltf_holds_what_the_extension_says(tmp_path, ending):
    file = some_file(20, antialiased=True)
    save_gaussians(tmp_path / f"a{ending}", file, report=silent)
    document, _ = glb_parts(tmp_path / f"a{ending}")
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0 and document["extensionsUsed"] == [NAME] and "extensionsRequired" not in document
    extension = primitive["extensions"][NAME]
    assert (extension["kernel"], extension["colorSpace"]) == ("ellipse", "srgb_rec709_display")
    wanted, found = turned(file.splats, np.diag([-1.0, -1.0, 1.0])), glb_attributes(tmp_path / f"a{ending}")
    assert len(found) == 5 + 16
    np.testing.assert_array_equal(found["POSITION"], wanted.means)
    bounds = document["accessors"][primitive["attributes"]["POSITION"]]
    for side in ("min", "max"):
        np.testing.assert_array_equal(np.float32(bounds[side]), getattr(wanted.means, side)(0))
    np.testing.assert_allclose(found[f"{NAME}:SCALE"], np.exp(wanted.scales), rtol=1e-6)
    np.testing.assert_allclose(found[f"{NAME}:OPACITY"], sigmoid(wanted.opacities), rtol=1e-5)
    unit = wanted.quats / np.linalg.norm(wanted.quats, axis=1, keepdims=True)
    np.testing.assert_allclose(found[f"{NAME}:ROTATION"], unit[:, [1, 2, 3, 0]], atol=1e-6)
    for degree in range(4):
        for order in range(2 * degree + 1):
            name = f"{NAME}:SH_DEGREE_{degree}_COEF_{order}"
            np.testing.assert_array_equal(found[name], wanted.sh[:, degree * degree + order])
    assert (found["COLOR_0"][:, 3] == np.rint(255 * sigmoid(wanted.opacities))).all()


@pytest.mark.parametrize("name", ["a%41b", "a#b c", "100%", "a\udcffb"])
def test_gltf_of_any_name_finds_its_buffer(tmp_path, name):
    save_gaussians(tmp_path / f"{name}.gltf", some_file(3), report=silent)
    (buffer,) = json.loads((tmp_path / f"{name}.gltf").read_text())["buffers"]
    assert not {"#", " "} & {*buffer["uri"]}
    assert len(load_gaussians(tmp_path / f"{name}.gltf", report=silent).splats.means) == 3


def place(tmp_path, nodes, **more):
    """A file b.glb whose mesh stands where ``nodes`` say."""
    save_gaussians(tmp_path / "a.glb", file := some_file(10), report=silent)
    document, binary = glb_parts(tmp_path / "a.glb")
    (tmp_path / "b.glb").write_bytes(glb_bytes({**document, "nodes": nodes, **more}, binary))
    return file.splats


def test_gltf_nodes_move_turn_and_scale(tmp_path):
    turn = Rotation.from_rotvec([0.3, 1.0, -0.4])
    child = {"mesh": 0, "rotation": turn.as_quat().tolist(), "scale": [2, 2, 2]}
    matrix = np.eye(4)
    matrix[:3, 3] = 1, 2, 3
    before = place(tmp_path, [{"children": [1], "matrix": matrix.T.ravel().tolist()}, child])
    after = load_gaussians(tmp_path / "b.glb", report=silent).splats
    flip = np.diag([-1.0, -1.0, 1.0])  # from our axes to those of glTF and back
    wanted = turned(before, flip @ turn.as_matrix() @ flip, flip @ [1, 2, 3], 2.0)
    np.testing.assert_allclose(after.means, wanted.means, atol=1e-5)
    np.testing.assert_allclose(after.sh, wanted.sh, atol=1e-5)
    np.testing.assert_allclose(covariances(after), covariances(wanted), rtol=1e-3, atol=1e-5)


def test_gltf_pieces_are_joined(tmp_path):
    place(tmp_path, [{"mesh": 0}] * 30, scenes=[{"nodes": list(range(30))}])
    refusal(lambda: load_gaussians(tmp_path / "b.glb"), "more Gaussians than its data has room for")
    before = place(tmp_path, [{"mesh": 0}, {"mesh": 0, "translation": [5, 0, 0]}], scenes=[{"nodes": [0, 1]}])
    after = load_gaussians(tmp_path / "b.glb", report=silent).splats
    np.testing.assert_array_equal(after.means, np.concatenate([before.means, before.means - [5, 0, 0]]).astype("f4"))


def test_gltf_pieces_of_both_lights_are_refused(tmp_path, capsys):
    place(tmp_path, [{"mesh": 0}])
    document, binary = glb_parts(tmp_path / "a.glb")
    first, second = copy.deepcopy(document["meshes"]), copy.deepcopy(document["meshes"])
    whole = {**document, "nodes": [{"mesh": 0}, {"mesh": 1}], "scenes": [{"nodes": [0, 1]}], "meshes": first + second}
    second[0]["primitives"][0]["extensions"][NAME]["colorSpace"] = "lin_rec709_display"
    (tmp_path / "b.glb").write_bytes(glb_bytes(whole, binary))
    refusal(lambda: load_gaussians(tmp_path / "b.glb"), "some are in linear light and some are not")
    mixed = copy.deepcopy(second)
    mixed[0]["primitives"][0]["extensions"][NAME]["extras"] = {"SplatRenderMode": "mip"}
    (tmp_path / "b.glb").write_bytes(glb_bytes({**whole, "meshes": second + mixed}, binary))
    assert Finished(tmp_path / "b.glb").is_linear(SimpleNamespace(linear=False))
    assert "only some of its parts are antialiased" in capsys.readouterr().out


def test_gltf_quantized_attributes(tmp_path):
    """Bytes and shorts, normalized, strided, as the extension allows; scales below 0 are an old draft's logarithms."""
    rows = np.zeros(2, [("p", "<i2", 3), ("pad", "<i2"), ("q", "i1", 4), ("s", "<u2", 3), ("o", "u1"), ("x", "u1")])
    rows["p"], rows["q"], rows["s"], rows["o"] = [[1, 2, -3], [4, 5, 6]], [[0, 0, 0, 127]] * 2, 1, [51, 255]
    data = rows.tobytes() + np.float32([[1, 2, 3], [4, 5, 6]]).tobytes()
    kinds = {"POSITION": (0, 5122, "VEC3", False), f"{NAME}:ROTATION": (8, 5120, "VEC4", True)}
    kinds |= {f"{NAME}:SCALE": (12, 5123, "VEC3", False), f"{NAME}:OPACITY": (18, 5121, "SCALAR", True)}
    names = ("byteOffset", "componentType", "type", "normalized")
    accessors = [dict(zip(names, kind, strict=True)) | {"bufferView": 0, "count": 2} for kind in kinds.values()]
    accessors.append({"bufferView": 1, "componentType": 5126, "type": "VEC3", "count": 2})
    attributes = {name: index for index, name in enumerate([*kinds, f"{NAME}:SH_DEGREE_0_COEF_0"])}
    primitive = {"mode": 0, "attributes": attributes, "extensions": {NAME: {"kernel": "ellipse"}}}
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": [NAME, "KHR_mesh_quantization"],
        "extensionsRequired": ["KHR_mesh_quantization"],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteLength": rows.nbytes, "byteStride": rows.itemsize},
            {"buffer": 0, "byteOffset": rows.nbytes, "byteLength": 24},
        ],
        "buffers": [{"byteLength": len(data)}],
    }
    (tmp_path / "a.glb").write_bytes(glb_bytes(document, data))
    splats = load_gaussians(tmp_path / "a.glb", report=silent).splats
    np.testing.assert_array_equal(splats.means, [[-1, -2, -3], [-4, -5, 6]])
    np.testing.assert_array_equal(splats.scales, 0)
    np.testing.assert_array_equal(splats.sh[:, 0], [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(sigmoid(splats.opacities), [0.2, 1.0], atol=1e-6)
    np.testing.assert_allclose(covariances(splats), [np.eye(3)] * 2, atol=1e-6)
    accessors[2]["componentType"] = 5122
    (tmp_path / "a.glb").write_bytes(glb_bytes(document, data.replace(b"\1\0\1\0\1\0", b"\xff\xff\0\0\1\0")))
    lines = []
    np.testing.assert_array_equal(load_gaussians(tmp_path / "a.glb", lines.append).splats.scales, [[-1, 0, 1]] * 2)
    assert len(lines) == 1 and "logarithms" in lines[0]


def test_gltf_nodes_that_are_hidden_repeated_or_too_far_away(tmp_path):
    """A child of a hidden node is hidden, too; what 32 bits round, and instances, are told."""
    hidden = {"KHR_node_visibility": {"visible": False}}
    hidden["KHR_node_visibility"]["extras"] = {}
    repeated = {"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}}
    nodes = [repeated, {"children": [2], "extensions": hidden}, {"mesh": 0}]
    before = place(tmp_path, nodes, scenes=[{"nodes": [0, 1]}], extensionsRequired=["KHR_node_visibility"])
    lines = []
    assert len(load_gaussians(tmp_path / "b.glb", lines.append).splats.means) == len(before.means)
    assert len(lines) == 1 and "EXT_mesh_gpu_instancing repeats nothing here" in lines[0]
    place(tmp_path, [{"mesh": 0, "translation": [5e5, 0, 5.4e6]}])
    lines.clear()
    load_gaussians(tmp_path / "b.glb", lines.append)
    assert len(lines) == 1 and "positions are rounded to steps of about 0.6; move it nearer" in lines[0]
    place(tmp_path, [{"mesh": 0, "translation": [5e3, 0, 5e3], "extensions": ["x"]}])
    load_gaussians(tmp_path / "b.glb", lines.append)
    assert len(lines) == 1

"""Files from strangers: whatever the bytes, a reader gives finite Gaussians or one sentence, in little memory.

Random bytes, cuts, and changes of valid files: of the bytes, of what is compressed, and of values in the JSON.
The short run is part of every test run; the long one is marked long. Both try the same inputs each time, so that they
gate a change and nothing else; the long one tries others with ``--hypothesis-seed=N``.
"""

import gzip
import io
import json
import struct
import warnings
import zipfile

import numpy as np
import pytest
from hostile import changed, changed_json, little_memory, one_sentence, tried, value_at
from hypothesis import strategies as st
from splat_files import glb_bytes, glb_parts, sog_bytes, some_file, spz2, spz4

from warp_splat.errors import InputError
from warp_splat.formats.exchange import load_gaussians, save_gaussians

QUICK, LONG = 150, 2_000  # examples for each reader
MEMORY = 200 * 2**20  # bytes for a file of a few kilobytes: JSON of many lists and the smallest limits of SPZ fit in
KINDS = ("ply", "text.ply", "compressed.ply", "splat", "2.spz", "3.spz", "4.spz", "sog", "glb", "gltf")

WORDS = b"0 1 3 5 -1 1000000000000 99999999999999 1e3 float double uchar int8 list vertex face x nx f_rest_0 opacity"
WORDS = [*WORDS.split(), b"comment", b"element", b"property", b"ascii", b"binary_big_endian", b"", b"\xff", b"\0"]


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    """A small valid file of each kind, as bytes."""
    folder = tmp_path_factory.mktemp("valid")
    file, files = some_file(4, 4), {}
    for ending in ("ply", "compressed.ply", "splat", "sog", "glb"):
        save_gaussians(folder / f"a.{ending}", file, report=lambda line: None)
        files[ending] = (folder / f"a.{ending}").read_bytes()
    rows = np.frombuffer(files["ply"].split(b"end_header\n")[1], "<f4").reshape(4, -1)
    text = "\n".join(" ".join(map(str, row)) for row in rows)
    header = files["ply"].split(b"end_header\n")[0].replace(b"binary_little_endian", b"ascii")
    files["text.ply"] = header + b"end_header\n" + text.encode()
    spz2(folder / "2.spz")
    save_gaussians(folder / "3.spz", file)
    save_gaussians(folder / "4.spz", file)
    spz4(folder / "4.spz", 4)
    files |= {f"{version}.spz": (folder / f"{version}.spz").read_bytes() for version in (2, 3, 4)}
    document, binary = glb_parts(folder / "a.glb")
    document["buffers"][0]["uri"] = "data.bin"
    files["gltf"], files["data.bin"] = json.dumps(document).encode(), binary
    return files


def survive(folder, kind, data):
    """Read ``data`` as a file of ``kind``; whether it was read at all."""
    path, lines = folder / f"hostile.{kind}", []
    path.write_bytes(data)
    try:
        with little_memory(MEMORY + 100 * len(data)), warnings.catch_warnings(action="error"):
            splats, antialiased, *_ = load_gaussians(path, report=lines.append)
    except InputError as error:
        one_sentence(error, path)
        return False
    assert all(array.dtype == np.float32 and np.isfinite(array).all() for array in splats)
    assert isinstance(antialiased, bool) and len({len(array) for array in splats}) == 1
    assert all("\n" not in line for line in lines)
    return True


def changed_header(draw, data):
    """A PLY file with a few words or lines of its header replaced, repeated or removed, and maybe a few bytes after."""
    header, body = data.split(b"end_header\n", 1)
    lines = [line.split(b" ") for line in header.split(b"\n")]
    for _ in range(draw(st.integers(1, 3))):
        line = draw(st.integers(0, len(lines) - 1))
        match draw(st.sampled_from(["word", "word", "repeat", "remove", "body"])):
            case "word":
                lines[line][draw(st.integers(0, len(lines[line]) - 1))] = draw(st.sampled_from(WORDS))
            case "repeat":
                lines.insert(draw(st.integers(0, len(lines))), list(lines[line]))
            case "remove":
                lines[line:] = lines[line + 1 :] or [[b""]]
            case "body":
                body = changed(draw, body)
    return b"\n".join(b" ".join(line) for line in lines) + b"end_header\n" + body


@st.composite
def hostile(draw, kind, files):
    """Bytes that a reader of ``kind`` may be given."""
    data = files[kind]
    how = draw(st.sampled_from(["random", "changed", "changed", "inside", "inside", "inside"]))
    if how == "random":
        keep = draw(st.integers(0, 40))  # a valid beginning gets further
        return data[:keep] + draw(st.binary(max_size=300))
    if how == "changed":
        return changed(draw, data)
    if kind in ("2.spz", "3.spz"):
        return gzip.compress(changed(draw, gzip.decompress(data)), 1)
    if kind == "sog":
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            files = {name: archive.read(name) for name in archive.namelist()}
        meta = json.loads(files.pop("meta.json"))
        if draw(st.booleans()):
            return sog_bytes(changed_json(draw, meta), files)
        name = draw(st.sampled_from(sorted(files)))
        return sog_bytes(meta, {**files, name: changed(draw, files[name])})
    if kind == "gltf":
        return json.dumps(changed_json(draw, json.loads(data))).encode()
    if kind == "glb":
        size = struct.unpack_from("<I", data, 12)[0]
        return glb_bytes(changed_json(draw, json.loads(data[20 : 20 + size])), data[28 + size :])
    if kind.endswith("ply"):
        return changed_header(draw, data)
    return changed(draw, data)


@pytest.mark.parametrize("examples", [QUICK, pytest.param(LONG, marks=pytest.mark.long)])
@pytest.mark.parametrize("kind", KINDS)
def test_hostile_bytes(tmp_path, valid, kind, examples, pytestconfig):
    (tmp_path / "data.bin").write_bytes(valid["data.bin"])
    assert survive(tmp_path, kind, valid[kind])
    seeded = examples == LONG and pytestconfig.getoption("--hypothesis-seed") is not None
    tried(examples, hostile(kind, valid), lambda data: survive(tmp_path, kind, data), seeded)


@pytest.mark.parametrize("bits", [0x7F800001, 0xFFBFFFFF, 0x7F7FFFFF])
@pytest.mark.parametrize("kind", ["ply", "compressed.ply", "glb"])
def test_signaling_and_huge_numbers_are_read_without_a_word(tmp_path, valid, kind, bits):
    """NumPy warns where it casts a NaN that signals."""
    data = bytearray(valid[kind])
    begin = len(data) - 256 if kind == "glb" else data.rindex(b"end_header\n") + len(b"end_header\n")
    for place in range(begin, len(data) - 8, 28):
        data[place : place + 4] = bits.to_bytes(4, "little")
    assert survive(tmp_path, kind, bytes(data))


@pytest.mark.parametrize("kind", KINDS)
def test_every_cut(tmp_path, valid, kind):
    (tmp_path / "data.bin").write_bytes(valid["data.bin"])
    for length in range(0, len(valid[kind]), 1 + len(valid[kind]) // 300):
        read = survive(tmp_path, kind, valid[kind][:length])
        whole = kind == "splat" and length % 32 == 0 and length  # nothing says how many there should be
        last_digits = kind == "text.ply" and length > len(valid[kind]) - 12
        assert not read or whole or last_digits, f"{length} of {len(valid[kind])} bytes were taken for a file"


@pytest.mark.parametrize(
    ("count", "size", "sentence"),
    [
        (4_000_000, 65 * 4_000_000, "4000000 Gaussians expand to 260000000 bytes, over"),
        (2**32 - 1, 1000, "4294967295 Gaussians expand to"),
        (1, 10**8, "goes on after its last Gaussian"),
        (100, 65 * 50, "found 0 of 900|found 250 of|bytes"),
    ],
)
def test_gzip_bombs(tmp_path, count, size, sentence):
    """Few bytes that expand to many zeros, with a header that asks for many Gaussians."""
    header = struct.pack("<4sIIBBBB", b"NGSP", 3, count, 3, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(header + bytes(size)))
    with little_memory(2**25), pytest.raises(InputError, match=rf"a\.spz.*({sentence})"):
        load_gaussians(tmp_path / "a.spz")


URI, COUNT, VIEW = "buffers__0__uri", "accessors__0__count", "bufferViews__0__byte"
PRIMITIVE = "meshes__0__primitives__0__"
EXTENSION = f"{PRIMITIVE}extensions__KHR_gaussian_splatting__"


@pytest.mark.parametrize(
    ("way", "value", "sentence"),
    [
        (URI, "../data.bin", "a buffer outside of its folder"),
        (URI, "%2e%2e/data.bin", "a buffer outside of its folder"),
        (URI, "/etc/hostname", "a buffer outside of its folder"),
        (URI, "..\\data.bin", "a buffer outside of its folder"),
        (URI, "http://example.org/data.bin", "a buffer outside of its folder"),
        (URI, "link.bin", "a buffer outside of its folder"),
        (URI, "none.bin", "no file 'none.bin' beside it"),
        (URI, ".", "no file"),
        (URI, "a\0b", "damaged"),
        (URI, "x" * 5000, "could not be read"),
        (URI, "data:application/octet-stream;base64,AAAA", "a buffer inside the JSON"),
        (URI, 5, "a buffer inside the JSON"),
        (COUNT, 10**12, "count 1000000000000, at most 4"),
        (COUNT, 10**300, "count of many digits"),
        (COUNT, -1, "count -1, at most"),
        (COUNT, 1.5, "count 1.5, which is no whole number"),
        (COUNT, True, "count True, which is no whole number"),
        (COUNT, 3, "attributes of different lengths"),
        ("accessors__0__sparse", {}, "without data of its own"),
        ("accessors__0__componentType", 5125, "type 'VEC3', 5125"),
        (f"{VIEW}Stride", 3, "byteStride 3"),
        (f"{VIEW}Length", 10**9, "byteLength of a bufferView 1000000000"),
        ("buffers__0__byteLength", 10**9, "byteLength of a buffer 1000000000"),
        ("nodes__0__children", [0], "node 0 in two places"),
        ("nodes", [{"children": [1, 1], "mesh": 0}, {"mesh": 0}], "node 1 in two places"),
        ("nodes__0__mesh", 7, "index of meshes 7"),
        ("nodes__0__scale", [1, 2, 1], "a node that stretches or shears"),
        ("nodes__0__scale", [0, 0, 0], "a node that stretches or shears"),
        ("nodes__0__scale", [1e200, 1e200, 1e200], "a node that stretches or shears"),
        ("nodes__0__rotation", [0, 0, 0, 0], "a rotation"),
        ("nodes__0__matrix", [1] * 15, "matrix that are not 16 numbers"),
        ("scenes__0__nodes", [], "0 meshes of them"),
        ("extensionsRequired", ["KHR_draco_mesh_compression"], "needs the extension 'KHR_draco"),
        ("extensionsRequired", [[]], "needs the extension"),
        (f"{PRIMITIVE}extensions", {}, "0 meshes of them"),
        (f"{EXTENSION}kernel", "cone", "kernel 'cone'"),
        (f"{EXTENSION}extensions", {"spz": {}}, "in a compressed form"),
        (f"{PRIMITIVE}attributes", {}, "0 coefficients of SH"),
        (f"{PRIMITIVE}attributes__POSITION", 99, "index of accessors 99"),
        (f"{PRIMITIVE}attributes", 5, "a primitive without attributes"),
        ("nodes__0__scale", [1e100, 1e100, 1e100], None),  # positions beyond float32: every Gaussian is left out
    ],
)
def test_gltf_that_asks_for_too_much(tmp_path, valid, way, value, sentence):
    """Values replaced; ``way`` leads to one."""
    path = tmp_path / "inside" / "a.gltf"
    path.parent.mkdir()
    for folder in (tmp_path, path.parent):
        (folder / "data.bin").write_bytes(valid["data.bin"])
    (path.parent / "link.bin").symlink_to(tmp_path / "data.bin")
    document = json.loads(valid["gltf"])
    *keys, last = (int(key) if key.isdecimal() else key for key in way.split("__"))
    value_at(document, keys)[last] = value
    path.write_text(json.dumps(document))
    if sentence is None:
        assert len(load_gaussians(path, report=lambda line: None).splats.means) == 0
        return
    with pytest.raises(InputError, match=sentence) as error:
        load_gaussians(path)
    one_sentence(error, path, 400 - len(str(path)))


@pytest.mark.parametrize(
    "text",
    [
        b"[" * 10**6,
        b'{"a":' * 10**5,
        b"[]",
        b"5",
        b'{"asset": ' + b"9" * 10**5 + b"}",
        b'{"nodes": NaN}',
        b'{"nodes": 1e999}',
        b"\xff\xfe",
        b'{"a": [' + b"[]," * 300_000 + b"[]]}",
        b" " * (2**22 + 1),
        b'{"buffers": [' + b'{"byteLength": 1, "uri": "data.bin"},' * 10_000 + b"{}]}",
    ],
    ids=lambda text: f"{text[:12]!r}-{len(text)}",
)
def test_json_bombs(tmp_path, valid, text):
    (tmp_path / "data.bin").write_bytes(valid["data.bin"])
    assert not survive(tmp_path, "gltf", text)
    chunk = struct.pack("<I4s", len(text), b"JSON") + text
    assert not survive(tmp_path, "glb", struct.pack("<4sII", b"glTF", 2, 12 + len(chunk)) + chunk)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data.bin", "hostile.glb", "hostile.gltf"]

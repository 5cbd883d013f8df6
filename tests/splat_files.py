"""Gaussians to write into files, and readers and writers of such files that share nothing with the package."""

import gzip
import io
import json
import struct
import zipfile
from pathlib import Path

import numpy as np
import torch
import zstandard
from PIL import Image
from scipy.spatial.transform import Rotation

from warp_splat.compare.oracle import sh_basis
from warp_splat.formats.splats import SplatArrays, SplatFile

ENDINGS = (".ply", ".compressed.ply", ".splat", ".spz", ".sog", ".glb", ".gltf", ".usd", ".usda", ".usdc", ".usdz")


def some_splats(count=50, coefficients=16, seed=0):
    """Gaussians as a training leaves them, within the range of every format."""
    rng = np.random.default_rng(seed)
    return SplatArrays(
        means=rng.normal(scale=3.0, size=(count, 3)).astype(np.float32),
        sh=rng.uniform(-0.9, 0.9, (count, coefficients, 3)).astype(np.float32),
        opacities=rng.normal(scale=2.0, size=count).astype(np.float32),
        scales=rng.uniform(-6.0, 1.0, (count, 3)).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
    )


def small_splats(count, coefficients=1, seed=5):
    """Those in a ball of about 1."""
    splats = some_splats(count, coefficients, seed)
    return splats._replace(means=splats.means / 5, scales=splats.scales / 5 - 1.8, sh=splats.sh / 2)


def some_file(count=50, coefficients=16, seed=0, antialiased=False):
    return SplatFile(some_splats(count, coefficients, seed), antialiased)


def covariances(splats):
    """[N, 3, 3] float64, by SciPy's rotations."""
    rotation = Rotation.from_quat(splats.quats.astype(np.float64), scalar_first=True).as_matrix()
    factors = rotation * np.exp(splats.scales.astype(np.float64))[:, None]
    return factors @ factors.transpose(0, 2, 1)


def glb_parts(path):
    """The JSON and the binary chunk of a .glb file, or of a .gltf file and its buffer."""
    data = Path(path).read_bytes()
    if not data.startswith(b"glTF"):
        document = json.loads(data)
        return document, (Path(path).parent / document["buffers"][0]["uri"]).read_bytes()
    magic, version, length, json_length, json_kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, json_kind) == (b"glTF", 2, len(data), b"JSON") and json_length % 4 == 0
    binary_length, binary_kind = struct.unpack_from("<I4s", data, 20 + json_length)
    assert binary_kind == b"BIN\0" and 28 + json_length + binary_length == length
    return json.loads(data[20 : 20 + json_length]), data[28 + json_length :]


def glb_bytes(document, binary):
    """A .glb file."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def glb_attributes(path):
    """The attributes of the first primitive, by name."""
    document, binary = glb_parts(path)
    found = {}
    for name, index in document["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        dtype = {5121: np.uint8, 5126: np.dtype("<f4")}[accessor["componentType"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        values = np.frombuffer(binary, dtype, accessor["count"] * width, start)
        found[name] = values.reshape(-1, width) if width > 1 else values
    return found


def sog_parts(path):
    """The JSON of a .sog file and its images, by name, as RGBA [H, W, 4]."""
    with zipfile.ZipFile(path) as archive:
        meta = json.loads(archive.read("meta.json"))
        names = [name for name in archive.namelist() if name != "meta.json"]
        return meta, {name: np.asarray(Image.open(archive.open(name)).convert("RGBA")) for name in names}


def sog_bytes(meta, files, compression=zipfile.ZIP_STORED):
    """A .sog file of a meta.json, which may be bytes, and files by name."""
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", compression) as archive:
        archive.writestr("meta.json", meta if isinstance(meta, bytes) else json.dumps(meta))
        for name, data in files.items():
            archive.writestr(name, data)
    return target.getvalue()


def webp_bytes(image, **options):
    target = io.BytesIO()
    Image.fromarray(image).save(target, "WEBP", **{"lossless": True, "exact": True, **options})
    return target.getvalue()


def silent(line):
    raise AssertionError(f"unexpected: {line}")


def sigmoid(x):
    return 1 / (1 + np.exp(-np.asarray(x, np.float64)))


def seen_colors(splats, directions):
    """What a viewer sees along ``directions`` [N, 3], float64."""
    degree = int(np.sqrt(splats.sh.shape[1])) - 1
    basis = sh_basis(torch.from_numpy(directions), degree).numpy()
    return np.einsum("nk,nkc->nc", basis[:, : splats.sh.shape[1]], splats.sh.astype(np.float64))


def spz2(path, quats=(255, 128, 128)):
    """One Gaussian of version 2, degree 0, at (1, 2, 3) in axes right, up, back."""
    fixed = b"".join((value * 256).to_bytes(3, "little", signed=True) for value in (1, 2, 3))
    body = (
        struct.pack("<4sIIBBBB", b"NGSP", 2, 1, 0, 8, 0, 0) + fixed + bytes([128, 0, 128, 255, 160, 160, 176, *quats])
    )
    path.write_bytes(gzip.compress(body))


def spz4(path, axes_number=None):
    """The file rewritten as version 4, if wanted with an extension that names its axes."""
    data = gzip.decompress(path.read_bytes())
    _, _, count, degree, bits, flags, _ = struct.unpack("<4sIIBBBB", data[:16])
    streams, place = [], 16
    for size in (9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)):
        streams += [data[place : place + count * size]] if size else []
        place += count * size
    records = struct.pack("<II5s", 0x12340001, 5, b"other")
    records += struct.pack("<III", 0xADBE0003, 4, axes_number) if axes_number is not None else b""
    packed = [zstandard.compress(stream) for stream in streams]
    table = b"".join(struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams, strict=True))
    header = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, degree, bits, flags | 2, len(streams), 32 + len(records))
    path.write_bytes(header + records + table + b"".join(packed))

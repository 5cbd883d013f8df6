"""Gaussians as glTF 2.0 files with the extension KHR_gaussian_splatting, ratified by the Khronos Group in 2026.

A mesh primitive of POINTS whose attributes are POSITION, ROTATION (x y z w), SCALE (standard deviations), OPACITY
(0..1) and SH_DEGREE_l_COEF_n, one VEC3 for each coefficient. Axes of glTF: left, up, forward. COLOR_0 is what viewers
without the extension show. The extension has no word for Mip-Splatting: "extras" keeps the PLY file's. Those of the
file say where in the world the Gaussians are.
"""

import hashlib
import json
import os
from pathlib import Path
from urllib.parse import quote

import numpy as np

from warp_splat import __version__
from warp_splat.color import from_srgb
from warp_splat.errors import InputError
from warp_splat.formats.coordinates import kept
from warp_splat.formats.files import Unexpected, atomic_write, entries_of, reading, write_bytes
from warp_splat.formats.gltf_container import CHUNK, HEADER, VISIBILITY, Document, held
from warp_splat.formats.splats import COEFFICIENTS, SplatArrays, SplatFile, frame, of_parts, placed, turned
from warp_splat.formats.stored import LOG_SCALES, SH_C0, clipped, log_scales, logit, sigmoid, unit_quats
from warp_splat.text import Report

NAME = "KHR_gaussian_splatting"
AXES = "LUF"
UNDERSTOOD = {NAME, "KHR_mesh_quantization", VISIBILITY}  # extensions that a file may require
COLOR_SPACES = ("srgb_rec709_display", "lin_rec709_display")  # as photographs have it; in linear light
RENDER_MODE = "SplatRenderMode"
INSTANCES = "EXT_mesh_gpu_instancing"
COORDINATES = "coordinates"
MOST_PIECES = 4096  # meshes; the Gaussians of a scene are one or a few
LEAST_BYTES = 23  # of a Gaussian: bytes for position, rotation, scale and opacity, three floats for the color
GLB_BYTES = 2**32 - 1  # the length in the header of a .glb file has four bytes
ARRAY_BUFFER = 34962


def save_gltf(path: str | Path, file: SplatFile, report: Report = print) -> None:
    """Write Gaussians as a .glb file, or as a .gltf file with a .bin file beside it.

    The name of the .bin file holds a checksum, so that an older .gltf file keeps its own until it is replaced.

    Args:
        path: the file to write.
        file: the Gaussians, at least one.
        report: called with a part of a sentence for each kind of value that the format cannot hold.

    Raises:
        InputError: if a file cannot be written, or is too large for its kind.
    """
    path = Path(path)
    attributes = _attributes(turned(file.splats, frame(AXES).T), file.linear, report)
    data = b"".join(array.tobytes() for array in attributes.values())
    document = _describe(attributes, file)
    if coordinates := kept(file.coordinates, "x west, y up, z north"):
        document["extras"] = {COORDINATES: coordinates}
    if path.suffix.lower() == ".gltf":
        buffer = path.with_name(f"{path.stem}.{hashlib.sha256(data).hexdigest()[:8]}.bin")
        document["buffers"][0]["uri"] = quote(os.fsencode(buffer.name))
        with atomic_write(path) as temporary:
            temporary.write_text(json.dumps(document, indent=1, allow_nan=False), encoding="utf-8")
            write_bytes(buffer, data)  # last, so that it does not stay alone where the disk becomes full
        return
    text = json.dumps(document, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)  # chunks are padded to four bytes; every attribute is
    chunks = CHUNK.pack(len(text), b"JSON") + text + CHUNK.pack(len(data), b"BIN\0") + data
    if HEADER.size + len(chunks) > GLB_BYTES:
        raise InputError(f"{path}: {len(chunks)} bytes are more than a .glb file can hold; choose a name in .gltf.")
    write_bytes(path, HEADER.pack(b"glTF", 2, HEADER.size + len(chunks)) + chunks)


def load_gltf(path: str | Path, report: Report = print) -> SplatFile:
    """Read all Gaussians of a .glb or .gltf file's scene, as its nodes place them.

    Args:
        path: the file.
        report: called with a line for what differs from the extension's text, and if Gaussians were left out.

    Raises:
        InputError: if the file is missing, damaged, holds no Gaussians, or wants what is not supported.
    """
    with reading(path, "a glTF 2.0 file of Gaussians (KHR_gaussian_splatting)"):
        document = Document(path)
        required = entries_of(document.json, "extensionsRequired")
        if unknown := [name for name in required if not isinstance(name, str) or name not in UNDERSTOOD]:
            raise Unexpected(f"one that needs the extension {unknown[0]!r:.80}; export it without")
        meshes = [(entries_of(mesh, "primitives"), world) for mesh, world in document.placed_meshes()]
        found = [(piece, world) for pieces, world in meshes for piece in pieces if NAME in held(piece, "extensions")]
        if not 0 < len(found) <= MOST_PIECES:
            raise Unexpected(f"{len(found)} meshes of them in its scene, at most {MOST_PIECES} are read")
        notes: list[str] = []
        lengths = {buffer.path: buffer.length for buffer in document.buffers}  # those that are one file counted once
        parts, room = [], sum(lengths.values()) // LEAST_BYTES
        for piece, world in found:
            splats = _read_primitive(document, piece, notes.append)
            room -= len(splats.means)
            if room < 0:
                raise Unexpected("more Gaussians than its data has room for, some placed many times")
            parts.append(placed(splats, world, frame(AXES), notes.append))
        told = [piece["extensions"][NAME] for piece, _ in found]
        linear = {extension.get("colorSpace") == COLOR_SPACES[1] for extension in told}
        if len(linear) > 1:
            raise Unexpected("meshes of which some are in linear light and some are not; export them alike")
        mip = [held(extension, "extras").get(RENDER_MODE) == "mip" for extension in told]
        if any(INSTANCES in held(node, "extensions") for node in entries_of(document.json, "nodes")):
            notes.append(f"{INSTANCES} repeats nothing here; export nodes instead to draw all")
        coordinates = kept(held(document.json, "extras").get(COORDINATES))
    return of_parts(path, parts, mip, notes, report)._replace(coordinates=coordinates, linear=linear.pop())


def _attributes(splats: SplatArrays, in_linear: bool, report: Report) -> dict[str, np.ndarray]:
    means, sh, opacities, scales, quats = splats
    opacity = sigmoid(opacities)
    shown = np.clip(SH_C0 * sh[:, 0] + 0.5, 0, 1)
    linear = shown if in_linear else from_srgb(shown, np.where)  # as COLOR_0 is
    attributes = {
        "POSITION": means,
        "COLOR_0": np.rint(255 * np.concatenate([linear, opacity[:, None]], axis=1)),
        f"{NAME}:ROTATION": unit_quats(quats)[:, [1, 2, 3, 0]],
        f"{NAME}:SCALE": np.exp(clipped("log scale", scales, *LOG_SCALES, report)),
        f"{NAME}:OPACITY": opacity,
    }
    attributes |= {name: sh[:, index] for index, name in enumerate(_harmonic_names(sh.shape[1]))}
    return {name: np.asarray(array, "u1" if name == "COLOR_0" else "<f4") for name, array in attributes.items()}


def _harmonic_names(coefficients: int) -> list[str]:
    degrees = range(COEFFICIENTS.index(coefficients) + 1)
    return [f"{NAME}:SH_DEGREE_{degree}_COEF_{order}" for degree in degrees for order in range(2 * degree + 1)]


def _describe(attributes: dict[str, np.ndarray], file: SplatFile) -> dict:
    """The JSON of a file whose buffer holds the attributes one after the other."""
    views, accessors, offset = [], [], 0
    for index, (name, array) in enumerate(attributes.items()):
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": ARRAY_BUFFER})
        offset += array.nbytes
        kind = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
        component = {"normalized": True, "componentType": 5121} if array.dtype == np.uint8 else {"componentType": 5126}
        accessors.append({"bufferView": index, "count": len(array), "type": kind, **component})
        if name == "POSITION":
            accessors[-1] |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
    extension: dict = {"kernel": "ellipse", "colorSpace": COLOR_SPACES[file.linear]}
    if file.antialiased:
        extension["extras"] = {RENDER_MODE: "mip"}
    indices = {name: index for index, name in enumerate(attributes)}
    return {
        "asset": {"version": "2.0", "generator": f"warp_splat {__version__}"},
        "extensionsUsed": [NAME],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"mode": 0, "attributes": indices, "extensions": {NAME: extension}}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }


def _read_primitive(document: Document, primitive: dict, report: Report) -> SplatArrays:
    extension, attributes = primitive["extensions"][NAME], primitive.get("attributes")
    if not isinstance(extension, dict) or not isinstance(attributes, dict):
        raise Unexpected("a primitive without attributes")
    kernel, space = extension.get("kernel", "ellipse"), extension.get("colorSpace", COLOR_SPACES[0])
    if kernel != "ellipse" or extension.get("extensions"):
        raise Unexpected(f"Gaussians of kernel {kernel!r:.40} or in a compressed form; export them without extensions")
    if space not in COLOR_SPACES:
        report(f"the colors are in {space!r:.40} and are kept as they are; expected {COLOR_SPACES[0]!r}")
    coefficients = sum(name.startswith(f"{NAME}:SH_DEGREE_") for name in attributes)
    if coefficients not in COEFFICIENTS:
        raise Unexpected(f"a primitive with {coefficients} coefficients of SH, not 1, 4, 9 or 16")
    kinds = {"POSITION": "VEC3", f"{NAME}:ROTATION": "VEC4", f"{NAME}:SCALE": "VEC3", f"{NAME}:OPACITY": "SCALAR"}
    kinds |= dict.fromkeys(_harmonic_names(coefficients), "VEC3")
    if missing := [name for name in kinds if name not in attributes]:
        raise Unexpected(f"a primitive that lacks {', '.join(missing)}")
    arrays = [document.accessor(attributes[name], kind) for name, kind in kinds.items()]
    if len({len(array) for array in arrays}) > 1:
        raise Unexpected("attributes of different lengths")
    means, rotations, scales, opacities, *sh = arrays
    if (scales < 0).any():
        report("scales below 0, taken as logarithms, as in drafts of the extension")
    return SplatArrays(
        means=means,
        sh=np.stack(sh, axis=1),
        opacities=logit(clipped("opacity", opacities, 0.0, 1.0, report)),
        scales=scales if (scales < 0).any() else log_scales(scales),
        quats=rotations[:, [3, 0, 1, 2]],
    )

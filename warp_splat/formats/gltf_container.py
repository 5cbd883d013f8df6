"""What a glTF 2.0 file is made of, as far as points need it: JSON, buffers, accessors, the tree of nodes.

Written for files of strangers. Every number is checked before it is used. Nothing is allocated that the file does not
hold. No other files are opened than buffers in the folder of the .gltf file or below.

Own code, plain JSON and NumPy: the libraries for glTF build objects from the JSON without checking it.
"""

import os
import struct
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np

from warp_splat.formats.files import Unexpected, entries_of, json_object, numbers_of, whole_number

HEADER = struct.Struct("<4sII")  # of a .glb file: magic, version, length
CHUNK = struct.Struct("<I4s")  # length, type
JSON_BYTES = 2**22  # a thousand times that of a file of Gaussians, and a hundred megabytes once parsed
MOST_BUFFERS = 256  # files to look for; the Gaussians of a scene are in one or a few
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
TYPES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
VISIBILITY = "KHR_node_visibility"


def held(entry: object, name: str) -> dict:
    """The object by that name in another; an empty one, if it is none."""
    found = entry.get(name) if isinstance(entry, dict) else None
    return found if isinstance(found, dict) else {}


class Buffer(NamedTuple):
    """A run of bytes of a file."""

    path: Path
    start: int
    length: int


class Document:
    """An opened .glb or .gltf file.

    Attributes:
        json: its JSON object.
        buffers: one for each entry of "buffers".
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        size = self.path.stat().st_size
        with open(self.path, "rb") as source:
            binary = source.peek(4)[:4] == b"glTF"
            if not binary and size > JSON_BYTES:
                raise Unexpected(f"a JSON file of {size} bytes, more than {JSON_BYTES}")
            text, chunk = self._read_chunks(source, size) if binary else (source.read(), None)
        self.json = json_object(text)
        if (count := len(entries_of(self.json, "buffers"))) > MOST_BUFFERS:
            raise Unexpected(f"{count} buffers, more than {MOST_BUFFERS}")
        self.buffers = [self._open(self.entry("buffers", i), chunk if i == 0 else None) for i in range(count)]

    def entry(self, kind: str, index: Any) -> dict:
        """The object ``index`` of the list ``kind`` of the JSON."""
        if not isinstance((entries := self.json.get(kind)), list):
            raise Unexpected(f"no list of {kind}")
        found = entries[whole_number(index, f"index of {kind}", len(entries) - 1)]
        if not isinstance(found, dict):
            raise Unexpected(f"no object as entry {index} of {kind}")
        return found

    def accessor(self, index: Any, kind: str) -> np.ndarray:
        """The values of an accessor of type ``kind`` as float32, [N] or [N, components]."""
        accessor = self.entry("accessors", index)
        component = whole_number(accessor.get("componentType"), "componentType", max(COMPONENTS))
        if accessor.get("type") != kind or component not in COMPONENTS:
            raise Unexpected(f"accessor {index} of type {accessor.get('type')!r:.40}, {component}")
        if "sparse" in accessor or "bufferView" not in accessor:
            raise Unexpected(f"accessor {index} without data of its own (sparse, or compressed)")
        dtype, width = np.dtype(COMPONENTS[component]), TYPES[kind]
        view = self.entry("bufferViews", accessor["bufferView"])
        buffer = self.buffers[whole_number(view.get("buffer"), "buffer", len(self.buffers) - 1)]
        first = whole_number(view.get("byteOffset", 0), "byteOffset", buffer.length)
        length = whole_number(view.get("byteLength"), "byteLength of a bufferView", buffer.length - first)
        offset = whole_number(accessor.get("byteOffset", 0), "byteOffset of an accessor", length)
        element = dtype.itemsize * width
        if (stride := whole_number(view.get("byteStride", element), "byteStride", 252)) < element:
            raise ValueError(f"byteStride {stride} for elements of {element} bytes")
        count = whole_number(accessor.get("count"), "count", (length - offset - element) // stride + 1)
        size = max(0, (count - 1) * stride + element)
        data = np.fromfile(buffer.path, np.uint8, size, offset=buffer.start + first + offset)
        values = np.ndarray((count, width), dtype, data, strides=(stride, dtype.itemsize)).astype(np.float32)
        if accessor.get("normalized") is True and dtype.kind != "f":
            values = np.maximum(values / np.float32(np.iinfo(dtype).max), -1)
        return values[:, 0] if width == 1 else values

    def placed_meshes(self) -> list[tuple[dict, np.ndarray]]:
        """The meshes of the scene, each with the matrix [4, 4] from its coordinates to the world's."""
        nodes = entries_of(self.json, "nodes")
        if "scenes" in self.json:
            roots = entries_of(self.entry("scenes", self.json.get("scene", 0)), "nodes")
        else:  # a library of meshes: all that nobody else places
            children = [child for node in nodes if isinstance(node, dict) for child in entries_of(node, "children")]
            roots = sorted(set(range(len(nodes))) - {child for child in children if isinstance(child, int)})
        open_nodes, seen, found = [(index, np.eye(4)) for index in reversed(roots)], set(), []
        while open_nodes:
            index, parent = open_nodes.pop()
            node = self.entry("nodes", index)
            if index in seen:
                raise Unexpected(f"node {index} in two places")
            seen.add(index)
            if held(held(node, "extensions"), VISIBILITY).get("visible") is False:
                continue
            if not np.isfinite(world := parent @ _matrix(node)).all():
                raise ValueError(f"node {index} has a transform that is not finite")
            if "mesh" in node:
                found.append((self.entry("meshes", node["mesh"]), world))
            open_nodes += [(child, world) for child in reversed(entries_of(node, "children"))]
        return found

    def _open(self, entry: dict, chunk: Buffer | None) -> Buffer:
        if "uri" not in entry:
            if chunk is None:
                raise Unexpected("a buffer without data")
            return chunk._replace(length=whole_number(entry.get("byteLength"), "byteLength of a buffer", chunk.length))
        if not isinstance((uri := entry["uri"]), str) or uri.startswith("data:"):
            raise Unexpected("a buffer inside the JSON; export it as .glb, or with a .bin file")
        folder = self.path.parent.resolve()
        path = Path(os.path.realpath(folder / unquote(uri, errors="surrogateescape")))  # a null byte raises ValueError
        if "://" in uri or "\\" in uri or not path.is_relative_to(folder):
            raise Unexpected(f"a buffer outside of its folder ({uri!r:.80})")
        if not path.is_file():
            raise Unexpected(f"no file {path.name!r:.80} beside it, where its data should be")
        return Buffer(path, 0, whole_number(entry.get("byteLength"), "byteLength of a buffer", path.stat().st_size))

    def _read_chunks(self, source, size: int) -> tuple[bytes, Buffer | None]:
        """The JSON and where the binary chunk is, if there is one."""
        chunks = {}
        if size < HEADER.size:
            raise ValueError(f"{size} bytes")
        _, version, length = HEADER.unpack(source.read(HEADER.size))
        if version != 2:
            raise Unexpected(f"version {version}")
        if length > size:
            raise ValueError(f"found {size} of {length} bytes")
        # what follows these two is for others
        while (place := source.tell() + CHUNK.size) <= length and len(chunks) < 2:
            chunk_length, kind = CHUNK.unpack(source.read(CHUNK.size))
            if chunk_length > length - place:
                raise ValueError(f"a chunk of {chunk_length} bytes, of which {length - place} are there")
            chunks[kind] = Buffer(self.path, place, chunk_length)
            source.seek(place + chunk_length)
        if (text := chunks.get(b"JSON")) is None or text.length > JSON_BYTES:
            raise Unexpected("no JSON" if text is None else f"JSON of {text.length} bytes, more than {JSON_BYTES}")
        source.seek(text.start)
        return source.read(text.length), chunks.get(b"BIN\0")


def _matrix(node: dict) -> np.ndarray:
    """The transform [4, 4] of a node."""
    if "matrix" in node:
        return numbers_of(node, "matrix", 16).reshape(4, 4).T
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - slow to load, and other formats do without

    node = {"translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1], **node}
    if not 1e-6 < np.linalg.norm(quat := numbers_of(node, "rotation", 4)) < 1e6:
        raise ValueError(f"a rotation {quat.tolist()}")
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(quat).as_matrix() * numbers_of(node, "scale", 3)
    matrix[:3, 3] = numbers_of(node, "translation", 3)
    return matrix

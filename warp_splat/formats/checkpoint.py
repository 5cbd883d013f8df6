"""Checkpoints: a file of safetensors, so that reading one runs no code, whoever wrote it.

Arrays have names. All else is one JSON text in the file's metadata. Before anything is allocated, safetensors proves
that the arrays fill the file exactly. A CRC-32 of names, shapes, bytes and text finds damage. docs/checkpoints.md lists
the names.

Checkpoints of Gaussians in blocks: each process writes a file of its own, and the checkpoint names them all.

The checkpoint is written last, when all blocks are on the disk, and is a file as any other but for the Gaussians. Any
number of processes goes on from it, also one; and any number goes on from a checkpoint that is one file.
"""

import json
import re
import struct
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open

from warp_splat import __version__
from warp_splat.errors import InputError
from warp_splat.formats.exchange import FORMATS
from warp_splat.formats.files import Unexpected, atomic_write, reading
from warp_splat.runtime.distributed import Processes

LAST = "checkpoint.safetensors"  # where the run in a model folder stands
FORMAT = 1  # rises when older programs could not read what newer ones write
DTYPES = {"F32": np.float32, "F64": np.float64, "I32": np.int32, "I64": np.int64, "U8": np.uint8, "BOOL": np.bool_}
EXPECTED = "a checkpoint of this program"
GENERATOR_BYTES, TWISTER_WORDS = 5056, 624  # of the state of torch's generator on the CPU, a Mersenne Twister


@dataclass(frozen=True)
class Checkpoint:
    """What a file holds. The methods check what they return; they raise InputError if it is not as expected."""

    path: Path
    arrays: Mapping[str, np.ndarray]
    facts: Mapping[str, Any]

    def array(self, name: str, shape: tuple[int, ...], dtype: type = np.float32) -> np.ndarray:
        """An array by name, of ``dtype`` and ``shape``; -1 stands for any length but 0."""
        found = self.arrays.get(name, np.zeros(0, bool))
        wanted = [max(length, 1) if side == -1 else side for length, side in zip(found.shape, shape, strict=False)]
        if found.ndim != len(shape) or [*found.shape] != wanted or found.dtype != dtype:
            raise InputError(
                f"{self.path}: expected {name!r} as {np.dtype(dtype)} {list(shape)}, found {found.dtype} "
                f"{list(found.shape)}; start from another checkpoint."
            )
        return found

    def fact(self, name: str, kind: type) -> Any:
        """A value of exactly this type."""
        if type(found := self.facts.get(name)) is not kind:
            raise InputError(f"{self.path}: expected {name!r} as {kind.__name__}, found {found!r:.50}; name another.")
        return found

    def count(self, name: str) -> int:
        """A whole number, 0 to 2^63 - 1."""
        if not 0 <= (found := self.fact(name, int)) < 2**63:
            raise InputError(f"{self.path}: expected {name!r} as 0 to 2^63 - 1, found another; start from another one.")
        return found

    def generator(self, name: str) -> np.ndarray:
        """The state of a generator of torch; its place is checked, by which torch would read beyond its words."""
        state = self.array(name, (GENERATOR_BYTES,), np.uint8)
        left, seeded, place = struct.unpack_from("<iiQ", state, 8)
        if seeded != 1 or not 1 <= left <= TWISTER_WORDS or place + left > TWISTER_WORDS + 1:
            raise InputError(f"{self.path}: expected {name!r} as a generator's state, found other bytes.")
        return state


def save_checkpoint(path: str | Path, arrays: Mapping[str, np.ndarray], facts: Mapping[str, Any]) -> None:
    """Write a checkpoint; an older one of this name is replaced when the new one is complete, on the disk.

    Blocks of the older one are removed then, but those that the new one names.

    Args:
        path: the file.
        arrays: float32, float64, int32, int64, uint8 or bool.
        facts: values of JSON.

    Raises:
        InputError: if the file cannot be written.
    """
    arrays = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    text = json.dumps({"format": FORMAT, "version": __version__, **facts})
    header: dict[str, Any] = {"__metadata__": {"warp_splat": text, "crc32": _checksum(text, arrays)}}
    end = 0
    for name, array in arrays.items():
        start, end = end, end + array.nbytes
        dtype = next(key for key, kind in DTYPES.items() if kind == array.dtype)
        header[name] = {"dtype": dtype, "shape": array.shape, "data_offsets": [start, end]}
    encoded = json.dumps(header).encode()
    encoded += b" " * (-len(encoded) % 8)
    # Tried: safetensors' save_file. Only the owner may read what it writes. If killed, it leaves a file of its own.
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        file.write(struct.pack("<Q", len(encoded)) + encoded)
        for array in arrays.values():
            file.write(array.astype(array.dtype.newbyteorder("<"), copy=False).data)
    for old in Path(path).parent.glob(f"{Path(path).stem}-*-of-*{Path(path).suffix}"):
        if old.name not in facts.get(BLOCKS, ()) and re.fullmatch(r"-\d+-\d+-of-\d+", old.stem[len(Path(path).stem) :]):
            with suppress(OSError):
                old.unlink()


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Read a checkpoint: a file, or that of a model folder. Arrays of Gaussians stay there, mapped and read-only.

    Raises:
        InputError: if there is none, or it is damaged, cut short, of a newer program, or something else.
    """
    path = find_checkpoint(path)
    with reading(path, EXPECTED, SafetensorError), safe_open(path, framework="numpy") as file:
        (text, facts), content, arrays = _facts(file), np.memmap(path, np.uint8, "r"), {}
        end = 8 + int.from_bytes(content[:8], "little")  # of the header; without gaps, arrays follow
        for name in file.offset_keys():
            if (kept := file.get_slice(name)).get_dtype() not in DTYPES:
                raise Unexpected(f"an array of {kept.get_dtype()}")
            found = np.ndarray(kept.get_shape(), DTYPES[kept.get_dtype()], content, end)
            arrays[name], end = found if OF_GAUSSIANS.fullmatch(name) else found.copy(), end + found.nbytes
        if file.metadata().get("crc32") != _checksum(text, arrays):
            raise ValueError("its checksum does not match")
    return Checkpoint(path, arrays, facts)


def load_header(path: str | Path) -> Checkpoint:
    """A checkpoint without its arrays; only the beginning of the file is read.

    Raises:
        InputError: as :func:`load_checkpoint`, but for what follows the header.
    """
    path = find_checkpoint(path)
    with reading(path, EXPECTED, SafetensorError), safe_open(path, framework="numpy") as file:
        return Checkpoint(path, {}, _facts(file)[1])


def find_checkpoint(path: str | Path) -> Path:
    """The file of a checkpoint; in a model folder, that of the last.

    Raises:
        InputError: if there is none, or it is a file of torch's pickles.
    """
    if (path := Path(path)).is_dir():
        others = sorted(other for other in path.glob("*.safetensors") if other.is_file())
        path /= LAST
        if not path.is_file() and others:
            raise InputError(f"{path}: no such file; {others[-1]} can be named instead.")
    if path.suffix in (".pth", ".pt", ".ckpt"):
        raise InputError(
            f"{path}: expected {EXPECTED} ({LAST}), not one of torch's, which can run code when it is read; convert "
            "its Gaussians to .ply with the program that wrote it."
        )
    if path.is_file() and path.suffix.lower() in FORMATS:
        raise InputError(
            f"{path}: expected {EXPECTED} ({LAST}), found a model; name the folder of its training, or start a new one "
            "from it with --start_ply."
        )
    if path.is_dir():
        raise InputError(f"{path}: expected {EXPECTED}, found a folder of this name; remove it or name another.")
    if not path.is_file():
        raise InputError(f"{path}: no such file; name a training's {LAST} or folder (--blocks: run the same again).")
    return path


def remove_leftovers(folder: str | Path) -> None:
    """Remove half-written checkpoints of a process that was killed: each may be as large as a whole one."""
    for path in Path(folder).glob(".tmp-*.safetensors"):
        path.unlink(missing_ok=True)


def _facts(file: Any) -> tuple[str, dict[str, Any]]:
    """The JSON text and its values."""
    if (text := (file.metadata() or {}).get("warp_splat")) is None:
        raise Unexpected("other safetensors")
    facts = json.loads(text)
    if type(found := facts.get("format") if isinstance(facts, dict) else None) is not int:
        raise Unexpected("one without a format number")
    if found > FORMAT:
        raise Unexpected(f"one of format {found!r:.20} (this program knows up to {FORMAT}); install a newer version")
    return text, facts


def _checksum(text: str, arrays: Mapping[str, np.ndarray]) -> str:
    """CRC-32 of all that a checkpoint holds, as hexadecimal digits."""
    crc = zlib.crc32(text.encode())
    for name in sorted(arrays):
        array = arrays[name]
        crc = zlib.crc32(f"{name} {array.dtype.str} {array.shape}".encode(), crc)
        crc = zlib.crc32(array.reshape(-1).view(np.uint8), crc)
    return f"{crc:08x}"


OF_VIEWS = "statistics."  # with a column for each Gaussian
#: With a row for each, but those.
OF_GAUSSIANS = re.compile(
    r"(parameters|gradients|exp_avg|exp_avg_sq)\.(means|sh_dc|sh_rest|opacities|scales|quats)|radii|statistics\.\w+"
)
BLOCKS = "blocks"  # among the facts of a checkpoint: the names of files beside it, and the Gaussians in each


def save_in_blocks(processes: Processes, path: Path, arrays: Mapping[str, np.ndarray], facts: Mapping) -> None:
    """Write a checkpoint of all processes, which call this together.

    Raises:
        InputError: if one cannot write its block: in all; the checkpoint before stays whole. If the first one cannot
            write the rest: in that.
    """
    stem, refused = f"{path.stem}-{facts['iteration']}", None
    names = [f"{stem}-{rank}-of-{processes.count}{path.suffix}" for rank in range(processes.count)]
    own = {name: array for name, array in arrays.items() if OF_GAUSSIANS.fullmatch(name)}
    try:
        save_checkpoint(path.with_name(names[processes.rank]), own, {"iteration": facts["iteration"]})
    except InputError as error:
        refused = error
    counts = processes.gather(torch.tensor([-1 if refused else len(arrays["radii"])]))[:, 0].tolist()
    if min(counts) < 0:
        which = f"process {counts.index(-1)} could not write its block; see its message"
        raise refused or InputError(f"{path}: it stays as it was, since {which}.")
    if processes.rank == 0:
        rest = {name: array for name, array in arrays.items() if name not in own}
        save_checkpoint(path, rest, {**facts, BLOCKS: dict(zip(names, counts, strict=True))})


def load_own(path: str | Path, processes: Processes) -> Checkpoint:
    """:func:`load_checkpoint`, of one file or of blocks: of the Gaussians, what this one of ``processes`` holds.

    Raises:
        InputError: as that does, or if a block is missing or of another checkpoint.
    """
    if BLOCKS not in (whole := load_checkpoint(path)).facts and not processes.sharded:
        return whole
    blocks = whole.facts.get(BLOCKS, {whole.path.name: len(whole.arrays.get("radii", ()))})
    with reading(whole.path, EXPECTED):
        if not isinstance(blocks, dict) or not all(Path(n).name == n and type(blocks[n]) is int for n in blocks):
            raise Unexpected("one of other blocks")
        own, end, taken = processes.own(sum(blocks.values())), 0, []
        for name, count in blocks.items():
            first, last, end = max(own.start - end, 0), min(own.stop - end, count), end + count
            if first < last:
                block = whole if name == whole.path.name else load_checkpoint(whole.path.with_name(name))
                found = {n: np.atleast_1d(array) for n, array in block.arrays.items() if OF_GAUSSIANS.fullmatch(n)}
                if block.count("iteration") != whole.count("iteration") or (taken and found.keys() != taken[0].keys()):
                    raise Unexpected(f"one whose block {name} is that of another")
                rows = slice(first, last)
                taken.append({n: a[..., rows] if n.startswith(OF_VIEWS) else a[rows] for n, a in found.items()})
        if not taken:
            raise Unexpected(f"one of {end} Gaussians, fewer than there are processes")
        axes = {n: -1 if n.startswith(OF_VIEWS) else 0 for n in taken[0]}
        arrays = {n: np.concatenate([part[n] for part in taken], axis) for n, axis in axes.items()}
    return replace(whole, arrays={**whole.arrays, **arrays})

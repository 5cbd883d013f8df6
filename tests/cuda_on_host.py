"""CUDA kernels on the host, under a sanitizer of g++: no GPU runs, but the code that Warp generates for one does.

Warp's fibers never compile that code: they take other branches of Warp's headers. Here g++ compiles the generated
source against the branches of a GPU, with ``cuda_on_host.h`` in place of what CUDA offers. Launches are recorded while
the renderer works in fibers, and repeated by the program: the same arguments, and memory of exactly the same size.
"""

import ctypes
import json
import math
import os
import re
import shutil
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import warp as wp
from warp._src.context import pack_arg  # what wp.launch hands to a kernel

from warp_splat import runtime
from warp_splat.runtime import pool

HERE = Path(__file__).parent
COMPILER = shutil.which("g++")
#: Of the headers that compute with tiles: which branch is taken, and C++ where CUDA's is more lenient.
REPLACED = (
    (r"__CUDA_ARCH__|__CUDACC_RTC__", "HOST_CUDA"),
    (r"__shared__ (alignas\(\w+\))", r"\1 __shared__"),
    (r"extern __shared__ char dynamic_smem_base\[\]", "static char dynamic_smem_base[HOST_SHARED]"),
)
#: A GPU's instructions, and what they are without one.
INSTRUCTIONS = (
    (r'asm\("ex2\.approx.*?;"[^;]*;', "found = known;"),
    (r'asm\("rcp\.approx.*?;"[^;]*;', "inverse = 1.0f / left;"),
)
PROGRAM = """#include "cuda_on_host.h"
#define HOST_CUDA 900
#define HOST_SHARED {shared}
{source}
int main(int count, char** words) {{ return host::main({kernel}, count, words); }}
"""


@dataclass
class Launch:
    """One launch: its kernel, and arguments whose arrays are numbers of ``memory``."""

    kernel: wp.Kernel
    backward: bool
    shape: tuple[int, ...]  # of its indices
    blocks: int
    block_dim: int
    arguments: list[tuple[bytes, list[tuple[int, int, int]]]]  # and where what stands: a place in memory
    memory: list[np.ndarray]  # before
    after: list[np.ndarray]


@contextmanager
def recorded(monkeypatch: pytest.MonkeyPatch, named: dict[int, int] | None = None) -> Iterator[list[Launch]]:
    """Every launch in blocks of what is run inside; with ``named`` those in no blocks as well.

    Args:
        monkeypatch: takes the place of Warp's functions meanwhile.
        named: addresses that kernels get as numbers, and how many bytes are there; it may grow meanwhile.
    """
    wp.init()  # or arguments cannot be packed
    launches, launch, launch_tiled = [], wp.launch, wp.launch_tiled

    def record(kernel, dim, inputs, outputs, block_dim=None, adjoint=False, adj_inputs=(), adj_outputs=(), **where):
        names = kernel.adj.args
        given = [*inputs, *outputs, *([*adj_inputs, *adj_outputs] if adjoint else [])]
        packed = [
            pack_arg(kernel, names[i % len(names)].type, "", value, "cpu", i >= len(names))
            for i, value in enumerate(given)
        ]
        pointers = [
            [*spans_of(value, names[i % len(names)].type), *named_spans(bytes(value), named or {})]
            for i, value in enumerate(packed)
        ]
        spans = joined([span for here in pointers for _, span in here])
        read = lambda: [np.frombuffer(ctypes.string_at(a, b - a), np.uint8).copy() for a, b in spans]  # noqa: E731
        arguments = [
            (bytes(value), [(place, *whereabouts(span.start, spans)) for place, span in here])
            for value, here in zip(packed, pointers, strict=True)
        ]
        before = read()
        more = {"adjoint": True, "adj_inputs": adj_inputs, "adj_outputs": adj_outputs} if adjoint else {}
        if block_dim:
            launch_tiled(kernel, dim=dim, inputs=inputs, outputs=outputs, block_dim=block_dim, **more, **where)
            shape = (*dim, block_dim)
        else:
            launch(kernel, dim=dim, inputs=inputs, outputs=outputs, **more, **where)
            shape, block_dim = (dim,), kernel.module.options["block_dim"]
        blocks = -(-math.prod(shape) // block_dim)
        launches.append(Launch(kernel, adjoint, shape, blocks, block_dim, arguments, before, read()))

    def bound(kernel, inputs, outputs, adjoint):
        where = {"device": "cpu", "record_tape": False, **adjoint}
        return lambda low, high: record(kernel, high - low, [low, *inputs[1:]], outputs, **where)

    threads = pool.get_threads()
    pool.set_threads(1)  # or another thread's part of a launch writes between what is read before and after
    try:
        with monkeypatch.context() as patch:
            patch.setattr(wp, "launch_tiled", record)
            if named is not None:
                patch.setattr(wp, "launch", record)
                patch.setattr(runtime.launch, "_bound", bound)
            yield launches
    finally:
        pool.set_threads(threads)


class Span(NamedTuple):
    """Memory that an argument points to."""

    start: int
    end: int


def spans_of(value, kind, place: int = 0) -> Iterator[tuple[int, Span]]:
    """Arrays among an argument's fields: the byte at which each begins, and what it points to."""
    if hasattr(value, "strides"):
        size = wp.types.type_size_in_bytes(kind.dtype)
        size += sum((value.shape[i] - 1) * value.strides[i] for i in range(value.ndim))
        if value.data and all(value.shape[i] for i in range(value.ndim)):
            yield place, Span(value.data, value.data + size)
    elif isinstance(value, ctypes.Structure) and hasattr(kind, "vars"):
        for name, variable in kind.vars.items():
            yield from spans_of(getattr(value, name), variable.type, place + getattr(type(value), name).offset)


def named_spans(words: bytes, named: dict[int, int]) -> Iterator[tuple[int, Span]]:
    """Likewise of addresses that are numbers."""
    for place in range(0, len(words) - 7, 8):
        if (address := int.from_bytes(words[place : place + 8], "little")) in named:
            yield place, Span(address, address + named[address])


def joined(spans: list[Span]) -> list[Span]:
    """In order, those that overlap as one."""
    found: list[Span] = []
    for span in sorted(spans):
        if found and span.start < found[-1].end:
            found[-1] = Span(found[-1].start, max(found[-1].end, span.end))
        else:
            found.append(span)
    return found


def whereabouts(address: int, spans: list[Span]) -> tuple[int, int]:
    """In which of them an address lies, and how many bytes from its start."""
    return next((i, address - span.start) for i, span in enumerate(spans) if span.start <= address < span.end)


def compiled(launch: Launch, folder: Path, ending: str) -> tuple[str, str, int]:
    """The ".cu" or ".ptx" of its module, its kernel's name in there, and the bytes of shared memory it asks for."""
    if not folder.exists():
        wp.compile_aot_module(launch.kernel.module, arch=90, module_dir=folder, use_ptx=True)
    (text,) = (path.read_text() for path in folder.glob(f"*{ending}"))
    (sizes,) = (json.loads(path.read_text()) for path in folder.glob("*.meta"))
    (name,) = (
        name.removesuffix("_smem_bytes")
        for name in sizes
        if name.startswith(launch.kernel.get_mangled_name()) and ("_backward_" in name) == launch.backward
    )
    return text, name, sizes[f"{name}_smem_bytes"]


def build(launch: Launch, sanitizer: str, folder: Path) -> Path:
    """The program that repeats ``launch`` under "thread" or "address", compiled in ``folder``."""
    source, name, shared = compiled(launch, folder / "aot", ".cu")
    copy_headers(folder / "native")
    source = re.sub(REPLACED[0][0], REPLACED[0][1], source.replace("#define WP_NO_CRT\n", ""))
    for instruction, code in INSTRUCTIONS:
        source = re.sub(instruction, code, source)
    (folder / "program.cpp").write_text(PROGRAM.format(shared=max(shared, 1), source=source, kernel=name))
    flags = ["-std=c++17", "-O1", "-g", "-w", "-fpermissive", f"-fsanitize={sanitizer}"]
    flags += ["-I", HERE, "-I", folder / "native"]
    subprocess.run([COMPILER, *flags, folder / "program.cpp", "-o", folder / "program"], check=True)
    return folder / "program"


def copy_headers(folder: Path) -> None:
    """Warp's headers, those of tiles as a GPU's compiler reads them."""
    native = Path(wp.__file__).parent / "native"
    shutil.copytree(native, folder, ignore=lambda _, names: [n for n in names if n.endswith((".cpp", ".cu", ".S"))])
    for path in (folder / "tile.h", folder / "tile_reduce.h"):  # of tiles, the kernels store and sum
        text = path.read_text()
        for before, after in REPLACED:
            text = re.sub(before, after, text)
        path.write_text(text)


@dataclass
class Run:
    """What a program said, and left in the launch's memory."""

    code: int
    said: str
    barriers: list[str]
    memory: list[np.ndarray]


def run(program: Path, launch: Launch, seed: int = 0, without: str | None = None) -> Run:
    """Repeat ``launch`` with threads and blocks in the order of ``seed``, ``without`` one of its barriers."""
    with (program.parent / "launch").open("wb") as file:
        write = lambda *numbers: file.write(struct.pack(f"{len(numbers)}Q", *numbers))  # noqa: E731
        write(launch.blocks, launch.block_dim, len(launch.memory))
        for memory in launch.memory:
            write(len(memory))
            file.write(memory.tobytes())
        write(len(launch.arguments))
        for content, pointers in launch.arguments:
            write(len(content))
            file.write(content)
            write(len(pointers))
            for pointer in pointers:
                write(*pointer)
    command = [program, program.parent, str(seed), *([without] if without else [])]
    environment = os.environ | {"TSAN_OPTIONS": "exitcode=66", "ASAN_OPTIONS": "detect_leaks=0"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    result = program.parent / "memory"
    content = np.fromfile(result, np.uint8) if result.exists() else np.empty(0, np.uint8)
    result.unlink(missing_ok=True)
    ends = np.cumsum([len(memory) for memory in launch.memory])[:-1]
    return Run(done.returncode, done.stderr, done.stdout.split(), np.split(content, ends))

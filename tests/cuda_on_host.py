"""CUDA kernels on the host, under a sanitizer of g++: no GPU runs, but the code that Warp generates for one does.

Warp's fibers never compile that code: they take other branches of Warp's headers. Here g++ compiles the generated
source against the branches of a GPU, with ``cuda_on_host.h`` in place of what CUDA offers. Launches are recorded while
the renderer works in fibers, and repeated by the program: the same arguments, and memory of exactly the same size.
"""

import ctypes
import json
import os
import re
import shutil
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from warp._src.context import pack_arg  # what wp.launch hands to a kernel

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
    blocks: int
    block_dim: int
    arguments: list[tuple[bytes, list[tuple[int, int]]]]  # and where which pointer stands
    memory: list[np.ndarray]  # before
    after: list[np.ndarray]


@contextmanager
def recorded(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Launch]]:
    """Every launch in blocks of what is run inside."""
    wp.init()  # or arguments cannot be packed
    launches, launch_tiled = [], wp.launch_tiled

    def record(kernel, dim, inputs, outputs, block_dim, adjoint=False, adj_inputs=(), adj_outputs=(), **where):
        names = kernel.adj.args
        given = [*inputs, *outputs, *([*adj_inputs, *adj_outputs] if adjoint else [])]
        packed = [
            pack_arg(kernel, names[i % len(names)].type, "", value, "cpu", i >= len(names))
            for i, value in enumerate(given)
        ]
        found = dict.fromkeys(array.data for value in packed for _, array in arrays_of(value) if array.data)
        sizes = {data: max(size_of(array) for value in packed for _, array in arrays_of(value) if array.data == data)
                 for data in found}  # fmt: skip
        read = lambda: [np.frombuffer(ctypes.string_at(*item), np.uint8).copy() for item in sizes.items()]  # noqa: E731
        numbers = {data: number for number, data in enumerate(sizes)}
        arguments = [
            (bytes(value), [(place, numbers[array.data]) for place, array in arrays_of(value) if array.data])
            for value in packed
        ]
        before = read()
        more = {"adjoint": True, "adj_inputs": adj_inputs, "adj_outputs": adj_outputs} if adjoint else {}
        launch_tiled(kernel, dim=dim, inputs=inputs, outputs=outputs, block_dim=block_dim, **more, **where)
        launches.append(Launch(kernel, adjoint, *dim, block_dim, arguments, before, read()))

    with monkeypatch.context() as patch:
        patch.setattr(wp, "launch_tiled", record)
        yield launches


def arrays_of(value, place: int = 0) -> Iterator[tuple[int, ctypes.Structure]]:
    """Arrays among an argument's fields, and the byte at which each begins."""
    if hasattr(value, "strides"):
        yield place, value
    elif isinstance(value, ctypes.Structure):
        for name, *_ in value._fields_:
            yield from arrays_of(getattr(value, name), place + getattr(type(value), name).offset)


def size_of(array) -> int:
    """Bytes of an array without gaps."""
    return array.shape[0] * array.strides[0] if all(array.shape[i] for i in range(array.ndim)) else 0


def build(launch: Launch, sanitizer: str, folder: Path) -> Path:
    """The program that repeats ``launch`` under "thread" or "address", compiled in ``folder``."""
    module, kernel = launch.kernel.module, launch.kernel
    wp.compile_aot_module(module, arch=90, module_dir=folder / "aot", use_ptx=True)
    (source,) = (path.read_text() for path in (folder / "aot").glob("*.cu"))
    (sizes,) = (json.loads(path.read_text()) for path in (folder / "aot").glob("*.meta"))
    (name,) = (
        name.removesuffix("_smem_bytes")
        for name in sizes
        if name.startswith(kernel.get_mangled_name()) and ("_backward_" in name) == launch.backward
    )
    copy_headers(folder / "native")
    source = re.sub(REPLACED[0][0], REPLACED[0][1], source.replace("#define WP_NO_CRT\n", ""))
    for instruction, code in INSTRUCTIONS:
        source = re.sub(instruction, code, source)
    shared = max(sizes[f"{name}_smem_bytes"], 1)
    (folder / "program.cpp").write_text(PROGRAM.format(shared=shared, source=source, kernel=name))
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

"""Other systems and processors: what pip would install there, and, emulated, what the package computes there."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
UV = os.environ.get("UV") or shutil.which("uv")  # `uv run` names itself
PLATFORMS = {  # uv's name: whether there is a wheel of pycolmap
    "x86_64-manylinux_2_28": True,
    "aarch64-manylinux_2_34": False,
    "aarch64-apple-darwin": True,
    "x86_64-pc-windows-msvc": True,
}

ELSEWHERE = """
import ctypes, os, pathlib, sys
import psutil, torch, warp  # they choose by the name of the system
load, exists = ctypes.CDLL, pathlib.Path.exists
def load_unless_glibc(name, *rest, **options):
    if name == "libc.so.6":
        raise OSError(name)
    return load(name, *rest, **options)
ctypes.CDLL = load_unless_glibc
pathlib.Path.exists = lambda path: "/proc/" not in str(path) and exists(path)
del os.sched_getaffinity
sys.modules["resource"] = None
from warp_splat.config import CORES
from warp_splat.evaluation.report import machine
from warp_splat.runtime.devices import peak_memory
from warp_splat.runtime.launch import prepare
prepare("cpu", 1)
assert CORES == os.cpu_count() and peak_memory() is None and f"{CORES} cores" in machine()
"""

sys.path.insert(0, str(ROOT / "benchmarks"))


@pytest.mark.slow
@pytest.mark.skipif(UV is None, reason="uv resolves for other platforms")
@pytest.mark.parametrize("platform", PLATFORMS)
def test_every_dependency_has_a_wheel(platform):
    command = [UV, "pip", "compile", "-q", "--no-header", "--no-annotate", "--only-binary", ":all:", "pyproject.toml"]
    chosen = ["--python-version", "3.11", "--python-platform", platform]
    system = {**os.environ, "MACOSX_DEPLOYMENT_TARGET": "14.0"}  # the oldest that wheels of pycolmap run on
    done = subprocess.run([*command, *chosen], cwd=ROOT, env=system, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    names = {line.split("==")[0] for line in done.stdout.splitlines()}
    assert {"warp-lang", "torch", "openimageio", "av"} <= names
    assert ("pycolmap" in names) == PLATFORMS[platform]


def test_nothing_needs_glibc_or_proc():
    subprocess.run([sys.executable, "-c", ELSEWHERE], cwd=ROOT, check=True)


@pytest.mark.long
@pytest.mark.skipif(not all(map(shutil.which, ("apt-get", "llvm-objdump"))), reason="needs Debian and LLVM's objdump")
def test_emulated_arm_computes_the_same_bytes_in_vectors():
    import arm  # noqa: PLC0415 - in the folder of the benchmarks
    import vectors  # noqa: PLC0415

    arm.make_root(arm.DEFAULT_ROOT)
    arrays = arm.run_both(arm.DEFAULT_ROOT)
    found = dict(arm.compare(arrays["here"], arrays["ARM"]))
    assert {name: agreement for name, agreement in found.items() if agreement != "equal"} == {}
    for processor, folder in arm.kernel_folders(arm.DEFAULT_ROOT).items():
        hot = [row for row in vectors.vectors(folder) if row[0] in vectors.HOT]
        assert {row[0] for row in hot} == set(vectors.HOT)
        for kernel, packed, scalar, *_ in hot:
            assert packed > scalar, (processor, kernel)

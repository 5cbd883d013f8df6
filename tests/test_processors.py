"""One hash: the same bytes of lists, image, gradients and a training, whichever processor the kernels are built for."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest
from numpy._core._multiarray_umath import __cpu_dispatch__ as dispatched

ROOT = Path(__file__).parents[1]
#: What torch, NumPy, BLAS and the C library do on an old processor.
OLD = {
    "ATEN_CPU_CAPABILITY": "default",
    "NPY_DISABLE_CPU_FEATURES": " ".join(dispatched),
    "OPENBLAS_CORETYPE": "Nehalem",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX512F",
}
AVX2 = {"WARP_SPLAT_TARGET": "-target-cpu x86-64-v3", **OLD}
PORTABLE = {"WARP_SPLAT_PORTABLE": "1"}
SSE2 = {"WARP_SPLAT_TARGET": "-target-cpu x86-64", **PORTABLE, **OLD}


def hashes(changes: dict[str, str], *arguments: str) -> list[str]:
    """A line for each array, with its hash, in a process of this environment."""
    command = [sys.executable, "benchmarks/processor_hashes.py", *arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **changes}
    done = subprocess.run(command, cwd=ROOT, env=environment, check=True, capture_output=True, text=True)
    return [line for line in done.stdout.splitlines() if line.endswith(")")]


def test_a_misspelled_switch_is_refused():
    command = [sys.executable, "-m", "warp_splat", "export-html", "a.ply", "a.html"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "WARP_SPLAT_PORTABLE": "yes"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr == (
        "warp-splat: error: WARP_SPLAT_PORTABLE: expected 1, 0 or nothing in this environment variable, got 'yes'; "
        "set it to one of them.\n"
    )


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="names processors of the x86-64 family")
@pytest.mark.parametrize(
    ("here", "there", "arguments"),
    [
        pytest.param({}, AVX2, ["--adjoints", "manual", "--steps", "50"], marks=pytest.mark.slow, id="AVX2"),
        pytest.param({}, AVX2, ["--steps", "300"], marks=pytest.mark.long, id="AVX2, all of it"),
        pytest.param(PORTABLE, SSE2, ["--steps", "300"], marks=pytest.mark.long, id="SSE2"),
        *[
            pytest.param(
                {},
                AVX2,
                ["--steps", "60", "--options", f"exposure={kind}", "vignetting"],
                marks=pytest.mark.long,
                id=kind,
            )
            for kind in ("gain", "affine", "bilateral")
        ],
    ],
)
def test_same_bytes(here, there, arguments):
    expected = hashes(here, *arguments)
    assert len(expected) > 15
    assert hashes(there, *arguments) == expected

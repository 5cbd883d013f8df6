"""Torch, NumPy, BLAS and the C library choose code by the processor. What rendering and training compute stays."""

import os
import platform
import re
import subprocess
import sys
from pathlib import Path

import pytest
from numpy._core._multiarray_umath import __cpu_dispatch__ as dispatched

ROOT = Path(__file__).parents[1]
#: What the libraries would do on an old processor.
OLD = {
    "ATEN_CPU_CAPABILITY": "default",
    "NPY_DISABLE_CPU_FEATURES": " ".join(dispatched),
    "OPENBLAS_CORETYPE": "Nehalem",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX512F",
}


def hashes(variables):
    """By name of the array, of all that is computed until a short training with growth ends."""
    command = [sys.executable, "benchmarks/processor_hashes.py", "--steps", "50"]
    environment = {**os.environ, **variables, "PYTHONPATH": str(ROOT)}
    run = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT, env=environment)
    return re.findall(r"^.*\b[0-9a-f]{8,}\b.*$", run.stdout, re.MULTILINE)


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="names processors of the x86-64 family")
def test_old_libraries_compute_the_same():
    expected = hashes({})
    assert len(expected) > 10
    assert hashes(OLD) == expected

"""One hash: the same bytes of lists, image, gradients and a training, whichever processor the kernels are built for."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
#: An older processor, as far as environment variables make one of this one.
NO_AVX512 = {
    "ATEN_CPU_CAPABILITY": "avx2",
    "NPY_DISABLE_CPU_FEATURES": "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR",
    "OPENBLAS_CORETYPE": "Haswell",
}
AVX2 = {"WARP_SPLAT_TARGET": "-target-cpu x86-64-v3", **NO_AVX512}
HERE_PORTABLE = {"WARP_SPLAT_PORTABLE": "1"}
NO_FMA = {"WARP_SPLAT_TARGET": "-target-cpu x86-64", **HERE_PORTABLE, **NO_AVX512, "ATEN_CPU_CAPABILITY": "default"}


def hashes(changes: dict[str, str], *arguments: str) -> list[str]:
    """A line for each array, with its hash, in a process of this environment."""
    command = [sys.executable, "benchmarks/processor_hashes.py", *arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **changes}
    done = subprocess.run(command, cwd=ROOT, env=environment, check=True, capture_output=True, text=True)
    return [line for line in done.stdout.splitlines() if line.endswith(")")]


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="names processors of the x86-64 family")
@pytest.mark.parametrize(
    ("here", "there", "arguments"),
    [
        pytest.param({}, AVX2, ["--adjoints", "manual", "--steps", "0"], marks=pytest.mark.slow, id="AVX2"),
        pytest.param({}, AVX2, ["--steps", "300"], marks=pytest.mark.long, id="AVX2, training"),
        pytest.param(HERE_PORTABLE, NO_FMA, ["--steps", "300"], marks=pytest.mark.long, id="128 bits"),
    ],
)
def test_same_bytes(here, there, arguments):
    expected = hashes(here, *arguments)
    assert len(expected) > 15
    assert hashes(there, *arguments) == expected

"""Kernels assembled from functions: the same as if these were called, whatever their names."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from warp_splat.errors import InputError
from warp_splat.kernels.inline import kernel_of_parts

size = 2.0  # also the name of a variable of the kernel


@wp.func
def turned(x: float, y: float):
    half = 0.5 * size
    return x + y, half * (x - y)


def test_arguments_may_be_targets_and_names_may_meet():
    @kernel_of_parts({}, turned=turned)
    def kernel(values: wp.array[float], out: wp.array[float]):
        size = values[0]
        half = values[1]
        size, half = turned(size, half)
        out[0] = size
        out[1] = half

    out = wp.zeros(2, dtype=float, device="cpu")
    wp.launch(kernel, 1, [wp.array([5.0, 3.0], dtype=float, device="cpu")], [out], device="cpu")
    np.testing.assert_allclose(out.numpy(), [8.0, 2.0])


@wp.func
def hasty(x: float):
    if x > 1.0:
        return x
    return 2.0 * x


@wp.func
def careless(x: float):
    x = 2.0 * x
    return x


@wp.func
def generous(x: float):
    return x, x


@pytest.mark.parametrize(
    ("part", "message"),
    [(hasty, "returns once"), (careless, "returns once"), (generous, "returns 1 values, .* found 2")],
)
def test_functions_that_cannot_be_put_in_place_are_refused(part, message):
    with pytest.raises(InputError, match=message):

        @kernel_of_parts({}, part=part)
        def kernel(out: wp.array[float]):
            y = out[0]
            y = part(y)
            out[0] = y


def test_what_is_compiled_can_be_read():
    """What was assembled: names of a part stand in the kernel; what was written from a formula."""
    script = Path(__file__).parents[1] / "benchmarks" / "show_kernel.py"
    lines = {"project": "    rotation_w = times(qw, rotation_scale)\n"}
    for word, line in (lines | {"perspective_lens": "    v0 = of_lens(camera, 15, z)\n"}).items():
        command = [sys.executable, script, word]
        done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=600)
        assert f"def {word}(" in done.stdout and line in done.stdout, done.stderr

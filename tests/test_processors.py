"""The kernels on lesser processors: the same image and gradients without AVX-512, and without AVX."""

import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
CODE = """
import sys
sys.path.insert(0, "tests")
import numpy as np, torch
import warp_splat
from warp_splat.kernels import compiler

for options in [value for name, value in vars(compiler).items() if name.isupper() and name[0] != "_"]:  # read later
    options["cpu_compiler_flags"] = options["cpu_compiler_flags"].replace("-march=native", sys.argv[1])
from warp_splat.training.loss import image_loss
from scenes import SCENES

scene = SCENES["degree3"]()
names = ("means", "quats", "scales", "opacities", "sh")
tensors = [getattr(scene, name).clone().requires_grad_() for name in names]
out = warp_splat.rasterize(*tensors, scene.camera)
image_loss(out.image, torch.zeros_like(out.image)).backward()
np.savez(sys.argv[2], out.image.detach().numpy(), *(tensor.grad.numpy() for tensor in tensors))
"""


def run(architecture, path):
    subprocess.run([sys.executable, "-c", CODE, architecture, path], check=True, capture_output=True, cwd=ROOT)
    with np.load(path) as arrays:
        return [arrays[name] for name in arrays.files]


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="names processors of the x86-64 family")
@pytest.mark.parametrize(
    "architecture",
    [
        pytest.param("-target-cpu x86-64-v3", marks=pytest.mark.slow),
        pytest.param("-target-cpu x86-64", marks=pytest.mark.long),
    ],
)
def test_same_results(architecture, tmp_path):
    expected = run("-march=native", tmp_path / "native.npz")
    found = run(architecture, tmp_path / "other.npz")
    assert np.abs(found[0] - expected[0]).max() < 1e-4
    for ours, theirs in zip(found[1:], expected[1:], strict=True):
        assert np.linalg.norm(ours - theirs) < 1e-4 * np.linalg.norm(theirs)

"""A hash of each array that rendering and a short training compute: the same wherever results are the same.

    [WARP_SPLAT_TARGET="-target-cpu x86-64-v3"] python benchmarks/processor_hashes.py [--steps 50] [--out arrays.npz]

The Gaussians come from additions and multiplications alone, so that they are the same everywhere. ``benchmarks/arm.py``
runs this file on an emulated processor and compares.
"""

import argparse
import contextlib
import hashlib
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
import warp as wp

from warp_splat import Camera, CameraParameters, RasterOptions, rasterize
from warp_splat.cli import main as command
from warp_splat.config import ADJOINTS
from warp_splat.formats.ply import load_ply
from warp_splat.raster.data import Gaussians
from warp_splat.raster.drivers import CPU
from warp_splat.raster.project import project
from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene
from warp_splat.training.loss import image_loss

NAMES = ("means", "quats", "scales", "opacities", "sh")
COUNT, WIDTH, HEIGHT = 500, 75, 45
CAMERA = Camera(WIDTH, HEIGHT, 60.0, 58.0, 40.0, 22.0, np.eye(3), np.array((0.0, 0.0, 4.0)))
SMALL = 8  # -r of the training
#: Two rounds of growth and a reset of the opacities within 50 steps.
GROWTH = {"densify_from_iter": 9, "densification_interval": 10, "densify_until_iter": 29, "opacity_reset_interval": 20}


def gaussians() -> list[torch.Tensor]:
    """Means, quaternions, scales, opacities and SH of degree 3, as leaves."""
    uniform = np.random.default_rng(5).random
    means = uniform((COUNT, 3)) * (6, 4, 4) - (3, 2, 2)
    arrays = (means, uniform((COUNT, 4)) - 0.5, 0.01 + 0.2 * uniform((COUNT, 3)) ** 3, uniform(COUNT))
    tensors = [torch.tensor(array, dtype=torch.float32) for array in (*arrays, uniform((COUNT, 16, 3)) - 0.5)]
    return [tensor.requires_grad_() for tensor in tensors]


def rendered(adjoints: list[str]) -> dict[str, np.ndarray]:
    """What the stages of one view compute, and the gradients by each of ``adjoints``."""
    inputs = gaussians()
    target = torch.from_numpy(np.random.default_rng(6).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8))
    found = {f"input {name}": tensor for name, tensor in zip(NAMES, inputs, strict=True)}
    with torch.no_grad():
        means, quats, scales, opacities, sh = inputs
        splats = project(Gaussians(means, quats, scales, opacities, sh[:, :1], sh[:, 1:]), CAMERA, RasterOptions())
        bins = CPU.bin(splats, CAMERA, RasterOptions())
    found |= {f"projected {name}": tensor for name, tensor in zip(splats._fields, splats, strict=True)}
    found |= {"lists": bins.instances, "list ranges": bins.ranges}
    for adjoint in adjoints:
        inputs, learned = gaussians(), CameraParameters(CAMERA)
        out = rasterize(*inputs, learned, adjoint=adjoint)
        out.means2d.retain_grad()
        loss = image_loss(out.image, target)
        loss.backward()
        found |= {"image": out.image, "loss": loss} if adjoint == adjoints[0] else {}
        found |= {f"{adjoint} d{name}": tensor.grad for name, tensor in zip(NAMES, inputs, strict=True)}
        found[f"{adjoint} dmeans2d"] = out.means2d.grad
        found |= {f"{adjoint} d{name}": getattr(learned, name).grad for name in ("twist", "intrinsics")}
    return {name: tensor.detach().numpy() for name, tensor in found.items()}


def trained(steps: int, options: list[str]) -> dict[str, np.ndarray]:
    """The photographs of the embedded scene, small, and the parameters that ``steps`` steps make of it, if any."""
    if not steps:
        return {}
    scene = load_scene(embedded_scene(), resolution=SMALL, report=str)
    found = {"photographs": np.stack([view.image for view in scene.train]), "points": scene.points}
    flags = [f"--{name}={value}" for name, value in {**GROWTH, "iterations": steps, "seed": 1, "threads": 1}.items()]
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(sys.stderr):
        if command(["train", "-m", folder, "-r", str(SMALL), "--quiet", *flags, *options]):
            raise RuntimeError("the training ended with an error")
        model = load_ply(Path(folder) / "point_cloud" / f"iteration_{steps}" / "point_cloud.ply").splats
    return found | {f"trained {name}": getattr(model, name) for name in NAMES}


def main() -> None:
    """Print a line for each array: its hash, its name, its shape."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=50, help="of training; 0: none")
    parser.add_argument("--options", nargs="*", default=[], help="of training, besides: exposure=gain")
    parser.add_argument("--adjoints", nargs="*", default=list(ADJOINTS), help="of the blend")
    parser.add_argument("--out", type=Path, help="also write the arrays there, as .npz")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    torch.set_num_threads(1)
    arrays = {}
    options = [f"--{option}" for option in arguments.options]
    for compute, how in ((rendered, [arguments.adjoints]), (trained, [arguments.steps, options])):
        found = compute(*how)
        for name, array in found.items():
            print(hashlib.sha256(np.ascontiguousarray(array)).hexdigest()[:12], name, array.shape, flush=True)
        arrays |= found
    if arguments.out:
        np.savez(arguments.out, **arrays)


if __name__ == "__main__":
    main()

"""How much faster are the lanes? Blend and adjoint on 100k Gaussians at 980 x 545 against a scalar Warp kernel.

Checks first that image and gradients agree, then times in one run, interleaved; prints and writes ratios.

    python benchmarks/blend.py [--out docs/benchmarks]
"""

import numpy as np
import torch
import warp as wp
from common import interleaved, option, parse, with_threads, write_table
from made_up import BlendScene, blend_scene
from scalar_blend import adj_blend, blend, vec9

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.kernels.splat import Splat2D
from warp_splat.raster.bin import balanced_slices
from warp_splat.raster.blend import Blending
from warp_splat.raster.blend import blend as blend_splats
from warp_splat.raster.data import Bins, Splats2D
from warp_splat.raster.drivers import CPU
from warp_splat.runtime import launch


class Lanes:
    """The package's driver on the scene."""

    def __init__(self, scene: BlendScene, upstream: torch.Tensor, mode: str = "manual"):
        splats = scene.splats
        self.mode = mode
        # the blend takes their values from the splats; tensors are there to receive gradients (of conics for roots)
        fields = ("mean", "root", "opacity", "color", "depth", "extent")
        tensors = [torch.from_numpy(splats[name].copy()).requires_grad_() for name in fields]
        self.projected = Splats2D(*tensors, radii=torch.ones(len(splats), dtype=torch.int32))
        self.camera = Camera(scene.width, scene.height, 1.0, 1.0, 0.0, 0.0, np.eye(3), np.zeros(3))
        self.scene, self.upstream = scene, upstream
        self.order = wp.array(np.arange(len(splats), dtype=np.int32), dtype=int, device="cpu")
        self.splats = wp.array(splats, dtype=Splat2D, device="cpu")
        lists = (scene.instances, scene.places, scene.place_begins, scene.ranges)
        self.lists = tuple(map(torch.from_numpy, lists))

    def forward(self) -> None:
        slices = balanced_slices(self.scene.ranges[:, 1])
        count = len(self.scene.splats)
        bins = Bins(
            count, self.order, self.splats, *self.lists, slices, self.scene.tiles_x, self.scene.height, invalid=0
        )
        blending = Blending(bins, self.camera, RasterOptions(), CPU, self.mode)
        self.image = blend_splats(self.projected, torch.zeros(3), blending).image

    def adjoint(self) -> None:
        self.grads = torch.autograd.grad(self.image, self.projected[:4], self.upstream, retain_graph=True)


class Scalar:
    """One thread per pixel."""

    def __init__(self, scene: BlendScene, upstream: torch.Tensor):
        shape = (scene.height, scene.width)
        to = lambda array, dtype: wp.array(array, dtype=dtype, device="cpu")  # noqa: E731
        self.shape = shape
        self.inputs = [
            scene.tiles_x,
            to(scene.ranges, wp.vec2i),
            to(scene.instances, int),
            to(scene.splats, Splat2D),
        ]
        self.image, self.final = (
            wp.zeros(shape, dtype=wp.vec3, device="cpu"),
            wp.zeros(shape, dtype=float, device="cpu"),
        )
        self.last = wp.zeros(shape, dtype=int, device="cpu")
        self.upstream = to(upstream.numpy(), wp.vec3)
        self.grads = wp.zeros(len(scene.splats), dtype=vec9, device="cpu")

    def forward(self) -> None:
        wp.launch(blend, dim=self.shape, inputs=self.inputs, outputs=[self.image, self.final, self.last], device="cpu")

    def adjoint(self) -> None:
        self.grads.zero_()
        inputs = [*self.inputs, self.final, self.last, self.upstream]
        wp.launch(adj_blend, dim=self.shape, inputs=inputs, outputs=[self.grads], device="cpu")


def compare(lanes: Lanes, scalar: Scalar) -> None:
    """Same image, same gradients, or there is nothing to time."""
    difference = np.abs(lanes.image.detach().numpy() - scalar.image.numpy())
    ours = torch.cat([grad.reshape(len(grad), -1) for grad in lanes.grads], 1).double().numpy()
    theirs = scalar.grads.numpy().astype(np.float64)
    error = np.linalg.norm(ours - theirs, axis=0) / np.linalg.norm(theirs, axis=0)
    print(f"image: mean difference {difference.mean():.1e}, largest {difference.max():.1e}")
    print(f"gradients: relative L2 difference {error.max():.1e} at most (mean, conic, opacity, color)")
    if difference.mean() > 1e-5 or error.max() > 1e-3:
        raise SystemExit("the two drivers disagree")


def main() -> None:
    arguments = parse(__doc__, option("--repeats", type=int, default=5))
    launch.prepare("cpu", 0)
    scene = blend_scene()
    upstream = torch.from_numpy(np.random.default_rng(1).normal(size=(scene.height, scene.width, 3)).astype(np.float32))
    lanes, scalar = Lanes(scene, upstream), Scalar(scene, upstream)
    for driver in (lanes, scalar):
        driver.forward()
        driver.adjoint()
    compare(lanes, scalar)

    runs = {"scalar forward": scalar.forward, "scalar adjoint": scalar.adjoint}
    for count in (1, 2):
        plural = "s" if count > 1 else ""
        runs[f"lanes forward, {count} thread{plural}"] = with_threads(count, lanes.forward)
        runs[f"lanes adjoint, {count} thread{plural}"] = with_threads(count, lanes.adjoint)
    medians = interleaved(runs, arguments.repeats)
    work = len(scene.instances) * 256
    rows = []
    for name, seconds in medians.items():
        kind = "forward" if "forward" in name else "adjoint"
        speedup = medians[f"scalar {kind}"] / seconds
        rows.append((name, f"{1e3 * seconds:.1f}", f"{1e9 * seconds / work:.3f}", f"{speedup:.1f}"))
    headers = ("blend", "ms", "ns per instance and pixel", "times scalar")
    note = f"{len(scene.splats)} Gaussians, {scene.width} x {scene.height} px, {len(scene.instances)} tile instances."
    for kind in ("forward", "adjoint"):
        ratio = medians[f"lanes {kind}, 1 thread"] / medians[f"lanes {kind}, 2 threads"]
        note += f" {kind.capitalize()}: two threads {ratio:.2f} times one."
    write_table("blend", arguments.out, headers, rows, note, {"seconds": medians})


if __name__ == "__main__":
    main()

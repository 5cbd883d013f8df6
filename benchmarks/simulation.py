"""Pictures a second of many simulated worlds: our sensor and Newton's own on the same Gaussians, in one run.

A view of 128 x 128 pixels for each of 64 worlds: a body of its own before Gaussians that all share. Newton's is as
delivered, and in its mode QUALITY. The difference to the float64 renderer is that of the first view; also where
Gaussians cover a pixel wholly, because Newton draws others as if they did. Warp launches on one thread of a CPU, so one
row has ours on one; another calls ours for each view. Then ours with a large backdrop: 16 views of 512 x 512. Three
minutes.

    python benchmarks/simulation.py [--worlds 64] [--device cuda] [--out docs/benchmarks]
"""

import time
from functools import partial
from unittest import mock

import newton
import numpy as np
import torch
import warp as wp
from common import option, parse, synchronize, write_table
from newton.sensors import SensorCamera
from torch.utils._python_dispatch import TorchDispatchMode

from warp_splat import runtime
from warp_splat.camera import Camera
from warp_splat.color import to_srgb
from warp_splat.compare.oracle import Render, exact_render
from warp_splat.config import CORES
from warp_splat.errors import InputError
from warp_splat.newton import SensorSplatCamera, camera_of_fov
from warp_splat.runtime import pool
from warp_splat.runtime.launch import prepare

SIDE, FOV, CALLS = 128, 0.8, 3
LARGE = (16, 512, 100_000)  # worlds, pixels, Gaussians that all share
COVERED = 0.999  # alpha from which Gaussians cover a pixel
COLUMNS = {
    "renderer": "{name}",
    **{"pictures": "{size}", "Gaussians of a view": "{count}", "pictures a second": "{speed:.1f}"},
    "largest difference": "{most:.1e}",
    "mean difference": "{mean:.1e}",
    "mean where covered": "{covered:.1e}",
}
EYE = (0.0, 0.0, 4.0, 0.0, 0.0, 0.0, 1.0)


def ball(count: int, size: float, seed: int, scale: float = 1.0) -> newton.Gaussian:
    """Gaussians of degree 0, which is what Newton draws."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    colors = rng.uniform(-1.5, 1.5, (count, 3))
    scales, opacities = scale * rng.uniform(0.06, 0.24, (count, 3)), rng.uniform(0.3, 0.95, count)
    return newton.Gaussian(rng.normal(0, size, (count, 3)), quats, scales, opacities, colors)


def worlds_of(count: int, device: str, behind: int = 2_000):
    """A model of so many worlds, and the Gaussians of one of them, of which so many are shared."""
    body, shared = ball(300, 0.25, 1), ball(behind, 0.8, 2, (2_000 / behind) ** (1 / 3))
    world, scene = newton.ModelBuilder(), newton.ModelBuilder()
    number = world.add_body(
        xform=wp.transform((0.0, 0.0, 1.0), wp.quat_identity()), mass=1.0, inertia=wp.mat33(np.eye(3))
    )
    world.add_shape_gaussian(number, gaussian=body)
    scene.add_shape_gaussian(-1, gaussian=shared)
    scene.replicate(world, count)
    return scene.finalize(device=device), (shared, body)


def exact_view(parts: tuple) -> Render:
    """The float64 renderer's picture of the first world."""
    shared, body = parts
    means = np.concatenate([shared.positions, body.positions + np.float32([0, 0, 1])])
    quats, scales, opacities, colors = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("rotations", "scales", "opacities", "sh_coeffs")
    )
    turn, lens = np.diag([1.0, -1.0, -1.0]), camera_of_fov(SIDE, SIDE, FOV)
    camera = Camera(SIDE, SIDE, lens.fx, lens.fy, lens.cx, lens.cy, turn, -turn @ np.array(EYE[:3]))
    given = (means, quats[:, [3, 0, 1, 2]], scales, opacities, colors[:, None])
    return exact_render(*(torch.from_numpy(array).double() for array in given), camera)


def ways_of_ours(count: int, side: int, device: str, behind: int = 2_000) -> tuple[dict, wp.array, tuple]:
    """By name, what draws the views of so many worlds; into which images; and the Gaussians of a world."""
    model, parts = worlds_of(count, device, behind)
    state, eyes = model.state(), wp.array([EYE] * count, dtype=wp.transform)
    rgb = wp.zeros((count, side, side), dtype=wp.vec3)
    sensor, camera = SensorSplatCamera(model), camera_of_fov(side, side, FOV)

    def draw(threads: int, size: int) -> None:
        pool.set_threads(threads)
        for first in range(0, count, size):
            part, worlds = slice(first, first + size), range(first, min(first + size, count))
            sensor.update(state, eyes[part], camera, rgb_image=rgb[part], world_indices=worlds)

    if device == "cuda":
        return {"ours": lambda: draw(1, count), "ours, a call for each": lambda: draw(1, 1)}, rgb, (model, state, parts)
    ways = {f"ours, {CORES} threads": (CORES, count), "ours, 1 thread": (1, count), "ours, a call for each": (1, 1)}
    return {name: partial(draw, *way) for name, way in ways.items()}, rgb, (model, state, parts)


def timed(runs: dict, rgb: dict, device: str) -> tuple[dict, dict]:
    """The least seconds of each run, by turns, after one that is not counted; and the first picture of each."""
    times, shown = {name: [] for name in runs}, {}
    for _ in range(CALLS + 1):
        for name, run in runs.items():
            synchronize(device)
            begun = time.perf_counter()
            run()
            synchronize(device)
            times[name].append(time.perf_counter() - begun)
            shown[name] = rgb[name].numpy()[0].copy()
    return {name: min(seconds[1:]) for name, seconds in times.items()}, shown


class Counted(TorchDispatchMode):
    """Counts the kernels that are launched meanwhile, and what torch is asked for."""

    def __enter__(self):
        self.launches = self.operations = 0
        places = (wp, "launch"), (runtime.launch, "_bound")  # the latter on the CPU
        self.patches = [mock.patch.object(*place, self.counting(getattr(*place))) for place in places]
        for patch in self.patches:
            patch.start()
        return super().__enter__()

    def __exit__(self, *error):
        for patch in self.patches:
            patch.stop()
        return super().__exit__(*error)

    def counting(self, function):
        def launched(*arguments, **more):
            self.launches += 1
            return function(*arguments, **more)

        return launched

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        self.operations += 1
        return function(*args, **(kwargs or {}))


def main() -> None:
    where = option("--device", choices=("cpu", "cuda"), default="cpu")
    arguments = parse(__doc__, option("--worlds", type=int, default=64), where)
    device, worlds = arguments.device, arguments.worlds
    try:
        prepare(device, 0)
    except InputError as error:
        raise SystemExit(str(error)) from None
    wp.set_device(device)
    small, ours, (model, state, parts) = ways_of_ours(worlds, SIDE, device)
    runs = dict(small)
    theirs, own, eyes = wp.zeros_like(ours), SensorCamera(model), wp.array([EYE] * worlds, dtype=wp.transform)
    rays = SensorCamera.compute_camera_rays_pinhole(SIDE, SIDE, camera_fov=FOV)
    quality = SensorCamera.RenderConfig(gaussians_mode=SensorCamera.GaussianRenderMode.QUALITY)
    rgb = dict.fromkeys(runs, ours) | dict.fromkeys(("Newton's", "Newton's, QUALITY"), theirs)
    runs["Newton's"] = lambda: own.update(state, eyes, rays, hdr_color_image=theirs)
    runs["Newton's, QUALITY"] = lambda: own.update(state, eyes, rays, hdr_color_image=theirs, render_config=quality)
    seconds, shown = timed(runs, rgb, device)
    exact, records = exact_view(parts), []
    covered = exact.alpha.numpy() > COVERED
    for name, seen in shown.items():
        image = seen if name.startswith("ours") else to_srgb(seen.clip(0, 1), np.where)
        apart, speed = np.abs(image - exact.image.numpy()), worlds / seconds[name]
        row = {"name": name, "size": f"{worlds} of {SIDE} x {SIDE}", "count": sum(part.count for part in parts)}
        row |= {"speed": speed, "most": apart.max(), "mean": apart.mean(), "covered": apart[covered].mean()}
        records.append(row)
    count, side, behind = LARGE
    runs, ours, (*_, parts) = ways_of_ours(count, side, device, behind)
    seconds, _ = timed(runs, dict.fromkeys(runs, ours), device)
    for name, least in seconds.items():
        row = {"name": name, "size": f"{count} of {side} x {side}", "count": sum(part.count for part in parts)}
        records.append(row | {"speed": count / least})
    counts = []
    for name in ("ours" if device == "cuda" else "ours, 1 thread", "ours, a call for each"):
        with Counted() as counted:
            small[name]()
        counts += [counted.launches, counted.operations]
    note = f"A view of each world, wall time, the best of {CALLS} calls. "
    note += f"Gaussians cover {covered.mean():.0%} of the smaller pictures' pixels wholly. "
    note += (
        "All views of these together take {} launches and {} operations of torch, a call for each {} and {}.".format(
            *counts
        )
    )
    if device == "cuda":
        note += f" On {torch.cuda.get_device_name()}."
    write_table("simulation_cuda" if device == "cuda" else "simulation", arguments.out, COLUMNS, records, note)


if __name__ == "__main__":
    main()

"""Pictures a second of many simulated worlds: our sensor and Newton's own on the same Gaussians, in one run.

A view of 128 x 128 pixels for each of 64 worlds: a body of its own before Gaussians that all share. Newton's is as
delivered, and in its mode QUALITY. The difference to the float64 renderer is that of the first view; also where
Gaussians cover a pixel wholly, because Newton draws others as if they did. Warp launches on one thread of a CPU, so one
row has ours on one. Two minutes.

    python benchmarks/simulation.py [--worlds 64] [--device cuda] [--out docs/benchmarks]
"""

import time
from functools import partial

import newton
import numpy as np
import torch
import warp as wp
from common import option, parse, synchronize, write_table
from newton.sensors import SensorCamera

from warp_splat.camera import Camera
from warp_splat.color import to_srgb
from warp_splat.compare.oracle import Render, exact_render
from warp_splat.errors import InputError
from warp_splat.newton import SensorSplatCamera, camera_of_fov
from warp_splat.runtime import pool
from warp_splat.runtime.launch import prepare

SIDE, FOV, CALLS = 128, 0.8, 2
COVERED = 0.999  # alpha from which Gaussians cover a pixel
COLUMNS = {
    "renderer": "{name}",
    **{"Gaussians of a view": "{count}", "pictures a second": "{speed:.1f}", "largest difference": "{most:.1e}"},
    "mean difference": "{mean:.1e}",
    "mean where covered": "{covered:.1e}",
}
EYE = (0.0, 0.0, 4.0, 0.0, 0.0, 0.0, 1.0)


def ball(count: int, size: float, seed: int) -> newton.Gaussian:
    """Gaussians of degree 0, which is what Newton draws."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    colors = rng.uniform(-1.5, 1.5, (count, 3))
    scales, opacities = rng.uniform(0.06, 0.24, (count, 3)), rng.uniform(0.3, 0.95, count)
    return newton.Gaussian(rng.normal(0, size, (count, 3)), quats, scales, opacities, colors)


def worlds_of(count: int, device: str):
    """A model of so many worlds, and the Gaussians of one of them."""
    body, shared = ball(300, 0.25, 1), ball(2_000, 0.8, 2)
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


def place_all(sensor: SensorSplatCamera, state: newton.State, eyes: wp.array) -> None:
    """What a call does before it renders."""
    for view, (pieces, layout) in enumerate(sensor._worlds):
        sensor._place(view, pieces, layout, state, eyes, False)


def main() -> None:
    where = option("--device", choices=("cpu", "cuda"), default="cpu")
    arguments = parse(__doc__, option("--worlds", type=int, default=64), where)
    device = arguments.device
    try:
        prepare(device, 0)
    except InputError as error:
        raise SystemExit(str(error)) from None
    wp.set_device(device)
    model, parts = worlds_of(arguments.worlds, device)
    state, eyes = model.state(), wp.array([EYE] * arguments.worlds, dtype=wp.transform)
    shape = (arguments.worlds, SIDE, SIDE)
    ours, theirs = (wp.zeros(shape, dtype=wp.vec3) for _ in range(2))
    sensor, camera, own = SensorSplatCamera(model), camera_of_fov(SIDE, SIDE, FOV), SensorCamera(model)
    rays = SensorCamera.compute_camera_rays_pinhole(SIDE, SIDE, camera_fov=FOV)
    quality = SensorCamera.RenderConfig(gaussians_mode=SensorCamera.GaussianRenderMode.QUALITY)

    def draw(threads: int) -> None:
        pool.set_threads(threads)
        sensor.update(state, eyes, camera, rgb_image=ours)

    cores = pool.get_threads()
    ways = {f"ours, {cores} threads": cores, "ours, 1 thread": 1} if device == "cpu" else {"ours": 1}
    runs = {
        **{name: partial(draw, threads) for name, threads in ways.items()},
        "Newton's": lambda: own.update(state, eyes, rays, hdr_color_image=theirs),
        "Newton's, QUALITY": lambda: own.update(state, eyes, rays, hdr_color_image=theirs, render_config=quality),
    }
    times, shown = {name: [] for name in runs}, {}
    for _ in range(CALLS + 1):
        for name, run in runs.items():
            synchronize(device)
            begun = time.perf_counter()
            run()
            synchronize(device)
            times[name].append(time.perf_counter() - begun)
            shown[name] = ours.numpy()[0].copy() if "ours" in name else to_srgb(theirs.numpy()[0].clip(0, 1), np.where)
    exact, records = exact_view(parts), []
    covered = exact.alpha.numpy() > COVERED
    for name, image in shown.items():
        apart, speed = np.abs(image - exact.image.numpy()), arguments.worlds / min(times[name][1:])
        row = {"name": name, "count": sum(part.count for part in parts), "speed": speed, "most": apart.max()}
        records.append(row | {"mean": apart.mean(), "covered": apart[covered].mean()})
    note = f"{arguments.worlds} worlds, a view of {SIDE} x {SIDE} each, wall time, the best of {CALLS} calls. "
    note += f"Gaussians cover {covered.mean():.0%} of the pixels wholly."
    if device == "cuda":
        note += f" On {torch.cuda.get_device_name()}."
        write_table("simulation_cuda", arguments.out, COLUMNS, records, note)
        return
    write_table("simulation", arguments.out, COLUMNS, records, note)
    spent = []  # of one thread, without what else runs on the machine
    for work in (lambda: draw(1), lambda: place_all(sensor, state, eyes)):
        begun = time.thread_time()
        work()
        spent.append(time.thread_time() - begun)
    print(f"Placing takes {spent[1] / spent[0]:.1%} of a call on one thread.")


if __name__ == "__main__":
    main()

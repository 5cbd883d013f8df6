"""Commands for ``test_pretend_cuda.py``, one after another in a process that has a GPU, or a pretended one.

    PYTHONPATH=tests/pretend_cuda:benchmarks python tests/pretended_runs.py FOLDER [NAME ...]

FOLDER holds a scene of three photographs. A line of JSON for each command: how it ended, and where the host waited,
which the pretended GPU knows.
"""

import json
import sys
import traceback
from collections import Counter
from contextlib import contextmanager, nullcontext
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
import warp as wp
from fake_viser import FakeClient, FakeServer, drawn
from knobs import run_knobs

from warp_splat import Camera, CameraParameters, RasterOptions, rasterize
from warp_splat.cli import main
from warp_splat.compare import adjoints
from warp_splat.compare.workloads import layered
from warp_splat.config import ADJOINTS
from warp_splat.gsplat import rasterization
from warp_splat.raster.api import render
from warp_splat.raster.data import Gaussians, Room
from warp_splat.viewer import server

try:
    from sitecustomize import Stream, notes, used  # the pretended GPU's
except ImportError:  # a real one
    Stream, notes, used = None, [], set()
SIZE = (40, 24)
STEPS = 16
CHANGES = (1, 6, 12)  # steps from which on the host has to know another number of Gaussians
SHORT = (
    f"--iterations {STEPS} --densify_from_iter 3 --densification_interval 6 --densify_until_iter 14 --test_iterations "
    "--opacity_reset_interval 9 --sh_interval 3 --densify_grad_threshold 0.00005 --quiet --device cuda"
).split()
TRAININGS = {
    "default": "--eval",
    "budget": "--growth budget --max_gaussians 30",
    "mcmc": "--growth mcmc --max_gaussians 40",
    "parts": "--parts exposure,sky,surface,floaters --vignetting",
    "depth": "--depths depths",
    "grid": "--exposure bilateral --coarse 2 --coarse_until_iter 5",
    "background": "--random_background --white_background",
    "pose": "--parts pose,sky --pose_intrinsics focal",
    "sparse": "--optimizer_type sparse_adam --half_moments --antialiasing --data_device cuda",
    "stepwise": "--adjoint stepwise --projection ellipsoid",
    "reversible": "--adjoint reversible --projection unscented",
    "stored": "--adjoint stored",
    "profile": "--profile 4 --tensorboard --checkpoint_iterations 8",
}


def gaussians():
    """Means, quaternions, scales, opacities and harmonics, on the device."""
    random = torch.Generator().manual_seed(0)
    new = lambda *shape: torch.rand(60, *shape, generator=random)  # noqa: E731
    given = (new(3) - 0.5, new(4), 0.05 + 0.1 * new(3), 0.2 + 0.7 * new(), new(16, 3) - 0.3)
    return [tensor.cuda().requires_grad_() for tensor in given]


def call(mode: str) -> None:
    """The function ``rasterize`` and its adjoint, against the host's."""
    found, camera = [], Camera(*SIZE, 30.0, 30.0, 20.0, 12.0, np.eye(3), np.array([0.0, 0.0, 3.0]))
    for device in ("cuda", "cpu"):
        leaves = [tensor.detach().to(device).requires_grad_() for tensor in gaussians()]
        out = rasterize(*leaves, camera, adjoint=mode)
        out.image.square().sum().backward()
        found.append([out.image.detach().cpu(), *(leaf.grad.cpu() for leaf in leaves)])
    for one, other in zip(*found, strict=True):
        assert (one - other).norm() <= 1e-5 * other.norm(), mode


def learned_camera() -> None:
    """Gradients of a camera's numbers: the host knows these and does not look at sums, beside one that does."""
    base, found = Camera(*SIZE, 30.0, 31.0, 20.0, 12.0, np.eye(3), np.array([0.0, 0.0, 3.0])), []
    for device in ("cuda", "cpu"):
        numbers = torch.tensor([0.05, -0.02, 0.03, 0.1, 0.2, -0.1]), torch.tensor([30.5, 31.0, 20.2, 12.0])
        leaves = [tensor.double().to(device).requires_grad_() for tensor in numbers]
        camera = CameraParameters(base, *leaves)
        camera.here = CameraParameters(base, *(tensor.double() for tensor in numbers))
        scene = [tensor.detach().to(device) for tensor in gaussians()]
        given = Gaussians(*scene[:4], scene[4][:, :1], scene[4][:, 1:])
        room, before = Room(10**4), len(notes)
        image = render(given, camera, torch.zeros(3, device=device), RasterOptions(), room=room).image
        image.square().sum().backward()
        assert not notes[before:]
        found.append([leaf.grad.cpu() for leaf in leaves])
    for one, other in zip(*found, strict=True):
        assert (one - other).norm() <= 1e-5 * other.norm()


def call_as_gsplat() -> None:
    leaves, pose = gaussians(), torch.eye(4, device="cuda")
    pose[2, 3] = 3.0
    lens = torch.tensor([[30.0, 0.0, 20.0], [0.0, 30.0, 12.0], [0.0, 0.0, 1.0]], device="cuda")
    for packed in (False, True):
        image, *_ = rasterization(*leaves, pose[None], lens[None], *SIZE, sh_degree=3, absgrad=True, packed=packed)
        image.square().sum().backward()


def waited() -> Counter:
    """Where the host did."""
    return Counter(note["where"].split(" < ")[0] for note in notes)


def in_simulation() -> None:
    """Newton's sensor and its adjoint in a stream of Warp's: all of it there, and the host's picture and gradients.

    The host waits where docs/simulation.md says so.
    """
    import newton  # noqa: PLC0415 - optional

    from warp_splat.newton import SensorSplatCamera, camera_of_fov  # noqa: PLC0415

    world, scene, found = newton.ModelBuilder(), newton.ModelBuilder(), []
    means, quats, scales, opacities, sh = (tensor.detach().cpu().numpy() for tensor in gaussians())
    splats = newton.Gaussian(
        means, quats / np.linalg.norm(quats, axis=1)[:, None], scales, opacities, sh.reshape(60, 48)
    )
    world.add_shape_gaussian(world.add_body(mass=1.0), gaussian=splats)
    scene.add_shape_gaussian(-1, gaussian=splats)
    scene.replicate(world, 2)
    card = wp.device_from_torch(torch.device("cuda", 0))
    for device in (card, wp.get_device("cpu")):
        model = scene.finalize(device=device, requires_grad=True)
        sensor, state = SensorSplatCamera(model), model.state()
        eyes = wp.array([(0, 0, 3, 0, 0, 0, 1)] * 2, dtype=wp.transform, device=device, requires_grad=True)
        rgb = wp.zeros((2, 24, 40), dtype=wp.vec3, device=device, requires_grad=True)
        again, camera, waits = wp.zeros_like(rgb), camera_of_fov(40, 24, 0.8), []
        stream = wp.ScopedStream(Stream(7, card) if Stream else wp.Stream(card)) if device is card else nullcontext()
        used.clear()
        with wp.ScopedDevice(device), stream:
            notes.clear()
            with wp.Tape() as tape:
                sensor.update(state, eyes, camera, rgb_image=rgb)
                tape.backward(grads={rgb: wp.full_like(rgb, wp.vec3(1.0))})
            waits.append(waited())
            notes.clear()
            sensor.update(state, eyes, camera, rgb_image=again)
            waits.append(waited())
        seen = device is card and Stream
        assert used == ({7} if seen else set()) and np.array_equal(again.numpy(), rgb.numpy())
        places = ("raster/checks.py:check_gaussians", "raster/bin.py:bin_by_sorting")
        each = dict.fromkeys((*places, "raster/api.py:invalid"), len(eyes))
        for_all = {"newton/sensor.py:_draw_together": 1, "raster/worlds.py:_merge": 1}
        for_all |= dict.fromkeys((*places, "raster/worlds.py:__init__"), 2)  # of what is shared, and of all worlds
        assert waits == ([each, for_all] if seen else [{}, {}]), waits
        found.append([array.numpy() for array in (rgb, eyes.grad, state.body_q.grad)])
    for one, other in zip(*found, strict=True):
        assert other.any() and np.linalg.norm(one - other) <= 1e-4 * np.linalg.norm(other)


def compare() -> None:
    """What ``warp-splat compare`` measures, of a scene small enough for fibers."""
    workload = layered(10).to(torch.device("cuda"))
    assert adjoints.run_adjoints([workload], ADJOINTS, str) and run_knobs([workload], str)


def view(folder: Path) -> None:
    """``warp-splat view`` of the first training's model, with the places of viser and of a browser taken."""
    client = FakeClient(1, Camera(*SIZE, 30.0, 30.0, 20.0, 12.0, np.eye(3), np.array([0.0, 0.0, 3.0])))

    class Viewer(server.Viewer):
        def __enter__(self):
            self.server.enter(client)
            drawn(self)
            return super().__enter__()

    sys.modules["viser"] = type(sys)("viser")
    sys.modules["viser"].ViserServer = FakeServer
    command = sys.modules["warp_splat.viewer.command"]
    command.Viewer, command.interruptible = Viewer, contextmanager(lambda: (yield [2]))
    assert main(["view", str(folder / "default"), "--device", "cuda"]) == 0 and client.frames


def commands(folder: Path) -> dict:
    """By name, what runs."""
    run = lambda *words: lambda: main([str(word) for word in words])  # noqa: E731
    model, scene = folder / "default", folder / "scene"
    found = {"first call": lambda: call("manual")}  # of a process
    found |= {
        name: run("train", "-s", scene, "-m", folder / name, *SHORT, *words.split())
        for name, words in TRAININGS.items()
    }
    return found | {
        "resume": run("train", "--resume", folder / "profile", "--iterations", STEPS + 4),
        "render": run("render", "-m", model, "--device", "cuda"),
        "bound": run("render", "-m", model, "--tolerance", "0.01", "--bound", "--skip_train", "--device", "cuda"),
        "view": lambda: view(folder),
        "simplify": run("simplify", model, "--keep", "0.5", "--steps", "2", "--device", "cuda"),
        "clean": run("clean", model, "--steps", "2", "--device", "cuda"),
        "learned camera": learned_camera,
        "gsplat": call_as_gsplat,
        **({"simulation": in_simulation} if find_spec("newton") else {}),
        **{mode: (lambda mode=mode: call(mode)) for mode in ADJOINTS},
        "compare": compare,
    }


def main_of_runs(folder: Path, wanted: list[str]) -> None:
    for name, run in commands(folder).items():
        if wanted and name not in wanted:
            continue
        notes.clear()
        try:
            code = run() or 0
        except BaseException:
            code = traceback.format_exc()
        steps = [note for note in notes if note["iteration"]]
        print("ran", json.dumps({"name": name, "code": code, "waits": steps}), flush=True)


if __name__ == "__main__":
    import warp_splat.viewer.command  # noqa: F401 - whose names view() replaces

    main_of_runs(Path(sys.argv[1]), sys.argv[2:])

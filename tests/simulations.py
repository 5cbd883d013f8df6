"""A simulation of Newton's in which Gaussians move, for the tests of its sensor; skips them where newton is not."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation
from splat_files import small_splats

from warp_splat.formats.exchange import save_gaussians
from warp_splat.formats.splats import SplatFile

newton = pytest.importorskip("newton", reason="newton is not installed")
from warp_splat.newton import SensorSplatCamera, gaussian_of_file  # noqa: E402 - behind the question for it

FOV, WIDTH, HEIGHT = 0.9, 40, 32
BACKGROUND = (0.2, 0.3, 0.1)
UNSEEN = newton.ModelBuilder.ShapeConfig(is_visible=False, density=0.0, has_shape_collision=False)
PLACE = (0.3, -0.2, 0.1, *Rotation.from_rotvec([0.2, 0.5, -0.4]).as_quat())  # of the shape on its body
BODIES = [(0.2, 0.1, 0.4, *Rotation.from_rotvec([0.4, -0.3, 1.2]).as_quat()), (-0.3, 0.2, -0.1, 0, 0, 0, 1)]
CAMERAS = [(0.1, 0.2, 5.0, *Rotation.from_rotvec([0.05, 0.1, 0.2]).as_quat()), (0.3, 0.0, 4.5, 0, 0, 0, 1)]


def make_simulation(folder: Path) -> SimpleNamespace:
    """Two worlds, each with a body of Gaussians of degree 3; others of degree 1 stand in both."""
    parts = small_splats(30, 4, 1), small_splats(25, 16, 2)
    for number, splats in enumerate(parts):
        save_gaussians(folder / f"{number}.ply", SplatFile(splats))
    world, scene = newton.ModelBuilder(), newton.ModelBuilder()
    body = world.add_body(mass=1.0)
    world.add_shape_gaussian(
        body, xform=PLACE, gaussian=gaussian_of_file(folder / "1.ply"), scale=(1.5, 1.5, 1.5), cfg=UNSEEN
    )
    scene.add_shape_gaussian(-1, gaussian=gaussian_of_file(folder / "0.ply"), cfg=UNSEEN)
    scene.replicate(world, 2)
    model = scene.finalize(device="cpu", requires_grad=True)
    return SimpleNamespace(model=model, parts=parts, sensor=SensorSplatCamera(model, background=BACKGROUND))


def state_of(simulation, bodies=BODIES):
    state = simulation.model.state()
    state.body_q.assign(np.float32(bodies))
    return state


def images(count=2, **kinds):
    return {
        name: wp.zeros((count, HEIGHT, WIDTH), dtype=kind, requires_grad=kind != wp.uint32)
        for name, kind in kinds.items()
    }

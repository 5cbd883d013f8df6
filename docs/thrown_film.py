"""A film of a simulation: a trained globe and a red ball of Newton are thrown onto a trained table.

    uv run train.py --preset fast -m output/abc123
    uv run --extra newton --extra mesh python docs/thrown_film.py -m output/abc123

The globe's Gaussians are copied out of the model and follow a body. Both balls bounce on the surface that ``warp-splat
mesh`` finds, which is not drawn. Newton draws the red one: Gaussians hide it, and it hides Gaussians.
"""

import argparse
from pathlib import Path

import matplotlib.image
import newton
import numpy as np
import trimesh
import warp as wp
from newton.sensors import SensorCamera

from warp_splat.cli import main
from warp_splat.errors import InputError
from warp_splat.formats.model_folder import find_iteration, ply_path, read_cameras
from warp_splat.formats.png import save_video
from warp_splat.newton import SensorSplatCamera, gaussian_of_file

GLOBE, RADIUS, VIEW = (0.66, 0.2, 0.41), 0.315, "view_031.png"  # of the embedded scene
FRAMES, RATE, SUBSTEPS, SHOWN = 40, 24, 10, ((1, 6, 10), (14, 18, 22))  # frames a simulated second; film at half speed


def simulation(model: Path) -> newton.Model:
    """Two balls in flight over the trained scene."""
    scene = gaussian_of_file(ply_path(model, find_iteration(model)))
    near = np.linalg.norm(scene.positions - GLOBE, axis=1) < 1.05 * RADIUS
    parts = (scene.rotations, scene.scales, scene.opacities, scene.sh_coeffs)
    globe = newton.Gaussian(scene.positions[near] - GLOBE, *(part[near] for part in parts))
    assert main(["mesh", str(model), str(model / "mesh.ply")]) == 0
    surface, config, builder = trimesh.load(model / "mesh.ply"), newton.ModelBuilder.ShapeConfig, newton.ModelBuilder()
    solid, drawn = config(is_visible=False, restitution=0.7), config(is_visible=False, density=0, collision_group=0)
    builder.add_shape_mesh(-1, mesh=newton.Mesh(surface.vertices, surface.faces.ravel()), cfg=solid)
    builder.add_shape_gaussian(-1, gaussian=scene, cfg=drawn)
    thrown = builder.add_body(xform=wp.transform((1.5, -0.6, 1.1), wp.quat_identity()))
    builder.add_shape_sphere(thrown, radius=0.29, cfg=solid)
    builder.add_shape_gaussian(thrown, gaussian=globe, cfg=drawn)
    red = builder.add_body(xform=wp.transform((-1.3, -0.1, 0.75), wp.quat_identity()))
    builder.add_shape_sphere(red, radius=0.13, cfg=config(restitution=0.7), color=(0.8, 0.1, 0.1))
    builder.body_qd[thrown], builder.body_qd[red] = (-1.8, -0.6, 1.0, 3, 0, 4), (1.4, 0.9, 2.2, 0, 0, 0)
    return builder.finalize(device="cpu")


def film(model: newton.Model, camera):
    """[H, W, 3] uint8, one after another."""
    solver, pipeline = newton.solvers.SolverXPBD(model, enable_restitution=True), newton.CollisionPipeline(model)
    contacts, states = pipeline.contacts(), [model.state(), model.state()]
    turn = wp.quat_from_matrix(wp.mat33(camera.rotation.T * [1, -1, -1]))  # Newton's look along -z
    eyes = wp.array([wp.transform(camera.center, turn)], dtype=wp.transform)
    size, lens = (camera.width, camera.height), (camera.fx, camera.fy, camera.cx, camera.cy)
    rays = SensorCamera.compute_camera_rays_pinhole_opencv(*size, *lens)
    meshes, splats = SensorCamera(model), SensorSplatCamera(model)
    meshes.create_default_light(enable_shadows=False)
    color, depth = splats.allocate_image_color(1, *size), splats.allocate_image_depth_forward(1, *size)
    for _ in range(FRAMES):
        for _ in range(SUBSTEPS):
            states[0].clear_forces()
            pipeline.collide(states[0], contacts)
            solver.step(*states, None, contacts, 1 / RATE / SUBSTEPS)
            states.reverse()
        model.bvh_refit_shapes(states[0])
        meshes.update(states[0], eyes, rays, color_image=color, forward_depth_image=depth)
        splats.update(states[0], eyes, camera, color_image=color, mesh_color=color, mesh_depth=depth)
        yield color.numpy().view(np.uint8).reshape(*size[::-1], 4)[..., :3].copy()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-m", dest="model", type=Path, required=True, help="folder of a model of the embedded scene")
    model = parser.parse_args().model
    try:
        simulated, camera = simulation(model), dict(read_cameras(model)).get(VIEW)
    except InputError as error:
        parser.error(str(error))
    if camera is None:
        parser.error(f"{model}: expected a model of the embedded scene, found none with {VIEW}; train one.")
    frames = list(film(simulated, camera))
    save_video(model / "thrown.mp4", frames, RATE / 2)
    sheet = np.concatenate([np.concatenate([frames[number] for number in row], axis=1) for row in SHOWN])
    matplotlib.image.imsave(model / "thrown.jpg", sheet)

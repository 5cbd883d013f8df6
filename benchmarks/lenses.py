"""Round trip: the embedded scene traced through a fisheye of 180 degrees, trained as it is and undistorted first.

    python benchmarks/lenses.py --out docs/benchmarks

Each pixel of a photograph is the light along rays that its lens sees; no picture is resampled. Both trainings have the
same steps. Both are judged on the lens's own pixels of views that were held out: the one that was undistorted, too.
"""

import contextlib
import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import warp as wp
from common import option, parse, picture_of, run_training, write_table

sys.path.insert(0, str(Path(__file__).parents[1] / "assets"))
from make_scene import TARGET, orbit
from scene_geometry import still_life
from scene_trace import GRID, LAMP, LAMP_HALF, Scene, Tracer, develop, trace

from warp_splat.camera import Camera
from warp_splat.formats.png import save_png
from warp_splat.gaussians import GaussianModel
from warp_splat.lenses import Lens
from warp_splat.rendering.finished import Finished
from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene

SIZE, FOCAL = 144, 144 / np.pi  # px: 180 degrees across
LENS = Lens("OPENCV_FISHEYE", (0.01, -0.002, 0.0, 0.0))
NEARER = 0.5  # than the photographs of the embedded scene, which a fisheye would show small
WAYS = ("native", "undistort")


@wp.kernel
def photograph_rays(
    scene: Scene,
    position: wp.vec3,
    rays: wp.array2d[wp.vec3],  # [P, GRID GRID] unit, in the world
    # out
    image_out: wp.array[wp.vec3],  # [P] sRGB 0..1
):
    """One pixel per thread, with the samples of scene_trace."""
    pixel = wp.tid()
    total = wp.vec3()
    for sample in range(GRID * GRID):
        spot = (sample * 7 + 3) % (GRID * GRID)
        i, j = (float(spot % GRID) + 0.5) / float(GRID), (float(spot // GRID) + 0.5) / float(GRID)
        lamp = LAMP + 2.0 * LAMP_HALF * wp.vec3(i - 0.5, j - 0.5, 0.0)
        total += wp.min(trace(scene, position, rays[pixel, sample], lamp), wp.vec3(4.0, 4.0, 4.0))
    total = total / float(GRID * GRID)
    image_out[pixel] = wp.vec3(develop(total[0]), develop(total[1]), develop(total[2]))


def write_scene(folder: Path) -> None:
    """Photographs, transforms.json and points."""
    lens = Camera(SIZE, SIZE, FOCAL, FOCAL, SIZE / 2, SIZE / 2, np.eye(3), np.zeros(3), LENS)
    corner = (np.arange(GRID) + 0.5) / GRID
    y, x = np.mgrid[:SIZE, :SIZE].reshape(2, -1, 1, 1)
    places = np.stack(np.broadcast_arrays(x + corner, y + corner[:, None]), -1).reshape(-1, 2)
    rays = lens.rays(places).reshape(SIZE * SIZE, GRID * GRID, 3)
    tracer, frames = Tracer(still_life()), []
    (folder / "images").mkdir()
    for index, (center, rotation) in enumerate(zip(*orbit(), strict=True)):
        place = TARGET + NEARER * (center - TARGET)
        image = wp.empty(SIZE * SIZE, dtype=wp.vec3, device="cpu")
        seen = wp.array(np.ascontiguousarray(rays @ rotation, np.float32), dtype=wp.vec3, device="cpu")
        wp.launch(photograph_rays, image.size, [tracer.scene, wp.vec3(*place), seen], [image], device="cpu")
        name, pose = f"images/view_{index:03}.png", np.eye(4)
        save_png(folder / name, np.rint(image.numpy().reshape(SIZE, SIZE, 3) * 255).astype(np.uint8))
        pose[:3, :3], pose[:3, 3] = rotation.T * (1, -1, -1), place  # OpenGL's axes
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    content = {"camera_model": LENS.model, "fl_x": FOCAL, "fl_y": FOCAL, "cx": SIZE / 2, "cy": SIZE / 2}
    content |= {"w": SIZE, "h": SIZE, "ply_file_path": "points.ply", "frames": frames}
    content |= dict(zip(("k1", "k2", "k3", "k4"), LENS.coefficients, strict=True))
    (folder / "points.ply").write_bytes((embedded_scene() / "points.ply").read_bytes())
    (folder / "transforms.json").write_text(json.dumps(content))


def own_psnr(folder: Path, model: Path) -> float:
    """Of a model, on the lens's own pixels of the views held out [dB], the mean."""
    finished = Finished(model)
    scene = load_scene(folder, eval=True, lens="native", report=str)
    draw = picture_of(GaussianModel.from_splats(finished.file.splats), None, finished.options)
    errors = [np.mean((draw(view.camera) / 255.0 - view.image / 255.0) ** 2) for view in scene.test]
    return float(np.mean(-10 * np.log10(errors)))


def main() -> None:
    given = parse(
        __doc__,
        option("--iterations", type=int, default=1000, help="of each training"),
        option("--work", type=Path, help="folder for scene and models; default: removed afterwards"),
    )
    with contextlib.ExitStack() as stack:
        work = given.work.resolve() if given.work else Path(stack.enter_context(tempfile.TemporaryDirectory()))
        scene = work / "scene"
        if not scene.exists():
            scene.mkdir(parents=True)
            write_scene(scene)
        rows, data = [], {}
        for way in WAYS:
            options = ["--eval", "--iterations", given.iterations, "--lens", way, "--quiet"]
            run_training(work / way, ["-s", scene, *options])
            view = load_scene(scene, lens=way, report=str).train[0]
            data[way] = own_psnr(scene, work / way)
            rows.append([way, f"{view.camera.width} x {view.camera.height}", f"{data[way]:.2f}"])
    note = f"{given.iterations} steps, one seed; the embedded scene through a fisheye of 180 degrees across, {SIZE} px."
    write_table(
        "lenses", given.out, ["--lens", "trained on [px]", "PSNR on the lens's own pixels [dB]"], rows, note, data
    )


if __name__ == "__main__":
    main()

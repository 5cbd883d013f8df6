"""How true the surface of `warp-splat mesh` is: the embedded scene's known geometry, and points of other scenes.

Of a mesh of the embedded scene: accuracy, its area that is near the true surface; completeness, what the cameras see
of the true surface that is near the mesh; both within shares of the extent, and F, their harmonic mean. The table, with
what is on it: completeness without the room around. Normals: mean angle of what is near. Of any scene: how far the
points of structure from motion are from the mesh.

    python benchmarks/mesh.py -m MODEL [-m MODEL ...] [--out docs/benchmarks]
"""

import time
from pathlib import Path

import numpy as np
import trimesh
import warp as wp
from common import TRAINED, parse, write_table
from scene_geometry import still_life
from scene_trace import Measure

from warp_splat.config import MeshConfig
from warp_splat.meshing.command import mesh
from warp_splat.pruning.opened import Opened
from warp_splat.scene.types import Scene, View

SHARES = (0.005, 0.01, 0.02)
SAMPLES, STRIDE, FAR = 200_000, 4, 1e6
TABLE = np.array([[-1.5, -1.5, -0.1], [1.5, 1.5, 2.0]])  # around the embedded scene's table and what is on it
HEADERS = ("scene", *(f"{name} {share:.1%}" for share in SHARES for name in ("accuracy", "completeness", "F")))
HEADERS += ("table, completeness 1.0%", "normals, degrees", "points, median", "points, 90 %", "triangles", "seconds")


@wp.kernel
def nearest(
    mesh: wp.uint64,
    points: wp.array[wp.vec3],  # [P]
    # out
    distance_out: wp.array[float],  # [P]
    normal_out: wp.array[wp.vec3],  # [P] of the nearest triangle
):
    i = wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], FAR)
    place = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
    distance_out[i] = wp.length(place - points[i])
    normal_out[i] = wp.mesh_eval_face_normal(mesh, query.face)


def to_mesh(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances [P] of points [P, 3] to the triangles, and the normals [P, 3] there."""
    arrays = [wp.array(np.asarray(x, np.float32), dtype=wp.vec3, device="cpu") for x in (vertices, points)]
    exact = wp.Mesh(arrays[0], wp.array(np.asarray(faces, np.int32).ravel(), dtype=int, device="cpu"))
    found = [wp.empty(len(points), dtype=dtype, device="cpu") for dtype in (float, wp.vec3)]
    wp.launch(nearest, dim=len(points), inputs=[exact.id, arrays[1]], outputs=found, device="cpu")
    return found[0].numpy(), found[1].numpy()


def seen_by(view: View, measure: Measure) -> np.ndarray:
    """Points [P, 3] of the embedded scene's surface: of every fourth pixel of every fourth row."""
    c = view.camera
    x, y = np.meshgrid(np.arange(0, c.width, STRIDE) + 0.5, np.arange(0, c.height, STRIDE) + 0.5)
    along = np.stack([(x - c.cx) / c.fx, (y - c.cy) / c.fy, np.ones_like(x)], -1).reshape(-1, 3) @ c.rotation
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return c.center + measure(np.broadcast_to(c.center, along.shape), along)[:, None] * along


def against_truth(found: trimesh.Trimesh, scene: Scene) -> list[float]:
    """Accuracy, completeness and F for each share of the extent [%]; completeness of the table; angle of normals."""
    patch = still_life()
    measure = Measure(patch)
    visible = np.concatenate([seen_by(view, measure) for view in scene.train])
    missing, _ = to_mesh(visible, found.vertices, found.faces)
    sampled, of = trimesh.sample.sample_surface(found, SAMPLES, seed=0)
    wrong, normals = to_mesh(sampled, patch.points, patch.faces)
    row = []
    for share in SHARES:
        accuracy, completeness = ((far < share * scene.extent).mean() for far in (wrong, missing))
        row += [accuracy, completeness, 2 * accuracy * completeness / (accuracy + completeness)]
    table = ((visible > TABLE[0]) & (visible < TABLE[1])).all(1)
    row.append((missing[table] < SHARES[1] * scene.extent).mean())
    cosines = np.abs((found.face_normals[of] * normals).sum(1)).clip(0, 1)[wrong < SHARES[-1] * scene.extent]
    return [*(100 * value for value in row), np.degrees(np.arccos(cosines)).mean()]


def row_of(model: Path) -> tuple:
    config = MeshConfig(model=str(model), output=str(model / "mesh.ply"))
    opened = Opened(config)
    scene, name, path = opened.scene, Path(opened.trained["source_path"]).name, Path(config.output)
    begin = time.perf_counter()
    mesh(config)
    seconds = time.perf_counter() - begin
    found = trimesh.load(path, process=False)
    truth = against_truth(found, scene) if name == "still_life" else [None] * (3 * len(SHARES) + 2)
    far = to_mesh(scene.points, found.vertices, found.faces)[0] / scene.extent * 100
    numbers = [*truth, np.median(far), np.quantile(far, 0.9)]
    shown = ("" if value is None else f"{value:.3g}" for value in numbers)
    return (name, *shown, len(found.faces), f"{seconds:.0f}")


def main() -> None:
    arguments = parse(__doc__, TRAINED)
    rows = [row_of(model.resolve()) for model in arguments.models]
    note = "Shares and distances in percent of the scene's extent; seconds with opening the scene; 2 threads."
    write_table("mesh", arguments.out, HEADERS, rows, note)


if __name__ == "__main__":
    main()

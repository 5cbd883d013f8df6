"""How true the surface of `warp-splat mesh` is: the embedded scene's known geometry, and points of other scenes.

Of a mesh of the embedded scene: accuracy, its area that is near the true surface; completeness, what the cameras see
of the true surface that is near the mesh; both within shares of the extent, and F, their harmonic mean. The table, with
what is on it: completeness without the room around. Normals: mean angle of what is near. Of any scene: how far the
points of structure from motion are from the mesh. Colors: PSNR of the mesh in the photographs that were held out.

Beside it, on the same scene, what comes of the model's depths alone, without what photographs tell; and by Open3D (pip
install open3d-cpu), whose rows are left out without it: its distance field of the same depths, of all depths (those
that no other view sees, too), and Poisson's surface of the points of structure from motion (Kazhdan and Hoppe 2013).

    python benchmarks/mesh.py -m MODEL [-m MODEL ...] [--out docs/benchmarks]
"""

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import trimesh
import warp as wp
from common import TRAINED, parse, write_table
from scipy.spatial import KDTree

sys.path.insert(0, str(Path(__file__).parents[1] / "assets"))

from scene_geometry import still_life
from scene_trace import Measure

from warp_splat.config import MeshConfig
from warp_splat.meshing.command import PIXELS, drawn_views, mesh, surface_in, trimesh_of, without_islands
from warp_splat.meshing.fusion import EDGE, TRUNCATION, Drawn, Surface, agreed, pixel, voxels_of
from warp_splat.pruning.opened import Opened
from warp_splat.scene.types import Scene, View

SHARES = (0.005, 0.01, 0.02)
SAMPLES, STRIDE, FAR = 200_000, 4, 1e6
MEMORY, BLOCKS, LEAST = 2e9, 50_000, 3.0  # of Open3D: bytes of views; blocks at first; its own threshold of weights
NEIGHBORS, OCTREE, FAINT = 30, 9, 0.01  # Poisson: points of a normal; depth; share of vertices left out
TABLE = np.array([[-1.5, -1.5, -0.1], [1.5, 1.5, 2.0]])  # around the embedded scene's table and what is on it
HEADERS = ("scene", "surface")
HEADERS += tuple(f"{name} {share:.1%}" for share in SHARES for name in ("accuracy", "completeness", "F"))
HEADERS += (
    "table, completeness 1.0%",
    "normals, degrees",
    "points, median",
    "points, 90 %",
    "colors, dB",
    "triangles",
    "processor seconds",
)


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


@wp.kernel
def hit(
    mesh: wp.uint64,
    center: wp.vec3,
    rays: wp.array[wp.vec3],  # [P]
    colors: wp.array[wp.vec3],  # [V]
    # out
    color_out: wp.array[wp.vec3],  # [P]; -1 where a ray meets nothing
):
    i = wp.tid()
    query = wp.mesh_query_ray(mesh, center, rays[i], FAR)
    color = wp.vec3(-1.0)
    if query.result:
        corners = wp.mesh_get(mesh).indices
        a, b, c = corners[3 * query.face], corners[3 * query.face + 1], corners[3 * query.face + 2]
        color = query.u * colors[a] + query.v * colors[b] + (1.0 - query.u - query.v) * colors[c]
    color_out[i] = color


def colors_of(found: trimesh.Trimesh, views: list[View]) -> float:
    """PSNR [dB] of a mesh's colors in views that were held out, where they show the mesh."""
    vertices, colors = (
        wp.array(np.asarray(x, np.float32), dtype=wp.vec3, device="cpu")
        for x in (found.vertices, found.visual.vertex_colors[:, :3] / 255)
    )
    exact = wp.Mesh(vertices, wp.array(np.asarray(found.faces, np.int32).ravel(), dtype=int, device="cpu"))
    errors = []
    for view in views:
        c = view.camera
        x, y = np.meshgrid(np.arange(c.width) + 0.5, np.arange(c.height) + 0.5)
        rays = c.rays(np.stack([x, y], -1).reshape(-1, 2)) @ c.rotation
        made = wp.empty(len(rays), dtype=wp.vec3, device="cpu")
        inputs = [exact.id, wp.vec3(*c.center), wp.array(rays.astype(np.float32), dtype=wp.vec3, device="cpu"), colors]
        wp.launch(hit, dim=len(rays), inputs=inputs, outputs=[made], device="cpu")
        shown = made.numpy()
        errors.append((shown - view.picture.reshape(-1, 3) / 255)[shown[:, 0] >= 0])
    return -10 * np.log10(np.mean(np.concatenate(errors) ** 2))


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


def open3d_fused(views: list[Drawn], voxel: float, least: float) -> trimesh.Trimesh:
    """Depths in Open3D's distance field where at least so many meet: our voxels and truncation, without islands."""
    import open3d  # noqa: PLC0415 - may be missing

    tensor, single = open3d.core.Tensor, open3d.core.float32
    blocks = open3d.t.geometry.VoxelBlockGrid(("tsdf", "weight"), (single, single), ((1,), (1,)), voxel, EDGE, BLOCKS)
    for view in views:
        c, depth = view.camera, open3d.t.geometry.Image(tensor(view.depth.numpy()))
        pinhole = tensor(np.array([[c.fx, 0, c.cx - 0.5], [0, c.fy, c.cy - 0.5], [0, 0, 1]]))
        pose = tensor(np.block([[c.rotation, c.translation[:, None]], [np.zeros(3), 1.0]]))
        scale = (pinhole, pose, 1.0, FAR, TRUNCATION)
        blocks.integrate(blocks.compute_unique_block_coordinates(depth, *scale), depth, *scale)
    found = blocks.extract_triangle_mesh(least)
    vertices = found.vertex.positions.numpy()
    kept = without_islands(Surface(vertices, found.triangle.indices.numpy(), np.zeros_like(vertices)))
    return trimesh.Trimesh(kept.vertices, kept.faces, process=False)


def poisson(scene: Scene) -> trimesh.Trimesh:
    """Poisson's surface of the scene's points; their normals look to the nearest camera."""
    import open3d  # noqa: PLC0415 - may be missing

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(scene.points.astype(np.float64)))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NEIGHBORS))
    centers = np.stack([view.camera.center for view in scene.train])
    towards = centers[KDTree(centers).query(scene.points)[1]] - scene.points
    normals = np.asarray(cloud.normals)
    cloud.normals = open3d.utility.Vector3dVector(normals * np.sign((normals * towards).sum(1, keepdims=True)))
    found, density = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=OCTREE)
    found.remove_vertices_by_mask(np.asarray(density) < np.quantile(density, FAINT))
    return trimesh.Trimesh(np.asarray(found.vertices), np.asarray(found.triangles), process=False)


def surfaces_of(config: MeshConfig, opened: Opened) -> Iterator[tuple[str, Callable[[], trimesh.Trimesh]]]:
    """Each with what makes it."""

    def ours() -> trimesh.Trimesh:
        mesh(config)
        return trimesh.load(config.output, process=False)

    learned = opened.trained.get("parts")
    yield f"ours, --parts {learned}" if learned else "ours", ours
    if learned:
        return
    views = drawn_views(opened, MEMORY)
    counting = agreed(views)
    voxel = PIXELS * pixel(counting)
    yield "ours, the model's depths", lambda: trimesh_of(surface_in(voxels_of(counting, voxel), counting, voxel))
    try:
        import open3d  # noqa: F401, PLC0415 - may be missing
    except ImportError as error:
        print(f"Open3D's rows are left out: {error}")
        return
    yield "Open3D, the model's depths", lambda: open3d_fused(counting, voxel, 0.0)
    yield "Open3D, all depths", lambda: open3d_fused(views, voxel, LEAST)
    yield "Poisson, points", lambda: poisson(opened.scene)


def rows_of(model: Path) -> Iterator[tuple]:
    config = MeshConfig(model=str(model), output=str(model / "mesh.ply"))
    opened = Opened(config)
    scene, name = opened.scene, Path(opened.trained["source_path"]).name
    for surface, make in surfaces_of(config, opened):
        begin = time.process_time()
        found = make()
        seconds = time.process_time() - begin
        truth = against_truth(found, scene) if name == "still_life" else [None] * (3 * len(SHARES) + 2)
        far = to_mesh(scene.points, found.vertices, found.faces)[0] / scene.extent * 100
        colors = colors_of(found, scene.test) if found.visual.kind == "vertex" else None
        numbers = [*truth, np.median(far), np.quantile(far, 0.9), colors]
        shown = ("" if value is None else f"{value:.3g}" for value in numbers)
        yield name, surface, *shown, len(found.faces), f"{seconds:.0f}"


def main() -> None:
    arguments = parse(__doc__, TRAINED)
    rows = [row for model in arguments.models for row in rows_of(model.resolve())]
    note = (
        "Shares and distances in percent of the scene's extent; processor seconds of all threads; ours from the model."
    )
    write_table("mesh", arguments.out, HEADERS, rows, note)


if __name__ == "__main__":
    main()

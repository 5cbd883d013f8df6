"""A small ray tracer on Warp's mesh queries: the source of the photographs, which knows nothing of Gaussians.

Light comes from one square lamp below the ceiling (soft shadows, a Blinn-Phong highlight that moves with the camera)
and from the room itself (an ambient term, dimmed by an occlusion baked per vertex). Glossy things mirror the room once.
All sample patterns are fixed, so that shadows agree between views and a second run writes the same bytes.
"""

import numpy as np
import warp as wp
from scene_geometry import Patch
from scene_textures import lettering, paint

wp.set_module_options({"enable_backward": False})

GRID = 4  # GRID x GRID samples per pixel, each with its own point on the lamp
FAR = 100.0
LAMP = wp.vec3(2.2, -1.9, 3.0)
LAMP_HALF = 0.4  # half its width
LAMP_POWER = wp.vec3(44.0, 39.5, 32.5)
SKY = wp.vec3(0.40, 0.43, 0.49)  # ambient light from above
GROUND = wp.vec3(0.27, 0.22, 0.18)  # and from below
OCCLUSION_RAYS = 96
OCCLUSION_REACH = 1.2


@wp.struct
class Scene:
    """The mesh and all that is attached to its vertices and faces."""

    mesh: wp.uint64
    faces: wp.array[int]  # [3 F]
    normals: wp.array[wp.vec3]  # [V]
    uvw: wp.array[wp.vec3]  # [V]
    openness: wp.array[float]  # [V] share of the hemisphere that is free
    materials: wp.array[int]  # [F]
    lettering: wp.array2d[float]


@wp.struct
class Camera:
    """Pinhole; COLMAP axes (x right, y down, z forward), pixel centers at half integers."""

    position: wp.vec3
    world_from_camera: wp.mat33
    focal: wp.vec2
    center: wp.vec2
    width: int


@wp.struct
class Hit:
    """The nearest surface along a ray."""

    distance: float  # negative: nothing hit
    point: wp.vec3
    normal: wp.vec3  # towards the viewer
    openness: float
    paint: wp.vec4  # r, g, b, gloss


@wp.func
def intersect(scene: Scene, origin: wp.vec3, direction: wp.vec3):
    """The nearest surface along a ray of unit ``direction``."""
    hit = Hit()
    hit.distance = -1.0
    query = wp.mesh_query_ray(scene.mesh, origin, direction, FAR)
    if query.result:
        a, b, c = scene.faces[3 * query.face], scene.faces[3 * query.face + 1], scene.faces[3 * query.face + 2]
        w = 1.0 - query.u - query.v
        normal = wp.normalize(query.u * scene.normals[a] + query.v * scene.normals[b] + w * scene.normals[c])
        uvw = query.u * scene.uvw[a] + query.v * scene.uvw[b] + w * scene.uvw[c]
        hit.distance = query.t
        hit.point = origin + query.t * direction
        hit.normal = wp.where(wp.dot(query.normal, direction) * wp.dot(query.normal, normal) > 0.0, -normal, normal)
        hit.openness = query.u * scene.openness[a] + query.v * scene.openness[b] + w * scene.openness[c]
        hit.paint = paint(scene.materials[query.face], uvw, scene.lettering)
    return hit


@wp.func
def radiance(scene: Scene, hit: Hit, direction: wp.vec3, lamp: wp.vec3):
    """Light that ``hit`` sends back along ``direction``; ``lamp`` is the sampled point of the lamp."""
    if hit.distance < 0.0:
        return wp.vec3()
    albedo = wp.vec3(hit.paint[0], hit.paint[1], hit.paint[2])
    ambient = hit.openness * wp.lerp(GROUND, SKY, 0.5 + 0.5 * hit.normal[2])
    color = wp.cw_mul(albedo, ambient)
    to_lamp = lamp - hit.point
    distance = wp.length(to_lamp)
    to_lamp = to_lamp / distance
    cosine = wp.dot(hit.normal, to_lamp)
    if cosine > 0.0:  # Warp's `and` does not skip the ray
        if not wp.mesh_query_ray_anyhit(scene.mesh, hit.point + 2.0e-3 * hit.normal, to_lamp, distance):
            incoming = LAMP_POWER * (cosine * wp.max(to_lamp[2], 0.15) / (distance * distance))
            exponent = 12.0 + 320.0 * hit.paint[3] * hit.paint[3]
            lobe = wp.pow(wp.max(wp.dot(hit.normal, wp.normalize(to_lamp - direction)), 0.0), exponent)
            shine = wp.where(hit.paint[3] > 0.0, 0.07 * (exponent + 8.0) / 8.0 * lobe, 0.0)
            color += wp.cw_mul(albedo + wp.vec3(shine, shine, shine), incoming)
    return color


@wp.func
def trace(scene: Scene, origin: wp.vec3, direction: wp.vec3, lamp: wp.vec3):
    """Light that arrives at ``origin`` from ``direction``, one mirror image included."""
    hit = intersect(scene, origin, direction)
    color = radiance(scene, hit, direction, lamp)
    if hit.paint[3] > 0.5:
        facing = wp.clamp(-wp.dot(hit.normal, direction), 0.0, 1.0)
        fresnel = 0.05 + 0.6 * wp.pow(1.0 - facing, 5.0)
        mirrored = direction + 2.0 * facing * hit.normal
        color += fresnel * radiance(scene, intersect(scene, hit.point + 2.0e-3 * hit.normal, mirrored), mirrored, lamp)
    return color


@wp.func
def develop(x: float):
    """Linear light to an sRGB value, with a soft shoulder."""
    y = x * (1.0 + x / 9.0) / (1.0 + 0.55 * x)
    y = wp.clamp(y, 0.0, 1.0)
    return wp.where(y < 0.0031308, 12.92 * y, 1.055 * wp.pow(y, 1.0 / 2.4) - 0.055)


@wp.kernel
def photograph(
    scene: Scene,
    camera: Camera,
    # out
    image_out: wp.array[wp.vec3],  # [H*W] sRGB 0..1
):
    """One pixel per thread."""
    pixel = wp.tid()
    column, row = float(pixel % camera.width), float(pixel // camera.width)
    total = wp.vec3()
    for sample in range(GRID * GRID):
        x = column + (float(sample % GRID) + 0.5) / float(GRID)
        y = row + (float(sample // GRID) + 0.5) / float(GRID)
        ray = wp.vec3((x - camera.center[0]) / camera.focal[0], (y - camera.center[1]) / camera.focal[1], 1.0)
        spot = (sample * 7 + 3) % (GRID * GRID)
        i, j = (float(spot % GRID) + 0.5) / float(GRID), (float(spot // GRID) + 0.5) / float(GRID)
        lamp = LAMP + 2.0 * LAMP_HALF * wp.vec3(i - 0.5, j - 0.5, 0.0)
        color = trace(scene, camera.position, wp.normalize(camera.world_from_camera * ray), lamp)
        total += wp.min(color, wp.vec3(4.0, 4.0, 4.0))
    total = total / float(GRID * GRID)
    image_out[pixel] = wp.vec3(develop(total[0]), develop(total[1]), develop(total[2]))


@wp.kernel
def bake_openness(
    scene: Scene,
    points: wp.array[wp.vec3],  # [V]
    # out
    openness_out: wp.array[float],  # [V]
):
    """The share of free sky above each vertex; one vertex per thread."""
    vertex = wp.tid()
    normal = scene.normals[vertex]
    side = wp.normalize(
        wp.cross(normal, wp.where(wp.abs(normal[2]) < 0.9, wp.vec3(0.0, 0.0, 1.0), wp.vec3(1.0, 0.0, 0.0)))
    )
    up = wp.cross(normal, side)
    free = wp.float32(0.0)
    for ray in range(OCCLUSION_RAYS):  # cosine-weighted sunflower
        r2 = (float(ray) + 0.5) / float(OCCLUSION_RAYS)
        angle = 2.3999632 * float(ray)
        flat = wp.sqrt(r2) * (wp.cos(angle) * side + wp.sin(angle) * up)
        start = points[vertex] + 4.0e-3 * normal
        query = wp.mesh_query_ray(scene.mesh, start, flat + wp.sqrt(1.0 - r2) * normal, OCCLUSION_REACH)
        free += wp.where(query.result, query.t / OCCLUSION_REACH, 1.0)
    openness_out[vertex] = free / float(OCCLUSION_RAYS)


@wp.kernel
def measure(
    mesh: wp.uint64,
    origins: wp.array[wp.vec3],  # [R]
    directions: wp.array[wp.vec3],  # [R] unit
    # out
    distance_out: wp.array[float],  # [R] to the first surface
):
    """One ray per thread."""
    ray = wp.tid()
    distance_out[ray] = wp.mesh_query_ray(mesh, origins[ray], directions[ray], FAR).t


class Measure:
    """Distances [R] along unit rays [R, 3] from origins [R, 3] to the first surface of a mesh, on the CPU."""

    def __init__(self, patch: Patch):
        points = wp.array(patch.points.astype(np.float32), dtype=wp.vec3, device="cpu")
        self.mesh = wp.Mesh(points, wp.array(patch.faces.ravel().astype(np.int32), dtype=int, device="cpu"))

    def __call__(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        rays = [
            wp.array(np.ascontiguousarray(x, np.float32), dtype=wp.vec3, device="cpu") for x in (origins, directions)
        ]
        distance = wp.empty(len(origins), dtype=float, device="cpu")
        wp.launch(measure, dim=distance.size, inputs=[self.mesh.id, *rays], outputs=[distance], device="cpu")
        return distance.numpy()


class Tracer:
    """The scene on the CPU, ready to be photographed."""

    def __init__(self, patch: Patch):
        vec3 = {"dtype": wp.vec3, "device": "cpu"}
        self.measure = Measure(patch)
        self.scene = scene = Scene()
        scene.mesh, scene.faces = self.measure.mesh.id, self.measure.mesh.indices
        points = self.measure.mesh.points
        scene.normals = wp.array(patch.normals.astype(np.float32), **vec3)
        scene.uvw = wp.array(patch.uvw.astype(np.float32), **vec3)
        scene.materials = wp.array(patch.materials.astype(np.int32), dtype=int, device="cpu")
        scene.lettering = wp.array(lettering(), dtype=float, device="cpu")
        scene.openness = wp.ones(len(points), dtype=float, device="cpu")
        openness = wp.empty_like(scene.openness)
        wp.launch(bake_openness, dim=len(points), inputs=[scene, points], outputs=[openness], device="cpu")
        scene.openness = openness

    def photograph(self, position, camera_from_world, focal, center, size) -> np.ndarray:
        """The view of a pinhole camera, [H, W, 3] uint8 sRGB. ``focal``, ``center``: px; ``size``: width, height."""
        camera = Camera()
        camera.position, camera.world_from_camera = wp.vec3(*position), wp.mat33(*camera_from_world.T.ravel())
        camera.focal, camera.center, camera.width = wp.vec2(*focal), wp.vec2(*center), size[0]
        image = wp.empty(size[0] * size[1], dtype=wp.vec3, device="cpu")
        wp.launch(photograph, dim=image.size, inputs=[self.scene, camera], outputs=[image], device="cpu")
        return np.rint(image.numpy().reshape(size[1], size[0], 3) * 255).astype(np.uint8)

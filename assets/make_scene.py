"""Make the embedded test scene: 50 photographs of a ray-traced still life, with their cameras and points.

    python assets/make_scene.py [--out assets/still_life] [--kind few|forward|ceiling]

The other kinds of capture are for what must not depend on one scene.
Because a ray tracer that knows nothing of Gaussians takes the pictures, cameras are exact and the truth is independent
of the code under test. The geometry is in ``scene_geometry``, the look in ``scene_textures``, the tracer in
``scene_trace``; this file places the cameras, takes the pictures and writes what COLMAP would have found, as
COLMAP's model and as transforms.json.
"""

import argparse
import json
import pathlib
import shutil

import numpy as np
import OpenImageIO as oiio
import pycolmap
from scene_geometry import CEILING, still_life
from scene_trace import Tracer

from warp_splat.formats.ply import save_points

VIEWS, TURNS = 50, 3  # a closed spiral: each eighth view lies between its neighbors
SIZE = (264, 248)  # width, height [px]; not multiples of a tile
FOCAL = (291.0, 288.0)  # fx, fy [px]
CENTER = (130.6, 125.3)  # cx, cy [px]
TARGET = (0.02, 0.06, 0.24)
POINTS = 4500
MAX_TRACK = 6  # observations kept per point, to keep the model small
NOISE = 0.0015  # standard deviation of a point, as a share of its distance
SEED = 7


def look(centers: np.ndarray, forward: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Camera centers [V, 3] and rotations camera-from-world [V, 3, 3] (x right, y down, z forward)."""
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return centers, np.stack([right, np.cross(forward, right), forward], 1)


def orbit() -> tuple[np.ndarray, np.ndarray]:
    """A closed spiral around the table."""
    t = 2 * np.pi * np.arange(VIEWS) / VIEWS
    azimuth, elevation = TURNS * t, np.radians(34 + 17 * np.cos(t + 0.4))
    distance = 3.2 + 0.45 * np.sin(7 * t)
    circle = np.stack([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], 1)
    wander = 0.06 * np.stack([np.sin(5 * t), np.cos(4 * t), np.sin(9 * t)], 1)  # the aim is not perfect
    centers = TARGET + distance[:, None] * circle
    return look(centers, TARGET + wander - centers)


def few() -> tuple[np.ndarray, np.ndarray]:
    """Twelve views of the spiral."""
    return tuple(numbers[: 4 * 12 : 4] for numbers in orbit())


def one_side() -> tuple[np.ndarray, np.ndarray]:
    """24 views from one side, all in one direction."""
    x, z = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.9, 0.9, 6), np.linspace(0.3, 1.2, 4)))
    shift = np.random.default_rng(SEED).normal(scale=0.05, size=(len(x), 2))
    centers = np.stack([x + shift[:, 0], np.full_like(x, -3.0), z + shift[:, 1]], 1)
    return look(centers, np.broadcast_to((0.0, 1.0, -0.15), centers.shape))


def circle() -> tuple[np.ndarray, np.ndarray]:
    """40 views across the table to the walls, and to a ceiling too plain for points."""
    t = 2 * np.pi * np.arange(40) / 40
    centers = np.stack([2.2 * np.cos(t), 2.2 * np.sin(t), 0.7 + 0.2 * np.sin(3 * t)], 1)
    return look(centers, np.stack([-np.cos(t), -np.sin(t), 0.45 + 0.2 * np.cos(5 * t)], 1))


KINDS = {"orbit": orbit, "few": few, "forward": one_side, "ceiling": circle}


def project(points: np.ndarray, center: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixel coordinates [N, 2] and depths [N] of world points [N, 3]."""
    x = (points - center) @ rotation.T
    return x[:, :2] / x[:, 2:] * FOCAL + CENTER, x[:, 2]


def scan(tracer: Tracer, images: list[np.ndarray], centers: np.ndarray, rotations: np.ndarray):
    """Surface points seen through random pixels: positions [N, 3], colors [N, 3], distances [N]."""
    rng = np.random.default_rng(SEED)
    view = np.arange(2 * POINTS) % len(images)  # more than needed: some will be seen too rarely
    column, row = rng.integers(SIZE[0], size=len(view)), rng.integers(SIZE[1], size=len(view))
    rays = np.stack([(column + 0.5 - CENTER[0]) / FOCAL[0], (row + 0.5 - CENTER[1]) / FOCAL[1], np.ones(len(view))], 1)
    rays = np.einsum("nji,nj->ni", rotations[view], rays / np.linalg.norm(rays, axis=1, keepdims=True))
    distance = tracer.measure(centers[view], rays)
    colors = np.stack(images)[view, row, column]
    return centers[view] + distance[:, None] * rays, colors, distance


def visibility(tracer: Tracer, points: np.ndarray, centers: np.ndarray, rotations: np.ndarray):
    """Projections [V, N, 2] and whether each view sees each point [V, N]."""
    pixels, seen = [], []
    for center, rotation in zip(centers, rotations, strict=True):
        xy, depth = project(points, center, rotation)
        reach = np.linalg.norm(points - center, axis=1)
        free = tracer.measure(np.broadcast_to(center, points.shape), (points - center) / reach[:, None]) > reach - 5e-3
        pixels.append(xy)
        seen.append(free & (depth > 0) & (xy > 1).all(1) & (xy < np.array(SIZE) - 1).all(1))
    return np.stack(pixels), np.stack(seen)


def choose_tracks(seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The first POINTS candidates with at least three views [N], and the few observations kept of each [V, N]."""
    chosen = np.flatnonzero(seen.sum(0) >= 3)[:POINTS]
    rank = np.random.default_rng(SEED + 1).random((len(seen), len(chosen)))
    rank[~seen[:, chosen]] = 2.0
    kept = np.zeros_like(rank, bool)
    np.put_along_axis(kept, np.argsort(rank, axis=0)[:MAX_TRACK], True, axis=0)
    return chosen, kept & seen[:, chosen]


def write_model(folder: pathlib.Path, names, centers, rotations, points, colors, pixels, kept):
    """Write cameras, images, points and their tracks with pycolmap, and return them."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=SIZE[0], height=SIZE[1], params=[*FOCAL, *CENTER])
    model.add_camera_with_trivial_rig(camera)
    for view, name in enumerate(names):
        image = pycolmap.Image(name=name, keypoints=pixels[view, kept[view]], camera_id=1, image_id=view + 1)
        translation = -rotations[view] @ centers[view]
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotations[view]), translation)
        model.add_image_with_trivial_frame(image, pose)
    slot = np.cumsum(kept, axis=1) - 1  # place of a point among the keypoints of a view
    for point in range(len(points)):
        track = pycolmap.Track()
        for view in np.flatnonzero(kept[:, point]):
            track.add_element(int(view) + 1, int(slot[view, point]))
        model.add_point3D(points[point], track, colors[point])
    model.update_point_3d_errors()
    model.write_binary(str(folder))
    return model


def write_transforms(folder: pathlib.Path, model: pycolmap.Reconstruction) -> None:
    """Write the model's cameras and points as nerfstudio does, for machines without pycolmap."""
    lens = dict(zip(("fl_x", "fl_y", "cx", "cy", "w", "h"), (*FOCAL, *CENTER, *SIZE), strict=True))
    frames = []
    for image in (model.image(view + 1) for view in range(len(model.images))):
        pose, rotation = np.eye(4), image.cam_from_world().rotation.matrix()
        pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ image.cam_from_world().translation
        pose[:, 1:3] *= -1  # OpenGL's y and z axes point the other way
        frames.append({"file_path": f"images/{image.name}", "transform_matrix": pose.tolist()})
    scene = {**lens, "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(scene) + "\n")

    points = [point for _, point in sorted(model.points3D.items(), key=lambda item: item[0])]
    save_points(folder / "points.ply", np.array([point.xyz for point in points]), [point.color for point in points])


def write_png(path: pathlib.Path, image: np.ndarray) -> None:
    """Write an 8 bit RGB image [H, W, 3]."""
    spec = oiio.ImageSpec(image.shape[1], image.shape[0], 3, "uint8")
    spec.attribute("png:compressionLevel", 9)
    output = oiio.ImageOutput.create(str(path))
    if not (output and output.open(str(path), spec) and output.write_image(image) and output.close()):
        raise OSError(f"cannot write {path}: {oiio.geterror()}")


def main() -> None:
    """Take the pictures and write the model."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path(__file__).parent / "still_life")
    parser.add_argument("--kind", choices=KINDS, default="orbit")
    arguments = parser.parse_args()
    out = arguments.out
    shutil.rmtree(out, ignore_errors=True)
    (out / "images").mkdir(parents=True)
    (out / "sparse" / "0").mkdir(parents=True)

    tracer = Tracer(still_life())
    centers, rotations = KINDS[arguments.kind]()
    names = [f"view_{view:03d}.png" for view in range(len(centers))]
    images = [tracer.photograph(c, r, FOCAL, CENTER, SIZE) for c, r in zip(centers, rotations, strict=True)]
    for name, image in zip(names, images, strict=True):
        write_png(out / "images" / name, image)

    points, colors, distance = scan(tracer, images, centers, rotations)
    pixels, seen = visibility(tracer, points, centers, rotations)
    seen &= points[:, 2] < CEILING - 0.01  # nothing there that a matcher would find
    chosen, kept = choose_tracks(seen)
    noise = np.random.default_rng(SEED + 2).normal(size=points.shape) * NOISE * distance[:, None]
    noisy = (points + noise)[chosen]
    model = write_model(out / "sparse" / "0", names, centers, rotations, noisy, colors[chosen], pixels[:, chosen], kept)
    write_transforms(out, model)


if __name__ == "__main__":
    main()

"""Make a capture of any length with the ray tracer of the embedded scene: photographs without cameras, for `sfm`.

    python assets/make_capture.py walk 464 --out output/walk [--size 320 240]

walk: through rooms and back, a room for every 50 photographs. loop: once around in one room. video: the walk at a third
of the pace, blurred by movement, under an exposure that swings by two stops. `positions.csv` says where each photograph
was taken.
"""

import argparse
import pathlib

import numpy as np
import warp as wp
from PIL import Image
from scene_geometry import Patch, join, place, plane
from scene_textures import Material
from scene_trace import GROUND, SKY, Camera, Scene, Tracer, develop, intersect

KINDS = ("walk", "loop", "video")
PER_ROOM = 50  # photographs
SIDE, HEIGHT, DOOR, LINTEL = 6.0, 3.0, 1.2, 2.2  # of a room and its doors [m]
FOCAL = 0.8  # of the width
LIGHT = 4.0
STOPS = 2.0  # from the darkest to the brightest exposure of a video
SHUTTER = 0.2  # of the time from one frame to the next


@wp.kernel
def expose(
    scene: Scene,
    opened: Camera,
    closed: Camera,
    light: float,
    # out
    image_out: wp.array[wp.vec3],  # [H*W] sRGB 0..1
):
    """Four rays for each pixel, while the camera goes from one pose to the other."""
    pixel = wp.tid()
    total = wp.vec3()
    for sample in range(4):
        time = (float(sample) + 0.5) / 4.0
        x = float(pixel % opened.width) + 0.25 + 0.5 * float(sample % 2)
        y = float(pixel // opened.width) + 0.25 + 0.5 * float(sample // 2)
        ray = wp.vec3((x - opened.center[0]) / opened.focal[0], (y - opened.center[1]) / opened.focal[1], 1.0)
        turned = (1.0 - time) * (opened.world_from_camera * ray) + time * (closed.world_from_camera * ray)
        hit = intersect(scene, wp.lerp(opened.position, closed.position, time), wp.normalize(turned))
        ambient = hit.openness * wp.lerp(GROUND, SKY, 0.5 + 0.5 * hit.normal[2])
        total += wp.cw_mul(wp.vec3(hit.paint[0], hit.paint[1], hit.paint[2]), ambient)
    total = total * (0.25 * light)
    image_out[pixel] = wp.vec3(develop(total[0]), develop(total[1]), develop(total[2]))


def painted(origin, across, height: float, seed: float) -> Patch:
    """An upright plane, painted as no other is."""
    size = float(np.linalg.norm(across)), height
    return plane(Material.PAINTING, origin, across, (0, 0, height), 4, size, seed=seed)


def room(number: int) -> list[Patch]:
    """A room whose doors lie on the x axis, and three chests in it."""
    half, jamb, seed = SIDE / 2, (SIDE - DOOR) / 2, 40.0 * number
    ground = {"n": 4, "scale": (SIDE, SIDE), "shift": (SIDE * number, 17.0 * number)}
    parts = [
        plane(Material.FLOOR, (0, -half, 0), (SIDE, 0, 0), (0, SIDE, 0), **ground),
        plane(Material.CEILING, (0, -half, HEIGHT), (SIDE, 0, 0), (0, SIDE, 0), **ground),
    ]
    for k, y in enumerate((-half, half)):
        parts += [painted((2 * i, y, 0), (2, 0, 0), HEIGHT, seed + 3 * k + i) for i in range(3)]
    for k, x in enumerate((0.04, SIDE - 0.04)):
        parts += [painted((x, y, 0), (0, jamb, 0), HEIGHT, seed + 6 + 2 * k + (y > 0)) for y in (-half, DOOR / 2)]
        parts.append(painted((x, -DOOR / 2, LINTEL), (0, DOOR, 0), HEIGHT - LINTEL, seed + 10 + k))
    random = np.random.default_rng(number)
    for k, (x, y) in enumerate(((1.3, -2.1), (3.0, 2.3), (4.7, -2.1))):
        sides = ((-0.4, -0.4), (0.8, 0)), ((0.4, -0.4), (0, 0.8)), ((0.4, 0.4), (-0.8, 0)), ((-0.4, 0.4), (0, -0.8))
        chest = [painted((*o, 0), (*a, 0), 0.7, seed + 16 + 5 * k + i) for i, (o, a) in enumerate(sides)]
        lid = {"n": 4, "scale": (0.8, 0.8), "seed": seed + 20 + 5 * k}
        chest.append(plane(Material.PAINTING, (-0.4, -0.4, 0.7), (0.8, 0, 0), (0, 0.8, 0), **lid))
        yaw = random.uniform(0, 90)
        parts += [place(part, (x, y, 0), yaw=yaw) for part in chest]
    return [place(part, (SIDE * number, 0, 0)) for part in parts]


def pose(kind: str, share: float, rooms: int) -> tuple[np.ndarray, np.ndarray]:
    """Center [3] and rotation camera-from-world [3, 3] (x right, y down, z forward) at ``share`` 0..1 of the way."""
    turn = 2 * np.pi * share
    if kind == "loop":
        center = np.array((3 + 1.6 * np.cos(turn), 1.6 * np.sin(turn), 1.5 + 0.1 * np.sin(3 * turn)))
        yaw, pitch = turn + 0.5 * np.sin(2 * turn), 0.1 * np.sin(5 * turn)
    else:
        back = share > 0.5
        x = SIDE * rooms * (2 * (1 - share) if back else 2 * share)
        x = np.clip(x, 0.8, SIDE * rooms - 0.8)
        wave = 2 * np.pi * x / SIDE
        center = np.array((x, 0.9 * np.sin(wave) * (-1 if back else 1), 1.5 + 0.1 * np.sin(3 * wave)))
        yaw, pitch = np.pi * back + 1.3 * np.sin(2 * wave), 0.12 * np.sin(2.7 * wave)
    forward = np.array((np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)))
    right = np.cross(forward, (0, 0, 1)) / np.cos(pitch)
    return center, np.stack([right, np.cross(forward, right), forward])


def camera(center: np.ndarray, rotation: np.ndarray, size: tuple[int, int]) -> Camera:
    """The same as the tracer takes it."""
    result = Camera()
    result.position, result.world_from_camera = wp.vec3(*center), wp.mat33(*rotation.T.ravel())
    result.focal, result.center = wp.vec2(FOCAL * size[0]), wp.vec2(size[0] / 2, size[1] / 2)
    result.width = size[0]
    return result


def make_capture(folder: pathlib.Path, kind: str, count: int, size: tuple[int, int] = (320, 240)) -> None:
    """Write ``count`` photographs to ``folder``/images, and their places to ``folder``/positions.csv."""
    rooms = 1 if kind == "loop" else max(2, round(count / PER_ROOM / (3 if kind == "video" else 1)))
    tracer = Tracer(join([part for number in range(rooms) for part in room(number)]))
    (folder / "images").mkdir(parents=True, exist_ok=True)
    lines = ["name,x,y,z"]
    for index in range(count):
        shares = np.array([0, SHUTTER if kind == "video" else 0]) / count + index / count
        poses = [camera(*pose(kind, share, rooms), size) for share in shares]
        swing = np.sin(2 * np.pi * index / 40) if kind == "video" else 0.0
        image = wp.empty(size[0] * size[1], dtype=wp.vec3, device="cpu")
        inputs = [tracer.scene, *poses, LIGHT * 2 ** (STOPS / 2 * swing)]
        wp.launch(expose, dim=image.size, inputs=inputs, outputs=[image], device="cpu")
        pixels = np.rint(image.numpy().reshape(size[1], size[0], 3) * 255).astype(np.uint8)
        Image.fromarray(pixels).save(folder / "images" / f"{index:05d}.jpg", quality=95)
        lines.append(f"{index:05d}.jpg," + ",".join(f"{x:.5f}" for x in pose(kind, shares.mean(), rooms)[0]))
    (folder / "positions.csv").write_text("\n".join(lines) + "\n")


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("count", type=int)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240))
    options = parser.parse_args()
    make_capture(options.out, options.kind, options.count, tuple(options.size))


if __name__ == "__main__":
    main()

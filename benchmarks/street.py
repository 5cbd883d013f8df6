"""A made street with known cameras: boxes with noise on them, ray traced in NumPy. For ``benchmarks/blocks.py``."""

import json
from functools import reduce
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from warp_splat.formats.ply import save_points
from warp_splat.formats.png import save_png

PHOTOS, WIDTH, HEIGHT, FOCAL = 400, 160, 120, 100.0
LENGTH, HOUSES, TALL, WIDE = 80.0, 20, 1.6, 2.5  # the street [m], houses on each side, the eye, half the way
FINE = 2  # rays of a pixel, each way
POINTS = 50  # of a photograph
TEXEL = 0.03  # m
SIDE = 512  # texels, after which noise repeats


def boxes() -> tuple[np.ndarray, np.ndarray]:
    """Corners [B, 2, 3] and colors [B, 3]: x along the street, z up. The first is the sky, seen from inside."""
    random, made = (
        np.random.default_rng(0),
        [((-60, -60, -0.1), (LENGTH + 60, 60, 50)), ((-60, -60, -0.2), (140, 60, 0))],
    )
    step = LENGTH / HOUSES
    for index in range(HOUSES):
        for side in (-1, 1):
            x, near, deep, high = index * step, WIDE + random.uniform(1, 2), random.uniform(4, 8), random.uniform(4, 9)
            gap, (low, far) = random.uniform(0, 1), sorted((side * near, side * (near + deep)))
            made.append(((x + gap, low, 0), (x + step, far, high)))
            x, y, size = x + random.uniform(0, step), side * (WIDE + 0.3), random.uniform(0.2, 0.5)
            made.append(((x - size, y - 0.3, 0), (x + size, y + 0.3, 3 * size)))
    colors = random.uniform(0.3, 0.9, (len(made), 3))
    colors[:2] = (0.5, 0.65, 0.9), (0.45, 0.43, 0.4)
    return np.array(made, float), colors


def pose(index: int) -> tuple[np.ndarray, np.ndarray]:
    """Where photograph ``index`` is taken, and its axes right, down, ahead: a walk that looks around."""
    share, turn = (index + 0.5) / PHOTOS, 2 * np.pi * (index * 0.381966 % 1)
    ahead = np.array([np.cos(turn), np.sin(turn), -0.05])
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    axes = np.stack([right, np.cross(ahead, right), ahead])
    return np.array([LENGTH * share, 1.5 * np.sin(40 * share), TALL]), axes / np.linalg.norm(
        axes, axis=1, keepdims=True
    )


def photograph(index: int, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colors [HEIGHT, WIDTH, 3] uint8, and the points [HEIGHT, WIDTH, 3] that its pixels show."""
    corners, colors = boxes()
    origin, axes = pose(index)
    y, x = (np.mgrid[: FINE * HEIGHT, : FINE * WIDTH] + 0.5) / FINE
    rays = np.stack([(x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL, np.ones_like(x)], -1).reshape(-1, 3) @ axes
    nearest, which = np.full(len(rays), np.inf), np.zeros(len(rays), int)
    slopes = 1 / rays.T
    for box, (low, high) in enumerate(corners):
        ends = [((low[k] - origin[k]) * slopes[k], (high[k] - origin[k]) * slopes[k]) for k in range(3)]
        enter = reduce(np.maximum, [np.minimum(*pair) for pair in ends])
        leave = reduce(np.minimum, [np.maximum(*pair) for pair in ends])
        distance = leave if box == 0 else enter
        met = (enter <= leave) & (distance > 0) & (distance < nearest)
        nearest[met], which[met] = distance[met], box
    points = origin + nearest[:, None] * rays
    gaps = np.abs(points[:, None] - corners[which]).min(1)  # to the two planes of each axis
    axis = gaps.argmin(1)
    across = np.take_along_axis(points, np.array([[1, 2], [0, 2], [0, 1]])[axis], 1)
    texel = (across / np.where(which == 0, 20 * TEXEL, TEXEL)[:, None]).astype(int) % SIDE
    bright = noise[which % len(noise), texel[:, 0], texel[:, 1]]
    windows = (which > 1) & (which % 2 == 0) & (axis < 2) & ((across % 2.0 - 0.6) % 2.0 < 0.9).all(1)
    light = np.where(which == 0, 1.0, np.choose(axis, (0.85, 0.6, 0.8))) * np.where(windows, 0.35, 1.0)
    seen = colors[which] * (light * (1 + np.where(which == 0, 0.1, 0.5) * bright))[:, None]
    mean = lambda values: values.reshape(HEIGHT, FINE, WIDTH, FINE, 3).mean((1, 3))  # noqa: E731
    middle = points.reshape(HEIGHT, FINE, WIDTH, FINE, 3)[:, FINE // 2, :, FINE // 2]
    return np.rint(255 * mean(seen).clip(0, 1)).astype(np.uint8), middle


def make_street(folder: Path) -> None:
    """Write it as transforms.json, unless it is there."""
    if (folder / "transforms.json").is_file():
        return
    random = np.random.default_rng(1)
    blurred = [
        gaussian_filter(random.standard_normal((4, SIDE, SIDE)), (0, sigma, sigma), mode="wrap") * sigma
        for sigma in (1.5, 4, 10, 25)
    ]
    noise = reduce(np.add, blurred)
    noise = (noise / noise.std()).clip(-2, 2) / 2
    frames, points, colors = [], [], []
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for index in range(PHOTOS):
        image, shown = photograph(index, noise)
        name, (origin, (right, down, ahead)) = f"images/{index:03d}.png", pose(index)
        save_png(folder / name, image)
        pixels = random.choice(WIDTH * HEIGHT, POINTS, replace=False)
        points.append(shown.reshape(-1, 3)[pixels])
        colors.append(image.reshape(-1, 3)[pixels])
        matrix = np.eye(4)
        matrix[:3] = np.stack([right, -down, -ahead, origin], 1)
        frames.append({"file_path": name, "transform_matrix": matrix.tolist()})
    save_points(folder / "points.ply", np.concatenate(points).astype(np.float32), np.concatenate(colors))
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    facts = {**lens, "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(facts))

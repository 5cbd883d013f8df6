"""Photographs of a corner of a room with known cameras, ray traced in numpy: what structure from motion should find."""

import numpy as np
from scene_files import write_image
from scipy.ndimage import gaussian_filter

WIDTH, HEIGHT, FOCAL = 360, 280, 330.0
WALL = 512  # texels along a wall of length 2
TARGET = np.array((0.5, 0.5, 0.5))


def walls():
    """A texture [3, WALL, WALL, 3] for each of the planes x = 0, y = 0, z = 0: noise of many scales."""
    random = np.random.default_rng(7)
    noise = sum(
        gaussian_filter(random.standard_normal((3, WALL, WALL, 3)), (0, sigma, sigma, 0), mode="wrap") * sigma
        for sigma in (1.5, 3, 6, 12)
    )
    return np.clip(0.5 + 0.25 * noise / noise.std(), 0, 1)


def center(share):
    """Where the camera stands, ``share`` in 0..1 along its way."""
    angle = np.radians(45 + 50 * (share - 0.5))
    return np.array((2.4 * np.cos(angle), 2.4 * np.sin(angle), 1.2 + 0.5 * np.sin(7 * share)))


def photo(share, textures, focal=FOCAL):
    """[HEIGHT, WIDTH, 3] uint8 from :func:`center`, looking at TARGET, the world's z up."""
    origin = center(share)
    forward = (TARGET - origin) / np.linalg.norm(TARGET - origin)
    right = np.cross(forward, (0, 0, 1)) / np.linalg.norm(np.cross(forward, (0, 0, 1)))
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(x - WIDTH / 2) / focal, (y - HEIGHT / 2) / focal, np.ones_like(x)], axis=-1)
    rays = rays @ np.stack([right, np.cross(forward, right), forward])
    distances = -origin / rays  # to the three planes; the first that is met is the nearest in front
    axis = np.where(distances > 0, distances, np.inf).argmin(axis=-1)
    points = origin + rays * np.take_along_axis(distances, axis[..., None], axis=-1)
    across = np.take_along_axis(points, np.array([[1, 2], [0, 2], [0, 1]])[axis], axis=-1)
    texel = np.floor(across * WALL / 2).astype(int) % WALL  # the texture repeats beyond the wall, far from the corner
    return np.rint(255 * textures[axis, texel[..., 0], texel[..., 1]]).astype(np.uint8)


def write_photos(folder, count):
    """``count`` photographs, and the centers [count, 3] from which they were taken, by name."""
    textures, shares = walls(), np.linspace(0, 1, count)
    for index, share in enumerate(shares):
        write_image(folder / f"photo_{index}.png", photo(share, textures))
    return {f"photo_{index}.png": center(share) for index, share in enumerate(shares)}

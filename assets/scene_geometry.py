"""The still life as triangles: a laid table in the middle of a furnished room.

Every part is a parametric patch ``(u, v) in [0, 1]^2 -> point`` sampled on a grid, so one function makes spheres,
lathed shapes, tubes and walls, together with their normals and texture coordinates. World axes: z up, table top at
z = 0. The room is ten units wide, the table 2.6.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scene_textures import Material

TAU = 2.0 * np.pi
ROOM = 5.0  # half width of the room
FLOOR = -1.1  # height of the floor
CEILING = 4.2


class Patch(NamedTuple):
    """A triangle mesh with attributes per vertex."""

    points: np.ndarray  # [V, 3]
    normals: np.ndarray  # [V, 3] unit
    uvw: np.ndarray  # [V, 3] texture coordinates
    faces: np.ndarray  # [F, 3]
    materials: np.ndarray  # [F]


def patch(material: Material, position: Callable, nu: int, nv: int, seed: float = 0.0, coords=None) -> Patch:
    """Sample ``position(u, v)`` on a grid. ``coords``: texture coordinates, (u, v, seed) by default."""
    u, v = (g.ravel() for g in np.meshgrid(np.linspace(0, 1, nu + 1), np.linspace(0, 1, nv + 1), indexing="ij"))
    step = 1e-4
    inner_u, inner_v = np.clip(u, step, 1 - step), np.clip(v, 20 * step, 1 - 20 * step)  # keeps off the poles
    along_u = position(inner_u + step, inner_v) - position(inner_u - step, inner_v)
    along_v = position(inner_u, inner_v + step) - position(inner_u, inner_v - step)
    corner = (np.arange(nu)[:, None] * (nv + 1) + np.arange(nv)).ravel()
    lower = np.stack([corner, corner + nv + 1, corner + nv + 2], 1)
    upper = np.stack([corner, corner + nv + 2, corner + 1], 1)
    faces = np.concatenate([lower, upper])
    uvw = np.stack([u, v, np.full_like(u, seed)], 1) if coords is None else coords(u, v)
    normals = _unit(np.cross(along_u, along_v))
    return Patch(position(u, v), normals, uvw, faces, np.full(len(faces), int(material)))


def place(part: Patch, offset=(0, 0, 0), yaw: float = 0.0, pitch: float = 0.0) -> Patch:
    """Turn by ``pitch`` about x, then by ``yaw`` about z [degrees], then move."""
    cy, sy, cp, sp = (
        np.cos(np.radians(yaw)),
        np.sin(np.radians(yaw)),
        np.cos(np.radians(pitch)),
        np.sin(np.radians(pitch)),
    )
    turn = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    return part._replace(points=part.points @ turn.T + np.array(offset, float), normals=part.normals @ turn.T)


def join(parts: list[Patch]) -> Patch:
    """One mesh of many."""
    starts = np.cumsum([0] + [len(p.points) for p in parts[:-1]])
    faces = [p.faces + start for p, start in zip(parts, starts, strict=True)]
    points, normals, uvw, _, materials = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Patch(points, normals, uvw, np.concatenate(faces), materials)


# shapes ----------------------------------------------------------------------------------------


def lathe(material: Material, profile, nu: int, nv: int, seed=0.0, flute=0.0, twist=0.0, coords=None) -> Patch:
    """Turn ``profile(v) -> radius, height`` about z; ``flute`` adds ten ridges that ``twist`` winds up."""

    def position(u, v):
        radius, height = profile(v)
        radius = radius * (1 + flute * np.sin(np.pi * v) * np.cos(10 * TAU * u + TAU * twist * v))
        return np.stack([radius * np.cos(TAU * u), radius * np.sin(TAU * u), height], -1)

    return patch(material, position, nu, nv, seed, coords)


def sphere(material: Material, radius: float, n: int = 32, seed: float = 0.0, coords=None) -> Patch:
    """A ball about the origin, its poles on z."""
    return lathe(
        material, lambda v: (radius * np.sin(np.pi * v), -radius * np.cos(np.pi * v)), 2 * n, n, seed, coords=coords
    )


def tube(material: Material, path, radius: float, along: int, around: int, reference=(0, 0, 1), seed=0.0) -> Patch:
    """Sweep a circle along ``path(t) -> [..., 3]``, whose tangent must nowhere be parallel to ``reference``."""

    def position(u, v):
        tangent = _unit(path(u + 1e-3) - path(u - 1e-3))
        side = _unit(np.cross(tangent, reference))
        up = np.cross(side, tangent)
        angle = TAU * v[..., None]
        return path(u) + radius * (np.cos(angle) * side + np.sin(angle) * up)

    return patch(material, position, along, around, seed)


def ring(material: Material, major: float, minor: float, height=0.0, along=64, around=10, seed=0.0) -> Patch:
    """A torus about z."""
    return tube(material, lambda t: _polar(major, TAU * t, height), minor, along, around, seed=seed)


def rod(material: Material, start, end, radius: float, around: int = 6) -> Patch:
    """A straight bar."""
    start, end = np.array(start, float), np.array(end, float)
    reference = np.eye(3)[np.argmin(np.abs(end - start))]
    return tube(material, lambda t: start + t[..., None] * (end - start), radius, 1, around, reference)


def plane(
    material: Material, origin, edge_u, edge_v, n: int = 1, scale=(1.0, 1.0), shift=(0.0, 0.0), seed=0.0
) -> Patch:
    """A parallelogram; texture coordinates run from ``shift`` to ``shift + scale``."""
    origin, edge_u, edge_v = (np.array(x, float) for x in (origin, edge_u, edge_v))

    def coords(u, v):
        return np.stack([shift[0] + scale[0] * u, shift[1] + scale[1] * v, np.full_like(u, seed)], -1)

    return patch(material, lambda u, v: origin + u[..., None] * edge_u + v[..., None] * edge_v, n, n, seed, coords)


def _unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def _polar(radius, angle, height) -> np.ndarray:
    radius, angle, height = np.broadcast_arrays(radius, angle, height)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1)


def _profile(knots: list[tuple[float, float]]):
    """A smooth (radius, height) curve through ``knots`` (Catmull-Rom)."""
    p = np.array([knots[0], *knots, knots[-1]], float)

    def curve(v):
        t = np.clip(v, 0, 1) * (len(knots) - 1)
        i = np.minimum(t.astype(int), len(knots) - 2)
        f = (t - i)[..., None]
        a, b, c, d = p[i], p[i + 1], p[i + 2], p[i + 3]
        q = b + 0.5 * f * (c - a + f * (2 * a - 5 * b + 4 * c - d + f * (3 * (b - c) + d - a)))
        return q[..., 0], q[..., 1]

    return curve


# things ----------------------------------------------------------------------------------------


def room() -> list[Patch]:
    """Floor, rug, four papered walls with pictures and a window, ceiling."""
    width, height = 2 * ROOM, CEILING - FLOOR
    floor = plane(Material.FLOOR, (-ROOM, -ROOM, FLOOR), (width, 0, 0), (0, width, 0), 64, (width, width))
    ceiling = plane(Material.CEILING, (-ROOM, ROOM, CEILING), (width, 0, 0), (0, -width, 0), 4)
    rug = lathe(
        Material.RUG,
        lambda v: (2.3 * (1 - v), np.full_like(v, FLOOR + 0.01)),
        96,
        24,
        coords=lambda u, v: _polar(2.3 * (1 - v), TAU * u, 0.0),
    )
    parts = [floor, ceiling, rug]
    for side in range(4):
        wall = [plane(Material.WALL, (-ROOM, ROOM, FLOOR), (width, 0, 0), (0, 0, height), 32, (width, height))]
        for k, frame in enumerate(((-3.6, 0.1, 2.0, 1.5), (-0.9, -0.1, 1.5, 2.0), (1.4, 0.1, 2.2, 1.6))):
            wall += picture(*frame, seed=3.0 * side + k)
        parts += [place(p, yaw=90.0 * side) for p in wall]
    return parts


def picture(x: float, z: float, w: float, h: float, seed: float) -> list[Patch]:
    """A framed painting on the wall y = ROOM."""
    y, bar = ROOM - 0.04, 0.045
    parts = [plane(Material.PAINTING, (x, y, z), (w, 0, 0), (0, 0, h), 8, (w, h), seed=seed)]
    corners = [(x, y, z), (x + w, y, z), (x + w, y, z + h), (x, y, z + h)]
    return parts + [rod(Material.FRAME, corners[i], corners[(i + 1) % 4], bar, 8) for i in range(4)]


def table() -> list[Patch]:
    """A round table on one turned leg."""
    radius = 1.3

    def disc(u, v):
        return _polar(radius * (1 - v), TAU * u, 0.0)

    top = patch(Material.TABLE, disc, 256, 96, coords=disc)
    rim = lathe(Material.LEG, _profile([(1.15, -0.1), (1.29, -0.08), (1.325, -0.04), (1.3, 0.0)]), 128, 8)
    leg = [
        (0.8, FLOOR + 0.01),
        (0.7, -1.02),
        (0.2, -0.95),
        (0.12, -0.8),
        (0.2, -0.6),
        (0.1, -0.4),
        (0.16, -0.2),
        (0.5, -0.1),
    ]
    return [top, rim, lathe(Material.LEG, _profile(leg), 48, 64)]


def vase() -> list[Patch]:
    """The glossy, twisted vase and the flowers in it."""
    knots = [
        (0.0, 0.005),
        (0.13, 0.005),
        (0.15, 0.03),
        (0.24, 0.22),
        (0.22, 0.4),
        (0.11, 0.56),
        (0.1, 0.62),
        (0.15, 0.7),
        (0.135, 0.695),
        (0.085, 0.61),
        (0.0, 0.5),
    ]
    parts = [lathe(Material.VASE, _profile(knots), 200, 120, flute=0.06, twist=3.0)]
    for k in range(7):
        angle, reach, top = 2.4 * k, 0.12 + 0.045 * k, 1.28 - 0.055 * k

        def stem(t, angle=angle, reach=reach, top=top):
            return _polar(0.04 + reach * t**2.2, angle, 0.4 + (top - 0.4) * t)

        side = (-np.sin(angle), np.cos(angle), 0)
        parts.append(tube(Material.STEM, lambda t, stem=stem: stem(np.maximum(t, 0)), 0.011, 16, 8, side))
        bloom = patch(Material.BLOOM, _bloom, 96, 24, seed=float(k))
        parts.append(place(bloom, stem(np.array(1.0)), yaw=np.degrees(angle) + 90, pitch=25 + 5 * k))
    return parts


def _bloom(u, v):
    """Eight petals about a bulging heart: a saucer, from the middle of its underside to the middle of its top."""
    reach = np.where(v < 0.3, v / 0.3, (1 - v) / 0.7)  # 0 in the middle, 1 at the rim
    petals = 1 - reach * (0.5 - 0.5 * np.abs(np.cos(4 * TAU * u)) ** 0.6)
    thickness = np.where(v < 0.3, -0.012, 0.02) * (1 - reach**2)
    return _polar(0.13 * reach * petals, TAU * u, 0.05 * reach**2 + thickness)


def cage() -> list[Patch]:
    """A dome of thin wires over a glossy ball."""
    parts = [ring(Material.WIRE, 0.29, 0.016, 0.016), sphere(Material.BALL, 0.15, 40)]
    parts[1] = place(parts[1], (0, 0, 0.15))
    for k in range(14):
        angle = TAU * k / 14

        def rib(t, angle=angle):
            return _polar(0.29 * np.cos(t * np.pi / 2), angle, 0.015 + 0.58 * np.sin(t * np.pi / 2))

        parts.append(tube(Material.WIRE, rib, 0.0075, 24, 6, (-np.sin(angle), np.cos(angle), 0)))
    for a in (0.3, 0.6, 0.9, 1.2):
        parts.append(ring(Material.WIRE, 0.29 * np.cos(a), 0.0065, 0.015 + 0.58 * np.sin(a), 48, 6))
    handle = ring(Material.WIRE, 0.05, 0.009, 0.0, 32, 8)
    return [*parts, place(handle, (0, 0, 0.65), pitch=90)]


def wheel() -> list[Patch]:
    """A spoked wheel, upright in the plane y = 0."""
    parts = [ring(Material.TYRE, 0.31, 0.022, along=96, around=12), ring(Material.WIRE, 0.286, 0.012, along=96)]
    parts.append(rod(Material.WIRE, (0, 0, -0.06), (0, 0, 0.06), 0.022, 12))
    for k in range(24):
        angle, lead = TAU * k / 24, 0.5 if k % 4 < 2 else -0.5
        hub = _polar(0.022, angle + lead * np.pi, 0.045 if k % 2 else -0.045)
        parts.append(rod(Material.WIRE, hub, _polar(0.286, angle, 0.0), 0.0055))
    return [place(p, (0, 0, 0.332), pitch=90) for p in parts]


def box() -> list[Patch]:
    """A carton with lettering on its long sides and lid, bar codes on its ends."""
    x, y, z = 0.3, 0.17, 0.34
    title, small, code = ((0.0, 0.0), (1.0, 0.5)), ((0.0, 0.5), (1.0, 0.5)), ((0.0, 2.0), (1.0, 1.0))
    faces = [
        ((-x, -y, 0), (2 * x, 0, 0), (0, 0, z), title),
        ((x, y, 0), (-2 * x, 0, 0), (0, 0, z), title),
        ((-x, -y, z), (2 * x, 0, 0), (0, 2 * y, 0), small),
        ((x, -y, 0), (0, 2 * y, 0), (0, 0, z), code),
        ((-x, y, 0), (0, -2 * y, 0), (0, 0, z), code),
    ]
    return [plane(Material.BOX, o, eu, ev, 24, scale, shift) for o, eu, ev, (shift, scale) in faces]


def globe() -> list[Patch]:
    """A globe in its meridian ring."""

    def direction(u, v):
        return _polar(np.sin(np.pi * v), TAU * u, -np.cos(np.pi * v))

    foot = [(0.0, 0.0), (0.17, 0.002), (0.17, 0.02), (0.06, 0.05), (0.04, 0.1), (0.03, 0.14)]
    ball = place(sphere(Material.GLOBE, 0.29, 48, coords=direction), (0, 0, 0.41), yaw=40, pitch=23)
    return [
        ball,
        lathe(Material.LEG, _profile(foot), 48, 32),
        place(ring(Material.WIRE, 0.315, 0.012), (0, 0, 0.41), pitch=67, yaw=40),
    ]


def knot() -> Patch:
    """A trefoil of glazed tube."""

    def path(t):
        a = TAU * t
        return np.stack([np.sin(a) + 2 * np.sin(2 * a), np.cos(a) - 2 * np.cos(2 * a), -np.sin(3 * a)], -1) * (
            0.075,
            0.075,
            0.06,
        )

    return place(tube(Material.KNOT, path, 0.05, 240, 24), (0, 0, 0.112))


def still_life() -> Patch:
    """The whole scene."""
    parts = room() + table()
    parts += [place(p, (0.0, 0.25, 0)) for p in vase()]
    parts += [place(p, (-0.62, 0.2, 0)) for p in cage()]
    parts += [place(p, (0.66, 0.2, 0)) for p in globe()]
    parts += [place(p, (0.02, -0.52, 0), yaw=-18) for p in box()]
    parts += [place(p, (0.18, 0.86, 0), yaw=-8) for p in wheel()]
    parts.append(place(ring(Material.TORUS, 0.2, 0.085, 0.085, 128, 40), (-0.66, -0.5, 0)))
    parts.append(place(knot(), (0.72, -0.55, 0), yaw=15))
    for k, (x, y) in enumerate(((-0.28, -0.12), (-0.3, -0.92), (0.4, -0.2), (-0.5, 0.78), (0.35, -0.98), (0.68, 0.72))):
        parts.append(place(sphere(Material.MARBLE, 0.06, 24, seed=float(k)), (x, y, 0.06), yaw=50 * k, pitch=40 * k))
    return join(parts)

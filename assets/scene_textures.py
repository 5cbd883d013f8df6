"""What each surface of the still life looks like: color and gloss as functions of texture coordinates.

Everything is procedural. Colors are linear RGB; patterns are made from lattice noise, stripes and a 5 x 7 pixel font.
"""

from enum import IntEnum

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})

TAU = 6.2831853
ATLAS = (64, 72)  # texels of the lettering: columns, rows (upper half: title, lower half: small print)


class Material(IntEnum):
    """What a face is made of."""

    TABLE = 0
    LEG = 1
    FLOOR = 2
    RUG = 3
    WALL = 4
    CEILING = 5
    PAINTING = 6
    FRAME = 7
    VASE = 8
    STEM = 9
    BLOOM = 10
    WIRE = 11
    BALL = 12
    TYRE = 13
    BOX = 14
    GLOBE = 15
    TORUS = 16
    KNOT = 17
    MARBLE = 18


# patterns --------------------------------------------------------------------------------------


@wp.func
def cloud(p: wp.vec3, octaves: int, seed: int):
    """Fractal noise, roughly -1..1."""
    total = wp.float32(0.0)
    weight = wp.float32(1.0)
    for octave in range(octaves):
        total += weight * wp.noise(wp.rand_init(seed + octave), p)
        p = p * 2.03
        weight = weight * 0.55
    return total


@wp.func
def fract(x: float):
    """The part after the point."""
    return x - wp.floor(x)


@wp.func
def cell(x: float, y: float, seed: int):
    """A random number 0..1 for each unit square."""
    return wp.randf(wp.rand_init(seed, int(wp.floor(x)) * 7919 + int(wp.floor(y))))


@wp.func
def band(x: float, center: float, half: float):
    """1 within ``half`` of ``center``, else 0."""
    return wp.where(wp.abs(x - center) < half, 1.0, 0.0)


@wp.func
def wood(x: float, y: float, light: wp.vec3, dark: wp.vec3, seed: int):
    """Grain along x."""
    warp = cloud(wp.vec3(0.8 * x, 4.0 * y, float(seed)), 2, seed)
    grain = 0.5 + 0.5 * wp.sin(40.0 * y + 9.0 * warp)
    fibre = 0.5 + 0.5 * cloud(wp.vec3(6.0 * x, 70.0 * y, 0.5), 2, seed + 9)
    return wp.lerp(light, dark, wp.clamp(0.6 * grain + 0.5 * fibre - 0.1, 0.0, 1.0))


@wp.func
def palette(t: float):
    """A smooth ring of saturated colors."""
    return wp.vec3(
        0.5 + 0.42 * wp.cos(TAU * t), 0.42 + 0.38 * wp.cos(TAU * (t + 0.67)), 0.42 + 0.4 * wp.cos(TAU * (t + 0.36))
    )


# surfaces --------------------------------------------------------------------------------------


@wp.func
def table_top(x: float, y: float):
    """A chequered board with an inlaid border of saw teeth."""
    maple, walnut = wp.vec3(0.62, 0.40, 0.19), wp.vec3(0.17, 0.075, 0.03)
    radius, angle = wp.sqrt(x * x + y * y), wp.atan2(y, x)
    if radius > 1.02 and radius < 1.2:
        tooth = wp.abs(2.0 * fract(angle * 36.0 / TAU) - 1.0)
        inside = wp.where(tooth > (radius - 1.04) / 0.14, 1.0, 0.0)
        return wp.lerp(walnut, maple, inside) * (0.9 + 0.2 * cloud(wp.vec3(30.0 * x, 30.0 * y, 0.0), 2, 3))
    if radius >= 1.2 or radius > 1.0:
        return wood(1.5 * angle, radius, wp.vec3(0.33, 0.15, 0.06), walnut, 5)
    a, b = x / 0.145, y / 0.145
    odd = (int(wp.floor(a)) + int(wp.floor(b))) & 1
    tone = 0.85 + 0.3 * cell(a, b, 1)
    if odd == 1:
        return tone * wood(x, y + 3.0 * cell(a, b, 2), maple, 0.6 * maple, 7)
    return tone * wood(y, x + 3.0 * cell(a, b, 2), wp.vec3(0.30, 0.13, 0.055), walnut, 8)


@wp.func
def floor_boards(x: float, y: float):
    """Planks of uneven tone."""
    row = y / 0.32
    along = x / 1.7 + 0.5 * cell(0.0, row, 4) + 0.37 * wp.floor(row)
    tone = 0.6 + 0.5 * cell(along, row, 6)
    gap = wp.max(band(fract(row), 0.0, 0.03), band(fract(along), 0.0, 0.006))
    board = tone * wood(
        0.6 * x, 0.7 * y + 5.0 * cell(along, row, 11), wp.vec3(0.40, 0.24, 0.12), wp.vec3(0.22, 0.12, 0.06), 12
    )
    return wp.lerp(board, wp.vec3(0.04, 0.025, 0.015), gap)


@wp.func
def rug(x: float, y: float):
    """Wavy rings and dots."""
    radius, angle = wp.sqrt(x * x + y * y), wp.atan2(y, x)
    wave = radius + 0.05 * wp.sin(18.0 * angle)
    ground = wp.lerp(wp.vec3(0.30, 0.085, 0.045), wp.vec3(0.045, 0.12, 0.13), band(fract(wave * 1.7), 0.5, 0.22))
    dots = band(fract(angle * 54.0 / TAU), 0.5, 0.22) * band(fract(radius * 5.1), 0.5, 0.2)
    color = wp.lerp(ground, wp.vec3(0.72, 0.58, 0.34), wp.max(dots, band(fract(wave * 1.7), 0.25, 0.045)))
    return color * (0.9 + 0.25 * cloud(wp.vec3(25.0 * x, 25.0 * y, 1.0), 2, 14))


@wp.func
def wall(x: float, z: float):
    """Panelling below, a rail, paper with stripes and sprigs above."""
    if z < 0.85:
        panel = fract(x / 0.9)
        groove = wp.max(band(panel, 0.5, 0.46) * band(z, 0.47, 0.3), 0.0) - band(panel, 0.5, 0.43) * band(z, 0.47, 0.26)
        paint = wp.lerp(wp.vec3(0.42, 0.44, 0.38), wp.vec3(0.16, 0.17, 0.14), groove)
        return wp.where(z < 0.12, wp.vec3(0.2, 0.11, 0.06), paint)
    if z < 0.95:
        return wp.vec3(0.24, 0.13, 0.07)
    paper = wp.lerp(wp.vec3(0.50, 0.55, 0.42), wp.vec3(0.38, 0.46, 0.38), band(fract(x / 0.5), 0.25, 0.25))
    shift = 0.25 * float(int(wp.floor(x / 0.25)) & 1)
    a, b = (fract(x / 0.25) - 0.5) * 0.25, (fract((z + shift) / 0.5) - 0.5) * 0.5
    r, phi = wp.sqrt(a * a + b * b), wp.atan2(b, a)
    sprig = wp.where(r < 0.05 + 0.035 * wp.cos(5.0 * phi + 1.57), 1.0, 0.0)
    paper = wp.lerp(paper, wp.vec3(0.62, 0.33, 0.24), 0.75 * sprig)
    return paper * (1.0 + 0.12 * cloud(wp.vec3(0.9 * x, 0.9 * z, 2.0), 3, 16))


@wp.func
def painting(x: float, y: float, seed: float):
    """A hilly landscape under a cloudy sky, different for each seed."""
    tint = fract(0.618 * seed)
    sky = wp.lerp(
        wp.vec3(0.80, 0.60, 0.36),
        wp.lerp(wp.vec3(0.06, 0.28, 0.62), wp.vec3(0.45, 0.16, 0.14), tint),
        wp.clamp(0.6 * y, 0.0, 1.0),
    )
    puff = cloud(wp.vec3(2.2 * x, 4.0 * y, seed), 4, 20)
    color = wp.lerp(sky, wp.vec3(0.9, 0.87, 0.8), wp.clamp(2.0 * puff, 0.0, 1.0))
    for ridge in range(4):
        height = 1.05 - 0.25 * float(ridge) + 0.3 * cloud(wp.vec3(1.6 * x, seed + 3.0 * float(ridge), 0.0), 4, 24)
        if y < height:
            near = float(ridge) / 3.0
            hill = wp.lerp(
                wp.vec3(0.18, 0.30, 0.48), wp.lerp(wp.vec3(0.10, 0.26, 0.03), wp.vec3(0.55, 0.24, 0.03), tint), near
            )
            color = hill * (1.0 + 0.5 * cloud(wp.vec3(9.0 * x, 12.0 * y, seed), 3, 30))
    return 0.85 * color


@wp.func
def globe(d: wp.vec3):
    """Seas, land and ice under a graticule, for a unit direction."""
    height = cloud(1.9 * d + wp.vec3(3.1, 0.0, 0.4), 5, 40)
    latitude, longitude = wp.asin(wp.clamp(d[2], -1.0, 1.0)), wp.atan2(d[1], d[0])
    color = wp.lerp(wp.vec3(0.03, 0.16, 0.36), wp.vec3(0.10, 0.38, 0.50), wp.clamp(1.0 + 2.5 * height, 0.0, 1.0))
    if height > 0.05:
        color = wp.lerp(wp.vec3(0.14, 0.33, 0.09), wp.vec3(0.55, 0.40, 0.18), wp.clamp(3.0 * (height - 0.1), 0.0, 1.0))
        color = color * (1.0 + 0.4 * cloud(14.0 * d, 2, 45))
    if wp.abs(latitude) > 1.15 + 0.25 * height:
        color = wp.vec3(0.62, 0.66, 0.70)
    line = wp.max(
        band(fract(latitude * 12.0 / 3.1415927), 0.5, 0.035),
        band(fract(longitude * 12.0 / TAU), 0.5, 0.02 / wp.max(0.2, wp.cos(latitude))),
    )
    return wp.lerp(color, wp.vec3(0.72, 0.62, 0.38), 0.8 * line)


@wp.func
def glaze(u: float, v: float):
    """The vase: deep blue, with gilded bands and a row of rosettes."""
    color = wp.lerp(
        wp.vec3(0.015, 0.05, 0.22),
        wp.vec3(0.03, 0.20, 0.36),
        wp.clamp(0.5 + cloud(wp.vec3(9.0 * u, 7.0 * v, 0.0), 3, 50), 0.0, 1.0),
    )
    a, b = fract(16.0 * u) - 0.5, (v - 0.34) * 22.0
    r, phi = wp.sqrt(a * a + b * b), wp.atan2(b, a)
    if r < 0.30 + 0.12 * wp.cos(6.0 * phi):
        color = wp.where(r < 0.12, wp.vec3(0.60, 0.10, 0.05), wp.vec3(0.80, 0.76, 0.66))
    gilt = band(v, 0.275, 0.008) + band(v, 0.405, 0.008) + band(v, 0.535, 0.007) + band(v, 0.68, 0.012)
    return wp.lerp(color, wp.vec3(0.72, 0.47, 0.13), wp.min(gilt, 1.0))


@wp.func
def carton(u: float, v: float, lettering: wp.array2d[float]):
    """Texture row 0 of ``lettering`` is the top of the print; ``v >= 2`` selects the bar code."""
    paper = wp.vec3(0.72, 0.62, 0.44) * (1.0 + 0.12 * cloud(wp.vec3(30.0 * u, 30.0 * v, 0.0), 2, 60))
    if v >= 2.0:
        bar = wp.where(cell(u * 34.0, 0.0, 61) > 0.5, 1.0, 0.0) * band(u, 0.5, 0.36) * band(v, 2.55, 0.22)
        return wp.lerp(paper, wp.vec3(0.02, 0.02, 0.025), bar)
    lid = wp.where(v >= 0.5, 1.0, 0.0)
    ground = wp.lerp(wp.vec3(0.62, 0.09, 0.05), paper, lid)
    ink = wp.lerp(wp.vec3(0.85, 0.80, 0.66), wp.vec3(0.03, 0.05, 0.16), lid)
    rows, cols = lettering.shape[0], lettering.shape[1]
    row = int((0.5 * (1.0 + lid) - (v - 0.5 * lid)) * float(rows))
    col = int(u * float(cols))
    return wp.lerp(ground, ink, lettering[wp.clamp(row, 0, rows - 1), wp.clamp(col, 0, cols - 1)])


@wp.func
def bloom(u: float, v: float, seed: float):
    """Veined petals, a spiral of seeds in the middle."""
    if v > 0.76:
        return wp.lerp(wp.vec3(0.75, 0.50, 0.06), wp.vec3(0.28, 0.12, 0.03), band(fract(u * 16.0 + 9.0 * v), 0.5, 0.25))
    hue = wp.where(
        int(seed) % 3 == 0,
        wp.vec3(0.85, 0.80, 0.74),
        wp.where(int(seed) % 3 == 1, wp.vec3(0.80, 0.20, 0.30), wp.vec3(0.85, 0.48, 0.08)),
    )
    vein = 0.75 + 0.25 * wp.abs(wp.cos(4.0 * TAU * u))
    return hue * vein * (0.7 + 0.4 * v)


@wp.func
def ornament(material: int, u: float, v: float, seed: float):
    """The small things: (r, g, b, gloss)."""
    if material == int(Material.BLOOM):
        c = bloom(u, v, seed)
        return wp.vec4(c[0], c[1], c[2], 0.0)
    if material == int(Material.TORUS):  # candy stripes
        stripe = fract(10.0 * u + v) * 4.0
        c = wp.where(
            stripe < 1.5,
            wp.vec3(0.80, 0.76, 0.66),
            wp.where(stripe < 2.5, wp.vec3(0.70, 0.10, 0.08), wp.vec3(0.05, 0.30, 0.33)),
        )
        c = wp.lerp(c, wp.vec3(0.05, 0.04, 0.04), band(fract(stripe), 0.5, 0.07))
        return wp.vec4(c[0], c[1], c[2], 0.3)
    if material == int(Material.KNOT):
        c = wp.lerp(wp.vec3(0.02, 0.30, 0.16), wp.vec3(0.80, 0.72, 0.30), band(fract(48.0 * u), 0.5, 0.1))
        return wp.vec4(c[0], c[1], c[2], 0.8)
    if material == int(Material.MARBLE):
        swirl = cloud(wp.vec3(3.0 * v, wp.sin(TAU * u), wp.cos(TAU * u)) + wp.vec3(seed, 0.0, 0.0), 3, 80)
        c = wp.lerp(palette(0.17 * seed), wp.vec3(0.8, 0.78, 0.72), band(fract(2.0 * swirl), 0.5, 0.16))
        return wp.vec4(c[0], c[1], c[2], 0.9)
    if material == int(Material.STEM):
        return wp.vec4(0.10, 0.24, 0.05, 0.1)
    if material == int(Material.TYRE):
        tread = band(fract(60.0 * u + wp.abs(3.0 * v - 1.5)), 0.5, 0.2)
        return wp.vec4(0.03 + 0.05 * tread, 0.03 + 0.05 * tread, 0.035 + 0.05 * tread, 0.0)
    if material == int(Material.WIRE):
        return wp.vec4(0.55, 0.42, 0.22, 0.4)
    return wp.vec4(0.75, 0.33, 0.08, 1.0)  # Material.BALL


@wp.func
def paint(material: int, p: wp.vec3, lettering: wp.array2d[float]):
    """Color and gloss (0..1; above 0.5 the surface also mirrors the room) at texture coordinates ``p``."""
    c = wp.vec3(0.62, 0.60, 0.55)
    gloss = 0.0
    if material == int(Material.TABLE):
        c = table_top(p[0], p[1])
        gloss = 0.25
    elif material == int(Material.LEG):
        c = wood(6.0 * p[1], 3.0 * p[0], wp.vec3(0.30, 0.14, 0.06), wp.vec3(0.13, 0.055, 0.025), 70)
        gloss = 0.3
    elif material == int(Material.FLOOR):
        c = floor_boards(p[0], p[1])
    elif material == int(Material.RUG):
        c = rug(p[0], p[1])
    elif material == int(Material.WALL):
        c = wall(p[0], p[1])
    elif material == int(Material.PAINTING):
        c = painting(p[0], p[1], p[2])
    elif material == int(Material.FRAME):
        c = wp.vec3(0.50, 0.33, 0.11)
        gloss = 0.2
    elif material == int(Material.VASE):
        c = glaze(p[0], p[1])
        gloss = 0.9
    elif material == int(Material.BOX):
        c = carton(p[0], p[1], lettering)
    elif material == int(Material.GLOBE):
        c = globe(p)
        gloss = 0.35
    elif material != int(Material.CEILING):
        return ornament(material, p[0], p[1], p[2])
    return wp.vec4(c[0], c[1], c[2], gloss)


# lettering -------------------------------------------------------------------------------------

FONT = {  # rows of five pixels, top to bottom
    "A": "0E 11 11 1F 11 11 11",
    "C": "0E 11 10 10 10 11 0E",
    "D": "1E 11 11 11 11 11 1E",
    "E": "1F 10 10 1E 10 10 1F",
    "F": "1F 10 10 1E 10 10 10",
    "G": "0E 11 10 17 11 11 0F",
    "I": "0E 04 04 04 04 04 0E",
    "L": "10 10 10 10 10 10 1F",
    "N": "11 19 19 15 13 13 11",
    "P": "1E 11 11 1E 10 10 10",
    "R": "1E 11 11 1E 14 12 11",
    "S": "0F 10 10 0E 01 01 1E",
    "T": "1F 04 04 04 04 04 04",
    "U": "11 11 11 11 11 11 0E",
    "W": "11 11 11 15 15 15 0A",
    "Y": "11 11 0A 04 04 04 04",
}


def lettering() -> np.ndarray:
    """The print of the carton, [rows, columns] 0 or 1: a large title above three small lines."""
    columns, rows = ATLAS
    texels = np.zeros((rows, columns), np.float32)

    def write(text: str, top: int, size: int):
        left = (columns - size * (6 * len(text) - 1)) // 2
        for k, letter in enumerate(text):
            glyph = [
                [int(row, 16) >> (4 - bit) & 1 for bit in range(5)] for row in FONT.get(letter, "0 0 0 0 0 0 0").split()
            ]
            x = left + 6 * size * k
            texels[top : top + 7 * size, x : x + 5 * size] = np.kron(glyph, np.ones((size, size)))

    write("WARP", 2, 2)
    write("SPLAT", 19, 2)
    for line, text in enumerate(("STILL LIFE", "RAY TRACED", "GAUSSIANS")):
        write(text, 39 + 11 * line, 1)
    texels[[0, 34, 36, 70], 1:-1] = 1.0  # rules
    return texels

"""What travels between the stages, as kernels read and write it: the arrays of one thing are one parameter."""

import warp as wp

from warp_splat.kernels.splat import Splat2D

mat53 = wp.types.matrix(shape=(5, 3), dtype=float)
mat73 = wp.types.matrix(shape=(7, 3), dtype=float)


@wp.struct
class HarmonicsView:
    """Coefficients of spherical harmonics, or their gradients; an array is empty where there is no such degree."""

    dc: wp.array[wp.vec3]  # [N]
    degree1: wp.array[wp.mat33]  # [N]
    degree2: wp.array[mat53]  # [N]
    degree3: wp.array[mat73]  # [N]


@wp.struct
class Splats2DView:
    """Gaussians projected."""

    means2d: wp.array[wp.vec2]  # [N] px
    conics: wp.array[wp.vec3]  # [N] 1/px^2, (xx, xy, yy)
    opacities: wp.array[float]  # [N]
    colors: wp.array[wp.vec3]  # [N]
    depths: wp.array[float]  # [N]
    extents: wp.array[wp.vec2]  # [N] px, half sides of the box where alpha >= alpha_min
    radii: wp.array[int]  # [N] px


@wp.struct
class BinsView:
    """Tile lists; several pictures of one size stand below each other."""

    tiles_x: int
    tiles: int  # of a picture
    height: int  # px of a picture
    ranges: wp.array[wp.vec2i]  # [T] first and last instance of a tile
    instances: wp.array[int]  # [M] splats, by tile, front to back
    splats: wp.array[Splat2D]  # [V]
    blocks: wp.array[int]  # [M] blocks of its tile in which an instance is blended, a bit each: see `walk` of the CPU


@wp.struct
class PixelsView:
    """An image, or the upstream gradient of one."""

    image: wp.array3d[float]  # [H, W, 3]
    alpha: wp.array2d[float]  # [H, W]
    depth: wp.array2d[float]  # [H, W] sum of w z; [0, 0] if not asked for

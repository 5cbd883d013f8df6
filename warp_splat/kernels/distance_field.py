"""Depth maps that agree, and their truncated signed distance (Curless and Levoy 1996)."""

import warp as wp

from warp_splat.kernels.compiler import FORWARD_ONLY


@wp.func
def depth_at(lens: wp.vec4, p: wp.vec3, depths: wp.array2d[float]):
    """Of a map [H, W], where it shows a point of its camera, with the pixel; 0 outside of it."""
    x, y = int(-1), int(-1)
    if p[2] > 0.0:
        x = int(wp.floor(wp.clamp(lens[0] * p[0] / p[2] + lens[2], -1.0, float(depths.shape[1]))))
        y = int(wp.floor(wp.clamp(lens[1] * p[1] / p[2] + lens[3], -1.0, float(depths.shape[0]))))
    if x < 0 or y < 0 or x >= depths.shape[1] or y >= depths.shape[0]:
        return 0.0, 0, 0
    return depths[y, x], x, y


@wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
def agree(
    first: int,  # pixel of this slice
    tolerance: float,  # share of the depth
    rotation: wp.mat33,  # camera to the other one
    translation: wp.vec3,
    lens: wp.vec4,  # fx, fy, cx, cy [px]
    other_lens: wp.vec4,
    depths: wp.array2d[float],  # [H, W] world units; 0: none
    others: wp.array2d[float],  # [H2, W2] of the other one
    # out
    agreeing_out: wp.array[int],  # [H * W] one more where both see the same place
):
    i = first + wp.tid()
    x, y = i % depths.shape[1], i // depths.shape[1]
    depth = depths[y, x]
    if depth > 0.0:
        along = wp.vec3((float(x) + 0.5 - lens[2]) / lens[0], (float(y) + 0.5 - lens[3]) / lens[1], 1.0)
        p = rotation * (depth * along) + translation
        found, _x, _y = depth_at(other_lens, p, others)
        if wp.abs(found - p[2]) < tolerance * p[2]:
            agreeing_out[i] = agreeing_out[i] + 1


@wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
def fuse(
    first: int,  # voxel of this slice
    voxel: float,  # edge [world units]
    truncation: float,  # [world units]
    rotation: wp.mat33,  # world to camera
    translation: wp.vec3,
    lens: wp.vec4,  # fx, fy, cx, cy [px]
    voxels: wp.array[wp.vec3i],  # [V] places on the grid
    depths: wp.array2d[float],  # [H, W] world units; 0: none
    image: wp.array2d[wp.vec3],  # [H, W]
    # out
    distances_out: wp.array[wp.vec2],  # [V] sum of distances over the truncation, in front positive; how many
    colors_out: wp.array[wp.vec4],  # [V] sum of the colors of those at most a truncation away; how many
):
    i = first + wp.tid()
    place = voxels[i]
    p = rotation * (voxel * wp.vec3(float(place[0]), float(place[1]), float(place[2]))) + translation
    depth, x, y = depth_at(lens, p, depths)
    distance = depth - p[2]
    if depth > 0.0 and distance > -truncation:
        distances_out[i] = distances_out[i] + wp.vec2(wp.min(distance / truncation, 1.0), 1.0)
        if distance < truncation:
            color = image[y, x]
            colors_out[i] = colors_out[i] + wp.vec4(color[0], color[1], color[2], 1.0)

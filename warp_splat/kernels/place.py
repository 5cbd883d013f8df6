"""Gaussians of a simulation's shapes in front of a camera, and their picture among meshes. Warp differentiates both.

Gaussians are put into the camera's frame, so that nothing of the camera but its lens is left for the renderer. Colors
are found in the shape's own frame, from where the camera stands in it: harmonics need not turn with the body.
"""

import warp as wp

from warp_splat.kernels.compiler import once
from warp_splat.kernels.harmonics import C0, make_harmonics

NOTHING = wp.constant(wp.uint32(0xFFFFFFFF))  # as Newton's index of no shape


@wp.struct
class ShapeView:
    """The Gaussians of a shape, in its frame."""

    means: wp.array[wp.vec3]  # [N]
    quats: wp.array[wp.quat]  # [N]
    sh: wp.array2d[wp.vec3]  # [N, K]


@once
def make_place(coefficients: int) -> wp.Kernel:
    """The Gaussians of shapes that are alike, as cameras see them; each with its color, as a harmonic of degree 0."""
    evaluate = make_harmonics(1).evaluate

    @wp.kernel(module="unique", enable_backward=True)
    def place(
        first: int,
        places: wp.array[wp.vec4i],  # [P] view, body or -1, shape, and where its Gaussians begin
        splats: ShapeView,
        shape_transform: wp.array[wp.transform],  # [S]
        body_q: wp.array[wp.transform],  # [B]
        camera_transforms: wp.array[wp.transform],  # [V]
        # out
        means_out: wp.array[wp.vec3],  # [all]
        quats_out: wp.array[wp.quat],  # [all]
        sh_out: wp.array2d[wp.vec3],  # [all, 1]
    ):
        i = (first + wp.tid()) % splats.means.shape[0]
        where = places[(first + wp.tid()) // splats.means.shape[0]]
        world = shape_transform[where[2]]
        if where[1] >= 0:
            world = wp.transform_multiply(body_q[where[1]], shape_transform[where[2]])
        # Newton's cameras look along -z, with y up; ours along z, with y down
        seen = wp.transform_multiply(wp.transform_inverse(camera_transforms[where[0]]), world)
        turned = wp.transform_multiply(wp.transform(wp.vec3(), wp.quat(1.0, 0.0, 0.0, 0.0)), seen)
        mean = splats.means[i]
        offset = mean - wp.transform_get_translation(wp.transform_inverse(seen))
        color = C0 * splats.sh[i, 0]
        if wp.static(coefficients > 1):
            basis = evaluate(offset[0], offset[1], offset[2])
            for k in range(wp.static(coefficients - 1)):
                color += basis[k, 0] * splats.sh[i, k + 1]
        means_out[where[3] + i] = wp.transform_point(turned, mean)
        quats_out[where[3] + i] = wp.transform_get_rotation(turned) * splats.quats[i]
        sh_out[where[3] + i, 0] = color / C0

    return place


@wp.func
def pixel_at(index: int, height: int, width: int):
    """View, line and column."""
    return index // (height * width), index // width % height, index % width


@wp.func
def channel_of(color: wp.uint32, channel: int):
    return float((color >> wp.uint32(8 * channel)) & wp.uint32(255)) / 255.0


@wp.func
def byte_of(value: float, channel: int):
    return wp.uint32(wp.clamp(value, 0.0, 1.0) * 255.0 + 0.5) << wp.uint32(8 * channel)


@wp.kernel(enable_backward=True)
def put_among_meshes(
    first: int,
    image: wp.array3d[wp.vec3],  # [V, H, W] of the Gaussians in front of the meshes, on black
    alpha: wp.array3d[float],  # [V, H, W]
    depth: wp.array3d[float],  # [V, H, W]
    background: wp.vec3,
    mesh_color: wp.array3d[wp.uint32],  # [V, H, W] of the meshes, packed; empty without any, as what follows
    mesh_depth: wp.array3d[float],  # [V, H, W] not positive where there is none
    # out
    rgb_out: wp.array3d[wp.vec3],  # [V, H, W] as is packed below; or empty, as what follows
    color_out: wp.array3d[wp.uint32],  # [V, H, W]
    depth_out: wp.array3d[float],  # [V, H, W]
):
    v, y, x = pixel_at(first + wp.tid(), alpha.shape[1], alpha.shape[2])
    through = 1.0 - alpha[v, y, x]
    behind = background
    far = float(0.0)
    if mesh_depth.shape[0] > 0:
        if mesh_depth[v, y, x] > 0.0:
            far = mesh_depth[v, y, x]
            if mesh_color.shape[0] > 0:
                packed = mesh_color[v, y, x]
                behind = wp.vec3(channel_of(packed, 0), channel_of(packed, 1), channel_of(packed, 2))
    rgb = image[v, y, x] + through * behind
    if rgb_out.shape[0] > 0:
        rgb_out[v, y, x] = rgb
    if color_out.shape[0] > 0:
        alike = byte_of(rgb[0], 0) | byte_of(rgb[1], 1) | byte_of(rgb[2], 2)
        color_out[v, y, x] = alike | byte_of(1.0, 3)
    if depth_out.shape[0] > 0:
        among = alpha[v, y, x] * depth[v, y, x] + through * far
        depth_out[v, y, x] = wp.where(far > 0.0, among, depth[v, y, x])


@wp.kernel
def name_shapes(
    first: int,
    strongest: wp.array4d[wp.int64],  # [V, H, W, 1]
    weights: wp.array4d[float],  # [V, H, W, 1]
    alpha: wp.array3d[float],  # [V, H, W]
    owners: wp.array2d[wp.uint32],  # [V, most] shape of each Gaussian
    mesh_depth: wp.array3d[float],  # [V, H, W] or empty
    mesh_index: wp.array3d[wp.uint32],  # [V, H, W] or empty
    # out
    index_out: wp.array3d[wp.uint32],  # [V, H, W] shape of the strongest Gaussian, or mesh
):
    v, y, x = pixel_at(first + wp.tid(), alpha.shape[1], alpha.shape[2])
    index = NOTHING
    share = float(0.0)
    if mesh_index.shape[0] > 0:
        if mesh_depth[v, y, x] > 0.0:
            index = mesh_index[v, y, x]
            share = 1.0 - alpha[v, y, x]
    if weights[v, y, x, 0] > 0.0 and alpha[v, y, x] > share:
        index = owners[v, int(strongest[v, y, x, 0])]
    index_out[v, y, x] = index

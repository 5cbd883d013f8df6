"""The color of a Gaussian from where the camera stands: spherical harmonics (Kerbl et al. 2023), and its adjoint.

The color is linear in the coefficients. So their gradient, a product of two vectors, is written down, and stored
instead of added. Warp differentiates how the functions depend on the direction.

On a CPU, a kernel evaluates the functions for sixteen Gaussians at once, then goes through their coefficients in turn.
Tried:

- 3.7 instead of 2.8 ms, adjoint 7.4 instead of 5.6: one Gaussian at a time (193,000 of degree 3, one thread)
- 2.3 x the adjoint, 16.5 instead of 7.0 ms: all of it by Warp (137,000 of degree 3, one at a time, equal to 1e-7)
- 1.2 x the adjoint: no functions for groups of which none is drawn, or of degree 0; what may be absent stays in memory
"""

import warp as wp

from warp_splat.kernels.compiler import FORWARD_ONLY, once
from warp_splat.kernels.harmonics import C0, make_harmonics
from warp_splat.kernels.project.camera_view import CameraView
from warp_splat.kernels.project.shared import INVALID
from warp_splat.kernels.simd import TYPES, pick
from warp_splat.kernels.structs import HarmonicsView, Splats2DView, mat53, mat73

OPTIONS = {**FORWARD_ONLY, "max_unroll": 15}  # unrolls all loops but those over lanes


@once
def make_offsets(lanes: int) -> wp.Function:
    """From the camera to ``lanes`` Gaussians; beyond the last one, that one's."""
    number = TYPES[lanes].number

    @wp.func
    def offsets(camera: CameraView, means: wp.array[wp.vec3], first: int):
        if wp.static(lanes == 1):
            offset = (means[first] - camera.center) - camera.center_low
            return offset[0], offset[1], offset[2]
        else:
            x = number()
            y = number()
            z = number()
            for lane in range(lanes):
                mean = means[wp.min(first + lane, means.shape[0] - 1)]
                x[lane] = (mean[0] - camera.center[0]) - camera.center_low[0]
                y[lane] = (mean[1] - camera.center[1]) - camera.center_low[1]
                z[lane] = (mean[2] - camera.center[2]) - camera.center_low[2]
            return x, y, z

    return offsets


@once
def make_shade(lanes: int) -> wp.Kernel:
    """The colors of ``lanes`` Gaussians at once."""
    evaluate = make_harmonics(lanes).evaluate
    offsets = make_offsets(lanes)

    @wp.kernel(module="unique", module_options=dict(OPTIONS))
    def shade(
        first: int,  # group of Gaussians of this slice
        camera: CameraView,
        means: wp.array[wp.vec3],  # [N] world
        sh: HarmonicsView,
        # out
        splats_out: Splats2DView,  # of `project`: colors where radii tell of one; cleared where a color is not finite
    ):
        group = (first + wp.tid()) * lanes
        x, y, z = offsets(camera, means, group)
        functions = evaluate(x, y, z)
        for lane in range(lanes):
            i = group + lane
            if i < splats_out.radii.shape[0]:
                if splats_out.radii[i] > 0:
                    color = C0 * sh.dc[i] + wp.vec3(0.5)
                    if camera.sh_degree > 0:  # inactive degrees are not even read
                        for k in range(3):
                            color += functions[k, lane] * sh.degree1[i][k]
                    if camera.sh_degree > 1:
                        for k in range(5):
                            color += functions[3 + k, lane] * sh.degree2[i][k]
                    if camera.sh_degree > 2:
                        for k in range(7):
                            color += functions[8 + k, lane] * sh.degree3[i][k]
                    if wp.dot(color, wp.vec3(0.0)) == 0.0:
                        splats_out.colors[i] = wp.max(color, wp.vec3(0.0))
                    else:
                        splats_out.means2d[i] = wp.vec2(0.0)
                        splats_out.conics[i] = wp.vec3(0.0)
                        splats_out.opacities[i] = 0.0
                        splats_out.depths[i] = 0.0
                        splats_out.extents[i] = wp.vec2(0.0)
                        splats_out.radii[i] = INVALID

    return shade


@once
def make_adj_shade(lanes: int) -> wp.Kernel:
    """The adjoint of :func:`make_shade`'s kernel."""
    table, evaluate, _, weigh = make_harmonics(lanes)
    number = TYPES[lanes].number
    offsets = make_offsets(lanes)

    @wp.kernel(module="unique", module_options=dict(OPTIONS))
    def adj_shade(
        first: int,  # group of Gaussians of this slice
        camera: CameraView,
        means: wp.array[wp.vec3],  # [N]
        sh: HarmonicsView,
        radii: wp.array[int],  # [N]
        colors: wp.array[wp.vec3],  # [N]
        adj_colors: wp.array[wp.vec3],  # [N]
        # out: gradients, zero where culled and of inactive degrees
        means_out: wp.array[wp.vec3],  # [N]
        sh_out: HarmonicsView,
    ):
        group = (first + wp.tid()) * lanes
        x, y, z = offsets(camera, means, group)
        functions = evaluate(x, y, z)
        weights = table()
        drawn = number(0.0)
        for lane in range(lanes):
            i = group + lane
            if i < radii.shape[0]:
                adj = wp.vec3(0.0)
                adj1 = wp.mat33()
                adj2 = mat53()
                adj3 = mat73()
                if radii[i] > 0:
                    if wp.static(lanes == 1):
                        drawn = 1.0
                    else:
                        drawn[lane] = 1.0
                    for channel in range(3):
                        if colors[i][channel] > 0.0:  # not cut to 0
                            adj[channel] = adj_colors[i][channel]
                    if camera.sh_degree > 0:
                        for k in range(3):
                            weights[k, lane] = wp.dot(sh.degree1[i][k], adj)
                            adj1[k] = functions[k, lane] * adj
                    if camera.sh_degree > 1:
                        for k in range(5):
                            weights[3 + k, lane] = wp.dot(sh.degree2[i][k], adj)
                            adj2[k] = functions[3 + k, lane] * adj
                    if camera.sh_degree > 2:
                        for k in range(7):
                            weights[8 + k, lane] = wp.dot(sh.degree3[i][k], adj)
                            adj3[k] = functions[8 + k, lane] * adj
                sh_out.dc[i] = C0 * adj
                if wp.static(lanes > 1):  # else it is `make_adj_rest`'s
                    if sh_out.degree1.shape[0] > 0:
                        sh_out.degree1[i] = adj1
                    if sh_out.degree2.shape[0] > 0:
                        sh_out.degree2[i] = adj2
                    if sh_out.degree3.shape[0] > 0:
                        sh_out.degree3[i] = adj3
        # the weights of those not drawn are zero, and zero times what is not finite is not
        one = number(1.0)
        x = pick(drawn, x, one)
        y = pick(drawn, y, one)
        z = pick(drawn, z, one)
        adj_x, adj_y, adj_z, _weights = wp.grad(weigh)(x, y, z, weights)
        for lane in range(lanes):
            i = group + lane
            if i < radii.shape[0]:
                if wp.static(lanes == 1):
                    means_out[i] = wp.vec3(adj_x, adj_y, adj_z)
                else:
                    means_out[i] = wp.vec3(adj_x[lane], adj_y[lane], adj_z[lane])

    return adj_shade


@once
def make_adj_rest() -> wp.Kernel:
    """Of a GPU, the gradients of all coefficients but the first, which threads then store side by side."""
    evaluate = make_harmonics(1).evaluate
    offsets = make_offsets(1)

    @wp.kernel(module="unique", module_options=dict(OPTIONS))
    def adj_rest(
        first: int,  # coefficient of this launch
        camera: CameraView,
        means: wp.array[wp.vec3],  # [N]
        radii: wp.array[int],  # [N]
        colors: wp.array[wp.vec3],  # [N]
        adj_colors: wp.array[wp.vec3],  # [N]
        # out: gradients, zero as those of `adj_shade`
        rest_out: wp.array2d[wp.vec3],  # [N, K - 1]
    ):
        i, mine = (first + wp.tid()) // rest_out.shape[1], (first + wp.tid()) % rest_out.shape[1]
        adj = wp.vec3(0.0)
        if radii[i] > 0:
            if mine < camera.sh_degree * (camera.sh_degree + 2):
                x, y, z = offsets(camera, means, i)
                functions = evaluate(x, y, z)
                function = float(0.0)
                for k in range(15):  # an index that varies would put them in memory
                    if k == mine:
                        function = functions[k, 0]
                for channel in range(3):
                    if colors[i][channel] > 0.0:  # not cut to 0
                        adj[channel] = adj_colors[i][channel]
                adj = function * adj
        rest_out[i, mine] = adj

    return adj_rest

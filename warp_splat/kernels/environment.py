"""What lies behind the Gaussians in every direction, as harmonics, and its adjoint.

A color is that of a Gaussian with these coefficients: at least 0, and linear in them.
"""

import warp as wp

from warp_splat.kernels.columns import columns, rows
from warp_splat.kernels.compiler import FORWARD_ONLY, once
from warp_splat.kernels.harmonics import C0, make_harmonics
from warp_splat.kernels.simd import TYPES, fill, fma, inner, less, times, vec48

COEFFICIENTS = 16  # of degree 3, each of red, green and blue: the 48 numbers of a vector
RUN = 32  # groups of pixels of a thread of the adjoint, which adds them up
OPTIONS = {**FORWARD_ONLY, "max_unroll": 15}  # unrolls the loops over coefficients


@once
def make_see(lanes: int) -> wp.Function:
    """The harmonics in the directions of ``lanes`` rays of the camera."""
    number, _integer, _row2, row3, _row4 = TYPES[lanes]
    evaluate = make_harmonics(lanes).evaluate

    @wp.func
    def turned(rotation: wp.mat33, axis: int, x: number, y: number, z: number):
        near = times(z, fill(rotation[2, axis], x))
        return fma(x, fill(rotation[0, axis], x), fma(y, fill(rotation[1, axis], x), near))

    @wp.func
    def see(rotation: wp.mat33, ray: row3):
        x, y, z = columns(ray)
        return evaluate(turned(rotation, 0, x, y, z), turned(rotation, 1, x, y, z), turned(rotation, 2, x, y, z))

    return see


@once
def make_put_behind(lanes: int) -> wp.Kernel:
    """Of ``lanes`` pixels at once."""
    number, _integer, _row2, row3, _row4 = TYPES[lanes]
    see, value_of = make_see(lanes), make_harmonics(lanes).value_of

    @wp.kernel(module="unique", module_options=dict(OPTIONS))
    def put_behind(
        first: int,  # group of pixels of this slice
        rotation: wp.mat33,  # world to camera
        harmonics: wp.array[vec48],  # [1]
        rays: wp.array[row3],  # [M / lanes] in the camera, of any length
        alphas: wp.array[number],  # [M / lanes]
        colors: wp.array[row3],  # [M / lanes] of the Gaussians alone
        # out
        behind_out: wp.array[row3],  # [M / lanes] what the harmonics show
        colors_out: wp.array[row3],  # [M / lanes]
    ):
        i = first + wp.tid()
        h = harmonics[0]
        functions = see(rotation, rays[i])
        r, g, b = columns(colors[i])
        red = fill(0.5 + C0 * h[0], r)
        green = fill(0.5 + C0 * h[1], r)
        blue = fill(0.5 + C0 * h[2], r)
        for k in range(COEFFICIENTS - 1):
            value = value_of(functions, k)
            red = fma(value, fill(h[3 * k + 3], r), red)
            green = fma(value, fill(h[3 * k + 4], r), green)
            blue = fma(value, fill(h[3 * k + 5], r), blue)
        zero = fill(0.0, r)
        red = wp.max(red, zero)
        green = wp.max(green, zero)
        blue = wp.max(blue, zero)
        clear = fill(1.0, r) - alphas[i]
        behind_out[i] = rows(red, green, blue)
        colors_out[i] = rows(fma(clear, red, r), fma(clear, green, g), fma(clear, blue, b))

    return put_behind


@once
def make_adj_put_behind(lanes: int) -> wp.Kernel:
    """Of RUN times ``lanes`` pixels."""
    number, _integer, _row2, row3, _row4 = TYPES[lanes]
    see, harmonics = make_see(lanes), make_harmonics(lanes)
    table, value_of = harmonics.table, harmonics.value_of

    @wp.kernel(module="unique", module_options=dict(OPTIONS))
    def adj_put_behind(
        first: int,  # run of groups of pixels of this slice
        rotation: wp.mat33,
        rays: wp.array[row3],  # [M / lanes]
        alphas: wp.array[number],  # [M / lanes]
        behind: wp.array[row3],  # [M / lanes]
        adj: wp.array[row3],  # [M / lanes] of the colors
        # out
        adj_alphas_out: wp.array[number],  # [M / lanes]
        adj_harmonics_out: wp.array[vec48],  # [M / lanes / RUN] sums over the run
    ):
        run = first + wp.tid()
        mean_r = number(0.0)
        mean_g = number(0.0)
        mean_b = number(0.0)
        reds = table()
        greens = table()
        blues = table()
        for i in range(run * RUN, wp.min(run * RUN + RUN, rays.shape[0])):
            functions = see(rotation, rays[i])
            red, green, blue = columns(behind[i])
            r, g, b = columns(adj[i])
            adj_alphas_out[i] = -fma(r, red, fma(g, green, times(b, blue)))
            zero = fill(0.0, r)
            clear = fill(1.0, r) - alphas[i]
            r = times(times(clear, r), less(zero, red))  # where it is not cut to 0
            g = times(times(clear, g), less(zero, green))
            b = times(times(clear, b), less(zero, blue))
            mean_r += r
            mean_g += g
            mean_b += b
            for k in range(COEFFICIENTS - 1):
                if wp.static(lanes == 1):
                    reds[k, 0] += functions[k, 0] * r
                    greens[k, 0] += functions[k, 0] * g
                    blues[k, 0] += functions[k, 0] * b
                else:
                    reds[k] = fma(functions[k], r, reds[k])
                    greens[k] = fma(functions[k], g, greens[k])
                    blues[k] = fma(functions[k], b, blues[k])
        one = fill(1.0, mean_r)
        sums = vec48()
        sums[0] = C0 * inner(one, mean_r)
        sums[1] = C0 * inner(one, mean_g)
        sums[2] = C0 * inner(one, mean_b)
        for k in range(COEFFICIENTS - 1):
            sums[3 * k + 3] = inner(one, value_of(reds, k))
            sums[3 * k + 4] = inner(one, value_of(greens, k))
            sums[3 * k + 5] = inner(one, value_of(blues, k))
        adj_harmonics_out[run] = sums

    return adj_put_behind

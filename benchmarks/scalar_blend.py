"""The baseline of benchmarks/blend.py: one scalar thread per pixel, as a CUDA programmer would first write it.

The same image and the same gradients as the package's driver, by the same formulas (warp_splat.kernels.splat), with
wp.exp and a sum into each Gaussian's gradient. On the CPU a launch is one thread, so that plain sums are no race.
"""

import warp as wp

from warp_splat.config import ALPHA_MAX, ALPHA_MIN, T_MIN, TILE
from warp_splat.kernels.compiler import FORWARD_ONLY
from warp_splat.kernels.falloff import LN_2
from warp_splat.kernels.splat import Splat2D

wp.set_module_options(FORWARD_ONLY)
vec9 = wp.types.vector(length=9, dtype=float)


@wp.func
def exponential(splat: Splat2D, dx: float, dy: float):
    u = splat.root[0] * dx + splat.root[1] * dy
    v = splat.root[2] * dy
    return wp.exp(-LN_2 * (u * u + v * v))


@wp.kernel
def blend(
    tiles_x: int,
    ranges: wp.array[wp.vec2i],  # [T]
    instances: wp.array[int],  # [M]
    splats: wp.array[Splat2D],  # [V]
    # out
    image_out: wp.array2d[wp.vec3],  # [H, W]
    final_out: wp.array2d[float],  # [H, W] transmittance
    last_out: wp.array2d[int],  # [H, W] where the adjoint starts
):
    y, x = wp.tid()
    span = ranges[(y // TILE) * tiles_x + x // TILE]
    t = float(1.0)
    c = wp.vec3(0.0)
    last = span[0]
    for k in range(span[0], span[1]):
        splat = splats[instances[k]]
        dx = splat.mean[0] - float(x) - 0.5
        dy = splat.mean[1] - float(y) - 0.5
        raw = splat.opacity * exponential(splat, dx, dy)
        if raw < ALPHA_MIN:
            continue
        alpha = wp.min(ALPHA_MAX, raw)
        if t - alpha * t < T_MIN:
            break
        c += splat.color * (alpha * t)
        t -= alpha * t
        last = k + 1
    image_out[y, x] = c
    final_out[y, x] = t
    last_out[y, x] = last


@wp.kernel
def adj_blend(
    tiles_x: int,
    ranges: wp.array[wp.vec2i],
    instances: wp.array[int],
    splats: wp.array[Splat2D],
    final: wp.array2d[float],
    last: wp.array2d[int],
    adj_image: wp.array2d[wp.vec3],  # [H, W]
    # out
    grads_out: wp.array[vec9],  # [V] mean, conic, opacity, color
):
    y, x = wp.tid()
    first = ranges[(y // TILE) * tiles_x + x // TILE][0]
    up = adj_image[y, x]
    t = final[y, x]
    behind = float(0.0)
    for back in range(last[y, x] - first):
        i = instances[last[y, x] - 1 - back]
        splat = splats[i]
        dx = splat.mean[0] - float(x) - 0.5
        dy = splat.mean[1] - float(y) - 0.5
        fall = exponential(splat, dx, dy)
        raw = splat.opacity * fall
        if raw < ALPHA_MIN:
            continue
        alpha = wp.min(ALPHA_MAX, raw)
        t = t / (1.0 - alpha)
        lit = wp.dot(splat.color, up)
        adj_alpha = t * lit - behind / (1.0 - alpha)
        behind += alpha * t * lit
        grad = vec9(0.0)
        if raw < ALPHA_MAX:
            adj_q = -raw * adj_alpha
            u = 2.0 * LN_2 * adj_q * (splat.root[0] * dx + splat.root[1] * dy)
            grad[0] = splat.root[0] * u
            grad[1] = splat.root[1] * u + 2.0 * LN_2 * adj_q * splat.root[2] * splat.root[2] * dy
            grad[2] = 0.5 * adj_q * dx * dx
            grad[3] = adj_q * dx * dy
            grad[4] = 0.5 * adj_q * dy * dy
            grad[5] = fall * adj_alpha
        for channel in range(3):
            grad[6 + channel] = alpha * t * up[channel]
        grads_out[i] += grad

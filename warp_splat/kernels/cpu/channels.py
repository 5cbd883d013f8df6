"""What is blended beside the color on the CPU: any number of channels, some at a time, or the strongest Gaussians.

The blend of the color has found where each pixel stops, and its transmittance there. So these loops decide nothing:
forward they repeat the weights, backward they recover T as ``manual`` and ``stepwise`` do. Their sums stay in the first
cache, which is why channels go in groups. Kernels for one group serve any number of channels in it.
"""

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.compiler import FORWARD_ONLY, once
from warp_splat.kernels.cpu.adjoint import folded
from warp_splat.kernels.cpu.blend import AHEAD, BLOCKS, ROWS_AHEAD, aligned, walk
from warp_splat.kernels.falloff import make_falloff
from warp_splat.kernels.inline import kernel_of_parts
from warp_splat.kernels.simd import LANES, equal, fma, pick, times, vec16, where_less
from warp_splat.kernels.slots import CHANNEL, OPACITY, write_geometry
from warp_splat.kernels.splat import BlendVariant, Splat2D
from warp_splat.kernels.step import make_reverse_step, opaque
from warp_splat.kernels.structs import BinsView

AT_ONCE = 32  # channels
vec_geometry = wp.types.vector(length=CHANNEL, dtype=float)


@wp.func
def pixel_of(tile: int, tiles_x: int, number: int):
    """Column and line of a tile's pixel, block by block."""
    block = number // LANES
    lane = number % LANES
    column = (tile % tiles_x) * TILE + 4 * (block & 3) + lane % 4
    return column, (tile // tiles_x) * TILE + 4 * (block >> 2) + lane // 4


@wp.func
def into_lanes(
    pixels: wp.array3d[float], begin: int, channels: int, tile: int, tiles_x: int, numbers: wp.array[float], width: int
):
    """A group's channels of a tile's pixels into rows of lanes, ``width`` rows for a block; 0 beyond the image."""
    pixel = int(0)
    while pixel < TILE * TILE:
        x, y = pixel_of(tile, tiles_x, pixel)
        inside = y < pixels.shape[0] and x < pixels.shape[1]
        place = (pixel // LANES) * width * LANES + pixel % LANES
        for channel in range(channels):
            numbers[place] = 0.0
            if inside:
                numbers[place] = pixels[y, x, begin + channel]
            place += LANES
        pixel += 1


@wp.func
def row_of_splat(rows: wp.array2d[float], splat: int):
    """The channels of a splat, as an array whose stride is known."""
    return wp.array(ptr=rows.ptr + wp.uint64(4 * AT_ONCE) * wp.uint64(splat), shape=(AT_ONCE,), dtype=float)


@once
def make_beside(variant: BlendVariant, most: int | None = None) -> wp.Kernel:
    """The sums of weights times channels; nothing stands behind them.

    With ``most``, instead the weights of so many strongest Gaussians, their places in the tile's list, and that of the
    Gaussian at which half of the light is gone.
    """
    fall_at, way, known, WIDTH, MOST = make_falloff(variant.falloff).value, 1, True, AT_ONCE, most or 0
    T, WALKED, SUMS, MEDIAN, WEIGHT, RANK = (place * BLOCKS for place in (0, 1, 2, 2, 3, 3 + MOST))
    STATE = RANK + MOST * BLOCKS if most is not None else SUMS + WIDTH * BLOCKS
    mat_room = wp.types.matrix(shape=(STATE + ROWS_AHEAD + 1, LANES), dtype=float)

    def begin(k, here, out, bins, rows):
        return row_of_splat(rows, bins.instances[k])

    def step(k, splat, dx, dy, fall, block, here, mine, out, s, alphas, channels):
        t = s[T + block]
        alpha = opaque(fall * splat.opacity, alphas, here, s[WALKED + block])
        w = times(alpha, t)
        behind = fma(-alpha, t, t)
        s[T + block] = behind
        if wp.static(most is None):
            row = SUMS + block * WIDTH
            channel = int(0)
            while channel < channels:
                s[row + channel] = fma(w, mine[channel], s[row + channel])
                channel += 1
        else:
            median = s[MEDIAN + block]
            s[MEDIAN + block] = where_less(vec16(0.5), t, where_less(vec16(0.5), behind, median, here), median)
            place = here
            for j in range(MOST):  # each as strong as it is pushes the weaker ones down
                best = s[WEIGHT + j * BLOCKS + block]
                rank = s[RANK + j * BLOCKS + block]
                s[WEIGHT + j * BLOCKS + block] = wp.max(w, best)
                s[RANK + j * BLOCKS + block] = where_less(best, w, place, rank)
                place = where_less(best, w, rank, place)
                w = wp.min(w, best)

    def finish(k, splat, ahead, out):
        return False

    @kernel_of_parts(FORWARD_ONLY, walk=walk, begin=begin, step=step, finish=finish)
    def beside(
        first: int,
        bins: BinsView,
        alphas: wp.vec2,
        count: wp.array2d[vec16],  # [T, BLOCKS]
        steps: wp.array[int],  # [T]
        rows: wp.array2d[float],  # [V, AT_ONCE] of the splats; of weights nothing
        begin: int,  # of the group
        channels: int,  # of the group
        # out
        pixels_out: wp.array3d[float],  # [H, W, C] channels, or weights [H, W, most]
        ranks_out: wp.array3d[int],  # [H, W, most] the strongest first, of equal ones the nearest; -1: no more
        median_out: wp.array2d[int],  # [H, W] -1: half of the light comes through
    ):
        tile = first + wp.tid()
        start = bins.ranges[tile][0]
        room = mat_room()
        s = wp.array(ptr=aligned(wp.address_of(room)), shape=(STATE,), dtype=vec16)
        near = wp.array(ptr=s.ptr + wp.uint64(64 * STATE), shape=(AHEAD,), dtype=Splat2D)
        for row in range(SUMS, s.shape[0]):
            s[row] = vec16(0.0)
        for block in range(BLOCKS):
            s[T + block] = vec16(1.0)
            s[WALKED + block] = count[tile, block]
            if wp.static(most is not None):
                s[MEDIAN + block] = vec16(-1.0)
            for j in range(MOST):
                s[RANK + j * BLOCKS + block] = vec16(-1.0)
        length = steps[tile]
        walk(bins, near, start, length, way, known, pixels_out, fall_at, begin, step, finish)
        numbers = wp.array(ptr=s.ptr + wp.uint64(64 * SUMS), shape=((STATE - SUMS) * LANES,), dtype=float)
        pixel = int(0)
        while pixel < TILE * TILE:
            x, y = pixel_of(tile % bins.tiles, bins.tiles_x, pixel)
            if y < bins.height and x < pixels_out.shape[1]:
                y += (tile // bins.tiles) * bins.height
                if wp.static(most is None):
                    place = (pixel // LANES) * WIDTH * LANES + pixel % LANES
                    for channel in range(channels):
                        pixels_out[y, x, begin + channel] = numbers[place]
                        place += LANES
                else:
                    median_out[y, x] = int(numbers[pixel])
                for j in range(MOST):
                    pixels_out[y, x, j] = numbers[(WEIGHT - SUMS + j * BLOCKS) * LANES + pixel]
                    ranks_out[y, x, j] = int(numbers[(RANK - SUMS + j * BLOCKS) * LANES + pixel])
            pixel += 1

    return beside


@once
def make_adj_channels(mode: str, variant: BlendVariant, most: int = 0) -> wp.Kernel:
    """The adjoint of the sums, by hand or by Warp's derivative of a step.

    By ``absolute``, instead of the means' gradients the sums of their magnitudes over the pixels, and no others. With
    ``most``, instead that of the weights of so many of a pixel's Gaussians, which have no channels.
    """
    (pixel, geometry), way, known = make_reverse_step(mode, variant.falloff, vec16), -1, True
    fall_at = make_falloff(variant.falloff).value
    WIDTH = most or AT_ONCE  # of a block's numbers
    geometric = bool(most) or mode == "absolute"  # channels have no gradients of their own
    T, ADJ_T, WALKED, UP = 0, BLOCKS, 2 * BLOCKS, 3 * BLOCKS
    RANK, SUMS = UP + WIDTH * BLOCKS, UP + (2 if most else 1) * WIDTH * BLOCKS
    GRADS = CHANNEL + (0 if geometric else WIDTH)
    mat_room = wp.types.matrix(shape=(SUMS + GRADS + ROWS_AHEAD + 1, LANES), dtype=float)

    def begin(k, here, slots_out, bins, rows, s):
        row = int(SUMS)
        while row < SUMS + slots_out.shape[1]:
            s[row] = vec16(0.0)
            row += 1
        return row_of_splat(rows, bins.instances[k])

    def step(k, splat, dx, dy, fall, block, here, mine, out, s, alphas, channels):
        up = UP + block * WIDTH
        lit = vec16(0.0)
        channel = int(0)
        while channel < channels:
            if wp.static(most > 0):
                meant = equal(here, s[RANK + block * WIDTH + channel])
                lit = lit + pick(meant, s[up + channel], vec16(0.0))
            else:
                lit = fma(s[up + channel], mine[channel], lit)
            channel += 1
        t, adj_t, walked = s[T + block], s[ADJ_T + block], s[WALKED + block]
        front, adj_front, w, part = pixel(dx, dy, fall, splat.root, splat.opacity, t, adj_t, alphas, here, walked, lit)
        s[T + block] = front
        s[ADJ_T + block] = adj_front
        for grad in range(CHANNEL):
            s[SUMS + grad] = s[SUMS + grad] + part[grad]
        if wp.static(not geometric):
            channel = int(0)
            while channel < channels:
                row = SUMS + CHANNEL + channel
                s[row] = fma(w, s[up + channel], s[row])
                channel += 1

    def finish(k, splat, ahead, slots_out, s):
        sums = vec_geometry()
        grad = int(CHANNEL)
        while grad < slots_out.shape[1]:
            slots_out[k, grad] = folded(s, SUMS + grad)
            grad += 1
        for grad in range(CHANNEL):
            sums[grad] = folded(s, SUMS + grad)
        mean, conic = geometry(sums, splat.root, splat.opacity)
        write_geometry(slots_out, k, mean, conic)
        slots_out[k, OPACITY] = sums[OPACITY]
        return False

    @kernel_of_parts(FORWARD_ONLY, walk=walk, begin=begin, step=step, finish=finish)
    def adj_channels(
        first: int,
        bins: BinsView,
        alphas: wp.vec2,
        final: wp.array2d[vec16],  # [T, BLOCKS]
        count: wp.array2d[vec16],  # [T, BLOCKS]
        steps: wp.array[int],  # [T]
        rows: wp.array2d[float],  # [V, AT_ONCE] of the splats; of weights nothing
        ranks: wp.array3d[float],  # [H, W, most] of which Gaussians the weights are; of channels nothing
        begin: int,  # of the group
        channels: int,  # of the group, or weights
        adj_pixels: wp.array3d[float],  # [H, W, C]
        # out
        slots_out: wp.array2d[float],  # [M, CHANNEL + channels or more], geometric [M, CHANNEL]
    ):
        tile = first + wp.tid()
        start = bins.ranges[tile][0]
        room = mat_room()
        s = wp.array(ptr=aligned(wp.address_of(room)), shape=(SUMS + GRADS,), dtype=vec16)
        near = wp.array(ptr=s.ptr + wp.uint64(64 * (SUMS + GRADS)), shape=(AHEAD,), dtype=Splat2D)
        for block in range(BLOCKS):
            s[T + block] = final[tile, block]
            s[ADJ_T + block] = vec16(0.0)
            s[WALKED + block] = count[tile, block]
        numbers = wp.array(ptr=s.ptr + wp.uint64(64 * UP), shape=(LANES * WIDTH * BLOCKS,), dtype=float)
        into_lanes(adj_pixels, begin, channels, tile, bins.tiles_x, numbers, WIDTH)
        if wp.static(most > 0):
            chosen = wp.array(ptr=s.ptr + wp.uint64(64 * RANK), shape=(LANES * WIDTH * BLOCKS,), dtype=float)
            into_lanes(ranks, 0, channels, tile, bins.tiles_x, chosen, WIDTH)
        length = steps[tile]
        walk(bins, near, start, length, way, known, slots_out, fall_at, begin, step, finish)
        for k in range(start + steps[tile], bins.ranges[tile][1]):
            for grad in range(slots_out.shape[1]):
                slots_out[k, grad] = 0.0

    return adj_channels

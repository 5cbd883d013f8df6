"""The adjoint of the blend on the CPU, its reverse loop by hand: ``manual`` and ``stepwise`` differ in the step.

Both recover T by division, both sum over the pixels of a tile in lanes and write one row per tile instance.
"""

import functools

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.compiler import IN_LANES
from warp_splat.kernels.cpu.blend import AHEAD, BLOCKS, ROWS_AHEAD, aligned, mat_boxes, offset_x, offset_y, reach
from warp_splat.kernels.simd import LANES, fma, times, vec16
from warp_splat.kernels.slots import CHANNEL, MEAN_X, MEAN_Y, OPACITY, XX, XY, YY
from warp_splat.kernels.splat import BlendVariant, Splat2D, exponent
from warp_splat.kernels.step import conic_from_root, geometry_from_moments, make_manual, make_stepwise
from warp_splat.kernels.structs import BinsView

vec5 = wp.types.vector(length=5, dtype=float)
vec8 = wp.types.vector(length=8, dtype=float)


@wp.func
def folded(halves: wp.array[vec8], quarters: wp.array[wp.vec4], row: int):
    """Sum of a row of lanes, two and four of which make it up; the row is spent.

    Folded in memory, because LLVM makes vectors of what is stored (Tried: a sum of 16 numbers, which stays scalar: 15 %
    of the loop).
    """
    halves[2 * row] = halves[2 * row] + halves[2 * row + 1]
    quarters[4 * row] = quarters[4 * row] + quarters[4 * row + 1]
    four = quarters[4 * row]
    return (four[0] + four[2]) + (four[1] + four[3])


@functools.cache
def _make_manual_body(variant: BlendVariant) -> tuple[wp.Function, wp.Function]:
    """What the loop does with a Gaussian and a block, and how its sums become gradients."""
    adj_step, CHANNELS = make_manual(variant.falloff, vec16), variant.channels
    mat_grads = wp.types.matrix(shape=(variant.columns, LANES), dtype=float)

    @wp.func
    def body(
        splat: Splat2D,
        dx: vec16,
        dy: vec16,
        t: vec16,  # transmittance behind
        adj_t: vec16,  # T dL/dT behind
        alphas: wp.vec2,
        here: vec16,
        walked: vec16,
        red: vec16,  # upstream gradients
        green: vec16,
        blue: vec16,
        far: vec16,
    ):
        """Both in front, and what to sum over pixels: d, d d', 1 times dL/dopacity, and the channels' gradients."""
        lit = fma(red, splat.color[0], fma(green, splat.color[1], blue * splat.color[2]))
        if wp.static(CHANNELS > 3):
            lit = fma(far, splat.depth, lit)
        z = exponent(dx, dy, splat.root[0], splat.root[1], splat.root[2])
        front, adj_front, w, adj_opacity = adj_step(z, splat.opacity, t, adj_t, alphas, here, walked, lit)
        part = mat_grads()
        adj_x = times(adj_opacity, dx)
        adj_y = times(adj_opacity, dy)
        part[MEAN_X] = adj_x
        part[MEAN_Y] = adj_y
        part[XX] = times(adj_x, dx)
        part[XY] = times(adj_x, dy)
        part[YY] = times(adj_y, dy)
        part[OPACITY] = adj_opacity
        part[CHANNEL] = times(w, red)
        part[CHANNEL + 1] = times(w, green)
        part[CHANNEL + 2] = times(w, blue)
        if wp.static(CHANNELS > 3):
            part[CHANNEL + 3] = times(w, far)
        return front, adj_front, part

    @wp.func
    def adj_geometry(sums: vec5, splat: Splat2D):
        """dL/d(mean, conic)."""
        s = wp.vec2(sums[MEAN_X], sums[MEAN_Y])
        return geometry_from_moments(s, sums[XX], sums[XY], sums[YY], splat.root, splat.opacity)

    return body, adj_geometry


@functools.cache
def _make_stepwise_body(variant: BlendVariant) -> tuple[wp.Function, wp.Function]:
    """What the loop does with a Gaussian and a block, and how its sums become gradients."""
    (Parcel, undo, step), CHANNELS = make_stepwise(variant, vec16), variant.channels
    mat_grads = wp.types.matrix(shape=(variant.columns, LANES), dtype=float)

    @wp.func
    def body(
        splat: Splat2D,
        dx: vec16,
        dy: vec16,
        t: vec16,  # transmittance behind
        adj_t: vec16,  # dL/dT behind
        alphas: wp.vec2,
        here: vec16,
        walked: vec16,
        red: vec16,  # upstream gradients
        green: vec16,
        blue: vec16,
        far: vec16,
    ):
        """Both in front, and what to sum over pixels: the gradients of a Parcel's members."""
        parcel = Parcel()
        parcel.dx = dx
        parcel.dy = dy
        parcel.xx = vec16(splat.root[0])
        parcel.xy = vec16(splat.root[1])
        parcel.yy = vec16(splat.root[2])
        parcel.opacity = vec16(splat.opacity)
        parcel.red = vec16(splat.color[0])
        parcel.green = vec16(splat.color[1])
        parcel.blue = vec16(splat.color[2])
        parcel.depth = vec16(splat.depth)
        fall, front = undo(parcel, t, alphas, here, walked)
        adj, _fall, adj_front, _behind, _min, _here, _walked, _red, _green, _blue, _far = wp.grad(step)(
            parcel, fall, front, adj_t, alphas, here, walked, red, green, blue, far
        )
        part = mat_grads()
        part[MEAN_X] = adj.dx
        part[MEAN_Y] = adj.dy
        part[XX] = adj.xx
        part[XY] = adj.xy
        part[YY] = adj.yy
        part[OPACITY] = adj.opacity
        part[CHANNEL] = adj.red
        part[CHANNEL + 1] = adj.green
        part[CHANNEL + 2] = adj.blue
        if wp.static(CHANNELS > 3):
            part[CHANNEL + 3] = adj.depth
        return front, adj_front, part

    @wp.func
    def adj_geometry(sums: vec5, splat: Splat2D):
        """dL/d(mean, conic)."""
        adj_root = wp.vec3(sums[XX], sums[XY], sums[YY])
        return wp.vec2(sums[MEAN_X], sums[MEAN_Y]), conic_from_root(adj_root, splat.root)

    return body, adj_geometry


@functools.cache
def make_reverse(mode: str, variant: BlendVariant) -> wp.Kernel:
    """The reverse loop with the body of ``mode``."""
    CHANNELS, GRADS = variant.channels, variant.columns
    # all in one matrix: a matrix of which only rows of known numbers are used would be taken apart into scalars
    T, ADJ_T, WALKED, UP, SUMS = 0, BLOCKS, 2 * BLOCKS, 3 * BLOCKS, (3 + CHANNELS) * BLOCKS
    mat_room = wp.types.matrix(shape=(SUMS + GRADS + ROWS_AHEAD + 1, LANES), dtype=float)
    vec_grads = wp.types.vector(length=GRADS, dtype=float)
    make_body = {"manual": _make_manual_body, "stepwise": _make_stepwise_body}[mode]
    body, adj_geometry = make_body(variant)

    @wp.kernel(module="unique", module_options=dict(IN_LANES))
    def adj_blend(
        first: int,
        bins: BinsView,
        alphas: wp.vec2,
        final: wp.array2d[vec16],  # [T, BLOCKS]
        count: wp.array2d[vec16],  # [T, BLOCKS]
        steps: wp.array[int],  # [T]
        up: wp.array2d[vec16],  # [T, BLOCKS CHANNELS]
        adj_final: wp.array2d[vec16],  # [T, BLOCKS]
        # out
        slots_out: wp.array2d[float],  # [M, GRADS]
    ):
        tile = first + wp.tid()
        start = bins.ranges[tile][0]
        x0 = float((tile % bins.tiles_x) * TILE) + 0.5
        y0 = float((tile // bins.tiles_x) * TILE) + 0.5
        room = mat_room()
        # rows of lanes: T, dL/dT (times T for manual), instances walked, upstream gradients, sums over pixels
        s = wp.array(ptr=aligned(wp.address_of(room)), shape=(SUMS + GRADS,), dtype=vec16)
        near = wp.array(ptr=s.ptr + wp.uint64(64 * (SUMS + GRADS)), shape=(AHEAD,), dtype=Splat2D)
        for block in range(BLOCKS):
            s[T + block] = final[tile, block]
            s[ADJ_T + block] = adj_final[tile, block]
            if wp.static(mode == "manual"):
                s[ADJ_T + block] = times(final[tile, block], adj_final[tile, block])
            s[WALKED + block] = count[tile, block]
            for channel in range(CHANNELS):
                s[UP + channel * BLOCKS + block] = up[tile, block * CHANNELS + channel]
        far = vec16(0.0)
        boxes = mat_boxes()
        sums = vec_grads()
        halves = wp.array(ptr=s.ptr + wp.uint64(64 * SUMS), shape=(2 * GRADS,), dtype=vec8)
        quarters = wp.array(ptr=s.ptr + wp.uint64(64 * SUMS), shape=(4 * GRADS,), dtype=wp.vec4)
        for back in range(steps[tile]):
            k = start + steps[tile] - 1 - back
            ahead = back & (AHEAD - 1)
            if ahead == 0:
                for j in range(wp.min(AHEAD, steps[tile] - back)):
                    near[j] = bins.splats[bins.instances[k - j]]
                for j in range(wp.min(AHEAD, steps[tile] - back)):
                    boxes[j] = reach(near[j].mean, near[j].extent, x0, y0)
            splat = near[ahead]
            box = boxes[ahead]
            here = vec16(float(k - start))
            for grad in range(GRADS):
                s[SUMS + grad] = vec16(0.0)
            by = box[2]
            while by <= box[3]:
                dy = offset_y(splat.mean, y0, by)
                bx = box[0]
                while bx <= box[1]:
                    block = (4 * by + bx) & (BLOCKS - 1)
                    dx = offset_x(splat.mean, x0, bx)
                    if wp.static(CHANNELS > 3):
                        far = s[UP + 3 * BLOCKS + block]
                    front, adj_front, part = body(
                        splat, dx, dy, s[T + block], s[ADJ_T + block], alphas, here, s[WALKED + block],
                        s[UP + block], s[UP + BLOCKS + block], s[UP + 2 * BLOCKS + block], far,
                    )  # fmt: skip
                    s[T + block] = front
                    s[ADJ_T + block] = adj_front
                    for grad in range(GRADS):
                        s[SUMS + grad] = s[SUMS + grad] + part[grad]
                    bx += 1
                by += 1
            grad = int(0)
            while grad < GRADS:  # as a range, which Warp unrolls, 10 % of the loop slower
                sums[grad] = folded(halves, quarters, grad)
                grad += 1
            adj_mean, adj_conic = adj_geometry(vec5(sums[MEAN_X], sums[MEAN_Y], sums[XX], sums[XY], sums[YY]), splat)
            slots_out[k, MEAN_X] = adj_mean[0]
            slots_out[k, MEAN_Y] = adj_mean[1]
            slots_out[k, XX] = adj_conic[0]
            slots_out[k, XY] = adj_conic[1]
            slots_out[k, YY] = adj_conic[2]
            for grad in range(OPACITY, GRADS):
                slots_out[k, grad] = sums[grad]

    return adj_blend

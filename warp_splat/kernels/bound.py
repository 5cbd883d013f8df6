"""How wrong a pixel can be: what the cuts leave out and what rounding adds. docs/tolerance.md derives every line.

A Gaussian adds to the bound wherever the blend does not look at it: in the corners of its box whose tiles its ellipse
does not touch, and in boxes around it, of which each is larger and its alpha outside lower. They are added into
differences over blocks of 4 x 4 pixels, in whole numbers, so that their order does not matter. There is a map for each
of a few ranges of depth: what lies behind others counts as little as it shows. Tried:

- as long: sixteen Gaussians in lanes; what is added here and there decides
- 50 % longer blends: lists of all tiles of the boxes, which leave no corners
"""

from typing import Any

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.compiler import FORWARD_ONLY, once
from warp_splat.kernels.falloff import LOG2_E, FalloffFunctions
from warp_splat.kernels.simd import fill, fma, smaller, times, where_less
from warp_splat.kernels.structs import BinsView, Splats2DView
from warp_splat.kernels.tiles import cut, outline, square_of

EPS = wp.constant(2.0**-24)  # of float32, half a unit in the last place of 1
BLOCK = wp.constant(4.0)  # px
FAINT = 1.0e-13  # alpha at which the last box ends
SEEN = 0.25  # share of the cut down to which the blend looks: where the tails matter most, they are summed exactly
SHARE = wp.constant(1.0 / 6.0)  # of the alpha at which a box ends, that at which the next one does
BOXES = wp.constant(3)  # around; the last ends at FAINT


@wp.struct
class Rules:
    """What the bound needs of the camera and the options."""

    focal: wp.vec2  # px
    principal: wp.vec2  # px
    seen: float  # alpha down to which the blend looks
    faint: float
    floor: float  # alpha below which the ideal has nothing
    square: int
    exp_error: float  # relative
    unit: float  # of a map's whole numbers
    usual: float  # brightness of a color; the weight of a brighter one is larger


@wp.struct
class BoundView:
    """What the blend reads for the bound, and where it writes it."""

    outside: wp.array3d[int]  # [K, rows, columns] of blocks: alpha that no list holds, in units
    unit: float
    usual: float
    floor: wp.vec2  # alpha below which the ideal has nothing, and from which on it surely has something
    begins: wp.array[float]  # [K] depths at which the maps begin; the first is below all
    errors: wp.array[wp.vec3]  # [V] of splats: of alpha, relative; of alpha that is faint, or at the floor; of color
    brightest: float  # of all colors and the background
    shade: float  # the largest error of a color
    darkest: float  # of the background
    behind: float  # brightest of the background
    everywhere: float  # light of all Gaussians outside their last box
    unknown: float  # Gaussians of whose place nothing is known
    bound_out: wp.array2d[float]  # [H, W]
    rounding_out: wp.array2d[float]  # [H, W] the part of it that is rounding


@wp.struct
class Since:
    """What a tile has seen since it settled last."""

    map: int  # that follows
    steps: float  # entries of the list
    error: float  # of alpha, relative
    shade: float  # error of a color
    hidden: float  # sum of what rounding may change of faint alpha


@wp.func
def watch(bound: BoundView, since: Since, bins: BinsView, first: int, count: int):
    """Some entries of the list, from ``first`` on."""
    for k in range(first, first + count):
        error = bound.errors[bins.instances[k]]
        since.steps += 1.0
        since.error = wp.max(since.error, error[0])
        since.hidden += error[1]
        since.shade = wp.max(since.shade, error[2])
    return since


@wp.func
def next_map(bound: BoundView, begin: int, last: float):
    """The first map from ``begin`` on that begins farther than ``last``."""
    end = begin
    while end < bound.begins.shape[0] and bound.begins[end] <= last:
        end += 1
    return end


@wp.func
def outside_of(bound: BoundView, begin: int, end: int, tile: int, tiles_x: int, block: int):
    """What some maps hold at one of the 16 blocks of a tile."""
    found = int(0)
    for depth in range(begin, end):
        found += bound.outside[depth, (tile // tiles_x) * 4 + (block >> 2), (tile % tiles_x) * 4 + (block & 3)]
    return float(found) * bound.unit


@wp.func
def brightness(color: wp.vec3, shade: float, usual: float):
    """What alpha of that color, which may be off by ``shade``, counts, in units of the usual; no less than 1."""
    return wp.max((wp.max(color) + shade) / usual, 1.0)


@wp.func
def sure(raw: Any, alphas: wp.vec2, bound: BoundView):
    """Alpha in the ideal. What is fainter is left out, as subnormal numbers take many times as long."""
    return where_less(raw, fill(bound.floor[1], raw), fill(0.0, raw), smaller(raw, fill(alphas[1], raw)))


@wp.func
def unsure(raw: Any, bound: BoundView):
    """Alpha that the ideal may have or not."""
    none = fill(0.0, raw)
    found = where_less(raw, fill(bound.floor[1], raw), raw, none)
    return where_less(raw, fill(bound.floor[0], raw), none, found)


@wp.func
def light_behind(total: Any, gained: Any, before: Any):
    """What left-out Gaussians take from those behind them, if they were blended: their alpha times that light."""
    return fma(total, gained, before)


@wp.func
def own_light(t: Any, mass: Any, usual: float, before: Any):
    """What left-out Gaussians would add, if they were blended; ``mass``: their alpha by :func:`brightness`."""
    return fma(times(t, usual), mass, before)


@wp.func
def rounding_of(t: Any, after: Any, light: Any, since: Since, brightest: float):
    """What rounding and colors change between the transmittances ``t`` and ``after``."""
    passed = t - after
    own = times(passed, brightest * since.error + since.shade)
    sums = wp.min(times(light, since.steps * EPS), times(passed, brightest))
    return fma(t, fill(brightest * (2.0 * EPS * since.steps + since.hidden), t), own + sums)


@wp.func
def all_rounding(rounding: Any, bound: BoundView):
    """What rounding changes, with that of the last sums."""
    return (rounding + fill((8.0 * EPS + bound.unknown) * bound.brightest, rounding)) * 1.001


@wp.func
def all_cuts(change: Any, taken: Any, added: Any, before: Any):
    """What cuts change in a channel, and ``before`` in others: ``change`` in the list, and what no list holds."""
    return wp.max(before, wp.max(change + added, taken - change))


@wp.func
def with_rest(cuts: Any, stopped: Any, bound: BoundView):
    """With what lies where a pixel ``stopped``, which is its transmittance there, and outside of the last boxes."""
    hidden = times(stopped, wp.max(bound.brightest - bound.darkest, bound.behind))
    return (cuts + hidden + fill(bound.everywhere, hidden)) * 1.001


@wp.func
def first_and_last(mean: float, half: float, blocks: int):
    """Of a row of blocks, those with a pixel center within ``half`` of ``mean``: the first, one after the last."""
    most = float(blocks)
    first = wp.ceil(mean - half - 0.5)
    last = wp.floor(mean + half - 0.5)
    low = wp.clamp(wp.floor(first / BLOCK), 0.0, most)
    high = wp.where(last < first, low, wp.clamp(wp.floor(last / BLOCK) + 1.0, low, most))
    return int(low), int(high)


@wp.func
def box_of(maps: wp.array4d[int], mean: wp.vec2, half: wp.vec2):
    """The blocks of a box: left, right, top, bottom, one after the last."""
    left, right = first_and_last(mean[0], half[0], maps.shape[3] - 1)
    top, bottom = first_and_last(mean[1], half[1], maps.shape[2] - 1)
    return wp.vec4i(left, right, top, bottom)


@wp.func
def add_box(maps: wp.array4d[int], band: int, depth: int, box: wp.vec4i, amount: int):
    """Add ``amount`` to the blocks of a box, as differences."""
    if box[0] < box[1] and box[2] < box[3] and amount != 0:
        wp.atomic_add(maps, band, depth, box[2], box[0], amount)
        wp.atomic_add(maps, band, depth, box[2], box[1], -amount)
        wp.atomic_add(maps, band, depth, box[3], box[0], -amount)
        wp.atomic_add(maps, band, depth, box[3], box[1], amount)


@wp.func
def conditions(rules: Rules, mean: wp.vec2, conic: wp.vec3, spread: wp.vec2, size: float, z: float):
    """How much rounding changes the exponent, relative, and the place, in standard deviations (docs/tolerance.md).

    ``spread``: standard deviations along x and y [px]; ``size``: the largest scale; ``z``: depth.
    """
    # variance along the short axis [px^2]
    short = 2.0 / (conic[0] + conic[2] + wp.length(wp.vec2(conic[0] - conic[2], 2.0 * conic[1])))
    u = wp.cw_div(mean - rules.principal, rules.focal)
    aside = 1.0 + wp.dot(u, u)
    most = wp.max(rules.focal[0], rules.focal[1])
    long = most * size / z
    condition = wp.sqrt((3.0 * aside * long * long + wp.dot(spread, spread)) / short)
    shift = EPS * (2.5 * aside * most + wp.length(mean) + wp.length(rules.principal))
    return 16.0 * EPS * condition, shift / wp.sqrt(short)


@wp.func
def alpha_error(rules: Rules, condition: float, shift: float, q: float):
    """Relative error of alpha at the exponent ``q``, from :func:`conditions`."""
    return rules.exp_error + 16.0 * EPS + condition * q + wp.sqrt(2.0 * q) * shift


@once
def make_beyond(fall_at: wp.Function) -> tuple[wp.Function, wp.Function]:
    """What is the most beside a row of blocks, and what adds the corners of a box; ``fall_at``: the falloff."""

    @wp.func
    def farther(d: float, most: float):
        """The largest alpha ``d`` standard deviations away or farther, rounded up."""
        near = wp.clamp(d * 0.9999 - 1.0e-3, 0.0, 1.0e4)
        return int(wp.ceil(most * fall_at(0.5 * LOG2_E * near * near)))

    @wp.func
    def beyond(low: int, high: int, blocks: int, mean: float, half: float, deviation: float, most: float):
        """The largest alpha outside of the blocks with a center within ``half``; nothing is outside the image."""
        distance = wp.where(low > 0, mean + 0.5 - BLOCK * float(low), 1.0e30)
        distance = wp.where(high < blocks, wp.min(distance, BLOCK * float(high) + 0.5 - mean), distance)
        # between two centers, there may be no such block
        return wp.where(distance < 1.0e30, farther(wp.max(distance, half) / deviation, most), 0)

    @wp.func
    def aside_of(root: wp.vec3, u: float, low: float, high: float, most: float):
        """The largest alpha ``u`` px or farther to one side of the mean, between two heights."""
        v = wp.clamp(-root[0] * root[1] / (root[1] * root[1] + root[2] * root[2]) * u, low, high)
        return farther(wp.length(wp.vec2(root[0] * u + root[1] * v, root[2] * v)), most)

    @wp.func
    def add_corners(
        maps: wp.array4d[int], band: int, depth: int, box: wp.vec4i, mean: wp.vec2, conic: wp.vec3, sigma: wp.vec2,
        near: float, most: float, slack: float,
    ):  # fmt: skip
        """Add what lies in tiles of the box that the ellipse, which ends at ``near``, does not touch."""
        root = wp.vec3(wp.sqrt(conic[0]), conic[1] / wp.sqrt(conic[0]), 1.0 / sigma[1])
        half = sigma * wp.sqrt(near)
        slope, width, turn = outline(half[0], half[1], root[0], root[1], root[2])
        for row in range(box[2] // 4, (box[3] + 3) // 4):
            top, bottom = wp.max(4 * row, box[2]), wp.min(4 * row + 4, box[3])
            low, high = float(16 * row) + 0.5 - mean[1], float(16 * row) + 15.5 - mean[1]
            first, last = cut(
                mean[0], mean[1], half[0], half[1], slope, width, turn, float(row), 4 * (maps.shape[3] - 1), 0, -slack
            )  # fmt: skip
            left, right = 4 * (first // TILE), 4 * ((last + TILE) // TILE)
            if left > box[0]:
                amount = aside_of(root, float(4 * left) - 0.5 - mean[0], low, high, most)
                add_box(maps, band, depth, wp.vec4i(box[0], wp.min(left, box[1]), top, bottom), amount)
            if right < box[1]:
                amount = aside_of(root, float(4 * right) + 0.5 - mean[0], low, high, most)
                add_box(maps, band, depth, wp.vec4i(wp.max(right, box[0]), box[1], top, bottom), amount)

    return beyond, add_corners


@once
def make_spread(falloff: FalloffFunctions) -> wp.Kernel:
    """What of each Gaussian lies outside of where the blend looks, and how far its alpha may be off."""
    reach_of = falloff.reach_of
    beyond, add_corners = make_beyond(falloff.value)

    @wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
    def spread(
        first: int,  # band of this slice
        bands: wp.array[int],  # [B + 1] bounds of the bands in the Gaussians
        splats2d: Splats2DView,  # extents where alpha is `faint`
        scales: wp.array[wp.vec3],  # [N]
        rules: Rules,
        begins: wp.array[float],  # [K]
        # out
        maps_out: wp.array4d[int],  # [B or 1, K, rows + 1, columns + 1] differences
        lost_out: wp.array[int],  # [1] Gaussians of which nothing is known
        extents_out: wp.array[wp.vec2],  # [N] where alpha is `seen`
        radii_out: wp.array[int],  # [N]
        errors_out: wp.array[wp.vec3],  # [N]; that of the color is the caller's
    ):
        band = first + wp.tid()
        here = band % maps_out.shape[0]
        for i in range(bands[band], bands[band + 1]):
            radii_out[i] = wp.min(splats2d.radii[i], 0)
            extents_out[i] = wp.vec2(0.0)
            if splats2d.radii[i] > 0:
                mean, conic, opacity = splats2d.means2d[i], splats2d.conics[i], splats2d.opacities[i]
                z = splats2d.depths[i]
                far = reach_of(opacity, rules.faint)
                near = reach_of(opacity, rules.seen)
                sigma = splats2d.extents[i] / wp.sqrt(far)
                half = sigma * wp.sqrt(near)
                size = wp.max(scales[i])
                condition, shift = conditions(rules, mean, conic, sigma, size, z)
                error = alpha_error(rules, condition, shift, wp.max(0.5 * near, 1.0))
                hidden = wp.max(rules.floor, rules.seen) * error * (1.0 + error)  # as exp(e) - 1 is less
                hidden = wp.where(error > 1.0, opacity, hidden)  # nothing is known of its place
                errors_out[i] = wp.vec3(wp.where(error > 1.0, 0.0, error * (1.0 + error)), hidden, errors_out[i][2])
                depth = int(0)
                while depth + 1 < begins.shape[0] and begins[depth + 1] <= z:
                    depth += 1
                outside = rules.floor == 0.0 or rules.square != 0  # whether the ideal has anything there
                ends_at = wp.where(outside, far, near)
                most_error = wp.min(alpha_error(rules, condition, shift, 0.5 * ends_at), 1.0)
                loose = 1.0 + most_error + most_error * most_error  # above its exponential
                margin = wp.min(0.1 * wp.min(sigma), 1.0e-2)
                margin += 1.0e-6 * (wp.max(wp.abs(mean)) + wp.max(half))
                # The blend looks a tenth below a floor. What is as narrow as the margin shows beside it, too.
                unsure = loose > wp.where(rules.floor > 0.0, 1.1, 2.0) or margin > 0.25 * wp.min(sigma)
                if unsure:
                    wp.atomic_add(lost_out, 0, 1)
                counted = outside and not unsure
                most = opacity * loose * brightness(splats2d.colors[i], errors_out[i][2], rules.usual)
                most = most * 1.001 / rules.unit
                slack = wp.vec2(margin, margin)
                alpha = wp.min(rules.seen, opacity)
                if opacity >= rules.seen:
                    radius = wp.ceil(float(splats2d.radii[i]) * wp.sqrt(near / far))
                    radii_out[i] = wp.max(int(wp.min(radius, 1.0e9)), 1)
                    extents_out[i] = half
                    if rules.square != 0:
                        side = square_of(half[0], half[1], conic[0], conic[1], near)
                        half = wp.vec2(side, side)
                else:
                    half = wp.vec2(0.0)
                half = half - slack
                inner = box_of(maps_out, mean, half)
                if counted and opacity >= rules.seen and rules.square == 0:
                    add_corners(maps_out, here, depth, inner, mean, conic, sigma, near, most, margin)
                carried = int(0)  # what the box before counts
                for step in range(BOXES):
                    alpha = wp.where(step < BOXES - 1, wp.max(alpha * SHARE, rules.faint), rules.faint)
                    wider = wp.max(sigma * wp.sqrt(reach_of(opacity, alpha)) * 1.000001, half + slack) + slack
                    if counted:
                        aside = beyond(inner[0], inner[1], maps_out.shape[3] - 1, mean[0], half[0], sigma[0], most)
                        above = beyond(inner[2], inner[3], maps_out.shape[2] - 1, mean[1], half[1], sigma[1], most)
                        outer = box_of(maps_out, mean, wider)
                        add_box(maps_out, here, depth, inner, carried - above)
                        add_box(maps_out, here, depth, wp.vec4i(inner[0], inner[1], outer[2], outer[3]), above - aside)
                        inner, half, carried = outer, wider, aside
                add_box(maps_out, here, depth, inner, carried)

    return spread

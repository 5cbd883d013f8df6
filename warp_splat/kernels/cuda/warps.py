"""Sums and votes of the lanes of a warp; and a warp for a whole tile, of which a lane takes eight pixels.

These lie in blocks of 8 x 4, of which a Gaussian reaches fewer than of pairs of lines: in a million Gaussians on
980 x 545 px, the boxes 32 % instead of 39, the ellipses 28 %.
"""

from typing import Any

import warp as wp

from warp_splat.config import TILE
from warp_splat.kernels.splat import Splat2D

WARP = wp.constant(32)
PIXELS = wp.constant(TILE * TILE // 32)  # of a lane; or warps of a block
ACROSS, DOWN = wp.constant(8), wp.constant(4)  # pixels of a block
COLUMNS, AT_ONCE = wp.constant(10), wp.constant(16)  # of a slot; channels beside the color: registers
vec10 = wp.types.vector(length=10, dtype=float)
vec12 = wp.types.vector(length=12, dtype=float)
vec_channels = wp.types.vector(length=16, dtype=float)
vec_pixels = wp.types.vector(length=TILE * TILE // 32, dtype=float)
mat_pixels = wp.types.matrix(shape=(4, TILE * TILE // 32), dtype=float)  # for red, green, blue, and depth

WARP_OPTIONS = {"enable_backward": False, "block_dim": 32}

#: What lanes exchange: on a GPU by shuffles, in fibers through memory.
_EXCHANGE = """
#if defined(__CUDA_ARCH__)
    auto exchange = [](float x, int bit) { return __shfl_xor_sync(0xffffffffu, x, bit); };
#else
    wp::wp_block_shared<wp::vec_t<WP_TILE_BLOCK_DIM, float>> values;
    auto exchange = [&](float x, int bit) {
        (*values)[thread] = x;
        WP_TILE_SYNC();
        float other = (*values)[thread ^ bit];
        WP_TILE_SYNC();
        return other;
    };
#endif
"""


def _halving(columns: int) -> str:
    """C++ in which a lane keeps one half of its columns in every step, and gives the other for another lane's.

    12 shuffles for ten columns, where sums of whole rows take 50. Tried: a loop, which ptxas left in local memory.
    """
    lines, width = [f"float sum{i} = row[{i}];" for i in range(columns)], columns
    for bit in (16, 8, 4, 2, 1):
        half = (width + 1) // 2
        for i in range(half):
            above = f"sum{i + half}" if i + half < width else "0.0f"
            mine, given = f"thread & {bit} ? {above} : sum{i}", f"thread & {bit} ? sum{i} : {above}"
            lines.append(f"sum{i} = ({mine}) + exchange({given}, {bit});")
        width = half
    return _EXCHANGE + "\n".join(lines) + "return sum0;"


@wp.func_native(_halving(10))
def lane_sum(row: vec10, thread: int) -> float:
    """The sum over the thread's warp of the column that :func:`column_of` names."""
    ...


@wp.func_native(_halving(16))
def lane_sum(row: vec_channels, thread: int) -> float: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return (int)__ballot_sync(0xffffffffu, vote);
#else
    wp::wp_block_shared<wp::vec_t<WP_TILE_BLOCK_DIM, int>> votes;
    (*votes)[thread] = vote;
    WP_TILE_SYNC();
    unsigned bits = 0;
    for (int lane = 0; lane < 32; ++lane)
        bits |= (unsigned)((*votes)[thread / 32 * 32 + lane] != 0) << lane;
    WP_TILE_SYNC();
    return (int)bits;
#endif
""")
def ballot(vote: bool, thread: int) -> int:
    """Which lanes of the thread's warp vote for it: a bit for each."""
    ...


@wp.func
def column_of(thread: int, columns: int):
    """The column of which :func:`lane_sum` tells ``thread`` the sum, of up to sixteen; -1: none."""
    column = int(0)
    width = columns
    left = columns
    bit = int(16)
    while bit > 0:
        half = (width + 1) // 2
        if (thread & bit) != 0:
            column += half
            left -= half
        else:
            left = wp.min(left, half)
        width = half
        bit = bit // 2
    return wp.where(left > 0, column, -1)


@wp.func
def block_sum(row: Any, thread: int):
    """As :func:`lane_sum`, over a block with a thread for each pixel; only its first warp is told."""
    parts = wp.tile(lane_sum(row, thread))
    total = float(0.0)
    if thread < WARP:
        for warp in range(PIXELS):
            total += parts[warp * WARP + thread]
    return total


@wp.func
def across_of(lane: int, pixel: int):
    """Column in the tile of one of a lane's pixels."""
    return (pixel % 2) * ACROSS + lane % ACROSS


@wp.func
def down_of(lane: int, pixel: int):
    """Line in the tile."""
    return (pixel // 2) * DOWN + lane // ACROSS


@wp.func
def blocks_of(splat: Splat2D, z_most: float, left: float, top: float):
    """Which of a lane's pixels, the blocks, the ellipse z <= ``z_most`` touches: a bit for each.

    Farther out alpha is below its least value. In lines of four the ellipse is widest where its widest line is, or
    nearest to that; a block is missed by what is not as wide there. With u and v as of :func:`.splat.exponent`, z is
    their squares' sum, and u at the edge of a block a slope times v more than at v = 0. The margins are far more than
    what rounding adds.
    """
    r = splat.root
    slope = r[1] / r[2]
    turned = wp.sqrt(1.0 + slope * slope)
    reach = wp.sqrt(wp.max(z_most, 0.0) + 1.0e-2) * (1.0 + 1.0e-4)  # of v
    margin = 1.0e-6 * reach * turned
    widest = reach * slope / turned
    most = reach * reach
    touched = int(0)
    for band in range(PIXELS // 2):
        first = (top + float(band * DOWN) - splat.mean[1]) * r[2]
        low = wp.max(first, -reach)
        high = wp.min(first + float(DOWN - 1) * r[2], reach)
        right = wp.clamp(-widest, low, high)
        left_most = wp.clamp(widest, low, high)
        for side in range(2):
            begin = (left + float(side * ACROSS) - splat.mean[0]) * r[0]
            end = begin + float(ACROSS - 1) * r[0]
            near = wp.max(begin + slope * right - margin, 0.0)
            far = wp.min(end + slope * left_most + margin, 0.0)
            outside = near * near + right * right > most or far * far + left_most * left_most > most
            if not (low > high or outside):  # what is not finite misses nothing
                touched |= 1 << (2 * band + side)
    return touched

"""Numbers side by side: what a kernel for one Gaussian or for sixteen, differentiated by Warp, is written with.

A kernel made for 16 lanes fills the CPU's registers; made for 1, it is what a thread of a GPU runs. Operations here
know their derivative, because the generated one is slow in lanes: that of a choice has a branch per lane, and that of a
constant is a sum over the lanes, one after the other (Tried: an adjoint twice as slow), that of a division two more.
What else there is, `+`, `-` and wp.cw_mul, Warp differentiates well. Masks are 1 or 0 and have no derivative.
"""

import functools
from typing import NamedTuple

import warp as wp


class Numbers(NamedTuple):
    """Types and operations for a number of lanes."""

    number: type
    integer: type
    fill: wp.Function  # a float in all lanes, without a gradient
    less: wp.Function  # mask: a < b
    equal: wp.Function  # mask: a == b
    some: wp.Function  # whether a mask is set anywhere
    pick: wp.Function  # a where a mask is set, else b
    root: wp.Function  # square root
    inverse: wp.Function  # 1 / x
    up: wp.Function  # rounded up; no gradient, as all below
    down: wp.Function
    real: wp.Function  # of integers
    whole: wp.Function  # to integers


@functools.cache
def make_numbers(lanes: int) -> Numbers:
    """Operations on vectors of ``lanes`` numbers."""
    number = wp.types.vector(length=lanes, dtype=float)
    integer = wp.types.vector(length=lanes, dtype=int)

    @wp.func
    def fill(value: float):
        return number(value)

    @wp.func_grad(fill)
    def adj_fill(value: float, adj_ret: number):
        pass

    @wp.func
    def less(a: number, b: number):
        r = number()
        for lane in range(lanes):
            r[lane] = wp.where(a[lane] < b[lane], 1.0, 0.0)
        return r

    @wp.func_grad(less)
    def adj_less(a: number, b: number, adj_ret: number):
        pass

    @wp.func
    def equal(a: number, b: number):
        r = number()
        for lane in range(lanes):
            r[lane] = wp.where(a[lane] == b[lane], 1.0, 0.0)
        return r

    @wp.func_grad(equal)
    def adj_equal(a: number, b: number, adj_ret: number):
        pass

    @wp.func
    def some(mask: number):
        s = int(0)  # a sum of floats would be taken in order
        for lane in range(lanes):
            s += int(mask[lane])
        return s > 0

    @wp.func
    def pick(mask: number, a: number, b: number):
        r = number()
        for lane in range(lanes):
            r[lane] = wp.where(mask[lane] > 0.0, a[lane], b[lane])
        return r

    @wp.func_grad(pick)
    def adj_pick(mask: number, a: number, b: number, adj_ret: number):
        zero = number(0.0)
        wp.adjoint[a] += pick(mask, adj_ret, zero)
        wp.adjoint[b] += pick(mask, zero, adj_ret)

    @wp.func
    def root(x: number):
        r = number()
        for lane in range(lanes):
            r[lane] = wp.sqrt(x[lane])
        return r

    @wp.func_grad(root)
    def adj_root(x: number, adj_ret: number):
        wp.adjoint[x] += wp.cw_div(adj_ret, root(x) * 2.0)

    @wp.func
    def inverse(x: number):
        return wp.cw_div(number(1.0), x)

    @wp.func_grad(inverse)
    def adj_inverse(x: number, adj_ret: number):
        r = inverse(x)
        wp.adjoint[x] -= wp.cw_mul(wp.cw_mul(adj_ret, r), r)

    @wp.func
    def up(x: number):
        r = number()
        for lane in range(lanes):
            r[lane] = wp.ceil(x[lane])
        return r

    @wp.func
    def down(x: number):
        r = number()
        for lane in range(lanes):
            r[lane] = wp.floor(x[lane])
        return r

    @wp.func
    def real(x: integer):
        r = number()
        for lane in range(lanes):
            r[lane] = float(x[lane])
        return r

    @wp.func
    def whole(x: number):
        r = integer()
        for lane in range(lanes):
            r[lane] = int(x[lane])
        return r

    return Numbers(number, integer, fill, less, equal, some, pick, root, inverse, up, down, real, whole)


class Rows(NamedTuple):
    """Rows of a few numbers, as they lie in memory, and their columns; the gradient of either is the other.

    Tried: one factory for any width, a column at a time, 80 lines less; projection and adjoint take half as long again.
    """

    row: type
    split: wp.Function  # rows to columns
    join: wp.Function  # columns to rows


@functools.cache
def make_rows2(lanes: int) -> Rows:
    """Rows of two numbers."""
    number = make_numbers(lanes).number
    row = wp.types.vector(length=2 * lanes, dtype=float)

    @wp.func
    def split(rows: row):
        x = number()
        y = number()
        for lane in range(lanes):
            x[lane] = rows[2 * lane]
            y[lane] = rows[2 * lane + 1]
        return x, y

    @wp.func
    def join(x: number, y: number):
        rows = row()
        for lane in range(lanes):
            rows[2 * lane] = x[lane]
            rows[2 * lane + 1] = y[lane]
        return rows

    @wp.func_grad(join)
    def adj_join(x: number, y: number, adj_ret: row):
        adj_x, adj_y = split(adj_ret)
        wp.adjoint[x] += adj_x
        wp.adjoint[y] += adj_y

    return Rows(row, split, join)


@functools.cache
def make_rows3(lanes: int) -> Rows:
    """Rows of three numbers."""
    number = make_numbers(lanes).number
    row = wp.types.vector(length=3 * lanes, dtype=float)

    @wp.func
    def split(rows: row):
        x = number()
        y = number()
        z = number()
        for lane in range(lanes):
            x[lane] = rows[3 * lane]
            y[lane] = rows[3 * lane + 1]
            z[lane] = rows[3 * lane + 2]
        return x, y, z

    @wp.func
    def join(x: number, y: number, z: number):
        rows = row()
        for lane in range(lanes):
            rows[3 * lane] = x[lane]
            rows[3 * lane + 1] = y[lane]
            rows[3 * lane + 2] = z[lane]
        return rows

    @wp.func_grad(split)
    def adj_split(rows: row, adj_x: number, adj_y: number, adj_z: number):
        wp.adjoint[rows] += join(adj_x, adj_y, adj_z)

    @wp.func_grad(join)
    def adj_join(x: number, y: number, z: number, adj_ret: row):
        adj_x, adj_y, adj_z = split(adj_ret)
        wp.adjoint[x] += adj_x
        wp.adjoint[y] += adj_y
        wp.adjoint[z] += adj_z

    return Rows(row, split, join)


@functools.cache
def make_rows4(lanes: int) -> Rows:
    """Rows of four numbers, to be read alone."""
    number = make_numbers(lanes).number
    row = wp.types.vector(length=4 * lanes, dtype=float)

    @wp.func
    def split(rows: row):
        w = number()
        x = number()
        y = number()
        z = number()
        for lane in range(lanes):
            w[lane] = rows[4 * lane]
            x[lane] = rows[4 * lane + 1]
            y[lane] = rows[4 * lane + 2]
            z[lane] = rows[4 * lane + 3]
        return w, x, y, z

    @wp.func
    def join(w: number, x: number, y: number, z: number):
        rows = row()
        for lane in range(lanes):
            rows[4 * lane] = w[lane]
            rows[4 * lane + 1] = x[lane]
            rows[4 * lane + 2] = y[lane]
            rows[4 * lane + 3] = z[lane]
        return rows

    @wp.func_grad(split)
    def adj_split(rows: row, adj_w: number, adj_x: number, adj_y: number, adj_z: number):
        wp.adjoint[rows] += join(adj_w, adj_x, adj_y, adj_z)

    return Rows(row, split, join)

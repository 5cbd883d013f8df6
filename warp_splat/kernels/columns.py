"""Rows of two to four numbers each, as they lie in memory, against one variable for each column, and back."""

import warp as wp

from warp_splat.kernels.simd import LANES, vec16, vec32, vec48, vec64


@wp.func
def columns(row: wp.vec2):
    """The numbers of a row one by one: rows of sixteen Gaussians become columns of sixteen lanes.

    Tried: one function for any width, a column at a time: projection and adjoint take half as long again.
    """
    return row[0], row[1]


@wp.func
def columns(row: vec32):
    x = vec16()
    y = vec16()
    for lane in range(LANES):
        x[lane] = row[2 * lane]
        y[lane] = row[2 * lane + 1]
    return x, y


@wp.func
def columns(row: wp.vec3):
    return row[0], row[1], row[2]


@wp.func
def columns(row: vec48):
    x = vec16()
    y = vec16()
    z = vec16()
    for lane in range(LANES):
        x[lane] = row[3 * lane]
        y[lane] = row[3 * lane + 1]
        z[lane] = row[3 * lane + 2]
    return x, y, z


@wp.func
def columns(row: wp.vec4):
    return row[0], row[1], row[2], row[3]


@wp.func
def columns(row: vec64):
    w = vec16()
    x = vec16()
    y = vec16()
    z = vec16()
    for lane in range(LANES):
        w[lane] = row[4 * lane]
        x[lane] = row[4 * lane + 1]
        y[lane] = row[4 * lane + 2]
        z[lane] = row[4 * lane + 3]
    return w, x, y, z


@wp.func
def rows(x: float, y: float):
    """Columns back to a row."""
    return wp.vec2(x, y)


@wp.func
def rows(x: vec16, y: vec16):
    row = vec32()
    for lane in range(LANES):
        row[2 * lane] = x[lane]
        row[2 * lane + 1] = y[lane]
    return row


@wp.func
def rows(x: float, y: float, z: float):
    return wp.vec3(x, y, z)


@wp.func
def rows(x: vec16, y: vec16, z: vec16):
    row = vec48()
    for lane in range(LANES):
        row[3 * lane] = x[lane]
        row[3 * lane + 1] = y[lane]
        row[3 * lane + 2] = z[lane]
    return row


@wp.func
def rows(w: vec16, x: vec16, y: vec16, z: vec16):
    row = vec64()
    for lane in range(LANES):
        row[4 * lane] = w[lane]
        row[4 * lane + 1] = x[lane]
        row[4 * lane + 2] = y[lane]
        row[4 * lane + 3] = z[lane]
    return row


@wp.func_grad(columns)
def adj_columns(row: vec48, adj_x: vec16, adj_y: vec16, adj_z: vec16):
    wp.adjoint[row] += rows(adj_x, adj_y, adj_z)


@wp.func_grad(columns)
def adj_columns(row: vec64, adj_w: vec16, adj_x: vec16, adj_y: vec16, adj_z: vec16):
    wp.adjoint[row] += rows(adj_w, adj_x, adj_y, adj_z)


@wp.func_grad(rows)
def adj_rows(x: vec16, y: vec16, adj_ret: vec32):
    adj_x, adj_y = columns(adj_ret)
    wp.adjoint[x] += adj_x
    wp.adjoint[y] += adj_y


@wp.func_grad(rows)
def adj_rows(x: vec16, y: vec16, z: vec16, adj_ret: vec48):
    adj_x, adj_y, adj_z = columns(adj_ret)
    wp.adjoint[x] += adj_x
    wp.adjoint[y] += adj_y
    wp.adjoint[z] += adj_z

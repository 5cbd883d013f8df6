"""Columns of a slot, which is the row of gradients of a tile instance, and of what leads to it.

In a slot, XX to YY are the conic's; elsewhere they are mostly the root's. Channels come last.
"""

import warp as wp

MEAN_X, MEAN_Y, XX, XY, YY, OPACITY, CHANNEL = range(7)


@wp.func
def write_geometry(slots: wp.array2d[float], slot: int, mean: wp.vec2, conic: wp.vec3):
    """The columns in front of the opacity's."""
    for i in range(2):
        slots[slot, MEAN_X + i] = mean[i]
    for i in range(3):
        slots[slot, XX + i] = conic[i]

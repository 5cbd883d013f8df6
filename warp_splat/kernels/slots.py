"""Columns of a slot, which is the row of gradients of a tile instance, and of what leads to it.

In a slot, XX to YY are the conic's; elsewhere they are mostly the root's. Channels come last.
"""

MEAN_X, MEAN_Y, XX, XY, YY, OPACITY, CHANNEL = range(7)

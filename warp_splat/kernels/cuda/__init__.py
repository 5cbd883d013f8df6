"""The blend and its adjoints in blocks: a warp, two, or a thread for each pixel, for a tile."""

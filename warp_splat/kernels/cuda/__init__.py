"""The blend and its adjoints in blocks: a thread for each pixel of a tile."""

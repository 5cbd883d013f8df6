"""The blend and its adjoints in blocks: a warp, two, or a thread for each pixel, for a tile."""

from warp_splat.kernels.cuda import adjoint, blend, channels, gather, taped

__all__ = ["adjoint", "blend", "channels", "gather", "taped"]

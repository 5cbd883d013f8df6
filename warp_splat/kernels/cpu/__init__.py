"""The blend and its adjoints in lanes: sixteen pixels at once."""

from warp_splat.kernels.cpu import adjoint, blend, channels, gather, taped

__all__ = ["adjoint", "blend", "channels", "gather", "taped"]

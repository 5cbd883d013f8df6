"""gsplat's function on this renderer, with its arguments and its results."""

from warp_splat.gsplat.call import rasterization

__all__ = ["rasterization"]

"""gsplat's function on this renderer, with its arguments and its results.

And what its strategies call beside it.
"""

from warp_splat.gsplat.call import rasterization
from warp_splat.gsplat.helpers import compute_relocation, quat_scale_to_covar_preci, spherical_harmonics

__all__ = ["compute_relocation", "quat_scale_to_covar_preci", "rasterization", "spherical_harmonics"]

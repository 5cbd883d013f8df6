# heavy_tails.py
from typing import Any

import warp as wp

from warp_splat import Falloff
from warp_splat.kernels.simd import fill, over


@wp.func
def fall(q: Any):
    one = fill(1.0, q)
    return over(one, one + q)


@wp.func
def reach(x: float):
    return x - 1.0


heavy_tails = Falloff(fall, reach)

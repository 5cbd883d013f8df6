"""gsplat's ``rasterization``.

It was written from what the package documents. On a GPU it ran with ``packed``, and refused.
"""

import torch
from gsplat import rasterization

from audit_targets.own import matrices_of

if not torch.cuda.is_available():
    raise ImportError("no CUDA device, which it needs")


def draw(means, quats, scales, opacities, sh, camera, background):
    viewmat, k = (matrix[None].cuda() for matrix in matrices_of(camera))
    given = (tensor.cuda() for tensor in (means, quats, scales, opacities, sh))
    # packed, its default, refuses a background
    settings = {"sh_degree": int(sh.shape[1] ** 0.5) - 1, "backgrounds": background[None].cuda(), "packed": False}
    return rasterization(*given, viewmat, k, camera.width, camera.height, **settings)[0][0]

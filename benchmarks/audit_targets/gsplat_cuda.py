"""gsplat's ``rasterization``.

It was written from what the package documents, and waits for a GPU.
"""

import torch
from gsplat import rasterization

from audit_targets.own import matrices_of

if not torch.cuda.is_available():
    raise ImportError("it needs CUDA, and there is no such device")


def draw(means, quats, scales, opacities, sh, camera, background):
    viewmat, k = (matrix[None].cuda() for matrix in matrices_of(camera))
    given = (tensor.cuda() for tensor in (means, quats, scales, opacities, sh))
    settings = {"sh_degree": int(sh.shape[1] ** 0.5) - 1, "backgrounds": background[None].cuda()}
    return rasterization(*given, viewmat, k, camera.width, camera.height, **settings)[0][0]

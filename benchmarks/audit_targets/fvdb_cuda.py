"""fVDB's ``GaussianSplat3d``.

It was written from what the package documents, and waits for a GPU.
"""

import torch
from fvdb import GaussianSplat3d

from audit_targets.own import matrices_of

if not torch.cuda.is_available():
    raise ImportError("no CUDA device, which it needs")


def draw(means, quats, scales, opacities, sh, camera, background):
    viewmat, k = (matrix[None].cuda() for matrix in matrices_of(camera))
    given = (means, quats, scales.log(), torch.logit(opacities), sh[:, :1], sh[:, 1:])
    model = GaussianSplat3d.from_tensors(*(tensor.cuda() for tensor in given))
    image, alpha = model.render_images(viewmat, k, camera.width, camera.height, 0.01, 1e10)
    return (image + background.cuda() * (1 - alpha))[0]

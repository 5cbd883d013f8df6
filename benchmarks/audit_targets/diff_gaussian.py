"""The rasterizer of Kerbl et al. 2023.

It was written from what the package documents, and waits for a GPU.
"""

import diff_gaussian_rasterization as theirs
import torch

from audit_targets.own import matrices_of

if not torch.cuda.is_available():
    raise ImportError("no CUDA device, which it needs")


def draw(means, quats, scales, opacities, sh, camera, background):
    """By ``GaussianRasterizer``; the principal point is in its matrix of projection."""
    viewmat, k = matrices_of(camera)
    width, height, near, far = camera.width, camera.height, 0.01, 100.0
    projection = torch.zeros(4, 4)
    projection[0, 0], projection[1, 1], projection[3, 2] = 2 * k[0, 0] / width, 2 * k[1, 1] / height, 1
    projection[0, 2], projection[1, 2] = 2 * k[0, 2] / width - 1, 2 * k[1, 2] / height - 1
    projection[2, 2], projection[2, 3] = far / (far - near), -far * near / (far - near)
    settings = theirs.GaussianRasterizationSettings(
        image_height=height, image_width=width, tanfovx=width / (2 * camera.fx), tanfovy=height / (2 * camera.fy),
        bg=background.cuda(), scale_modifier=1.0, viewmatrix=viewmat.T.cuda(),
        projmatrix=(projection @ viewmat).T.contiguous().cuda(), sh_degree=int(sh.shape[1] ** 0.5) - 1,
        campos=torch.tensor(camera.center).float().cuda(), prefiltered=False, debug=False,
    )  # fmt: skip
    named = {"means3D": means, "shs": sh, "opacities": opacities[:, None], "scales": scales, "rotations": quats}
    given = {name: tensor.cuda() for name, tensor in named.items()} | {"means2D": torch.zeros_like(means).cuda()}
    return theirs.GaussianRasterizer(settings)(**given)[0].permute(1, 2, 0)

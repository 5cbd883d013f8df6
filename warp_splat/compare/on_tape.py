"""A workload differentiated on Warp's tape instead of by torch: what that costs beside the pixel loop."""

from __future__ import annotations

import torch
import warp as wp

from warp_splat import tape
from warp_splat.compare.truth import Truth
from warp_splat.compare.workloads import Workload


def differentiate_on_tape(
    workload: Workload, upstream: torch.Tensor | None = None
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """The image [H, W, 3], and the gradients by parameter for the upstream gradient [H, W, 3], or for ones.

    The adjoint is "manual".
    """
    means, quats, scales, opacities, *sh = workload.gaussians
    given = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh": torch.cat(sh, 1)}
    given["background"] = workload.background
    arrays = {name: wp.from_torch(tensor.clone(), requires_grad=True) for name, tensor in given.items()}
    with wp.Tape() as recorded:
        out = tape.rasterize(**arrays, camera=workload.camera, options=workload.options)
    ones = wp.full_like(out.image, wp.vec3(1.0), requires_grad=False)
    recorded.backward(grads={out.image: ones if upstream is None else wp.from_torch(upstream, wp.vec3)})
    return wp.to_torch(out.image, requires_grad=False), {name: wp.to_torch(arrays[name].grad) for name in arrays}


def gradients_on_tape(workload: Workload, truth: Truth) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """As :func:`warp_splat.compare.truth.gradients_of`, but for the 2D means, which the tape does not show."""
    rows, columns = workload.pixels.T
    upstream = workload.background.new_zeros(workload.camera.height, workload.camera.width, 3)
    upstream[rows, columns] = truth.weights.to(upstream)
    image, found = differentiate_on_tape(workload, upstream)
    return image[rows, columns].cpu(), {name: grad.cpu() for name, grad in found.items()}

"""The gradient of a lens's coefficients: of each Gaussian's by Warp (`kernels/project/adj_lens.py`), then summed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.kernels.project.camera_view import CameraView
from warp_splat.kernels.simd import TYPES
from warp_splat.lenses import Lens
from warp_splat.raster.data import Gaussians, Splats2D
from warp_splat.runtime.launch import filled_up, lanes_of, launch, view
from warp_splat.runtime.pool import SMALLEST_SLICE, even_slices
from warp_splat.runtime.sums import in_pairs


def coefficients_gradient(
    camera: Camera,
    cam: CameraView,
    bend: wp.Kernel,
    lanes: int,
    coefficients: torch.Tensor,
    gaussians: Gaussians,
    splats: Splats2D,
    adj: Splats2D,
) -> torch.Tensor:
    """Of the coefficients of the camera's lens, like them; ``bend`` is the kernel of that lens."""
    assert camera.lens is not None
    count, numbers = len(gaussians.means), gaussians.means.new_tensor(camera.lens.numbers)
    inputs = [gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, splats.radii]
    given = [inputs, *([part.means2d, part.conics, part.opacities] for part in (splats, adj))]
    total, whole = np.zeros(len(numbers)), count - count % lanes
    for rows in (slice(0, whole), slice(whole, count)):
        groups = -(-(rows.stop - rows.start) // lanes)
        if not groups:
            continue
        tables = ([filled_up(tensor[rows], groups * lanes) for tensor in table] for table in given)
        total += _bent(cam, bend, lanes, numbers.expand(groups, lanes, -1), *tables)
    return torch.tensor((total[:, None] * _prepared(camera.lens)).sum(0)).to(coefficients)


def _bent(
    cam: CameraView,
    bend: wp.Kernel,
    lanes: int,
    numbers: torch.Tensor,
    inputs: list[torch.Tensor],
    outputs: list[torch.Tensor],
    adj_outputs: list[torch.Tensor],
) -> np.ndarray:
    """The gradients of the formula's coefficients ``numbers`` [M, lanes, K], summed over M groups of Gaussians, [K]."""
    number, integer, row2, row3, row4 = TYPES[lanes]
    numbers = numbers.transpose(1, 2).contiguous()
    adj = torch.zeros_like(numbers)
    shape = numbers.shape if lanes > 1 else numbers.shape[:2]

    def arrays(tensors: list[torch.Tensor], types: Sequence[type]) -> list:
        return [lanes_of(dtype, tensor)[0] for tensor, dtype in zip(tensors, types, strict=True)]

    given = [view(numbers.view(shape), number), *arrays(inputs, (row3, row4, row3, number, integer))]
    adj_given = [view(adj.view(shape), number), None, None, None, None, None]
    found, adj_found = (arrays(tensors, (row2, row3, number)) for tensors in (outputs, adj_outputs))
    bounds = even_slices(len(adj), SMALLEST_SLICE // lanes)
    adjoint = {"adj_inputs": [cam, *adj_given], "adj_outputs": adj_found}
    launch(bend, len(adj), [cam, *given], found, bounds=bounds, device=adj.device, **adjoint)
    finite = adj.isfinite().all(1, keepdim=True)  # a Gaussian whose share is not finite is left out
    sums = in_pairs(torch.where(finite, adj, 0.0))
    return in_pairs(sums.T).cpu().numpy()


def _prepared(lens: Lens) -> np.ndarray:
    """Derivatives of the formula's coefficients by the model's, [K, C], by differences: most are one and the same."""
    columns = []
    for index, value in enumerate(lens.coefficients):
        step = 1e-5 * max(1.0, abs(value))
        ends = [list(lens.coefficients) for _ in range(2)]
        ends[0][index], ends[1][index] = value + step, value - step
        above, below = (np.array(Lens(lens.model, tuple(end)).numbers) for end in ends)
        columns.append((above - below) / (ends[0][index] - ends[1][index]))
    return np.stack(columns, 1)

"""The gradient of a lens's coefficients: of each group's by Warp (`kernels/project/shared.py`), then summed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import warp as wp

from warp_splat.kernels.project.camera_view import CameraView
from warp_splat.kernels.simd import TYPES
from warp_splat.lenses import Lens
from warp_splat.runtime.launch import lanes_of, launch, view
from warp_splat.runtime.pool import SMALLEST_SLICE, even_slices
from warp_splat.runtime.sums import in_pairs


def bent_groups(
    bend: wp.Kernel,
    cam: CameraView,
    lanes: int,
    lens: Lens,
    inputs: Sequence[torch.Tensor],
    outputs: Sequence[torch.Tensor],
    adj_inputs: Sequence[torch.Tensor],
    adj_outputs: Sequence[torch.Tensor],
) -> list[torch.Tensor]:
    """The adjoint of the projection of N Gaussians, N a multiple of ``lanes``, added to ``adj_inputs``.

    Args:
        bend: kernel of the projection through ``lens``.
        cam: camera.
        lanes: Gaussians that a kernel takes at once.
        lens: of the camera.
        inputs: means, quats, scales, opacities.
        outputs: means2d, conics, opacities2d, depths, extents, radii.
        adj_inputs: of all inputs.
        adj_outputs: of all outputs; those of the last two are not read.

    Returns:
        The gradients of the formula's coefficients, of each group, [N / lanes, K].
    """
    number, integer, row2, row3, row4 = TYPES[lanes]
    types_in, types_out = (row3, row4, row3, number), (row2, row3, number, number, row2, integer)

    def arrays(tensors: Sequence[torch.Tensor], types: Sequence[type]) -> list:
        return [lanes_of(dtype, tensor)[0] for tensor, dtype in zip(tensors, types, strict=False)]

    radii = outputs[-1]
    numbers = torch.tensor(lens.numbers, dtype=torch.float32, device=radii.device).repeat(len(radii) // lanes, 1)
    adj = torch.zeros_like(numbers)
    given = [view(numbers, wp.float32), cam, *arrays(inputs, types_in)]
    adj_given = [view(adj, wp.float32), cam, *arrays(adj_inputs, types_in)]
    bounds = even_slices(len(adj), SMALLEST_SLICE // lanes)
    adjoint = {"adj_inputs": adj_given, "adj_outputs": [*arrays(adj_outputs[:4], types_out), None, None]}
    launch(bend, len(adj), given, arrays(outputs, types_out), bounds=bounds, device=adj.device, **adjoint)
    return [adj]


def coefficients_gradient(lens: Lens, found: list[torch.Tensor], coefficients: torch.Tensor) -> torch.Tensor:
    """Of a lens's coefficients, like them; ``found``: what :func:`bent_groups` did."""
    total = in_pairs(torch.cat(found)).cpu().numpy()
    return torch.tensor((total[:, None] * _prepared(lens)).sum(0)).to(coefficients)


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

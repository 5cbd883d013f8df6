"""From 3D Gaussians to 2D ones, differentiable in torch: the kernels of :mod:`warp_splat.kernels.project`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
import warp as wp
from torch.autograd.function import once_differentiable

from warp_splat.camera import Camera
from warp_splat.config import FRUSTUM_MARGIN, RasterOptions
from warp_splat.kernels.lanes import LANES
from warp_splat.kernels.numbers import make_numbers, make_rows2, make_rows3, make_rows4
from warp_splat.kernels.project import UNSEEN, CameraView, make_project, quarantine
from warp_splat.kernels.sh_colors import make_adj_shade, make_shade, mat53, mat73
from warp_splat.raster.bin import views2d
from warp_splat.runtime.launch import SMALLEST_SLICE, even_slices, in_slices, launch, stage, torch_slices, view


def camera_view(camera: Camera, rest: int, options: RasterOptions) -> CameraView:
    """The camera as kernels read it; ``rest`` is the number of coefficients beyond the first."""
    degree = {0: 0, 3: 1, 8: 2, 15: 3}[rest]
    focal, principal = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    size = np.array([camera.width, camera.height])
    margin = FRUSTUM_MARGIN * 0.5 * size / focal
    cam = CameraView()
    cam.rotation = wp.mat33(*camera.rotation.ravel())
    center = camera.center.astype(np.float32)
    cam.center, cam.center_low = wp.vec3(*center), wp.vec3(*(camera.center - center))
    cam.focal, cam.principal, cam.size = wp.vec2(*focal), wp.vec2(*principal), wp.vec2(*size)
    cam.slope_min = wp.vec2(*(-principal / focal - margin))
    cam.slope_max = wp.vec2(*((size - principal) / focal + margin))
    cam.sh_degree = degree if options.sh_degree is None else min(degree, options.sh_degree)
    cam.antialiasing = int(options.antialiasing)
    cam.ellipsoid = int(options.projection == "ellipsoid")
    cam.alpha_min = options.alpha_min
    return cam


def project(
    cam: CameraView,
    inputs: Sequence[torch.Tensor],
    outputs: Sequence[torch.Tensor],
    adj_inputs: Sequence[torch.Tensor] = (),
    adj_outputs: Sequence[torch.Tensor] = (),
) -> None:
    """The geometry of N Gaussians; or, with adjoints, the adjoint of that, added to ``adj_inputs``.

    On a CPU in groups of sixteen: the last ones are filled up with zeros, which are no Gaussians.

    Args:
        cam: camera.
        inputs: means, quats, scales, opacities.
        outputs: means2d, conics, opacities2d, depths, extents, all zero, and radii, all UNSEEN.
        adj_inputs: of all inputs.
        adj_outputs: of the first four outputs.
    """
    count = len(outputs[-1])
    lanes = _lanes(outputs[-1].device)
    whole = count - count % lanes
    tables = (inputs, outputs, adj_inputs, adj_outputs)
    _project_groups(cam, lanes, *([tensor[:whole] for tensor in table] for table in tables))
    if whole < count:
        last = [[_filled_up(tensor[whole:], lanes) for tensor in table] for table in tables]
        _project_groups(cam, lanes, *last)
        for tensor, group in zip(adj_inputs or outputs, last[2] or last[1], strict=True):
            tensor[whole:] = group[: count - whole]


def _filled_up(tensor: torch.Tensor, rows: int) -> torch.Tensor:
    full = tensor.new_zeros(rows, *tensor.shape[1:])
    full[: len(tensor)] = tensor
    return full


def _project_groups(cam, lanes, inputs, outputs, adj_inputs, adj_outputs) -> None:
    """See :func:`project`; N is a multiple of ``lanes``."""
    number, integer, *_ = make_numbers(lanes)
    pair, triple, quadruple = (make_rows(lanes).row for make_rows in (make_rows2, make_rows3, make_rows4))
    types_in, types_out = (triple, quadruple, triple, number), (pair, triple, number, number, pair, integer)

    def in_groups(tensors, types):
        sizes = [wp.types.type_size_in_bytes(dtype) // 4 for dtype in types]
        return [view(t.view(-1, size), dtype) for t, size, dtype in zip(tensors, sizes, types, strict=False)]

    adjoint = {}
    if adj_inputs:
        adj_in, adj_out = in_groups(adj_inputs, types_in), in_groups(adj_outputs, types_out)
        adjoint = {"adj_inputs": [cam, *adj_in], "adj_outputs": [*adj_out, None, None]}
    given, found = [cam, *in_groups(inputs, types_in)], in_groups(outputs, types_out)
    _launch_groups(make_project, len(outputs[-1]), given, found, outputs[-1].device, **adjoint)


def _by_degree(sh_rest: torch.Tensor) -> list:
    """The coefficients of degree 1, 2 and 3; an empty array for each degree that there is not."""
    return [
        view(sh_rest[:, low:high] if sh_rest.shape[1] >= high else sh_rest.new_empty(0, high - low, 3), dtype)
        for dtype, low, high in ((wp.mat33, 0, 3), (mat53, 3, 8), (mat73, 8, 15))
    ]


def _lanes(device: torch.device) -> int:
    """How many Gaussians a kernel takes at once."""
    return 1 if device.type == "cuda" else LANES


def _launch_groups(make_kernel: Callable[[int], wp.Kernel], count: int, inputs, outputs, device, **adjoint) -> None:
    """Launch a kernel for groups of lanes on ``count`` Gaussians."""
    lanes = _lanes(device)
    groups = -(-count // lanes)
    bounds = even_slices(groups, SMALLEST_SLICE // lanes)
    launch(make_kernel(lanes), groups, inputs, outputs, bounds=bounds, device=device, **adjoint)


class Project(torch.autograd.Function):
    """3D to 2D: geometry, whose adjoint Warp generates, and colors."""

    @staticmethod
    def forward(ctx, means, quats, scales, opacities, sh_dc, sh_rest, cam, dropped):
        count, new = means.shape[0], means.new_zeros
        inputs = [tensor.contiguous() for tensor in (means, quats, scales, opacities, sh_dc, sh_rest)]
        outputs = (new(count, 2), new(count, 3), new(count), new(count, 3), new(count), new(count, 2))
        radii = torch.full((count,), int(UNSEEN), dtype=torch.int32, device=means.device)
        project(cam, inputs[:4], [*outputs[:3], *outputs[4:], radii])
        given = [cam, *_views3d([inputs[0], inputs[4][:, 0]]), *_by_degree(inputs[5])]
        _launch_groups(make_shade, count, given, [*views2d(outputs), view(radii, wp.int32)], radii.device)
        ctx.save_for_backward(*inputs, *outputs, radii)
        ctx.cam, ctx.dropped = cam, dropped
        ctx.mark_non_differentiable(outputs[5], radii)
        return *outputs, radii

    @staticmethod
    @once_differentiable
    def backward(ctx, *adj_outputs):
        with stage("adjoint of project"):
            means, quats, scales, opacities, sh_dc, sh_rest, *outputs, radii = ctx.saved_tensors
            adj_outputs = [adj.contiguous() for adj in adj_outputs[:5]]
            adj_colors = adj_outputs.pop(3)
            colored = [torch.empty_like(tensor) for tensor in (means, sh_dc, sh_rest)]
            seen, (centers, *colors) = view(radii, wp.int32), _views3d([means, outputs[3], adj_colors])
            given = [ctx.cam, centers, *_by_degree(sh_rest), seen, *colors]
            stored = [*_views3d([colored[0], colored[1][:, 0]]), *_by_degree(colored[2])]
            _launch_groups(make_adj_shade, len(radii), given, stored, radii.device)
            placed = [colored[0], *(torch.zeros_like(tensor) for tensor in (quats, scales, opacities))]
            geometry = [*outputs[:3], *outputs[4:], radii]
            project(ctx.cam, (means, quats, scales, opacities), geometry, placed, adj_outputs)
            adj_inputs = [*placed, *colored[1:]]
            if not _all_finite(adj_inputs[:5]):  # sh_rest's are multiples of those of sh_dc
                bad = torch.zeros_like(radii)
                types = (wp.vec3, wp.vec4, wp.vec3, wp.float32, wp.vec3, wp.vec3, wp.int32)
                found = [view(tensor, dtype) for tensor, dtype in zip((*adj_inputs, bad), types, strict=True)]
                launch(quarantine, len(radii), [seen], found, device=radii.device)
                ctx.dropped.gaussian_count += torch.count_nonzero(bad)
        wanted = zip(adj_inputs, ctx.needs_input_grad[:6], strict=True)
        return *(adj if wants else None for adj, wants in wanted), None, None


def _all_finite(tensors: Sequence[torch.Tensor]) -> bool:
    """Whether the sums of ``tensors``, N rows each, are finite: then all is. Not asked on a GPU, which would stop."""
    if tensors[0].is_cuda:
        return False
    sums: list[float] = []

    def run(low: int, high: int) -> None:
        sums.extend(float(tensor[low:high].sum()) for tensor in tensors)

    in_slices(run, torch_slices(len(tensors[0])))
    return math.isfinite(sum(sums))


def _views3d(tensors: Sequence[torch.Tensor]) -> list:
    return [view(tensor, wp.vec3) for tensor in tensors]

"""From 3D Gaussians to 2D ones, differentiable in torch: the kernels of :mod:`warp_splat.kernels.project`."""

import importlib
import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
import warp as wp
from torch.autograd.function import once_differentiable

from warp_splat.camera import Camera
from warp_splat.config import FRUSTUM_MARGIN, RasterOptions
from warp_splat.errors import InputError
from warp_splat.kernels.project import Projection
from warp_splat.kernels.project.adj_camera import make_adj_intrinsics, make_adj_pose
from warp_splat.kernels.project.camera_view import CameraView
from warp_splat.kernels.project.lens import LIMIT
from warp_splat.kernels.project.quarantine import quarantine
from warp_splat.kernels.project.shared import UNSEEN, make_project
from warp_splat.kernels.sh_colors import make_adj_rest, make_adj_shade, make_shade
from warp_splat.kernels.simd import TYPES, vec16
from warp_splat.kernels.structs import HarmonicsView
from warp_splat.lenses import Lens
from warp_splat.raster import camera_parameters as cameras
from warp_splat.raster.camera_parameters import CameraParameters
from warp_splat.raster.data import Dropped, Gaussians, Splats2D, falloff_of, plus
from warp_splat.raster.drivers import Driver, driver_of
from warp_splat.runtime.launch import arrays_of, filled_up, launch, pack_struct, view
from warp_splat.runtime.pool import even_slices, in_slices, set_zero, torch_slices
from warp_splat.runtime.timers import stage

Tensors = Sequence[torch.Tensor]


def camera_view(camera: Camera, rest: int, options: RasterOptions, limits: Camera) -> CameraView:
    """The camera as kernels read it; ``rest`` is the number of coefficients beyond the first.

    ``limits``: the camera whose field of view limits the slopes.
    """
    degree = {0: 0, 3: 1, 8: 2, 15: 3}[rest]
    size = np.array([camera.width, camera.height])
    cam = CameraView()
    cam.rotation = wp.mat33(*camera.rotation.ravel())
    center = camera.center.astype(np.float32)
    cam.center, cam.center_low = wp.vec3(*center), wp.vec3(*(camera.center - center))
    cam.focal, cam.principal, cam.size = wp.vec2(camera.fx, camera.fy), wp.vec2(camera.cx, camera.cy), wp.vec2(*size)
    focal, principal = np.array([limits.fx, limits.fy]), np.array([limits.cx, limits.cy])
    margin = FRUSTUM_MARGIN * 0.5 * size / focal
    cam.slope_min = wp.vec2(*(-principal / focal - margin))
    cam.slope_max = wp.vec2(*((size - principal) / focal + margin))
    cam.sh_degree = degree if options.sh_degree is None else min(degree, options.sh_degree)
    cam.antialiasing = int(options.antialiasing)
    cam.alpha_min, cam.near, cam.blur = options.alpha_min, options.near, options.blur
    if camera.lens or camera.shutter or options.projection == "unscented":
        numbers = camera.lens.numbers if camera.lens else ()
        cam.lens = vec16(*numbers, *[0.0] * (LIMIT - len(numbers)), lens_limit(limits))
    return cam


def lens_limit(camera: Camera) -> float:
    """How far from the axis kernels follow the camera's lens: a cosine if it is wide, else a tangent."""
    if camera.lens and camera.lens.family.wide:
        return camera.lens.least_cosine
    slope = (1.0 + FRUSTUM_MARGIN) * math.tan(camera.reach)
    return min(slope, math.tan(camera.lens.limit)) if camera.lens else slope


def projection_of(options: RasterOptions, lens: Lens | None = None, learned: bool = False) -> Projection:
    """The user's own, or that of the file of that name, through the lens if there is one, which may be ``learned``.

    Raises:
        InputError: if it knows no lenses.
    """
    name, own = options.projection, options.projection if isinstance(options.projection, Projection) else None
    module = None if own else importlib.import_module(f"warp_splat.kernels.project.{name}")
    if lens and not hasattr(module, "through"):
        raise InputError(
            "options.projection: expected affine or unscented for a camera with a lens, got "
            f"{'one of your own' if own else name}; choose one of them, or undistort the photographs."
        )
    return own or (module.through(lens.family, learned) if lens else module.PROJECTION)


class Projecting(NamedTuple):
    """One projection: through which camera, by which kernels."""

    camera: Camera
    cam: CameraView
    kernel: wp.Kernel
    bend: wp.Kernel | None  # whose adjoint takes the place of the kernel's where a lens is learned
    driver: Driver
    dropped: Dropped
    here: CameraParameters | None  # those that are learned, on the host if somebody knows them there


def project(
    gaussians: Gaussians,
    camera: Camera | CameraParameters,
    options: RasterOptions,
    driver: Driver | None = None,
    dropped: Dropped | None = None,
) -> Splats2D:
    """What ``camera`` sees of ``gaussians``; ``dropped`` counts the gradients that the adjoint refuses to spread."""
    learned, limits, bend, here = (None, None, None, None), camera, None, None
    driver, reach_of = driver or driver_of(gaussians.means.device), falloff_of(options).reach_of
    if isinstance(camera, CameraParameters):
        learned = (camera.twist, camera.intrinsics, camera.last_twist, camera.coefficients)
        here, limits, camera = camera.here or camera, camera.base, camera.camera
        if learned[-1] is not None and learned[-1].requires_grad:
            bend = make_project(projection_of(options, camera.lens, learned=True), reach_of, driver.lanes, None)
    cam = camera_view(camera, gaussians.sh_rest.shape[1], options, limits)
    projection = projection_of(options, camera.lens)
    kernel = make_project(projection, reach_of, driver.lanes, cameras.exposed_by(camera, options, driver.lanes))
    it = Projecting(camera, cam, kernel, bend, driver, dropped or Dropped(), here)
    return Splats2D(*Project.apply(*gaussians, *learned, it))


def _launch_geometry(
    it: Projecting, inputs: Tensors, outputs: Tensors, adj_inputs: Tensors = (), adj_outputs: Tensors = ()
) -> list[torch.Tensor]:
    """The geometry of N Gaussians; or, with adjoints, the adjoint of that, added to ``adj_inputs``.

    In groups of lanes: the last ones are filled up with zeros, which are no Gaussians.

    Args:
        it: what to launch.
        inputs: means, quats, scales, opacities.
        outputs: means2d, conics, opacities2d, depths, extents, all zero, and radii, all UNSEEN.
        adj_inputs: of all inputs.
        adj_outputs: of all outputs; those of the last two are not read.

    Returns:
        The gradients, of each group, of what all Gaussians share: of a shutter's motion with the quaternions
        (:func:`.camera_parameters.motion_gradient`), or of the formula's coefficients [N / lanes, K]; else nothing.
    """
    lanes, count, motion, shared_grads = it.driver.lanes, len(outputs[-1]), cameras.motion_of(it.camera), []
    number, integer, row2, row3, row4 = TYPES[lanes]
    types_in, types_out = (row3, row4, row3, number), (row2, row3, number, number, row2, integer)
    whole = count - count % lanes
    for part in [slice(0, whole)] + [slice(whole, count)] * (whole < count):
        rows, kernel = -(-(part.stop - part.start) // lanes) * lanes, it.kernel
        given, made, adj_given, adj_made = (
            [filled_up(tensor if whole == count else tensor[part], rows) for tensor in table]
            for table in (inputs, outputs, adj_inputs, adj_outputs)
        )
        arrays, adj_arrays = [it.cam, *arrays_of(types_in, given)], [it.cam, *arrays_of(types_in, adj_given)]
        if it.bend and adj_inputs:
            kernel, numbers = it.bend, given[0].new_tensor(it.camera.lens.numbers).repeat(rows // lanes, 1)
            shared_grads.append(torch.zeros_like(numbers))
            arrays.insert(0, view(numbers, wp.float32))
            adj_arrays.insert(0, view(shared_grads[-1], wp.float32))
        elif motion is not None:
            moved = cameras.with_motion(given[1], motion, lanes)
            arrays[2] = view(moved, row4)
            if adj_inputs:
                shared_grads.append(cameras.with_motion(adj_given[1], 0.0, lanes))
                adj_arrays[2] = view(shared_grads[-1], row4)
        adj_out = [*arrays_of(types_out, adj_made[:4]), None, None]
        adjoint = {"adj_inputs": adj_arrays, "adj_outputs": adj_out} if adj_inputs else {}
        _launch_groups(kernel, lanes, rows, arrays, arrays_of(types_out, made), given[0].device, **adjoint)
        if motion is not None and adj_inputs:
            adj_given[1].copy_(shared_grads[-1][:, 0].reshape_as(adj_given[1]))
        if rows > part.stop - part.start:
            for tensor, group in zip(adj_inputs or outputs, adj_given or made, strict=True):
                tensor[part] = group[: count - whole]
    return shared_grads


def _harmonics(sh_dc: torch.Tensor, sh_rest: torch.Tensor) -> HarmonicsView:
    """The coefficients as kernels take them; an empty array for each degree that there is not."""
    degrees = (
        sh_rest[:, low:high] if sh_rest.shape[1] >= high else sh_rest.new_empty(0, high - low, 3)
        for low, high in ((0, 3), (3, 8), (8, 15))
    )
    return pack_struct(HarmonicsView, **dict(zip(HarmonicsView.vars, (sh_dc[:, 0], *degrees), strict=True)))


def _launch_groups(kernel: wp.Kernel, lanes: int, count: int, inputs, outputs, device, **adjoint) -> None:
    """Launch a kernel for groups of ``lanes`` on ``count`` Gaussians."""
    groups = -(-count // lanes)
    launch(kernel, groups, inputs, outputs, bounds=even_slices(groups, each=lanes), device=device, **adjoint)


class Project(torch.autograd.Function):
    """3D to 2D: geometry, whose adjoint Warp generates, and colors."""

    @staticmethod
    def forward(ctx, means, quats, scales, opacities, sh_dc, sh_rest, *more):
        *learned, it = more
        gaussians = Gaussians(*(tensor.contiguous() for tensor in (means, quats, scales, opacities, sh_dc, sh_rest)))
        count, new, lanes = means.shape[0], means.new_empty, it.driver.lanes
        splats = Splats2D(
            *(new(count, 2), new(count, 3), new(count), new(count, 3), new(count), new(count, 2)),
            radii=means.new_full((count,), int(UNSEEN), dtype=torch.int32),
        )
        set_zero(*splats[:-1])
        _launch_geometry(it, gaussians[:4], _geometry(splats))
        given = [it.cam, view(gaussians.means, wp.vec3), _harmonics(gaussians.sh_dc, gaussians.sh_rest)]
        _launch_groups(make_shade(lanes), lanes, count, given, [splats.view()], means.device)
        ctx.save_for_backward(*gaussians, *splats, *learned)
        ctx.it = it
        ctx.mark_non_differentiable(splats.extents, splats.radii)
        ctx.set_materialize_grads(False)  # of these two, which no one reads, nor of what has no influence
        return tuple(splats)

    @staticmethod
    @once_differentiable
    def backward(ctx, *adj_outputs):
        with stage("adjoint of project"):
            it: Projecting = ctx.it
            *saved, twist, intrinsics, last_twist, coefficients = ctx.saved_tensors  # once: checkpoints forbid more
            given = Gaussians(*saved[: len(Gaussians._fields)])
            splats = Splats2D(*saved[len(given) :])
            wants_twist, wants_intrinsics, wants_last = ctx.needs_input_grad[len(given) : len(given) + 3]
            wants_pose = wants_twist or wants_last
            adj_splats = [
                torch.zeros_like(found) if adj is None else adj.contiguous().resolve_neg()
                for found, adj in zip(splats[:5], adj_outputs[:5], strict=True)
            ]
            adj_splats = Splats2D(*adj_splats, splats.extents, splats.radii)
            lanes, count, device = it.driver.lanes, len(given.means), given.means.device
            seen, rest = view(splats.radii, wp.int32), given.sh_rest
            adj_means, adj_dc, adj_rest = (torch.empty_like(tensor) for tensor in (given.means, given.sh_dc, rest))
            tensors = (given.means, splats.colors, adj_splats.colors)
            means, colors, adj_colors = (view(tensor, wp.vec3) for tensor in tensors)
            inputs = [it.cam, means, _harmonics(given.sh_dc, rest), seen, colors, adj_colors]
            outputs = [view(adj_means, wp.vec3), _harmonics(adj_dc, adj_rest)]
            _launch_groups(make_adj_shade(lanes), lanes, count, inputs, outputs, device)
            if lanes == 1 and rest.shape[1] > 0:
                numbers = [it.cam, means, seen, colors, adj_colors], [view(adj_rest, wp.vec3)]
                launch(make_adj_rest(), adj_rest[..., 0].numel(), *numbers, device=device)
            shapes = [torch.empty_like(tensor) for tensor in (given.quats, given.scales, given.opacities)]
            set_zero(*shapes)
            adj = Gaussians(adj_means, *shapes, adj_dc, adj_rest)
            adj_placed = torch.zeros_like(adj_means) if wants_pose else adj_means  # else added to the colors' part
            outputs, adj_outputs = _geometry(splats), _geometry(adj_splats)
            found = _launch_geometry(it, given[:4], outputs, [adj_placed, *shapes], adj_outputs)
            adj_twist = adj_intrinsics = adj_last = adj_coefficients = None
            peeks = it.driver.peeks or it.camera.shutter is not None  # whose motion the host has looked at
            adj_motion = cameras.motion_gradient([] if it.bend else found, lanes, wants_pose or wants_intrinsics)
            if wants_pose:
                adj_means += adj_placed
                inputs = [it.cam, given.means, given.quats, adj_means, adj_placed, adj.quats]
                sums = cameras.sums_of(make_adj_pose, lanes, 6, inputs)
                by_twist = partial(cameras.twist_gradient, it.camera, it.here, adj_motion)
                adj_twist = cameras.of_sums(partial(by_twist, 0), sums, peeks, twist) if wants_twist else None
                adj_last = cameras.of_sums(partial(by_twist, 1), sums, peeks, last_twist) if wants_last else None
            if wants_intrinsics:
                inputs = [it.cam, given.opacities, *splats[:3], *adj_splats[:3]]  # opacities before antialiasing
                sums = cameras.sums_of(make_adj_intrinsics, lanes, 4, inputs)
                by_intrinsics = partial(cameras.intrinsics_gradient, it.camera, adj_motion[:, 3])
                adj_intrinsics = cameras.of_sums(by_intrinsics, sums, peeks, intrinsics)
            if it.bend:
                adj_coefficients = cameras.coefficients_gradient(it.camera.lens, found, coefficients)
            # a GPU would have to stop for the answer; sh_rest's are multiples of those of sh_dc
            if not (it.driver.peeks and _all_finite(adj[:5])):
                bad = torch.zeros_like(splats.radii)
                types = (wp.vec3, wp.vec4, wp.vec3, wp.float32, wp.vec3, wp.vec3, wp.int32)
                outputs = [view(tensor, dtype) for tensor, dtype in zip((*adj, bad), types, strict=True)]
                launch(quarantine, count, [seen], outputs, device=device)
                it.dropped.gaussian_count = plus(it.dropped.gaussian_count, torch.count_nonzero(bad))
        wanted = zip(adj, ctx.needs_input_grad[: len(adj)], strict=True)
        learned = adj_twist, adj_intrinsics, adj_last, adj_coefficients
        return *(tensor if wants else None for tensor, wants in wanted), *learned, None


def _geometry(splats: Splats2D) -> list[torch.Tensor]:
    """All but the colors."""
    return [splats.means2d, splats.conics, splats.opacities, splats.depths, splats.extents, splats.radii]


def _all_finite(tensors: Tensors) -> bool:
    """Whether the sums of ``tensors``, N rows each, are finite: then all is."""
    sums: list[float] = []

    def run(low: int, high: int) -> None:
        sums.extend(float(tensor[low:high].sum()) for tensor in tensors)

    in_slices(run, torch_slices(len(tensors[0])))
    return math.isfinite(sum(sums))

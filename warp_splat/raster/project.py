"""From 3D Gaussians to 2D ones, differentiable in torch: the kernels of :mod:`warp_splat.kernels.project`."""

import importlib
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
import warp as wp

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
from warp_splat.kernels.simd import vec16
from warp_splat.kernels.structs import HarmonicsView
from warp_splat.lenses import Lens
from warp_splat.raster import camera_parameters as cameras
from warp_splat.raster.camera_parameters import CameraParameters
from warp_splat.raster.data import Dropped, Gaussians, Splats2D, falloff_of, plus
from warp_splat.raster.drivers import Driver, driver_of
from warp_splat.runtime.launch import bind, filled_up, grouped, launch, pack_struct
from warp_splat.runtime.pool import even_slices, slice_by_slice
from warp_splat.runtime.timers import adjoint_of

Tensors = Sequence[torch.Tensor]
Pass = Callable[[int, int], object]  # over groups of Gaussians


def camera_view(camera: Camera, rest: int, options: RasterOptions, limits: Camera) -> CameraView:
    """The camera as kernels read it; ``rest`` is the number of coefficients beyond the first.

    ``limits``: the camera whose field of view limits the slopes.
    """
    degree = {0: 0, 3: 1, 8: 2, 15: 3}[rest]
    size = np.array([camera.width, camera.height])
    cam = CameraView()
    cam.rotation = wp.mat33(*camera.rotation.ravel())
    center = (exact := camera.center).astype(np.float32)
    cam.center, cam.center_low = wp.vec3(*center), wp.vec3(*(exact - center))
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


def _geometry_of(
    it: Projecting, inputs: Tensors, outputs: Tensors, adj_inputs: Tensors = (), adj_outputs: Tensors = ()
) -> tuple[Pass, torch.Tensor | None]:
    """The geometry of N Gaussians; or, with adjoints, the adjoint of that, added to ``adj_inputs``.

    In groups of lanes: the last one is filled up with zeros, which are no Gaussians.

    Args:
        it: what to launch.
        inputs: means, quats, scales, opacities.
        outputs: means2d, conics, opacities2d, depths, extents, all zero, and radii, all UNSEEN.
        adj_inputs: of all inputs.
        adj_outputs: of all outputs; those of the last two are not read.

    Returns:
        A pass over groups; and where it adds the gradients of each of what all Gaussians share: of a shutter's motion
        with the quaternions (:func:`.camera_parameters.motion_gradient`), or of the formula's coefficients
        [N / lanes, K]; else nothing.
    """
    lanes, count, motion, bend = it.driver.lanes, len(outputs[-1]), cameras.motion_of(it.camera), adj_inputs and it.bend
    tables, whole, shared = (inputs, outputs, adj_inputs, adj_outputs), count // lanes, None
    kernel, begin = (bend, 3) if bend else (it.kernel, 2)  # of the kernel's arguments, that of the means
    if bend or (adj_inputs and motion is not None):
        shared = inputs[0].new_zeros(-(-count // lanes), *((len(it.camera.lens.numbers),) if bend else (3, 4 * lanes)))

    def bound(given: Tensors, made: Tensors, adj_given: Tensors, adj_made: Tensors, groups: slice) -> Pass:
        arrays, adj_arrays = ([it.cam, *grouped(kernel, tensors, begin)] for tensors in (given, adj_given))
        grads = None if shared is None else shared[groups]
        if bend:
            arrays.insert(0, grads.new_tensor(it.camera.lens.numbers).repeat(len(grads), 1))
            adj_arrays.insert(0, grads)
        elif motion is not None:
            arrays[2] = cameras.with_motion(given[1], motion, lanes)
            adj_arrays[2:3] = [] if grads is None else [grads]
        adj_out = [*grouped(kernel, adj_made[:4], begin + 4), None, None]
        adjoint = {"adj_inputs": adj_arrays, "adj_outputs": adj_out} if adj_inputs else {}
        launched = bind(kernel, arrays, grouped(kernel, made, begin + 4), made[-1].device, **adjoint)

        def run(low: int, high: int) -> None:
            launched(low, high)
            if grads is not None and not bend:
                quats = adj_given[1][lanes * low : lanes * high]
                quats.copy_(grads[low:high, 0].reshape_as(quats))

        return run

    def run(low: int, high: int) -> None:
        if low < whole:
            most(low, min(high, whole))
        if high > whole:
            ends = [[filled_up(tensor[lanes * whole :], lanes) for tensor in table] for table in tables]
            bound(*ends, slice(whole, None))(0, 1)
            for tensor, group in zip(adj_inputs or outputs, ends[2] or ends[1], strict=True):
                tensor[lanes * whole :] = group[: count - lanes * whole]

    most = bound(*([tensor[: lanes * whole] for tensor in table] for table in tables), slice(0, whole))
    return run, shared


def _harmonics(sh_dc: torch.Tensor, sh_rest: torch.Tensor) -> HarmonicsView:
    """The coefficients as kernels take them; an empty array for each degree that there is not."""
    degrees = (
        sh_rest[:, low:high] if sh_rest.shape[1] >= high else sh_rest.new_empty(0, high - low, 3)
        for low, high in ((0, 3), (3, 8), (8, 15))
    )
    return pack_struct(HarmonicsView, **dict(zip(HarmonicsView.vars, (sh_dc[:, 0], *degrees), strict=True)))


class Project(torch.autograd.Function):
    """3D to 2D: geometry, whose adjoint Warp generates, and colors."""

    @staticmethod
    def forward(ctx, means, quats, scales, opacities, sh_dc, sh_rest, *more):
        *learned, it = more
        gaussians = Gaussians(*(tensor.contiguous() for tensor in (means, quats, scales, opacities, sh_dc, sh_rest)))
        count, new, lanes = means.shape[0], means.new_empty, it.driver.lanes
        splats = Splats2D(
            *(new(count, 2), new(count, 3), new(count), new(count, 3), new(count), new(count, 2)),
            radii=new(count, dtype=torch.int32),
        )
        geometry, _ = _geometry_of(it, gaussians[:4], _geometry(splats))
        given = [it.cam, gaussians.means, _harmonics(gaussians.sh_dc, gaussians.sh_rest)]
        shade = bind(make_shade(lanes), given, [splats.view()], means.device)
        unseen: Pass = lambda low, high: splats.radii[lanes * low : lanes * high].fill_(int(UNSEEN))  # noqa: E731
        groups = even_slices(-(-count // lanes), each=lanes, device=means.device)
        slice_by_slice([_clear(splats[:-1], lanes), unseen, geometry, shade], groups)
        ctx.save_for_backward(*gaussians, *splats, *learned)
        ctx.it = it
        ctx.mark_non_differentiable(splats.extents, splats.radii)
        ctx.set_materialize_grads(False)  # of these two, which no one reads, nor of what has no influence
        return tuple(splats)

    @staticmethod
    @adjoint_of("project")
    def backward(ctx, *adj_outputs):
        it: Projecting = ctx.it
        *saved, twist, intrinsics, last_twist, coefficients = ctx.saved_tensors  # once: checkpoints forbid more
        given = Gaussians(*saved[: len(Gaussians._fields)])
        splats = Splats2D(*saved[len(given) :])
        wants_twist, wants_intrinsics, wants_last = ctx.needs_input_grad[len(given) : len(given) + 3]
        wants_pose = wants_twist or wants_last
        pairs = zip(splats[:5], adj_outputs[:5], strict=True)
        adj_splats = (torch.zeros_like(of) if adj is None else adj.contiguous().resolve_neg() for of, adj in pairs)
        adj_splats = Splats2D(*adj_splats, splats.extents, splats.radii)
        lanes, count, device = it.driver.lanes, len(given.means), given.means.device
        rest = given.sh_rest
        adj_means, adj_dc, adj_rest = (torch.empty_like(tensor) for tensor in (given.means, given.sh_dc, rest))
        colored = [splats.radii, splats.colors, adj_splats.colors]
        inputs = [it.cam, given.means, _harmonics(given.sh_dc, rest), *colored]
        shade = bind(make_adj_shade(lanes), inputs, [adj_means, _harmonics(adj_dc, adj_rest)], device)
        if lanes == 1 and rest.shape[1] > 0:
            inputs = [it.cam, given.means, *colored]
            launch(make_adj_rest(), adj_rest[..., 0].numel(), inputs, [adj_rest], device=device)
        shapes = [torch.empty_like(tensor) for tensor in (given.quats, given.scales, given.opacities)]
        adj = Gaussians(adj_means, *shapes, adj_dc, adj_rest)
        adj_placed = torch.zeros_like(adj_means) if wants_pose else adj_means  # else added to the colors' part
        outputs, adj_outputs = _geometry(splats), _geometry(adj_splats)
        geometry, shared = _geometry_of(it, given[:4], outputs, [adj_placed, *shapes], adj_outputs)
        totals: list[float] = []

        def total(low: int, high: int) -> None:
            rows = slice(lanes * low, lanes * high)
            if wants_pose:
                adj_means[rows] += adj_placed[rows]
            if it.driver.peeks:
                totals.extend(float(tensor[rows].sum()) for tensor in adj[:5])

        groups = even_slices(-(-count // lanes), each=lanes, device=device)
        slice_by_slice([shade, _clear(shapes, lanes), geometry, total], groups)
        adj_twist = adj_intrinsics = adj_last = adj_coefficients = None
        peeks = it.driver.peeks or it.camera.shutter is not None  # whose motion the host has looked at
        adj_motion = cameras.motion_gradient(None if it.bend else shared, lanes, wants_pose or wants_intrinsics)
        if wants_pose:
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
            adj_coefficients = cameras.coefficients_gradient(it.camera.lens, shared, coefficients)
        # a GPU would have to stop for the answer; sh_rest's are multiples of those of sh_dc
        if not (it.driver.peeks and math.isfinite(sum(totals))):
            bad = torch.zeros_like(splats.radii)
            launch(quarantine, count, [splats.radii], [*adj, bad], device=device)
            it.dropped.gaussian_count = plus(it.dropped.gaussian_count, torch.count_nonzero(bad))
        wanted = zip(adj, ctx.needs_input_grad[: len(adj)], strict=True)
        learned = adj_twist, adj_intrinsics, adj_last, adj_coefficients
        return *(tensor if wants else None for tensor, wants in wanted), *learned, None


def _geometry(splats: Splats2D) -> list[torch.Tensor]:
    """All but the colors."""
    return [splats.means2d, splats.conics, splats.opacities, splats.depths, splats.extents, splats.radii]


def _clear(tensors: Tensors, lanes: int) -> Pass:
    """Set rows of dense ``tensors`` to zero; on a GPU in one launch."""
    rows_of = lambda low, high: [tensor[lanes * low : lanes * high] for tensor in tensors]  # noqa: E731
    return lambda low, high: torch._foreach_zero_(rows_of(low, high))  # pyright: ignore[reportPrivateImportUsage]

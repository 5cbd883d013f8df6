"""The renderer between Warp kernels of yours, on one tape: arrays in, arrays out, and no torch to write.

Warp could not derive the loop over a tile's list (docs/adjoints.md). So the launches inside record nothing, and the
renderer stands on the tape as one function with its own adjoint, whichever of the four is asked for.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.errors import InputError
from warp_splat.raster import api, checks
from warp_splat.raster.camera_parameters import CameraParameters
from warp_splat.raster.data import Dropped
from warp_splat.raster.worlds import Worlds
from warp_splat.runtime.launch import open_tape
from warp_splat.runtime.timers import stage

#: What has a gradient, and the type of its elements.
PIXELS = {"image": wp.vec3, "alpha": wp.float32, "depth": wp.float32, "features": wp.float32, "normals": wp.vec3}
PIXELS |= {"median_depth": wp.float32, "strongest_weights": wp.float32}
Twin = tuple[wp.array, torch.Tensor]  # of the caller's, and of torch's graph
#: Dimensions of what one world gives, counting the numbers of an element.
RANKS = {"means": 2, "quats": 2, "scales": 2, "opacities": 1, "sh": 3, "features": 2, "hidden_from": 2, "twist": 1}


@dataclass
class TapeOutput:
    """What :func:`rasterize` returns; H x W pixels, N Gaussians. Where an input has a gradient, pixels have one."""

    image: wp.array  # [H, W] vec3
    alpha: wp.array  # [H, W] float, 1 - transmittance
    depth: wp.array | None  # [H, W] float, world units, expected z (0 where alpha is 0), if asked for
    radii: wp.array  # [N] int, px from the mean to the farthest point where alpha >= alpha_min; 0 if culled
    invalid: int  # Gaussians left out because a quaternion was zero
    dropped: Dropped  # what the adjoint refused to spread
    # if given or asked for: see warp_splat.RenderOutput, whose planes, bound and rounding are not among them
    features: wp.array | None = None  # [H, W, C] float
    normals: wp.array | None = None  # [H, W] vec3
    median_depth: wp.array | None = None  # [H, W] float
    strongest: wp.array | None = None  # [H, W, k] int64
    strongest_weights: wp.array | None = None  # [H, W, k] float


def rasterize(
    means: wp.array,
    quats: wp.array,
    scales: wp.array,
    opacities: wp.array,
    sh: wp.array | tuple[wp.array, wp.array],
    camera: Camera,
    background: wp.array | tuple[float, float, float] = (0.0, 0.0, 0.0),
    adjoint: str = "manual",
    options: RasterOptions | None = None,
    twist: wp.array | None = None,
    intrinsics: wp.array | None = None,
    features: wp.array | None = None,
    hidden_from: wp.array | None = None,
    out: Mapping[str, wp.array] | None = None,
) -> TapeOutput:
    """:func:`warp_splat.rasterize` of Warp's arrays; inside ``with wp.Tape()`` it is recorded, with its adjoint.

    ``tape.backward`` adds to ``.grad`` of every array with ``requires_grad``, the bits that torch would get. It zeroes
    the gradients of the pixels that it has read, as a kernel's own adjoint does, but the values that it reads are those
    of the forward pass: inputs may change in between. What the adjoint needs is kept as long as the tape.

    Args:
        means: centers, [N] vec3 or [N, 3], float32 as all but the last two.
        quats: rotations, [N] quat (Warp's order, w last), or [N] vec4 or [N, 4] (w first).
        scales: standard deviations along the axes, [N] vec3 or [N, 3].
        opacities: [N].
        sh: [N, K] vec3 or [N, K, 3]; or the pair of [N, 1] and [N, K-1].
        camera: where ``twist`` and ``intrinsics`` start.
        background: RGB; an array of 3 numbers may want a gradient.
        adjoint: "manual", "stepwise", "reversible" or "stored".
        options: what to compute.
        twist: see :class:`warp_splat.CameraParameters`, 6 numbers, float32 or float64.
        intrinsics: likewise, fx, fy, cx, cy.
        features: any numbers, [N, C].
        hidden_from: depth of an opaque surface, [H, W]; see :class:`warp_splat.RasterOptions`. No gradient.
        out: arrays to write into instead of new ones, by the names of :class:`TapeOutput`'s pixels; where an input has
            a gradient, they need one.

    Returns:
        A :class:`TapeOutput`.

    Raises:
        InputError: as :func:`warp_splat.rasterize` does, if an argument is no Warp array, or ``out`` names a picture
            that is not drawn.
    """
    given: dict[str, Any] = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
    given |= {"sh[0]": sh[0], "sh[1]": sh[1]} if isinstance(sh, (tuple, list)) and len(sh) == 2 else {"sh": sh}
    if not isinstance(camera, Camera):
        raise InputError(f"camera: expected a Camera, got {type(camera).__name__}; give twist and intrinsics.")
    given |= {"background": background} if isinstance(background, wp.array) else {}
    more = {"twist": twist, "intrinsics": intrinsics, "features": features}
    given |= {name: array for name, array in more.items() if array is not None}
    named = {name: _checked(name, array) for name, array in given.items()}
    if hidden_from is not None:
        surface = wp.to_torch(_checked("hidden_from", hidden_from), requires_grad=False)
        options = replace(checks.check_options(adjoint, options), hidden_from=surface)
    tape = open_tape()
    recorded = tape is not None and any(array.requires_grad for array in named.values())
    with _torch_on(means.device, recorded):
        with stage("tape"):
            leaves = {name: wp.to_torch(array, requires_grad=False) for name, array in named.items()}
            if recorded:  # the adjoint reads them, and simulators reuse their arrays
                for name, array in named.items():
                    leaves[name] = leaves[name].clone().requires_grad_(array.requires_grad)
        found = _render(leaves, named, camera, background, adjoint, options)
        shown = {name: tensor for name in PIXELS if (tensor := getattr(found, name)) is not None}
        rooms = {} if out is None else out if isinstance(out, Mapping) else {type(out).__name__: out}
        if unknown := {name for name, room in rooms.items() if room is not None} - set(shown):
            raise InputError(f"out: expected some of {', '.join(shown)}, got {min(map(str, unknown))!r}; omit it.")
        with stage("tape"):
            pixels = {name: _array(name, tensor, recorded, rooms.get(name)) for name, tensor in shown.items()}
            if recorded:
                inputs = [(array, leaves[name]) for name, array in named.items() if array.requires_grad]
                outputs = [(pixels[name], tensor) for name, tensor in shown.items() if tensor.requires_grad]
                arrays = [array for array, _ in inputs + outputs if array.size]
                tape.record_func(partial(_run_adjoint, inputs, outputs), arrays)
        others = {"strongest": None if found.strongest is None else wp.from_torch(found.strongest)}
        others |= {"invalid": found.invalid, "dropped": found.dropped, "radii": wp.from_torch(found.radii)}
    return TapeOutput(**{"depth": None} | pixels, **others)


def draw_worlds(
    means: wp.array,
    quats: wp.array,
    scales: wp.array,
    opacities: wp.array,
    sh: wp.array,
    counts: Sequence[int],
    camera: Camera,
    options: RasterOptions | None = None,
    hidden_from: wp.array | None = None,
    backdrop: Worlds | None = None,
) -> tuple[dict[str, wp.array], Worlds]:
    """Pictures of W worlds through one camera, forward only, with the bits of :func:`rasterize` and in less time.

    Args:
        means: of all worlds, one after the other, as :func:`rasterize` takes them, like the next four.
        quats: likewise.
        scales: likewise.
        opacities: likewise.
        sh: likewise, one array.
        counts: of each world's Gaussians.
        camera: of all worlds; any but a panorama.
        options: what to compute: the color, depth, the strongest.
        hidden_from: as in :func:`rasterize`, [W, H, W].
        backdrop: what was drawn of a world that stands behind and among each of these, and is numbered first.

    Returns:
        Image, alpha and what else is asked for, by their names, with one more dimension in front, on black; and what
        others take for their backdrop. They share memory: do not write into pictures of a backdrop that is in use.

    Raises:
        InputError: as :func:`rasterize` does.
    """
    given = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh": sh}
    given |= {} if hidden_from is None else {"hidden_from": hidden_from}
    with _torch_on(_checked("means", means).device, False):
        found = {name: wp.to_torch(_checked(name, array), requires_grad=False) for name, array in given.items()}
        found["quats"] = _w_first(found["quats"], quats)
        if hidden_from is not None:
            options = replace(checks.check_options("manual", options), hidden_from=found.pop("hidden_from"))
        worlds = Worlds(list(found.values()), counts, camera, options, backdrop)
        return {name: wp.from_torch(tensor, PIXELS.get(name)) for name, tensor in worlds.pictures.items()}, worlds


def _checked(name: str, array: Any) -> wp.array:
    """``array``. Raises InputError if it is none of Warp's of real numbers; shapes are checked later."""
    kinds = (wp.float32, wp.float64) if name in ("twist", "intrinsics") else (wp.float32,)
    if not isinstance(array, wp.array):
        raise InputError(f"{name}: expected a Warp array, got {type(array).__name__}; rasterize takes torch tensors.")
    if getattr(array.dtype, "_wp_scalar_type_", array.dtype) not in kinds:
        wanted = " or ".join(kind.__name__ for kind in kinds)
        raise InputError(f"{name}: expected an array of {wanted}, got one of {array.dtype.__name__}.")
    return array


def _render(leaves: dict[str, torch.Tensor], named: dict[str, wp.array], camera, background, adjoint, options):
    """:func:`warp_splat.rasterize` of the tensors behind the arrays."""
    quats = _w_first(leaves["quats"], named["quats"])
    sh = leaves["sh"] if "sh" in leaves else (leaves["sh[0]"], leaves["sh[1]"])
    if "background" in leaves:
        background = leaves["background"].flatten()
    if learned := {name: leaves[name].flatten() for name in ("twist", "intrinsics") if name in leaves}:
        camera = CameraParameters(camera, **learned)
    gaussians = (leaves["means"], quats, leaves["scales"], leaves["opacities"], sh)
    return api.rasterize(*gaussians, camera, background, adjoint, options, leaves.get("features"))


def _w_first(quats: torch.Tensor, array: wp.array) -> torch.Tensor:
    """Quaternions of an array, in our order."""
    return quats.roll(1, 1) if issubclass(array.dtype, wp.quatf) else quats


def _run_adjoint(inputs: list[Twin], outputs: list[Twin]) -> None:
    """What the tape calls on its way back."""
    leaves, shown = ([tensor for _, tensor in twins] for twins in (inputs, outputs))
    with _torch_on(outputs[0][0].device, True):
        upstream = [wp.to_torch(array.grad, requires_grad=False) for array, _ in outputs]
        grads = torch.autograd.grad(shown, leaves, upstream, retain_graph=True, allow_unused=True)
        with stage("adjoint of tape"):
            for (array, _), grad in zip(outputs, upstream, strict=True):
                if not array.retain_grad:  # so do Warp's kernels with what they have read
                    grad.zero_()
            for (array, _), grad in zip(inputs, grads, strict=True):
                if grad is not None:
                    wp.to_torch(array.grad, requires_grad=False).add_(grad)


def _array(name: str, tensor: torch.Tensor, requires_grad: bool, room: wp.array | None) -> wp.array:
    """An image in the same memory; or in ``room``, if there is any."""
    if room is None:
        return wp.from_torch(tensor.detach().contiguous(), PIXELS[name], requires_grad=requires_grad)
    target = wp.to_torch(_checked(f"out[{name!r}]", room), requires_grad=False)
    if target.shape != tensor.shape or (requires_grad and not room.requires_grad):
        wanted, found = list(tensor.shape), list(target.shape)
        raise InputError(f"out[{name!r}]: expected {wanted} numbers, with requires_grad on a tape, got {found}.")
    target.copy_(tensor.detach())
    return room


def rasterize_worlds(
    means: wp.array, *gaussians: Any, cameras: Sequence[Camera], out: Mapping[str, wp.array] | None = None, **more: Any
) -> list[TapeOutput]:
    """:func:`rasterize` for several worlds, each through its camera.

    Args:
        means: those of all worlds, or one more dimension in front: [worlds, N].
        gaussians: quats, scales, opacities and sh, likewise.
        cameras: one for each world.
        out: arrays [worlds, H, W] to write into.
        more: what :func:`rasterize` takes besides; ``features``, ``hidden_from`` and ``twist`` likewise.

    Returns:
        A :class:`TapeOutput` for each world.

    Raises:
        InputError: as :func:`rasterize` does.
    """
    names = ("means", "quats", "scales", "opacities", "sh")[: 1 + len(gaussians)]  # others may come by name
    given = dict(zip(names, (means, *gaussians), strict=True)) | more

    def of(world: int, name: str, value: Any, rank: int) -> Any:
        """What of ``value`` is of one world."""
        if isinstance(value, (tuple, list)):
            return tuple(of(world, name, part, rank) for part in value)
        inner = len(getattr(getattr(value, "dtype", None), "_shape_", ()))
        if not isinstance(value, wp.array) or value.ndim + inner <= rank:
            return value
        if len(value) != len(cameras):
            raise InputError(f"{name}: expected one array for each of {len(cameras)} cameras, got {len(value)}.")
        return value[world] if value.ndim > 1 else value[world : world + 1]

    checks.bases_of(cameras)
    found = []
    for world, camera in enumerate(cameras):
        room = {name: of(world, name, array, 0) for name, array in out.items()} if isinstance(out, Mapping) else out
        own = {name: of(world, name, value, RANKS.get(name, 9)) for name, value in given.items()}
        found.append(rasterize(**own, camera=camera, out=room))
    return found


@contextmanager
def _torch_on(device: wp.Device, differentiated: bool) -> Iterator[None]:
    """Torch works where and when Warp's own kernels would, whatever the caller has set."""
    stream = torch.cuda.stream(wp.stream_to_torch(device)) if device.is_cuda else nullcontext()
    with torch.inference_mode(False), torch.set_grad_enabled(differentiated), stream:
        yield

"""What :func:`warp_splat.gsplat.rasterization` demands of its arguments, said in one sentence when it is not met."""

from __future__ import annotations

import math
import numbers
from typing import Any, NamedTuple

import torch

from warp_splat.config import CHANNELS_MOST, TILE
from warp_splat.errors import InputError
from warp_splat.raster.checks import CAMERA_PIXELS_MOST, check_range, is_one_of
from warp_splat.raster.drivers import DRIVERS, driver_of

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
CAMERA_MODELS = ("pinhole", "ortho", "fisheye")
#: What gsplat has and this does not, and what to do instead.
NOT_CARRIED = {
    "distributed": "render in each process by itself",
    "covars": "give quats and scales",
    "with_eval3d": "leave it False: Gaussians are evaluated on the image",
    "ftheta_coeffs": "undistort the photographs",
}
#: Coefficients of lenses: how many there are, by the camera's model.
COEFFICIENTS = {
    "radial_coeffs": {"pinhole": 6, "fisheye": 4},
    "tangential_coeffs": {"pinhole": 2},
    "thin_prism_coeffs": {"pinhole": 4},
}
#: Of rolling shutters: along which axis of the image they read, and whether from its end.
SHUTTERS = {
    "ROLLING_TOP_TO_BOTTOM": (1, False),
    "ROLLING_LEFT_TO_RIGHT": (0, False),
    "ROLLING_BOTTOM_TO_TOP": (1, True),
    "ROLLING_RIGHT_TO_LEFT": (0, True),
}


class Request(NamedTuple):
    """The arguments that are carried, the scenes' dimensions flattened to S."""

    means: torch.Tensor  # [S, N, 3]
    quats: torch.Tensor  # [S, N, 4]
    scales: torch.Tensor  # [S, N, 3]
    opacities: torch.Tensor  # [S, N]
    colors: torch.Tensor  # [S, C or 1, N, D], or [S, C or 1, N, K, 3]
    viewmats: torch.Tensor  # [S, C, 4, 4]
    Ks: torch.Tensor  # [S, C, 3, 3]
    width: int
    height: int
    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float
    sh_degree: int | None
    packed: bool
    backgrounds: torch.Tensor | None  # [S, C, D]
    render_mode: str
    sparse_grad: bool
    absgrad: bool
    rasterize_mode: str
    camera_model: str
    with_ut: bool
    radial_coeffs: torch.Tensor | None  # [S, C, 6 or 4]
    tangential_coeffs: torch.Tensor | None  # [S, C, 2]
    thin_prism_coeffs: torch.Tensor | None  # [S, C, 4]
    rolling_shutter: str  # one of SHUTTERS; empty: all rows at once
    viewmats_rs: torch.Tensor | None  # [S, C, 4, 4], of the last row; those above of the first
    batch: tuple[int, ...] = ()  # the scenes' dimensions


def check_request(request: Request, given: dict[str, Any]) -> Request:
    """The request with flat scenes. Raises InputError for the first argument that is not as it should be."""
    shutter = _check_choices(request, given)
    means, viewmats = request.means, request.viewmats
    if not isinstance(means, torch.Tensor) or means.dim() < 2:
        raise InputError(f"means: expected a tensor [..., N, 3], got {_found(means)}.")
    if not isinstance(viewmats, torch.Tensor) or viewmats.dim() < 3 or viewmats.shape[-3] < 1:
        raise InputError(f"viewmats: expected a tensor [..., C, 4, 4], got {_found(viewmats)}.")
    batch, count, cameras = tuple(means.shape[:-2]), means.shape[-2], viewmats.shape[-3]
    scenes = math.prod(batch)
    shapes = {"means": (count, 3), "quats": (count, 4), "scales": (count, 3), "opacities": (count,)}
    shapes |= {"viewmats": (cameras, 4, 4), "Ks": (cameras, 3, 3)}
    shapes |= {"viewmats_rs": (cameras, 4, 4)} if shutter else {}
    flat = {}
    for name, shape in shapes.items():
        _check_tensor(name, given[name], (*batch, *shape), means.device)
        flat[name] = given[name].reshape(scenes, *shape)
    scales, opacities = flat["scales"].detach(), flat["opacities"].detach()
    check_range("scales", scales, bool((scales < 0).any()), "positive values (activated, not their logarithm)")
    outside = bool(((opacities < 0) | (opacities > 1)).any())
    check_range("opacities", opacities, outside, "values in 0..1 (activated, not logits)")
    for name in ("viewmats", *(["viewmats_rs"] if shutter else [])):
        if not bool(torch.linalg.det(given[name].detach()).all()):
            raise InputError(f"{name}: expected matrices from world to camera, got one that has no inverse.")
    if not bool(flat["Ks"].detach()[..., (0, 1), (0, 1)].all()):
        raise InputError("Ks: expected matrices with focal lengths fx and fy [px], got a singular one; correct it.")
    colors = request.colors
    _check_tensor("colors", colors, None, means.device)
    tail = 1 if request.sh_degree is None else 2
    for shape in ((*batch, count), (*batch, cameras, count)):
        if tuple(colors.shape[:-tail]) == shape:
            per_view = cameras if len(shape) > len(batch) + 1 else 1
            break
    else:
        wanted = "[..., N, D] or [..., C, N, D]" if tail == 1 else "[..., N, K, 3] or [..., C, N, K, 3]"
        raise InputError(f"colors: expected shape {wanted}, got {list(colors.shape)}.")
    least = ((request.sh_degree or 0) + 1) ** 2
    if tail == 2 and (colors.shape[-1] != 3 or colors.shape[-2] < least):
        raise InputError(f"colors: expected {least} or more coefficients of 3 colors, got {list(colors.shape[-2:])}.")
    if tail == 1 and not 1 <= colors.shape[-1] <= CHANNELS_MOST:
        raise InputError(f"colors: expected 1 to {CHANNELS_MOST} channels, got {colors.shape[-1]}.")
    most = driver_of(means.device).channels.at_once - 2  # the depth and alpha are two more
    if request.absgrad and colors.shape[-1] > most:
        raise InputError(f"absgrad: expected at most {most} channels in colors with it, got {colors.shape[-1]}.")
    flat["colors"] = colors.reshape(scenes, per_view, count, *colors.shape[-tail:])
    if request.backgrounds is not None:
        shape = (cameras, colors.shape[-1])
        _check_tensor("backgrounds", request.backgrounds, (*batch, *shape), means.device)
        flat["backgrounds"] = request.backgrounds.reshape(scenes, *shape)
    for name, counts in COEFFICIENTS.items():
        if given[name] is not None:
            shape = (cameras, counts[request.camera_model])
            _check_tensor(name, given[name], (*batch, *shape), means.device)
            flat[name] = given[name].reshape(scenes, *shape)
    return request._replace(**flat, rolling_shutter=shutter, batch=batch)


def _check_choices(request: Request, given: dict[str, Any]) -> str:
    """The shutter's name, if it rolls. Raises InputError for what is not carried, or out of range."""
    for name, instead in NOT_CARRIED.items():
        if given[name] is not None and given[name] is not False:
            raise InputError(f"{name}: warp_splat.gsplat does not carry it; {instead}.")
    shutter = "GLOBAL" if given["rolling_shutter"] is None else getattr(given["rolling_shutter"], "name", None)
    if shutter not in ("GLOBAL", *SHUTTERS):
        wanted = f"None or gsplat's RollingShutterType of {', '.join(SHUTTERS)}"
        raise InputError(f"rolling_shutter: expected {wanted}, got {given['rolling_shutter']!r:.60}.")
    if shutter == "GLOBAL" and given["viewmats_rs"] is not None:
        raise InputError("viewmats_rs: expected None without a rolling_shutter, got some.")
    if shutter != "GLOBAL" and not (given["with_ut"] and given["viewmats_rs"] is not None):
        raise InputError(f"rolling_shutter: expected with_ut=True and viewmats_rs with {shutter}; give both.")
    choices = {"render_mode": RENDER_MODES, "camera_model": CAMERA_MODELS}
    choices["rasterize_mode"] = ("classic", "antialiased")
    for name, values in choices.items():
        if given[name] not in values:
            raise InputError(f"{name}: expected one of {', '.join(values)}, got {given[name]!r:.60}.")
    if given["with_ut"] and request.camera_model == "ortho":
        raise InputError("camera_model: expected pinhole or fisheye where with_ut is True, got 'ortho'.")
    for name, counts in COEFFICIENTS.items():
        if given[name] is not None and not (given["with_ut"] and request.camera_model in counts):
            models = " or ".join(counts)
            raise InputError(f"{name}: expected None without with_ut=True and camera_model {models}, got coefficients.")
    for name in ("width", "height", "channel_chunk"):
        if isinstance(given[name], bool) or not isinstance(given[name], numbers.Integral) or given[name] < 1:
            raise InputError(f"{name}: expected a whole number, at least 1, got {given[name]!r:.60}.")
    if given["width"] * given["height"] > CAMERA_PIXELS_MOST:
        size = f"{given['width']} x {given['height']}"
        raise InputError(f"width, height: expected at most {CAMERA_PIXELS_MOST} pixels, got {size}; render smaller.")
    if given["tile_size"] != TILE:
        raise InputError(f"tile_size: expected {TILE}, got {given['tile_size']!r:.60}.")
    for name in ("near_plane", "far_plane", "radius_clip", "eps2d"):
        if not isinstance(given[name], numbers.Real) or not float(given[name]) >= 0.0:
            raise InputError(f"{name}: expected a number, at least 0, got {given[name]!r:.60}.")
    degree = request.sh_degree
    if isinstance(degree, bool) or not is_one_of(degree, (None, *range(5))):
        raise InputError(f"sh_degree: expected 0 to 4 or None, got {degree!r:.60}.")
    return shutter.removeprefix("GLOBAL")


def _check_tensor(name: str, tensor: Any, shape: tuple[int, ...] | None, device: torch.device) -> None:
    if not isinstance(tensor, torch.Tensor) or (shape is not None and tuple(tensor.shape) != shape):
        wanted = "a tensor" if shape is None else f"a tensor {list(shape)}"
        raise InputError(f"{name}: expected {wanted}, got {_found(tensor)}.")
    if tensor.layout != torch.strided:
        raise InputError(f"{name}: expected a dense tensor, got one that is sparse; convert it with .to_dense().")
    if tensor.dtype != torch.float32:
        raise InputError(f"{name}: expected float32, got {str(tensor.dtype).removeprefix('torch.')}.")
    if tensor.device != device or device.type not in DRIVERS:
        raise InputError(f"{name}: expected a tensor on one CPU or NVIDIA GPU with the means, got {tensor.device}.")
    if not bool(tensor.detach().isfinite().all()):
        raise InputError(f"{name}: expected finite numbers, got some that are not.")


def _found(value: Any) -> str:
    return str(list(value.shape)) if isinstance(value, torch.Tensor) else type(value).__name__

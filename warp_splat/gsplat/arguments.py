"""What :func:`warp_splat.gsplat.rasterization` demands of its arguments, said in one sentence when it is not met."""

import math
import numbers
from types import SimpleNamespace
from typing import Any

import torch

from warp_splat.config import CHANNELS_MOST
from warp_splat.errors import InputError
from warp_splat.raster.checks import CAMERA_PIXELS_MOST, check_choice, check_opacities, check_tensor, is_one_of
from warp_splat.raster.drivers import driver_of

CHOICES = {
    "render_mode": ("RGB", "D", "ED", "RGB+D", "RGB+ED"),
    "camera_model": ("pinhole", "ortho", "fisheye"),
    "rasterize_mode": ("classic", "antialiased"),
}
#: What gsplat has and this does not, and what to do instead.
NOT_CARRIED = {
    "distributed": "render in each process by itself",
    "with_eval3d": "leave it False: Gaussians are evaluated on the image",
    "ftheta_coeffs": "undistort the photographs",
}
#: Coefficients of lenses: how many there are, by the camera's model.
COEFFICIENTS = {
    "radial_coeffs": {"pinhole": 6, "fisheye": 4},
    "tangential_coeffs": {"pinhole": 2},
    "thin_prism_coeffs": {"pinhole": 4},
}
OPTIONAL = ("covars", "viewmats_rs", "backgrounds", *COEFFICIENTS)
#: Of rolling shutters: along which axis of the image they read, and whether from its end.
SHUTTERS = {
    "ROLLING_TOP_TO_BOTTOM": (1, False),
    "ROLLING_LEFT_TO_RIGHT": (0, False),
    "ROLLING_BOTTOM_TO_TOP": (1, True),
    "ROLLING_RIGHT_TO_LEFT": (0, True),
}


class Request(SimpleNamespace):
    """The arguments of :func:`warp_splat.gsplat.rasterization` by their names, and of the shapes that it tells.

    Once checked, the scenes' dimensions are flattened to one, S, and kept as ``batch``; colors are [S, C or 1, N, ...];
    ``rolling_shutter`` is one of SHUTTERS, or empty: all rows at once.
    """


def check_request(request: Request) -> Request:
    """The request with flat scenes. Raises InputError for the first argument that is not as it should be."""
    given, shutter = vars(request), _check_choices(request)
    means, viewmats, colors = request.means, request.viewmats, request.colors
    if not isinstance(means, torch.Tensor) or means.dim() < 2:
        raise InputError(f"means: expected a tensor [..., N, 3], got {_found(means)}.")
    if not isinstance(viewmats, torch.Tensor) or viewmats.dim() < 3 or viewmats.shape[-3] < 1:
        raise InputError(f"viewmats: expected a tensor [..., C, 4, 4], got {_found(viewmats)}.")
    batch, count, cameras = tuple(means.shape[:-2]), means.shape[-2], viewmats.shape[-3]
    if 0 in batch:
        raise InputError(f"means: expected a scene or more, got {list(means.shape)}.")
    if request.covars is not None:  # then these are ignored
        given = given | {"quats": means.new_ones(*batch, count, 4), "scales": means.new_ones(*batch, count, 3)}
    _check_tensor("colors", colors, getattr(colors, "shape", ("...", "N", "D")), means.device)
    per_view = _check_colors(request, batch, count, cameras)
    shapes: dict[str, tuple[int, ...]] = {
        "means": (count, 3),
        "quats": (count, 4),
        "scales": (count, 3),
        "covars": (count, 3, 3),
        "opacities": (count,),
        "viewmats": (cameras, 4, 4),
        "viewmats_rs": (cameras, 4, 4),
        "Ks": (cameras, 3, 3),
        "backgrounds": (cameras, colors.shape[-1]),
        **{name: (cameras, counts.get(request.camera_model, 0)) for name, counts in COEFFICIENTS.items()},
    }
    # backgrounds are of the colors
    flat: dict[str, Any] = {"backgrounds": None} if request.render_mode in ("D", "ED") else {}
    for name, shape in shapes.items():
        if name not in flat and (given[name] is not None or name not in OPTIONAL):
            _check_tensor(name, given[name], (*batch, *shape), means.device)
            flat[name] = given[name].reshape(math.prod(batch), *shape)
    check_opacities(flat["opacities"].detach())
    for name in ("viewmats", "viewmats_rs"):
        if name in flat and not bool(torch.linalg.det(flat[name].detach()).all()):
            raise InputError(f"{name}: expected matrices from world to camera, got one that has no inverse.")
    if not bool(flat["Ks"].detach()[..., (0, 1), (0, 1)].all()):
        raise InputError("Ks: expected matrices with focal lengths fx and fy [px], got a singular one; correct it.")
    flat["colors"] = colors.reshape(math.prod(batch), cameras**per_view, *colors.shape[len(batch) + per_view :])
    flat |= {name: int(given[name]) for name in ("width", "height")}
    return Request(**(given | flat | {"rolling_shutter": shutter, "batch": batch}))


def _check_colors(request: Request, batch: tuple[int, ...], count: int, cameras: int) -> bool:
    """Whether each camera has its own."""
    colors = request.colors
    tail = 1 if request.sh_degree is None else 2
    per_view = tuple(colors.shape[:-tail]) == (*batch, cameras, count)
    if not per_view and tuple(colors.shape[:-tail]) != (*batch, count):
        wanted = "[..., N, D] or [..., C, N, D]" if tail == 1 else "[..., N, K, 3] or [..., C, N, K, 3]"
        raise InputError(f"colors: expected shape {wanted}, got {list(colors.shape)}.")
    least = ((request.sh_degree or 0) + 1) ** 2
    if tail == 2 and (colors.shape[-1] != 3 or colors.shape[-2] < least):
        raise InputError(f"colors: expected {least} or more coefficients of 3 colors, got {list(colors.shape[-2:])}.")
    if tail == 1 and not 1 <= colors.shape[-1] <= CHANNELS_MOST:
        raise InputError(f"colors: expected 1 to {CHANNELS_MOST} channels, got {colors.shape[-1]}.")
    most = driver_of(colors.device).kernels.channels.AT_ONCE - 2  # the depth and alpha are two more
    if request.absgrad and colors.shape[-1] > most:
        raise InputError(f"absgrad: expected at most {most} channels in colors with it, got {colors.shape[-1]}.")
    return per_view


def _check_choices(request: Request) -> str:
    """The shutter's name, if it rolls. Raises InputError for what is not carried, or out of range."""
    given = vars(request)
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
    for name, values in CHOICES.items():
        check_choice(name, given[name], values)
    if given["with_ut"] and given["covars"] is not None:
        raise InputError("covars: expected None where with_ut is True; give quats and scales.")
    if given["with_ut"] and request.camera_model == "ortho":
        raise InputError("camera_model: expected pinhole or fisheye where with_ut is True, got 'ortho'.")
    for name, counts in COEFFICIENTS.items():
        if given[name] is not None and not (given["with_ut"] and request.camera_model in counts):
            models = " or ".join(counts)
            raise InputError(f"{name}: expected None without with_ut=True and camera_model {models}, got coefficients.")
    for name in ("width", "height", "channel_chunk", "tile_size"):
        if isinstance(given[name], bool) or not isinstance(given[name], numbers.Integral) or given[name] < 1:
            raise InputError(f"{name}: expected a whole number, at least 1, got {given[name]!r:.60}.")
    if int(given["width"]) * int(given["height"]) > CAMERA_PIXELS_MOST:
        size = f"{given['width']} x {given['height']}"
        raise InputError(f"width, height: expected at most {CAMERA_PIXELS_MOST} pixels, got {size}; render smaller.")
    for name in ("near_plane", "far_plane", "radius_clip", "eps2d"):
        if not isinstance(given[name], numbers.Real) or not float(given[name]) >= 0.0:
            raise InputError(f"{name}: expected a number, at least 0, got {given[name]!r:.60}.")
    if isinstance(request.sh_degree, (bool, float)) or not is_one_of(request.sh_degree, (None, *range(5))):
        raise InputError(f"sh_degree: expected 0 to 4 or None, got {request.sh_degree!r:.60}.")
    return shutter.removeprefix("GLOBAL")


def _check_tensor(name: str, tensor: Any, shape: tuple[int, ...], device: torch.device) -> None:
    check_tensor(name, tensor, shape, device)
    if not bool(tensor.detach().isfinite().all()):
        raise InputError(f"{name}: expected finite numbers, got some that are not.")


def _found(value: Any) -> str:
    return str(list(value.shape)) if isinstance(value, torch.Tensor) else type(value).__name__

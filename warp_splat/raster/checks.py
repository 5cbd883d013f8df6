"""What :func:`warp_splat.rasterize` demands of its arguments, said in one sentence when it is not met."""

import numbers
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import torch

from warp_splat import config
from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.errors import InputError, reason_of
from warp_splat.kernels.falloff import Falloff
from warp_splat.kernels.project import Projection
from warp_splat.raster.camera_parameters import CameraParameters
from warp_splat.raster.data import Gaussians
from warp_splat.raster.drivers import DRIVERS
from warp_splat.runtime.devices import memory_explained
from warp_splat.runtime.launch import send

ROUNDING = 1e-5  # by which an opacity may lie above 1; alpha is clamped anyway
CAMERA_PIXELS_MOST = 2**32  # 80 GiB of image, alpha and what the adjoint reads; kernels number tiles with 32 bits


def check_camera(camera: Camera | CameraParameters) -> Camera:
    """The camera, or the base of one that learns. Raises InputError if it is neither, or its image absurdly large."""
    camera = camera.base if isinstance(camera, CameraParameters) else camera
    if not isinstance(camera, Camera):
        raise InputError(f"camera: expected a warp_splat.Camera, got {type(camera).__name__}.")
    if camera.width * camera.height > CAMERA_PIXELS_MOST:
        most, size = CAMERA_PIXELS_MOST, f"{camera.width} x {camera.height}"
        raise InputError(f"camera: expected at most {most} pixels, got {size}; resize it with .resized().")
    return camera


def bases_of(cameras: Sequence[Camera | CameraParameters]) -> list[Camera]:
    """The cameras, or their bases. Raises InputError if they are no sequence, or as :func:`check_camera` does."""
    if not isinstance(cameras, Sequence):
        raise InputError(f"cameras: expected a sequence of warp_splat.Camera, got {type(cameras).__name__}.")
    return [check_camera(camera) for camera in cameras]


@contextmanager
def explained(options: RasterOptions, means: torch.Tensor, cameras: Iterable[Camera]) -> Iterator[None]:
    """Turn into an InputError what memory that runs out says, and Warp of functions of the user's own."""
    advice = "render smaller images (Camera.resized) or fewer Gaussians"
    try:
        with memory_explained(means.device, means, cameras, advice):
            yield
    except Exception as error:
        words, functions = str(error.args[:1]), {"projection": options.projection, "falloff": options.falloff}
        own = [f"options.{name}" for name, value in functions.items() if not isinstance(value, str | None)]
        if not own or not any(found in words for found in ("while parsing function", "kernel build failed")):
            raise
        reason = reason_of("; ".join(str(error.args[0]).split("\n;")[-2:]))
        raise InputError(
            f"{' and '.join(own)}: expected functions that Warp compiles, but it says: {reason}; see docs/extending.md."
        ) from error


def is_one_of(value: object, choices: Collection) -> bool:
    """Whether ``choices`` has it; also for what cannot be compared with them, such as an array."""
    return (value is None or isinstance(value, (str, numbers.Real))) and value in choices


def check_choice(name: str, value: object, choices: Collection) -> None:
    """Raise InputError if ``value`` is none of ``choices``."""
    if not is_one_of(value, choices):
        raise InputError(f"{name}: expected one of {', '.join(map(str, choices))}, got {value!r:.80}.")


def check_options(adjoint: str, options: RasterOptions | None) -> RasterOptions:
    """The options to use, numbers as Python's. Raises InputError for an unknown adjoint or option."""
    check_choice("adjoint", adjoint, config.ADJOINTS)
    options = RasterOptions() if options is None else options
    if not isinstance(options, RasterOptions):
        raise InputError(f"options: expected a warp_splat.RasterOptions, got {type(options).__name__}.")
    given = vars(options)
    if not is_one_of(options.sh_degree, (None, 0, 1, 2, 3)):
        raise InputError(f"options.sh_degree: expected 0, 1, 2, 3 or None, got {options.sh_degree!r}.")
    if not isinstance(options.projection, Projection) and not is_one_of(options.projection, config.PROJECTIONS):
        wanted = f"one of {', '.join(config.PROJECTIONS)} or a warp_splat.kernels.project.Projection"
        raise InputError(f"options.projection: expected {wanted}, got {options.projection!r}.")
    for name, choices in (("extent", config.EXTENTS), ("exp_degree", config.EXP_DEGREES), ("of", config.BOUNDS_OF)):
        check_choice(f"options.{name}", given[name], choices)
    if not (options.falloff is None or isinstance(options.falloff, Falloff)):
        raise InputError(f"options.falloff: expected a warp_splat.Falloff or None, got {options.falloff!r:.80}.")
    for name in ("depth", "antialiasing", "median_depth", "normals", "bound"):
        if not isinstance(given[name], bool):
            raise InputError(f"options.{name}: expected True or False, got {given[name]!r}.")
    for name in ("alpha_min", "t_min"):
        if not (isinstance(given[name], numbers.Real) and 0.0 <= float(given[name]) < 1.0):
            raise InputError(f"options.{name}: expected a number from 0 to below 1, got {given[name]!r}.")
    for name, low, high in (("alpha_max", 0.0, 0.9999), ("near", 1e-6, 1e6), ("blur", 1e-6, 1e6)):
        value = given[name]
        if isinstance(value, bool) or not (isinstance(value, numbers.Real) and low <= float(value) <= high):
            raise InputError(f"options.{name}: expected a number from {low:g} to {high:g}, got {value!r:.60}.")
    steps = options.max_steps
    if steps is not None and not (isinstance(steps, numbers.Integral) and int(steps) >= 0):
        raise InputError(f"options.max_steps: expected a whole number, at least 0, or None, got {steps!r}.")
    most = options.strongest
    if isinstance(most, bool) or not (isinstance(most, numbers.Integral) and 0 <= int(most) <= config.STRONGEST_MOST):
        raise InputError(f"options.strongest: expected a whole number, 0 to {config.STRONGEST_MOST}, got {most!r}.")
    whole, kinds = ("strongest", "sh_degree", "exp_degree", "max_steps"), {}
    kinds |= dict.fromkeys(whole, int) | dict.fromkeys(("alpha_min", "alpha_max", "t_min", "near", "blur"), float)
    return replace(options, **{name: kind(given[name]) for name, kind in kinds.items() if given[name] is not None})


def check_hidden_from(options: RasterOptions, camera: Camera, device: torch.device) -> None:
    """Raise InputError if the surface that hides is not one depth for each pixel of ``camera``, or beside a bound."""
    if options.hidden_from is not None:
        check_tensor("options.hidden_from", options.hidden_from, (camera.height, camera.width), device)
        if options.bound or options.tolerance is not None:
            raise InputError("options.hidden_from: expected neither bound nor tolerance beside it; leave one out.")


def check_tolerance(options: RasterOptions, features: object = None) -> None:
    """Raise InputError if the tolerance is no positive number, or if it asks for what only a single pass gives."""
    if (tolerance := options.tolerance) is None:
        return
    if isinstance(tolerance, torch.Tensor) and not tolerance.is_complex():
        _check_place("options.tolerance", tolerance, None)
    elif isinstance(tolerance, bool) or not isinstance(tolerance, numbers.Real):
        raise InputError(f"options.tolerance: expected a number or a tensor [H, W], got {type(tolerance).__name__}.")
    if not bool(torch.as_tensor(tolerance > 0.0).all()):  # pyright: ignore[reportOperatorIssue]
        raise InputError(f"options.tolerance: expected numbers above 0, got {tolerance!r:.60}.")
    beside = ("normals", "median_depth", "strongest", "max_steps")
    given = [name for name in beside if getattr(options, name) not in (False, 0, None)]
    given += ["features"] * (features is not None) + ["extent 'square'"] * (options.extent == "square")
    if given:
        raise InputError(f"options.tolerance: expected none of {', '.join(given)} beside it; leave one of them out.")


def check_gaussians(means, quats, scales, opacities, sh) -> Gaussians:
    """The arguments as the renderer reads them.

    Raises:
        InputError: naming the first argument whose type, shape, dtype, device or range is not as it should be.
    """
    check_tensor("means", means, ("N", 3), None)
    count, device = means.shape[0], means.device
    check_tensor("quats", quats, (count, 4), device)
    check_tensor("scales", scales, (count, 3), device)
    check_tensor("opacities", opacities, (count,), device)
    if isinstance(sh, (tuple, list)) and len(sh) == 2:
        sh_dc, sh_rest = sh
        check_tensor("sh[0]", sh_dc, (count, 1, 3), device)
        check_tensor("sh[1]", sh_rest, (count, "K - 1", 3), device)
    else:
        check_tensor("sh", sh, (count, "K", 3), device)
        sh_dc, sh_rest = sh[:, :1], sh[:, 1:]
    if (found := sh_dc.shape[1] + sh_rest.shape[1]) not in (1, 4, 9, 16):
        raise InputError(f"sh: expected 1, 4, 9 or 16 coefficients (degree 0 to 3), got {found}.")
    named = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh": sh_dc, "sh ": sh_rest}
    finite = torch.stack([tensor.detach().sum() for tensor in named.values()]).isfinite().all()
    within = (scales > 0).all() & (opacities.clamp(0, 1 + ROUNDING) == opacities).all()
    if not bool(finite & within):  # one answer, for which a GPU is waited for; now what is wrong
        for name, tensor in named.items():
            _check_finite(name.strip(), tensor.detach())
        check_range("scales", scales, bool((scales <= 0).any()), "positive values (activated, not their logarithm)")
        check_opacities(opacities)
    return Gaussians(*(_dense(tensor) for tensor in (means, quats, scales, opacities, sh_dc, sh_rest)))


def check_features(features: torch.Tensor, means: torch.Tensor) -> None:
    """Raise InputError if ``features`` are not a number of finite channels for each of ``means``."""
    check_tensor("features", features, (means.shape[0], "C"), means.device)
    if not 1 <= features.shape[1] <= config.CHANNELS_MOST:
        raise InputError(f"features: expected 1 to {config.CHANNELS_MOST} channels, got {features.shape[1]}.")
    _check_finite("features", features.detach())


def check_tensor(name: str, tensor, shape: tuple[int | str, ...], device: torch.device | None) -> None:
    """Raise InputError if ``tensor`` is no dense float32 of a shape and device; None: of any with a driver."""
    wanted = f"[{', '.join(map(str, shape))}]"
    if not isinstance(tensor, torch.Tensor):
        raise InputError(f"{name}: expected a float32 torch tensor {wanted}, got {type(tensor).__name__}.")
    sides = zip(shape, tensor.shape, strict=False)
    if tensor.dim() != len(shape) or any(a != b for a, b in sides if not isinstance(a, str)):
        raise InputError(f"{name}: expected shape {wanted}, got {list(tensor.shape)}.")
    if tensor.dtype != torch.float32:
        raise InputError(
            f"{name}: expected float32, got {str(tensor.dtype).removeprefix('torch.')}; convert it with .float()."
        )
    _check_place(name, tensor, device)


def _check_place(name: str, tensor: torch.Tensor, device: torch.device | None) -> None:
    """Raise InputError if ``tensor`` is sparse, without a driver, or on another device than a given one."""
    if tensor.device.type not in DRIVERS:
        raise InputError(
            f"{name}: expected a tensor on the CPU or an NVIDIA GPU, got one on {tensor.device}; move it with .cpu()."
        )
    if tensor.layout != torch.strided:
        raise InputError(f"{name}: expected a dense tensor, got one that is sparse; convert it with .to_dense().")
    if device is not None and tensor.device != device:
        raise InputError(f"{name}: expected a tensor on {device}, as the means, got one on {tensor.device}.")


def check_background(background, device: torch.device) -> torch.Tensor:
    """The background as a tensor [3] on ``device``. Raises InputError if it is not three finite numbers there."""
    if not (given := isinstance(background, torch.Tensor)):
        try:
            background = torch.tensor([float(value) for value in background], dtype=torch.float32, device="cpu")
        except (TypeError, ValueError, OverflowError):
            raise InputError(f"background: expected three numbers or a tensor [3], got {background!r:.80}.") from None
    _check_place("background", background, device if given else None)
    if background.shape != (3,) or background.dtype != torch.float32 or not bool(torch.isfinite(background).all()):
        raise InputError(
            f"background: expected three finite numbers (a tensor: float32 [3]), got {background.dtype} "
            f"{list(background.shape)}: {background.tolist()}."
        )
    return _dense(background) if given else send(background, device)


def check_opacities(opacities: torch.Tensor) -> None:
    """Raise InputError if one lies outside of 0..1 by more than rounding."""
    outside = bool(((opacities < 0) | (opacities > 1 + ROUNDING)).any())
    check_range("opacities", opacities, outside, "values in 0..1 (activated, not logits)")


def check_range(name: str, tensor: torch.Tensor, outside: bool, wanted: str) -> None:
    """Raise InputError with the tensor's range if it lies ``outside`` what is ``wanted``."""
    if outside:
        low, high = tensor.min().item(), tensor.max().item()
        raise InputError(f"{name}: expected {wanted}, got values from {low:.8g} to {high:.8g}.")


def _dense(tensor: torch.Tensor) -> torch.Tensor:
    """Row after row, as kernels read it; here, so that several views share the copy."""
    if tensor.numel() == 0:  # which torch calls contiguous, whatever its strides
        return tensor.clone(memory_format=torch.contiguous_format)
    return tensor.contiguous().resolve_neg()


def _check_finite(name: str, tensor: torch.Tensor) -> None:
    if bool(tensor.sum().isfinite()):  # then all are; a test of each takes many times as long
        return
    if bool((bad := ~torch.isfinite(tensor)).any()):
        raise InputError(
            f"{name}: expected finite numbers, got {int(bad.sum())} that are NaN or infinite, the first in Gaussian "
            f"{int(bad.nonzero()[0, 0])}; remove those Gaussians."
        )


def explain_invalid(invalid: int, quats: torch.Tensor) -> None:
    """Raise InputError if Gaussians with good inputs could not be drawn (a zero quaternion is merely left out)."""
    too_large = invalid - int((quats == 0).all(1).sum()) if invalid else 0
    if too_large > 0:
        raise InputError(
            f"scales, sh: {too_large} Gaussians are too large on this image for float32 (over about 4e9 px), or their "
            "color overflows; remove them, move the camera away, or scale the coefficients down."
        )

"""What gradients are off by through each lens and with a rolling shutter, and what those of the camera cost."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from warp_splat.camera import Camera
from warp_splat.compare import oracle
from warp_splat.compare.exact_camera import exact_camera
from warp_splat.config import ADJOINTS, RasterOptions
from warp_splat.lenses.shutter import Shutter
from warp_splat.raster.api import rasterize
from warp_splat.raster.camera_parameters import CameraParameters
from warp_splat.raster.camera_parts import CAMERA, LAST_ROW, LENS, parts_of, put_together
from warp_splat.raster.data import Gaussians
from warp_splat.raster.project import project
from warp_splat.text import format_table

SHUTTER = Shutter((0.02, 0.05, -0.03), (0.05, 0.02, -0.08))
GAUSSIANS = "gaussians"  # the worst of their parameters
TURNS = 7  # of the timings


def measure(
    name: str,
    camera: Camera,
    projections: Sequence[str],
    few: Sequence[torch.Tensor],
    many: Sequence[torch.Tensor],
) -> list[dict[str, Any]]:
    """A record for each projection, mode and parameter of a camera, and of one that moves as well.

    Args:
        name: of the camera.
        camera: to learn.
        projections: to go through.
        few: means, quaternions, scales, opacities and harmonics of Gaussians, of which the errors are.
        many: likewise, of which the times are; [N, ...].
    """
    found = []
    for title, base in ((name, camera), (f"{name}, rolling shutter", replace(camera, shutter=SHUTTER))):
        learned = CameraParameters(base, coefficients=None if base.shutter else coefficients_of(base))
        for projection in projections:
            options = RasterOptions(projection=projection)
            seconds = {"still": measure_time(many, base, options), "learned": measure_time(many, learned, options)}
            for mode, errors in measure_errors(few, learned, options).items():
                what = {"camera": title, "projection": projection, "mode": mode}
                found += [{**what, "parameter": part, "error": error, **seconds} for part, error in errors.items()]
    return found


def coefficients_of(camera: Camera) -> torch.Tensor | None:
    """A leaf of those of the camera's lens, if it has any."""
    numbers = camera.lens.coefficients if camera.lens else ()
    return torch.tensor(numbers, dtype=torch.float64, requires_grad=True) if numbers else None


def measure_errors(
    gaussians: Sequence[torch.Tensor], learned: CameraParameters, options: RasterOptions
) -> dict[str, dict[str, float]]:
    """By mode and parameter, the relative error of the gradients of a random loss, at pixels that are sure."""
    parts = {part: tensor.detach().clone().requires_grad_() for part, tensor in parts_of(learned).items()}
    lens = learned.base.lens
    asked = [part for part in parts if not (lens and lens.family.around and part in CAMERA[2:])]  # its size says those
    exact = [tensor.float().double().requires_grad_() for tensor in gaussians]
    twist, intrinsics, last = (
        torch.cat([parts[part] for part in names]) if names[0] in parts else None
        for names in (CAMERA[:2], CAMERA[2:], LAST_ROW)
    )
    assert twist is not None and intrinsics is not None
    camera = exact_camera(learned.base, twist, intrinsics, last, parts.get(LENS))
    truth = oracle.exact_render(*exact, camera, projection=options.projection)
    weights = torch.randn(truth.image.shape, generator=torch.Generator().manual_seed(1))
    weights[truth.fragile] = 0
    chosen = [parts[part] for part in asked]
    wanted = torch.autograd.grad((truth.image * weights).sum(), [*exact, *chosen])
    found = {}
    for mode in ADJOINTS:
        leaves = [tensor.detach().float().requires_grad_() for tensor in exact]
        out = rasterize(*leaves, put_together(learned.base, parts), adjoint=mode, options=options)
        given = torch.autograd.grad((out.image * weights).sum(), [*leaves, *chosen])
        errors = [float((a.double() - b).norm() / b.norm()) for a, b in zip(given, wanted, strict=True)]
        found[mode] = {GAUSSIANS: max(errors[: len(exact)])} | dict(zip(asked, errors[len(exact) :], strict=True))
    return found


def measure_time(gaussians: Sequence[torch.Tensor], camera: Camera | CameraParameters, options: RasterOptions) -> float:
    """Processor seconds of projection and adjoint for each Gaussian, the least of some turns."""
    *geometry, sh = (tensor.detach().float().requires_grad_() for tensor in gaussians)
    given, best = Gaussians(*geometry, sh, sh.new_zeros(len(sh), 0, 3)), np.inf
    leaves = [*given[:5], *(leaf for leaf in _leaves(camera) if leaf is not None)]
    for _ in range(TURNS):
        start = time.process_time()
        splats = project(given, camera, options)
        torch.autograd.grad(splats[:5], leaves, [torch.ones_like(part) for part in splats[:5]])
        best = min(best, time.process_time() - start)
    return best / len(sh)


def _leaves(camera: Camera | CameraParameters) -> list[torch.Tensor | None]:
    if isinstance(camera, Camera):
        return []
    return [camera.twist, camera.intrinsics, camera.last_twist, camera.coefficients]


def report_gradients(records: Sequence[Mapping[str, Any]], say: Callable[[str], None]) -> None:
    """Two tables: the worst parameter of each mode, the worst mode of each parameter."""
    cells = {tuple(r[key] for key in ("camera", "projection", "mode", "parameter")): r["error"] for r in records}
    seconds = {(r["camera"], r["projection"]): (r["still"], r["learned"]) for r in records}
    parts = list(dict.fromkeys(r["parameter"] for r in records))
    say("\nGradients of a random loss against float64, relative: the worst parameter of Gaussians and camera\n")
    by_mode = [
        [*key, *(_number([e for (*k, m, _), e in cells.items() if (*k, m) == (*key, mode)]) for mode in ADJOINTS)]
        for key in seconds
    ]
    say(format_table(["camera", "projection", *ADJOINTS], by_mode))
    say("\nThe worst mode of each; time of projection and adjoint with a camera that learns all of it\n")
    rows = []
    for key, (still, learned) in seconds.items():
        worst = [_number([e for (*k, _, p), e in cells.items() if (*k, p) == (*key, part)]) for part in parts]
        rows.append([*key, *worst, f"{1e9 * learned:.0f}", f"{learned / still:.2f}"])
    headers = ["camera", "projection", *(part.replace("_", " ") for part in parts)]
    say(format_table([*headers, "ns a Gaussian", "times one that does not"], rows))


def _number(errors: Sequence[float]) -> str:
    return f"{max(errors):.1e}" if errors else "-"

"""Whether a device computes at all, and rightly: a scene so simple that its image is a formula.

Two balls on the optical axis, the near one over the far one. A ball of standard deviation s at depth z projects to a
circle of variance v = (f s / z)^2 + BLUR, so at distance r from the principal point

    a = opacity exp(-r^2 / (2 v)),   image = a1 c1 + (1 - a1) b,   b = a2 c2 + (1 - a2) background

for the near ball 1 and the far ball 2, and the gradient of the sum over all pixels and channels with respect to the
near ball's first scale is that of sum (c1 - b) a1 dx^2 / v1^2 (f / z1)^2 s1.

Beside it, random needles: a GPU counts their tiles, then lists them, and has to find as many.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch

from warp_splat.camera import Camera
from warp_splat.config import BLUR, RasterOptions
from warp_splat.errors import InputError
from warp_splat.kernels.harmonics import C0
from warp_splat.raster.api import render
from warp_splat.raster.bin import count_twice
from warp_splat.raster.data import Gaussians
from warp_splat.raster.project import project
from warp_splat.runtime.devices import is_out_of_memory
from warp_splat.runtime.launch import prepare

# The far ball stands first: the device has to sort. Each shows in every pixel of the four tiles.
CAMERA = Camera(24, 18, 20.0, 20.0, 12.3, 8.6, np.eye(3), np.zeros(3))
DEPTHS, SCALES, OPACITIES = (4.0, 2.0), (1.4, 0.6), (0.8, 0.6)
COLORS, BACKGROUND = ((0.9, 0.2, 0.4), (0.3, 0.7, 0.5)), (0.1, 0.3, 0.6)
TOLERANCE = 1e-4  # of the image, and relative of the gradient
NEEDLES, FIELD = 20_000, Camera(1000, 700, 600.0, 600.0, 500.3, 350.6, np.eye(3), np.zeros(3))


def settle_device(
    requested: str, threads: int, adjoints: Sequence[str] = ("manual",), say: Callable[[str], object] = print
) -> torch.device:
    """The device of a run, which :func:`prepare` chose and which passes the self-test.

    A GPU that "auto" chose and that fails gives way to the CPU, with a word.

    Args:
        requested: "auto", "cpu" or "cuda", as the user had it.
        threads: as :func:`prepare` takes them.
        adjoints: modes that will be used.
        say: receives what there is to say.

    Raises:
        InputError: if a GPU was asked for by name and cannot be used, or fails.
    """
    if (device := prepare(requested, threads)).type == "cpu":
        return device
    say("Testing the GPU; its kernels are compiled once on a machine ...")
    try:
        for adjoint in adjoints:
            check_device(device, adjoint)
    except InputError as error:
        if requested != "auto":
            raise
        say(f"warning: {error} Going on with the CPU.")
        return torch.device("cpu")
    return device


def check_device(device: torch.device, adjoint: str = "manual") -> None:
    """Render the scene and differentiate it on ``device``, the way every image is.

    Raises:
        InputError: if the answer is wrong, or there is none.
    """
    exact_image, exact_gradient = answer()
    try:
        image, gradient = _compute(device, adjoint)
        counted, listed = (counts.cpu().numpy() for counts in _count_tiles(device))
    except RuntimeError as error:
        if is_out_of_memory(error):
            what = "there is not enough memory left for the smallest image; end other programs that use it"
        else:
            what = f"the kernels could not be run ({str(error).splitlines()[0]}); update the driver"
        raise InputError(f"--device {device.type}: {what}, or use another device.") from error
    answers = {
        "a pixel": (image, exact_image, TOLERANCE),
        "a gradient": (gradient, exact_gradient, TOLERANCE * abs(exact_gradient)),
        "a number of tiles": (listed, counted, 0),
    }
    for what, (found, expected, allowed) in answers.items():
        wrong = ~(np.abs(np.subtract(found, expected)) <= allowed)  # NaN is wrong
        if wrong.any():
            place = tuple(np.argwhere(wrong)[0])
            raise InputError(
                f"--device {device.type}: the self-test expected {np.asarray(expected)[place]:.6g} as {what} and found "
                f"{np.asarray(found)[place]:.6g}: the kernels do nothing or answer wrongly there; update the driver, "
                "empty Warp's kernel cache (warp.clear_kernel_cache()), or use another device."
            )


def _compute(device: torch.device, adjoint: str) -> tuple[np.ndarray, float]:
    """The image [H, W, 3] and the gradient, by the renderer."""
    tensor = lambda values: torch.tensor(values, device=device)  # noqa: E731
    scales = tensor([[scale] * 3 for scale in SCALES]).requires_grad_()
    gaussians = Gaussians(
        means=tensor([[0.0, 0.0, depth] for depth in DEPTHS]),
        quats=tensor([[1.0, 0.0, 0.0, 0.0]] * 2),
        scales=scales,
        opacities=tensor(OPACITIES),
        sh_dc=(tensor(COLORS)[:, None] - 0.5) / C0,
        sh_rest=torch.zeros(2, 0, 3, device=device),
    )
    out = render(gaussians, CAMERA, tensor(BACKGROUND), RasterOptions(), adjoint)
    (gradient,) = torch.autograd.grad(out.image.sum(), scales)
    return out.image.detach().cpu().numpy(), gradient[1, 0].item()


def _count_tiles(device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    """The tiles of needles [NEEDLES], as a GPU's lists count and as they write them."""
    generator = torch.Generator().manual_seed(0)
    normal = lambda *shape: torch.randn(NEEDLES, *shape, generator=generator)  # noqa: E731
    gaussians = Gaussians(
        means=normal(3) + torch.tensor([0.0, 0.0, 6.0]),
        quats=normal(4),
        scales=torch.exp(1.5 * normal(3) - 4.0),
        opacities=torch.rand(NEEDLES, generator=generator),
        sh_dc=torch.zeros(NEEDLES, 1, 3),
        sh_rest=torch.zeros(NEEDLES, 0, 3),
    )
    options = RasterOptions()
    splats = project(Gaussians(*(tensor.to(device) for tensor in gaussians)), FIELD, options)
    return count_twice(splats, FIELD, options)


def answer() -> tuple[np.ndarray, float]:
    """The image [H, W, 3] and the gradient, by the formulas, in float64."""
    dx = np.arange(CAMERA.width) + 0.5 - CAMERA.cx
    dy = np.arange(CAMERA.height)[:, None] + 0.5 - CAMERA.cy
    zooms = [CAMERA.fx / depth for depth in DEPTHS]
    far_variance, variance = ((zoom * scale) ** 2 + BLUR for zoom, scale in zip(zooms, SCALES, strict=True))
    far = (OPACITIES[0] * np.exp(-0.5 * (dx**2 + dy**2) / far_variance))[..., None]
    near = (OPACITIES[1] * np.exp(-0.5 * (dx**2 + dy**2) / variance))[..., None]
    far_color, color = np.array(COLORS)
    behind = far * far_color + (1.0 - far) * np.array(BACKGROUND)
    slope = near * (dx**2)[:, None] * zooms[1] ** 2 * SCALES[1] / variance**2
    return near * color + (1.0 - near) * behind, float(((color - behind) * slope).sum())

"""Cameras that learn all that they may, and the gradients of it: the renderer's, by part, and an exact render."""

import exact_cameras
import torch
from exact_cameras import exact_camera

from warp_splat import CameraParameters, RasterOptions, rasterize
from warp_splat.compare import truth

LENS_ERROR = 1e-4  # relative L2, of coefficients, and of cameras with distortion away from the base
PLAIN, DEPTH, SHARP = RasterOptions(), RasterOptions(depth=True), RasterOptions(antialiasing=True)
HERE, NEAR = (0.0,) * 6, (0.03, -0.02, 0.05, 0.02, 0.04, -0.03)  # twists
OTHER = torch.tensor((0.01, -0.02, 0.015, 0.02, 0.03, -0.01), dtype=torch.float64)
PARTS = {  # of what a camera may learn
    "twist": ("rotation", "translation"),
    "intrinsics": ("focal", "principal"),
    "last_twist": ("last_rotation", "last_translation"),
    "coefficients": ("coefficients",),
}


def learned(camera, start=HERE):
    """All that a camera may learn, by name, in float64: its poses away from the base by ``start`` and back."""
    found = {"twist": start, "intrinsics": (camera.fx, camera.fy, camera.cx, camera.cy)}
    if camera.shutter:
        found["last_twist"] = [-0.7 * part for part in start]
    elif camera.lens and camera.lens.coefficients:
        found["coefficients"] = camera.lens.coefficients
    return {key: torch.tensor(numbers, dtype=torch.float64, requires_grad=True) for key, numbers in found.items()}


def split(gradients):
    """By part."""
    parts = {}
    for key, gradient in gradients.items():
        parts |= zip(PARTS[key], gradient.split(len(gradient) // len(PARTS[key])), strict=True)
    return parts


def exact_render(scene, options, numbers):
    scene, more = scene.to("cpu", torch.float64), {key: numbers.get(key) for key in ("last_twist", "coefficients")}
    camera = exact_camera(scene.camera, numbers["twist"], numbers["intrinsics"], **more)
    return exact_cameras.exact_render(*scene.parameters(), camera, scene.background, **truth.for_oracle(options))


def gradients_of(scene, upstream, options=PLAIN, start=HERE, adjoint="manual", leaves=None):
    """The renderer's, by part."""
    numbers = learned(scene.camera, start)
    camera = CameraParameters(scene.camera, **numbers)
    out = rasterize(*(leaves or scene.parameters()), camera, scene.background, adjoint, options)
    sum((getattr(out, key) * weight).sum() for key, weight in upstream.items()).backward()
    return split({key: leaf.grad for key, leaf in numbers.items()})

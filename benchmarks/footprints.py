"""What a projection through a lens costs: its footprints against rays through the lens, its gradients, its run time.

A pixel's ray is where the lens, in float64, sees that pixel's center. The truth of a footprint is "no overlap" of
benchmarks/light.py: each Gaussian's exact optical depth along the ray, composited as the renderer does. What is left
is the projection's own error. Gradients are those of a random loss, of cameras that learn: without and with a rolling
shutter.

    python benchmarks/footprints.py [--out docs/compare]
"""

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import light
import maps
import numpy as np
import torch
from common import interleaved, parse, transcribe
from exact_cameras import exact_camera, exact_render
from light import Volume

from warp_splat.camera import Camera
from warp_splat.compare.scenes import distinct_depths, make_camera, to_world
from warp_splat.compare.truth import random_upstream
from warp_splat.config import ADJOINTS, PROJECTIONS, RasterOptions
from warp_splat.formats.files import write_csv
from warp_splat.lenses import Lens
from warp_splat.lenses.shutter import Shutter
from warp_splat.raster.api import rasterize
from warp_splat.raster.camera_parameters import CameraParameters
from warp_splat.raster.camera_parts import CAMERA, parts_of, put_together
from warp_splat.raster.data import Gaussians
from warp_splat.raster.project import project
from warp_splat.text import format_table, table_of

PROJECTED = ("affine", "unscented")
SIZES = (0.03, 0.12)  # rad, the standard deviations of Gaussians as the camera sees them
COUNT, TIMED, MANY = 40, 20_000, 200_000  # Gaussians; the last of cameras that learn
TURNS = 7  # of the timings
LEAST = 1e-4  # of the maps
SHUTTER = Shutter((0.02, 0.05, -0.03), (0.05, 0.02, -0.08))
GAUSSIANS = "gaussians"  # the worst of their parameters
FOOTPRINTS = {
    **{"camera": "{camera}", "size [rad]": "{size}", "projection": "{projection}"},
    **{"mean error": "{mean:.1e}", "max error": "{max:.1e}", "PSNR [dB]": "{psnr:.1f}"},
    "ns a Gaussian": lambda record: f"{1e9 * record['seconds'] / TIMED:.0f}",
    "times a pinhole's": lambda record: f"{record['seconds'] / record['pinhole']:.2f}",
}


def _camera(width: int, height: int, focal: float, lens: Lens | None) -> Camera:
    return replace(make_camera(width, height, focal, seed=None), lens=lens)


#: A camera, and up to how many degrees from its axis there are Gaussians.
CAMERAS: dict[str, tuple[Camera, float]] = {
    "pinhole, 90 degrees": (_camera(64, 64, 32.0, None), 55.0),
    "OPENCV, 110 degrees": (_camera(64, 64, 30.0, Lens("OPENCV", (-0.13, 0.012, 0.002, -0.001))), 60.0),
    "OPENCV_FISHEYE, 180 degrees": (_camera(64, 64, 20.4, Lens("OPENCV_FISHEYE", (0.01, -0.003, 0.0, 0.0))), 95.0),
    "EQUIRECTANGULAR": (_camera(96, 48, 48 / np.pi, Lens("EQUIRECTANGULAR")), 180.0),
}


def compare_cameras(out: Path, say: Callable[[str], None] = print) -> list[dict[str, Any]]:
    """Measure everything; takes about two minutes on one core, besides what compiles the kernels.

    Args:
        out: folder for cameras.csv and cameras.png; created if it is missing.
        say: receives the tables and headings.

    Returns:
        A record for each camera, projection and size.

    Raises:
        InputError: if a file cannot be written.
    """
    rows, records = {}, []
    for name, (camera, most) in CAMERAS.items():
        ways = {projection: (camera, RasterOptions(projection=projection)) for projection in PROJECTED}
        ways["pinhole"] = replace(camera, lens=None), RasterOptions()
        seconds = measure_times(_made_splats(camera, most, TIMED), ways)
        row = rows[name.replace(", ", "\n").replace("_", "\n")] = []
        for size in SIZES:
            images = footprint_images(made_volume(camera, most, size), camera)
            row.append((f"truth, {size} rad", images["truth"], None))
            for projection in PROJECTED:
                row.append((f"{projection}, {size} rad", images["truth"], images[projection]))
                error = np.abs(images[projection] - images["truth"])
                found = {"mean": float(np.nanmean(error)), "max": float(np.nanmax(error))}
                found["psnr"] = float(-10 * np.log10(np.nanmean(error**2)))
                found |= {"seconds": seconds[projection], "pinhole": seconds["pinhole"]}
                records.append({"camera": name, "projection": projection, "size": size, **found})
    say("Footprints against rays through the lens (colors 0 to 1), and the time of projection and adjoint\n")
    say(table_of(records, FOOTPRINTS))
    gradients = measure_gradients()
    _report_gradients(gradients, say)
    write_csv(out / "cameras.csv", records)
    write_csv(out / "cameras_gradients.csv", gradients)
    maps.plot_maps(out / "cameras.png", rows, 1.6 * len(rows), LEAST)
    return records


def made_volume(camera: Camera, most: float, size: float, count: int = COUNT) -> Volume:
    """Gaussians up to ``most`` degrees from the axis, standard deviations up to ``size`` [rad], of density 1."""
    rng = np.random.default_rng(5)
    cosine, around = rng.uniform(np.cos(np.radians(most)), 1, count), rng.uniform(0, 2 * np.pi, count)
    sine, distance = np.sqrt(1 - cosine**2), distinct_depths(rng, count, 2, 6)
    points = np.stack([sine * np.cos(around), sine * np.sin(around), cosine], 1) * distance[:, None]
    scales = size * distance[:, None] * rng.uniform(0.3, 1, (count, 3))
    colors, quats = rng.uniform(0, 1, (count, 3)), rng.normal(size=(count, 4))
    return Volume(to_world(points, camera), quats, scales, np.ones(count), colors, [0.05, 0.05, 0.08])


def footprint_images(volume: Volume, camera: Camera) -> dict[str, np.ndarray]:
    """The true image [H, W, 3] and those with each projection's footprints; NaN where the lens has no ray."""
    optical_depths = np.exp(np.random.default_rng(6).uniform(np.log(0.3), np.log(4), len(volume.means)))
    volume = replace(volume, densities=optical_depths / light.peak_depths(volume, camera))
    images = light.splat_images(volume, camera, {name: (name, 0.0) for name in PROJECTED})
    return {"truth": images.pop("no overlap"), **images}


def _made_splats(camera: Camera, most: float, count: int) -> list[torch.Tensor]:
    volume = made_volume(camera, most, SIZES[0], count)
    return volume.splats(np.full(count, 0.7))


def measure_times(
    gaussians: Sequence[torch.Tensor], ways: Mapping[str, tuple[Camera | CameraParameters, RasterOptions]]
) -> dict[str, float]:
    """Processor seconds of projection and adjoint by each camera with its options, the least of some turns."""
    *geometry, sh = (tensor.detach().float().requires_grad_() for tensor in gaussians)
    given = Gaussians(*geometry, sh, sh.new_zeros(len(sh), 0, 3))

    def once(camera: Camera | CameraParameters, options: RasterOptions) -> None:
        known = () if isinstance(camera, Camera) else vars(camera).values()
        learned = [leaf for leaf in known if isinstance(leaf, torch.Tensor)]
        splats = project(given, camera, options)
        torch.autograd.grad(splats[:5], [*given[:5], *learned], [torch.ones_like(part) for part in splats[:5]])

    return interleaved({name: partial(once, *way) for name, way in ways.items()}, TURNS, time.process_time, min)


def measure_gradients() -> list[dict[str, Any]]:
    """A record for each camera, still and with a rolling shutter, and each projection, mode and parameter."""
    found = []
    for (name, (camera, most)), moves in itertools.product(CAMERAS.items(), (False, True)):
        few, many = (_made_splats(camera, most, count) for count in (COUNT, MANY))
        base = replace(camera, shutter=SHUTTER) if moves else camera
        numbers = camera.lens.coefficients if camera.lens and not moves else ()
        coefficients = torch.tensor(numbers, dtype=torch.float64, requires_grad=True) if numbers else None
        learned = CameraParameters(base, coefficients=coefficients)
        for projection in PROJECTED if camera.lens else PROJECTIONS:
            options = RasterOptions(projection=projection)
            seconds = measure_times(many, {"still": (base, options), "learned": (learned, options)})
            seconds = {way: value / MANY for way, value in seconds.items()}
            what = {"camera": f"{name}, rolling shutter" if moves else name, "projection": projection}
            for mode, errors in gradient_errors(few, learned, options).items():
                named = ({"mode": mode, "parameter": part, "error": error} for part, error in errors.items())
                found += [{**what, **record, **seconds} for record in named]
    return found


def gradient_errors(
    gaussians: Sequence[torch.Tensor], learned: CameraParameters, options: RasterOptions
) -> dict[str, dict[str, float]]:
    """By mode and parameter, the relative error of the gradients of a random loss, at pixels that are sure."""
    parts = {part: tensor.detach().clone().requires_grad_() for part, tensor in parts_of(learned).items()}
    lens = learned.base.lens
    asked = [part for part in parts if not (lens and lens.family.around and part in CAMERA[2:])]  # its size says those
    exact = [tensor.float().double().requires_grad_() for tensor in gaussians]
    given = put_together(learned.base, parts)
    assert isinstance(given, CameraParameters)
    camera = exact_camera(given.base, given.twist, given.intrinsics, given.last_twist, given.coefficients)
    truth = exact_render(*exact, camera, projection=options.projection)
    weights = random_upstream(truth.image.shape, truth.fragile)
    chosen = [parts[part] for part in asked]
    wanted = torch.autograd.grad((truth.image * weights).sum(), [*exact, *chosen])
    found = {}
    for mode in ADJOINTS:
        leaves = [tensor.detach().float().requires_grad_() for tensor in exact]
        out = rasterize(*leaves, put_together(learned.base, parts), adjoint=mode, options=options)
        got = torch.autograd.grad((out.image * weights).sum(), [*leaves, *chosen])
        errors = [float((a.double() - b).norm() / b.norm()) for a, b in zip(got, wanted, strict=True)]
        found[mode] = {GAUSSIANS: max(errors[: len(exact)])} | dict(zip(asked, errors[len(exact) :], strict=True))
    return found


def _report_gradients(records: Sequence[Mapping[str, Any]], say: Callable[[str], None]) -> None:
    """Two tables: the worst parameter of each mode, the worst mode of each parameter."""

    def worst(camera: str, projection: str, key: str, value: str) -> str:
        chosen = {"camera": camera, "projection": projection, key: value}
        errors = [r["error"] for r in records if chosen.items() <= r.items()]
        return f"{max(errors):.1e}" if errors else "-"

    seconds = {(r["camera"], r["projection"]): (r["still"], r["learned"]) for r in records}
    parts = list(dict.fromkeys(r["parameter"] for r in records))
    say("\nGradients of a random loss against float64, relative: the worst parameter of Gaussians and camera\n")
    rows = [[*key, *(worst(*key, "mode", mode) for mode in ADJOINTS)] for key in seconds]
    say(format_table(["camera", "projection", *ADJOINTS], rows))
    say("\nThe worst mode of each; time of projection and adjoint with a camera that learns all of it\n")
    rows = [
        [*key, *(worst(*key, "parameter", part) for part in parts), f"{1e9 * learned:.0f}", f"{learned / still:.2f}"]
        for key, (still, learned) in seconds.items()
    ]
    headers = ["camera", "projection", *(part.replace("_", " ") for part in parts)]
    say(format_table([*headers, "ns a Gaussian", "times one that does not"], rows))


def main() -> None:
    transcribe("cameras", parse(__doc__).out, compare_cameras)


if __name__ == "__main__":
    main()

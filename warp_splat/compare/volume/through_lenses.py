"""What a projection through a lens costs: its footprints against rays through the lens, its gradients, its run time.

A pixel's ray is where the lens, in float64, sees that pixel's center. The truth of a footprint is "no overlap" of
:mod:`.light`: each Gaussian's exact optical depth along the ray, composited as the renderer does. What is left is the
projection's own error.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warp_splat.camera import Camera
from warp_splat.compare import camera_gradients, oracle
from warp_splat.compare.scenes import distinct_depths, make_camera, to_world
from warp_splat.compare.volume import light
from warp_splat.compare.volume.light import Volume
from warp_splat.config import PROJECTIONS, RasterOptions
from warp_splat.evaluation import report
from warp_splat.formats.atomic import write_csv
from warp_splat.formats.stored import SH_C0
from warp_splat.lenses import Lens
from warp_splat.raster.data import Gaussians
from warp_splat.raster.project import project
from warp_splat.text import format_table

PROJECTED = ("affine", "unscented")
SIZES = (0.03, 0.12)  # rad, the standard deviations of Gaussians as the camera sees them
COUNT, TIMED, MANY = 40, 20_000, 200_000  # Gaussians; the last of cameras that learn
TURNS = 7  # of the timings
LEAST, MOST_ERROR = 1e-4, 0.3  # of the maps


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
    pictures: dict[str, dict[float, dict[str, np.ndarray]]] = {name: {} for name in CAMERAS}
    records = []
    for name, (camera, most) in CAMERAS.items():
        seconds = measure_times(camera, most)
        for size in SIZES:
            images = footprint_images(made_volume(camera, most, size), camera)
            pictures[name][size] = images
            for projection in PROJECTED:
                error = np.abs(images[projection] - images["truth"])
                found = {"mean": float(np.nanmean(error)), "max": float(np.nanmax(error))}
                found["psnr"] = float(-10 * np.log10(np.nanmean(error**2)))
                found |= {"seconds": seconds[projection], "pinhole": seconds["pinhole"]}
                records.append({"camera": name, "projection": projection, "size": size, **found})
    say("Footprints against rays through the lens (colors 0 to 1), and the time of projection and adjoint\n")
    say(_footprint_table(records))
    gradients = []
    for name, (camera, most) in CAMERAS.items():
        few, many = (_tensors(made_volume(camera, most, SIZES[0], count)) for count in (COUNT, MANY))
        projections = PROJECTED if camera.lens else PROJECTIONS
        gradients += camera_gradients.measure(name, camera, projections, few, many)
    camera_gradients.report_gradients(gradients, say)
    write_csv(out / "cameras.csv", [{"table": "footprints", **r} for r in records])
    write_csv(out / "cameras_gradients.csv", gradients)
    plot_cameras(out / "cameras.png", pictures)
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
    rays = light.camera_rays(camera)
    blind = np.isnan(rays[:, 0])
    exact = light.ray_profile(volume, camera.center, np.where(blind[:, None], camera.forward, rays)).depths()
    scene, peak = _tensors(volume), light.peak_depths(volume, camera)
    splats = {name: oracle.exact_splats(*scene, camera, projection=name) for name in PROJECTED}
    order = np.argsort(splats["affine"].z.numpy(), kind="stable")
    live = splats["affine"].live.numpy()  # what no projection draws is not theirs to get right
    alphas = {"truth": -np.expm1(-exact * live)}
    alphas |= {name: -np.expm1(-peak * light.falloff_at(found, camera, 0.0)) for name, found in splats.items()}
    images = {name: light.composite(alpha[:, order], volume, order, camera) for name, alpha in alphas.items()}
    hidden = blind.reshape(camera.height, camera.width, 1)
    return {name: np.where(hidden, np.nan, image) for name, image in images.items()}


def _tensors(volume: Volume) -> list[torch.Tensor]:
    """Means, quaternions, scales, opacities and harmonics of Gaussians with those densities' colors."""
    opacities = np.full(len(volume.means), 0.7)
    arrays = [volume.means, volume.quats, volume.scales, opacities, ((volume.colors - 0.5) / SH_C0)[:, None]]
    return [torch.from_numpy(np.ascontiguousarray(array)) for array in arrays]


def measure_times(camera: Camera, most: float) -> dict[str, float]:
    """Processor seconds of projection and adjoint, the least of some turns, of "pinhole" as well."""
    volume = made_volume(camera, most, SIZES[0], TIMED)
    *geometry, sh = (tensor.float().requires_grad_() for tensor in _tensors(volume))
    gaussians = Gaussians(*geometry, sh, sh.new_zeros(len(sh), 0, 3))
    ways = {name: (camera, RasterOptions(projection=name)) for name in PROJECTED}
    ways |= {"pinhole": (replace(camera, lens=None), RasterOptions())}
    best = dict.fromkeys(ways, np.inf)
    for _ in range(TURNS):
        for name, (seen_by, options) in ways.items():
            start = time.process_time()
            splats = project(gaussians, seen_by, options)
            torch.autograd.grad(splats[:5], gaussians[:5], [torch.ones_like(part) for part in splats[:5]])
            best[name] = min(best[name], time.process_time() - start)
    return best


def _footprint_table(records: Sequence[Mapping[str, Any]]) -> str:
    rows = [
        [
            *(str(r[key]) for key in ("camera", "size", "projection")),
            *(f"{r['mean']:.1e}", f"{r['max']:.1e}", f"{r['psnr']:.1f}"),
            *(f"{1e9 * r['seconds'] / TIMED:.0f}", f"{r['seconds'] / r['pinhole']:.2f}"),
        ]
        for r in records
    ]
    headers = ["camera", "size [rad]", "projection", "mean error", "max error", "PSNR [dB]", "ns a Gaussian"]
    return format_table([*headers, "times a pinhole's"], rows)


def plot_cameras(path: Path, pictures: Mapping[str, Mapping[float, Mapping[str, np.ndarray]]]) -> None:
    """Draw for each camera and size the truth, and where each projection is wrong."""
    from matplotlib.colors import LogNorm  # noqa: PLC0415 - half a second, only for pictures

    figure = report.new_figure(report.WIDTH, 1.6 * len(pictures), layout="compressed")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.02, hspace=0.02)
    titles = ("truth", *PROJECTED)
    grid = figure.subplots(len(pictures), len(SIZES) * len(titles))
    shown = None
    for line, (cells, (name, sizes)) in enumerate(zip(grid, pictures.items(), strict=True)):
        cells[0].set_ylabel(name.replace(", ", "\n").replace("_", "\n"), fontsize=7, color=report.INK)
        named = [(size, title, images) for size, images in sizes.items() for title in titles]
        for axes, (size, title, images) in zip(cells, named, strict=True):
            if title == "truth":
                axes.imshow(np.nan_to_num(images[title], nan=1.0).clip(0, 1))
            else:
                error = np.abs(images[title] - images["truth"]).mean(-1)
                shown = axes.imshow(error.clip(LEAST), cmap="inferno", norm=LogNorm(LEAST, MOST_ERROR))
                axes.set_xlabel(f"{np.nanmean(error):.1e}", fontsize=7, color=report.INK, labelpad=1)
            if not line:
                axes.set_title(f"{title}, {size} rad", fontsize=7, fontweight="bold", color=report.INK)
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
    bar = figure.colorbar(shown, ax=grid, orientation="horizontal", fraction=0.04, aspect=70, extend="both")
    bar.set_label("|error|, mean of the channels (colors 0 to 1); under each map its mean", fontsize=8)
    bar.ax.tick_params(labelsize=8, labelcolor=report.INK)
    report.save_figure(figure, path)

"""The two pictures of docs/renderer.md: one view of a trained model, from Gaussians to an image and back."""

from pathlib import Path

import numpy as np
import torch
from matplotlib.collections import EllipseCollection

from warp_splat.config import ALPHA_MAX, ALPHA_MIN, T_MIN, TILE, RasterOptions
from warp_splat.evaluation.report import BLUE, GREEN, INK, new_figure, plain_axes, save_figure
from warp_splat.gaussians import GaussianModel
from warp_splat.raster.api import rasterize
from warp_splat.raster.data import Gaussians
from warp_splat.raster.drivers import driver_of
from warp_splat.raster.project import project
from warp_splat.rendering.finished import Finished
from warp_splat.training.loss import image_loss

OUTLINES = 1500  # ellipses that are drawn
FEW = 60  # entries of a list


def draw(model: str, images: Path) -> list[Path]:
    """Write renderer.jpg and renderer_pixel.png for the first held-out view of ``model``."""
    finished = Finished(model)
    scene = finished.load_scene("", lambda line: None)
    view = scene.evaluated[1][0]
    activated = GaussianModel.from_splats(finished.file.splats).activated()
    activated = Gaussians(*(tensor.detach() for tensor in activated))
    means, quats, scales, opacities, *sh = activated
    arguments = (means.requires_grad_(), quats, scales, opacities, sh, view.camera)
    out = rasterize(*arguments)
    out.means2d.retain_grad()
    image_loss(out.image, torch.from_numpy(view.image), 0.2).backward()
    with torch.no_grad():
        splats = project(activated, view.camera, RasterOptions())
        ranges = driver_of(means.device).bin(splats, view.camera, RasterOptions()).ranges
        early = rasterize(*arguments, options=RasterOptions(max_steps=FEW)).image.numpy()
    lists = (ranges[:, 1] - ranges[:, 0]).reshape(-(-view.camera.height // TILE), -1).numpy()
    paths = [images / "renderer.jpg", images / "renderer_pixel.png"]
    stages(paths[0], out, lists, early)
    pixel(paths[1], out, np.unravel_index(lists.argmax(), lists.shape))
    return paths


def stages(path: Path, out, lists: np.ndarray, early: np.ndarray) -> None:
    """Six pictures: means, outlines, lists, an early image, the image, gradients."""
    image = out.image.detach().numpy().clip(0, 1)
    height, width, _ = image.shape
    seen = (out.radii > 0).numpy()
    means, colors = out.means2d.detach().numpy()[seen], out.colors.detach().numpy()[seen].clip(0, 1)
    slopes = out.means2d.grad.norm(dim=1).numpy()[seen]
    figure = new_figure(9.0, 2 * 3.0 * height / width + 0.6, "constrained")
    grid = figure.subplots(2, 3).ravel()
    titles = (
        "project: means, each in its color",
        f"project: outlines of {OUTLINES} (one sigma)",
        "bin: Gaussians in the list of each tile",
        f"blend: the nearest {FEW} of each list",
        "blend: all of them",
        "adjoint: gradient of the means in the image",
    )
    for axes, title in zip(grid, titles, strict=True):
        axes.set_title(title, fontsize=8, color=INK, loc="left")
        axes.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[], aspect="equal")
    grid[0].scatter(*means.T, s=1.5, c=colors, linewidths=0)
    chosen = np.random.default_rng(0).permutation(len(means))[:OUTLINES]
    a, b, c = out.conics.detach().numpy()[seen][chosen].astype(np.float64).T
    values, vectors = np.linalg.eigh(np.stack([a, b, b, c], -1).reshape(-1, 2, 2))
    angles = np.degrees(np.arctan2(vectors[:, 1, 0], vectors[:, 0, 0]))
    axes_px = 2 / np.sqrt(values)
    ellipses = EllipseCollection(
        *axes_px.T, angles, units="xy", offsets=means[chosen], offset_transform=grid[1].transData
    )
    ellipses.set(facecolor="none", edgecolor=colors[chosen], linewidth=0.5)
    grid[1].add_collection(ellipses)
    for axes in grid[:2]:
        axes.set_facecolor("black")
    shown = grid[2].imshow(lists, cmap="viridis", extent=(0, lists.shape[1] * TILE, lists.shape[0] * TILE, 0))
    figure.colorbar(shown, ax=grid[2], shrink=0.7).ax.tick_params(labelsize=6)
    for axes, picture in zip(grid[3:5], (early, image), strict=True):
        axes.imshow(picture.clip(0, 1), extent=(0, width, height, 0))
    order = np.argsort(slopes)
    grid[5].set_facecolor("black")
    strength = (slopes / np.percentile(slopes, 98)).clip(max=1)[order]
    grid[5].scatter(*means[order].T, s=2.5, c=strength, cmap="inferno", linewidths=0)
    save_figure(figure, path)


def pixel(path: Path, out, tile: tuple[int, int]) -> None:
    """What the middle pixel of ``tile`` sees, front to back, computed here from the projected Gaussians."""
    y, x = ((place + 0.5) * TILE for place in tile)
    parts = (out.means2d, out.conics, out.opacities2d, out.depths, out.colors, out.radii)
    means, conics, opacities, depths, colors, radii = (part.detach().numpy().astype(np.float64) for part in parts)
    dx, dy = means[:, 0] - x - 0.5, means[:, 1] - y - 0.5
    alphas = opacities * np.exp(-0.5 * (conics[:, 0] * dx**2 + 2 * conics[:, 1] * dx * dy + conics[:, 2] * dy**2))
    met = np.flatnonzero((radii > 0) & (alphas >= ALPHA_MIN))
    met = met[np.argsort(depths[met], kind="stable")]
    alphas = alphas[met].clip(max=ALPHA_MAX)
    behind = np.cumprod(1 - alphas)
    count = int((behind >= T_MIN).sum())
    front = np.concatenate([[1.0], behind])[:count]
    figure = new_figure(9.0, 2.4, "constrained")
    axes = figure.subplots()
    places = np.arange(count)
    axes.bar(places, alphas[:count] * front, color=colors[met[:count]].clip(0, 1), edgecolor=INK, linewidth=0.3)
    axes.step(places, front, color=BLUE, where="mid", linewidth=1.5, label="transmittance T in front")
    axes.plot(places, alphas[:count], ".", color=GREEN, markersize=4, label="opacity a at the pixel")
    plain_axes(
        axes, f"pixel ({int(x)}, {int(y)}): {count} of {len(met)} Gaussians count; bars: weight a T, in their colors"
    )
    axes.set_xlabel("place in the list, nearest first", fontsize=9, color=INK)
    axes.legend(frameon=False, fontsize=9)
    save_figure(figure, path)

"""``warp-splat mesh``: a trained model as triangles, .ply, .glb or .obj; and as convex pieces for simulators."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from warp_splat.color import from_srgb, to_srgb
from warp_splat.config import STRONGEST_MOST, MeshConfig
from warp_splat.errors import InputError, imported
from warp_splat.formats.exchange import MARKS
from warp_splat.formats.exposures import Exposures
from warp_splat.formats.files import save_somewhere, write_bytes
from warp_splat.formats.model_folder import check_output
from warp_splat.gaussians import GaussianModel
from warp_splat.meshing.fusion import HALF, Drawn, Surface, agreed, depth_of, image_at, pixel, surface_of, voxels_of
from warp_splat.meshing.stereo import filled
from warp_splat.pruning.opened import Opened
from warp_splat.raster.api import render
from warp_splat.rendering.finished import as_photographed
from warp_splat.runtime.launch import available_memory
from warp_splat.scene.types import View

ENDINGS = (".ply", ".glb", ".obj")
GLTF_AXES = np.diag([-1.0, -1.0, 1.0, 1.0])  # x left, y up, z forward
ISLAND, LARGE = 0.01, 500  # share of the largest piece's triangles below which a piece is left out; of more it stays
SMOOTHING = 10 * (0.5, -0.53)  # shares of the way to the mean of neighbors, there and back
PIXEL, VOXEL = 20, 60  # bytes of a pixel of a view; of a voxel, with those of the search
LEAST = 16  # px, of the shorter edge of a view: smaller ones agree on nothing
PIXELS = 2.0  # edge of a voxel where nothing else is asked for
COARSER = 1.25  # times the voxel, until there is memory for all


def mesh(config: MeshConfig) -> int:
    """Write the surface of a model as ``config`` says; returns the process's exit code.

    Raises:
        InputError: if the model, its scene, an option or a needed package is not usable; if there is no surface.
    """
    output = Path(config.output)
    pieces_place = output.parent / f"{output.stem}_collision{output.suffix}"
    for place in (output, pieces_place) if config.collision else (output,):
        check_output(place, config.model, config.iteration, ENDINGS)
    if config.triangles and config.watertight:
        raise InputError("--triangles: simplifying would open what --watertight closes; take larger voxels (--voxel).")
    for package, wanted in (("trimesh", True), ("fast_simplification", config.triangles), ("vhacdx", config.collision)):
        if wanted:
            needed(package)
    opened = Opened(config)
    memory = 1e9 * config.memory or available_memory(torch.device("cpu")) / 4
    drawn = drawn_views(opened, memory / 2)
    views = agreed(drawn)
    if config.voxel and any(view.depth.any() for view in views):
        _grid(config, PIXELS * pixel(views), views, memory / 2)  # refused now, not after minutes
    views = filled(drawn, views, opened.scene.train)
    if math.isnan(natural := PIXELS * pixel(views)):
        expected = f"expected two or more views that agree on depths, found none of {len(views)}"
        raise InputError(f"{config.model}: {expected}; train on more photographs, or longer.")
    voxel, voxels = _grid(config, natural, views, memory / 2)
    surface = surface_in(voxels, views, voxel, config.watertight)
    if not (found := len(surface.faces)):
        smaller = min(natural, voxel / 2)
        raise InputError(f"{config.model}: no surface crosses voxels of {voxel:.3g}; try --voxel {smaller:.2g}.")
    if 0 < config.triangles < found:
        surface = simplified(surface, config.triangles)
    if config.crop:  # smoothing and simplifying move vertices
        surface = surface._replace(vertices=surface.vertices.clip(*np.reshape(config.crop, (2, 3))))
    whole = trimesh_of(surface)
    output = save_somewhere(output, lambda place: write_bytes(place, exported(whole, place.suffix)))
    elsewhere = output != Path(config.output)
    least = ", the fewest that simplifying comes to" if 0 < config.triangles < 0.9 * len(surface.faces) else ""
    print(f"{output}: {len(surface.faces)} of {found} triangles{least}, voxels of {voxel:.4g}")
    if opened.placed().coordinates:
        print(f"  lost: {MARKS['coordinates']}")
    if config.collision:
        pieces = needed("trimesh").Scene(whole.convex_decomposition(maxConvexHulls=config.collision))  # V-HACD
        placed = save_somewhere(pieces_place, lambda place: write_bytes(place, exported(pieces, place.suffix)))
        print(f"{placed}: {len(pieces.geometry)} convex pieces")
        elsewhere |= placed != pieces_place
    return int(elsewhere)


def needed(package: str) -> Any:
    """The module of a package that meshes need. Raises InputError if it is not installed."""
    return imported(package, f"{package}: a mesh needs this package; pip install 'warp-splat[mesh]'.")


def drawn_views(opened: Opened, memory: float) -> list[Drawn]:
    """The training views as the model shows them, so small that they fit: depths where half of the light is gone."""
    setting, found = opened.setting, []
    options = replace(setting.options, strongest=STRONGEST_MOST)
    background = setting.background if setting.background.ndim == 1 else setting.background.new_zeros(3)
    cameras = [view.camera for view in opened.scene.train]
    share = min(1.0, math.sqrt(memory / PIXEL / sum(camera.width * camera.height for camera in cameras)))
    if (edge := share * min(min(camera.width, camera.height) for camera in cameras)) < LEAST:
        larger = "train on larger photographs, or raise --memory"
        raise InputError(f"{opened.path}: expected views of {LEAST} px and more, found {int(edge)}; {larger}.")
    with torch.no_grad():
        gaussians = GaussianModel.from_splats(opened.file.splats).to(background.device).activated()
        for view, camera in zip(opened.scene.train, cameras, strict=True):
            if camera.lens is not None and camera.lens.family.around:
                raise InputError("mesh: expected views of a plane to fuse, found a panorama; train on cube faces.")
            smaller = camera.resized(*(max(int(share * size), 1) for size in (camera.width, camera.height)))
            smaller = replace(smaller, lens=None, shutter=None)  # depths are drawn, not taken from photographs
            shown = render(gaussians, smaller, background, options)
            image = photographed(shown.image.cpu(), view, opened.exposures)
            image = to_srgb(image, torch.where) if view.linear else image
            depth = depth_of(shown, smaller)
            if opened.shows:
                depth *= opened.shows(smaller)  # the rest is hidden, or seen from within
            found.append(Drawn(smaller, depth.cpu(), image.contiguous()))
    return found


def photographed(image: torch.Tensor, view: View, exposures: Exposures | None) -> torch.Tensor:
    """A model's picture [H, W, 3] with a photograph's colors, in the mean exposure; where it is masked, the model's.

    To first order: what the photograph has more than the picture exposed alike. A lens's photograph gives none.
    """
    if view.camera.lens or view.camera.shutter:
        return image
    height, width, _ = image.shape
    pixels, camera = view.pixels, view.camera.resized(width, height)
    taken = image_at(torch.from_numpy(pixels.image).float(), camera, "area") / (1 if view.linear else 255)
    shown = as_photographed(exposures, image, view.name)
    if not view.linear:  # a photograph saturates
        image, shown = image.clamp(0.0, 1.0), shown.clamp(0.0, 1.0)
    more = taken - shown
    if pixels.mask is not None:
        more = more * image_at(torch.from_numpy(pixels.mask[..., None]), camera).bool()
    return image + more


def _grid(config: MeshConfig, natural: float, views: Sequence[Drawn], memory: float) -> tuple[float, torch.Tensor]:
    """The edge of a voxel [world units]: what is asked for, or what there is memory for; and the voxels."""
    voxel = config.voxel or natural
    while True:
        voxels = voxels_of(views, voxel, config.crop)
        if not len(voxels) or voxel * PIXELS > natural * min(views[0].depth.shape):  # what a view shows
            raise InputError(f"--voxel {voxel:g}: nothing is seen at this size, or in the box; try {natural:.2g}.")
        ends = [(int(axis.min()) - 1, int(axis.max()) + 2) for axis in voxels.T if config.watertight]
        count = math.prod(end - begin for begin, end in ends) if ends else len(voxels)
        wide = (voxels.amax(0) - voxels.amin(0)).max() >= 2 * HALF
        if count <= memory / VOXEL and not wide:
            return voxel, torch.cartesian_prod(*(torch.arange(*x, dtype=torch.int32) for x in ends)) if ends else voxels
        if config.voxel:
            found = f"more than {2 * HALF} along an axis" if wide else f"{2e-9 * count * VOXEL:.1f} GB"
            raise InputError(f"--voxel {voxel:g}: it takes {found}; raise it, or --memory.")
        voxel *= COARSER


def surface_in(voxels: torch.Tensor, views: Sequence[Drawn], voxel: float, watertight: bool = False) -> Surface:
    """What is written, but for triangles that are too many; watertight, if ``voxels`` fill a box."""
    return smoothed(without_islands(surface_of(voxels, views, voxel, watertight)))


def without_islands(surface: Surface) -> Surface:
    """Without connected pieces that are far smaller than the largest."""
    edges = surface.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    graph = csr_array((np.ones(len(edges), bool), tuple(edges.T)), shape=(len(surface.vertices),) * 2)
    piece = connected_components(graph, directed=False)[1][surface.faces[:, 0]]
    counts = np.bincount(piece, minlength=1)
    large = counts[piece] >= min(ISLAND * counts.max(), LARGE)
    used, faces = np.unique(surface.faces[large], return_inverse=True)
    return Surface(surface.vertices[used], faces.reshape(-1, 3), surface.colors[used])


def smoothed(surface: Surface) -> Surface:
    """With vertices moved towards their neighbors and back again and again (Taubin 1995), but for those at holes."""
    faces, vertices, size = surface.faces, surface.vertices, len(surface.vertices)
    edges = csr_array((np.ones(faces.size), (faces.ravel(), np.roll(faces, -1, 1).ravel())), shape=(size, size))
    neighbors, inside = edges + edges.T, abs(edges - edges.T).sum(1) == 0  # there the other triangle has it reversed
    weights = inside / neighbors.sum(1)
    for step in SMOOTHING:
        vertices = vertices + step * weights[:, None] * (neighbors @ vertices - neighbors.sum(1)[:, None] * vertices)
    return surface._replace(vertices=vertices)


def simplified(surface: Surface, triangles: int) -> Surface:
    """With about so many triangles (quadric errors, Garland and Heckbert 1997); colors are the nearest vertices'."""
    simplify = needed("fast_simplification").simplify
    vertices, faces = simplify(surface.vertices, surface.faces, 1 - triangles / len(surface.faces))
    if not len(faces):  # a closed surface vanishes
        return simplified(surface, 2 * triangles)
    nearest = KDTree(surface.vertices).query(vertices)[1]
    return Surface(vertices.astype(np.float64), faces.astype(np.int64), surface.colors[nearest])


def trimesh_of(surface: Surface) -> Any:
    """As trimesh's, with colors on vertices."""
    colors = np.rint(255 * surface.colors.clip(0, 1)).astype(np.uint8)
    return needed("trimesh").Trimesh(surface.vertices, surface.faces, vertex_colors=colors, process=False)


def exported(shape: Any, suffix: str) -> bytes:
    """The bytes of a file of what trimesh holds; .glb in glTF's axes, as Gaussians are written, and in linear light."""
    more = {}
    if suffix.lower() == ".glb":
        shape = shape.copy().apply_transform(GLTF_AXES)
        if hasattr(shape, "visual"):  # a mesh; a scene of convex pieces has no colors
            colors = shape.visual.vertex_colors[:, :3] / np.float32(255)
            shape.vertex_attributes["_COLOR_0"] = from_srgb(colors, np.where)
            shape.visual = None
            more["tree_postprocessor"] = _name_colors
    data = shape.export(file_type=suffix.lower()[1:], **more)
    return data.encode() if isinstance(data, str) else data


def _name_colors(tree: dict) -> None:
    """As glTF does; trimesh itself writes them in 8 bits."""
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    attributes["COLOR_0"] = attributes.pop("_COLOR_0")

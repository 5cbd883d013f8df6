"""The surface that the depths of many views agree on: a distance field around them, and its marching cubes.

Only blocks of voxels that some depth falls into exist. A depth counts where its pixel is at most ``COARSEST`` voxels
wide: what lies far behind a scene, seen from afar, has no surface of this resolution.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import warp as wp
from scipy import ndimage
from warp.geometry import IsoSurfaceMarchingCubes, sparse_marching_cubes_from_cells

from warp_splat.camera import Camera
from warp_splat.kernels.distance_field import agree, fuse
from warp_splat.raster.api import RenderOutput
from warp_splat.raster.beside import rays, rotations
from warp_splat.runtime.launch import launch

EDGE = 8  # voxels of a block
COARSEST = 3.0  # voxels that a pixel of a depth may span
TRUNCATION = 3.0  # voxels
AGREEING = 0.2  # share of the views asked that see a place where a pixel sees it, or its depth does not count
TOLERANCE = 0.01  # of the depth, within which that is the same place
SURE = 3  # views of a voxel, or one less than usual, by which closing goes: a wrong depth would bore into a solid
OTHERS = 40  # views that are asked, those that are nearest
HALF = 1 << 20  # blocks, and voxels from the middle, lie between -HALF and HALF


class Drawn(NamedTuple):
    """A view of the surface."""

    camera: Camera  # a pinhole
    depth: torch.Tensor  # [H, W] world units; 0: none
    image: torch.Tensor  # [H, W, 3]


class Surface(NamedTuple):
    """Triangles with colors."""

    vertices: np.ndarray  # [V, 3] float64, world units
    faces: np.ndarray  # [F, 3] int64
    colors: np.ndarray  # [V, 3] float32, 0 to 1


def lens_of(camera: Camera) -> wp.vec4:
    """Of a pinhole."""
    return wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy)


def image_at(image: torch.Tensor, camera: Camera, mode: str = "nearest-exact") -> torch.Tensor:
    """An image [H, W, C] at the size of a camera's."""
    size = camera.height, camera.width
    return torch.nn.functional.interpolate(image.movedim(2, 0)[None], size, mode=mode)[0].movedim(0, 2).contiguous()


def depth_of(shown: RenderOutput, camera: Camera) -> torch.Tensor:
    """Depth of the Gaussian at which half of a pixel's light is gone, of its strongest, [H, W]; 0: it is not gone.

    It is taken where the Gaussian is densest along the ray, not at its center, which all pixels that it covers share.
    """
    gaussians, numbers, weights = shown.gaussians, shown.strongest, shown.strongest_weights
    assert numbers is not None and weights is not None
    order = shown.depths[numbers.clamp_min(0)].sort(stable=True, dim=-1).indices
    sums = weights.gather(-1, order).cumsum(-1)
    half = (sums < 0.5 * sums[..., -1:]).sum(-1, keepdim=True).clamp_max(weights.shape[-1] - 1)
    middle = numbers.gather(-1, order.gather(-1, half))[..., 0].clamp_min(0)
    ray = rays(camera, weights.device)
    away = (gaussians.means[middle] - torch.from_numpy(camera.center).to(ray.device)).float()
    flatness = gaussians.scales.amin(1, keepdim=True) / gaussians.scales
    axes = (rotations(gaussians.quats).mT * flatness[..., None])[middle]  # to where the Gaussian is a ball
    along, mean = ((axes * x[..., None, :]).sum(-1) for x in (ray, away))
    return torch.where(shown.alpha > 0.5, (along * mean).sum(-1) / (along * along).sum(-1), 0.0)


def nearest_to(i: int, views: Sequence[Drawn]) -> list[Drawn]:
    """The other views, those whose centers are nearest first."""
    distances = [np.sum((view.camera.center - views[i].camera.center) ** 2) for view in views]
    return [views[j] for j in np.argsort(distances, kind="stable") if j != i]


def relative(camera: Camera, other: Camera) -> tuple[wp.mat33, wp.vec3]:
    """From a camera to another one."""
    rotation = other.rotation @ camera.rotation.T
    return wp.mat33(*rotation.ravel()), wp.vec3(*(other.translation - rotation @ camera.translation))


def agreed(views: Sequence[Drawn], share: float = AGREEING) -> list[Drawn]:
    """The views without the depths that less than a share of the others see, of those nearest to them."""
    found = []
    for i, view in enumerate(views):
        nearest = nearest_to(i, views)[:OTHERS]
        agreeing = torch.zeros(view.depth.numel(), dtype=torch.int32)
        for other in nearest:
            pose = relative(view.camera, other.camera)
            inputs = [TOLERANCE, *pose, lens_of(view.camera), lens_of(other.camera), view.depth, other.depth]
            launch(agree, len(agreeing), inputs, [agreeing])
        enough = agreeing.view_as(view.depth) >= max(share * len(nearest), 1)
        found.append(view._replace(depth=torch.where(enough, view.depth, 0.0)))
    return found


def pixel(views: Sequence[Drawn]) -> float:
    """The median edge of a pixel at a view's median depth [world units]; not a number if no view has one."""
    found = [(view.depth[view.depth > 0], view.camera.fx) for view in views]
    return float(np.median([float(depths.median()) / focal for depths, focal in found if len(depths)] or [np.nan]))


def voxels_of(views: Sequence[Drawn], voxel: float, box: Sequence[float] = ()) -> torch.Tensor:
    """Places on the grid [V, 3] int32 of the voxels of all blocks that depths fall into, or a truncation beside.

    ``box``: the smallest x, y, z and the largest [world units]; only those in it.
    """
    blocks = torch.empty(0, dtype=torch.int64)
    for view in views:
        camera, depth = view.camera, view.depth
        counts = (depth > 0) & (depth < COARSEST * voxel * camera.fx)
        z, ray, center = depth[counts].double(), rays(camera, depth.device)[counts], torch.from_numpy(camera.center)
        for offset in (-TRUNCATION, 0.0, TRUNCATION):
            points = ray * (z + offset * voxel)[:, None] + center
            places = torch.floor(points / (voxel * EDGE)).long()
            blocks = torch.unique(torch.cat([blocks, torch.unique(code(places))]))
    inside = torch.cartesian_prod(*[torch.arange(EDGE)] * 3)
    corners = torch.stack([(blocks >> shift & 2 * HALF - 1) - HALF for shift in (42, 21, 0)], 1)
    voxels = (corners[:, None] * EDGE + inside).reshape(-1, 3).int()
    if not box:
        return voxels
    low, high = torch.tensor(box).view(2, 3) / voxel
    return voxels[((voxels >= low) & (voxels <= high)).all(1)]


def code(places: torch.Tensor) -> torch.Tensor:
    """Of places on the grid, [M, 3], one number each, in the order of x, y, z."""
    x, y, z = (places.long() + HALF).unbind(1)
    return (x << 42) | (y << 21) | z


def fused(views: Sequence[Drawn], voxels: torch.Tensor, voxel: float) -> list[torch.Tensor]:
    """The distance at each voxel over the truncation, NaN where no view sees it, [V]; its color [V, 3]; views [V]."""
    sums, colors = torch.zeros(len(voxels), 2), torch.zeros(len(voxels), 4)
    for view in views:
        camera = view.camera
        pose = wp.mat33(*camera.rotation.ravel()), wp.vec3(*camera.translation)
        inputs = [voxel, TRUNCATION * voxel, *pose, lens_of(camera), voxels, view.depth, view.image]
        launch(fuse, len(voxels), inputs, [sums, colors])
    distance = torch.where(sums[:, 1] > 0, sums[:, 0] / sums[:, 1], torch.nan)
    return [distance, colors[:, :3] / colors[:, 3:].clamp_min(1.0), sums[:, 1]]


def closed(voxels: torch.Tensor, distances: torch.Tensor, colors: torch.Tensor) -> list[torch.Tensor]:
    """Places, distances and colors of those voxels of a whole box that are beside a surface without holes.

    A voxel whose distance is not known is as the nearest one beside the surface; the outermost are outside.
    """
    shape = tuple(int(size) for size in voxels[-1] - voxels[0] + 1)
    far = ~(distances.abs() < 1).view(shape).numpy()  # or not known
    nearest = ndimage.distance_transform_edt(far, return_distances=False, return_indices=True)
    nearest = torch.from_numpy(np.ravel_multi_index(tuple(nearest), shape).ravel())
    distances = torch.where(distances.isnan(), distances[nearest], distances).view(shape)
    distances = torch.nn.functional.pad(distances[1:-1, 1:-1, 1:-1], (1,) * 6, value=1.0)
    inside = (distances < 0).numpy()
    beside = torch.from_numpy(ndimage.maximum_filter(inside, 3) != ndimage.minimum_filter(inside, 3)).ravel()
    return [voxels[beside], distances.ravel()[beside], colors[nearest[beside]]]


def surface_of(voxels: torch.Tensor, views: Sequence[Drawn], voxel: float, watertight: bool = False) -> Surface:
    """Marching cubes in the cells of which all corners are seen: holes stay holes, unless it is to be watertight."""
    distances, colors, counts = fused(views, voxels, voxel)
    if watertight and (near := distances.abs() < 1).any():
        distances[counts < min(SURE, float(counts[near].median()) - 1)] = torch.nan
        voxels, distances, colors = closed(voxels, distances, colors)
    known = (~torch.isnan(distances)).nonzero()[:, 0]
    middle = (voxels.amin(0, True) + voxels.amax(0, True)) // 2 if len(voxels) else voxels
    voxels = voxels - middle  # so that codes differ and float32 is exact, wherever the scene is
    codes, order = torch.sort(code(voxels[known]))
    voxels, distances, colors = (values[known[order]] for values in (voxels, distances, colors))
    corners = []
    for offset in IsoSurfaceMarchingCubes.CUBE_CORNER_OFFSETS:
        wanted = code(voxels + torch.tensor(offset, dtype=torch.int32))
        found = torch.searchsorted(codes, wanted).clamp_max(len(codes) - 1)
        corners.append(torch.where(codes[found] == wanted, distances[found], torch.nan))
    values = torch.stack(corners, 1)
    cells = (values.amin(1) < 0) & (values.amax(1) >= 0)  # false where one is not a number
    places, values = voxels[cells].numpy(), values[cells].numpy()
    points, faces = sparse_marching_cubes_from_cells(places, values, device="cpu")
    points, faces = points.numpy().astype(np.float64), faces.numpy().reshape(-1, 3).astype(np.int64)
    nearest = torch.searchsorted(codes, code(torch.from_numpy(np.rint(points)).int())).clamp_max(len(codes) - 1)
    return Surface(voxel * (points + middle.numpy()), faces, colors[nearest].numpy())

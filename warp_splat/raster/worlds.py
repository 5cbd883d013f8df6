"""Pictures of several worlds through one camera, all at once: so many small ones cost little.

What stands still in all of them is a backdrop, drawn once. The others draw only the tiles that they touch, of lists
that are merged. Pixels are those of a call for each world, bit for bit. No gradient.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from numbers import Integral

import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.errors import InputError
from warp_splat.kernels.splat import Splat2D
from warp_splat.kernels.tiles import merge_lists
from warp_splat.raster import checks
from warp_splat.raster.beside import find_strongest
from warp_splat.raster.bin import balanced_slices, check_count
from warp_splat.raster.blend import Blending
from warp_splat.raster.data import Bins
from warp_splat.raster.drivers import driver_of
from warp_splat.raster.project import project
from warp_splat.runtime.launch import empty, launch, send


def takes(camera: Camera, options: RasterOptions) -> bool:
    """Whether :class:`Worlds` do: in a panorama splats show twice, and some options ask for more than they give."""
    around = camera.lens is not None and camera.lens.family.around
    return not (around or options.bound or options.normals or options.median_depth or options.tolerance is not None)


class Worlds:
    """W worlds before one camera.

    Args:
        gaussians: means, quats, scales, opacities and sh, of all worlds.
        counts: of each world's Gaussians.
        camera: of all worlds.
        options: what to compute: the color, depth and the strongest; see :func:`takes`. What hides is [W, H, W].
        backdrop: one world that stands behind and among each of these; its Gaussians are numbered first.

    Raises:
        InputError: as :func:`warp_splat.rasterize` does; if they do not take that, or if ``counts`` are of others, or
            the backdrop of another camera or other options.
    """

    def __init__(
        self,
        gaussians: Sequence[torch.Tensor],
        counts: Sequence[int],
        camera: Camera,
        options: RasterOptions,
        backdrop: "Worlds | None" = None,
    ):
        options = checks.check_options("manual", options)
        if checks.check_camera(camera) is not camera:
            raise InputError("camera: expected a warp_splat.Camera for several worlds, got CameraParameters.")
        if not takes(camera, options):
            beside = "bound, tolerance, normals nor median_depth"
            raise InputError(f"options: expected neither {beside} for several worlds, and no panorama.")
        whole = isinstance(counts, (list, tuple)) and all(isinstance(n, Integral) and n >= 0 for n in counts)
        if not (whole and counts):
            raise InputError(f"counts: expected a list of whole numbers, one for each world, got {counts!r:.80}.")
        counts = [int(n) for n in counts]
        if not isinstance(backdrop, Worlds | None):
            raise InputError(f"backdrop: expected what was drawn of another world, got {type(backdrop).__name__}.")
        self.way = camera, options
        hides = options.hidden_from is not None
        if backdrop and (hides or len(backdrop.counts) > 1 or backdrop.backdrop or backdrop.way != self.way):
            beside = "that has none itself, and nothing that hides"
            raise InputError(f"backdrop: expected one world of the same Camera object and options, {beside}.")
        if hides:
            shape = len(counts), camera.height, camera.width
            checks.check_tensor("hidden_from", options.hidden_from, shape, gaussians[0].device)
            options = replace(options, hidden_from=options.hidden_from.flatten(0, 1))
        self.counts, self.options, self.backdrop = counts, options, backdrop
        self.driver = driver_of(gaussians[0].device)
        # of pictures below each other: from here on, its size alone counts
        self.camera = replace(camera, height=camera.height * len(counts), lens=None, shutter=None)
        with checks.explained(options, gaussians[0], [self.camera]):
            if sum(counts) != len((checked := checks.check_gaussians(*gaussians)).means):
                raise InputError(f"counts: expected {len(checked.means)} Gaussians in all, got {sum(counts)}.")
            self.splats = project(checked, camera, options)
            self.bins = self.driver.bin(self.splats, camera, options, worlds=counts)
            checks.explain_invalid(int(self.bins.invalid), checked.quats)
            self.touched = self.bins.ranges[:, 1] > self.bins.ranges[:, 0]
            if backdrop:
                self._merge(backdrop)

    @cached_property
    def pictures(self) -> dict[str, torch.Tensor]:
        """By the names of RenderOutput, with one more dimension in front, on black."""
        with checks.explained(self.options, self.splats.means2d, [self.camera]):
            return self._draw()

    @torch.no_grad()
    def _draw(self) -> dict[str, torch.Tensor]:
        blending, black = Blending(self.bins, self.camera, self.options, self.driver), self.splats.depths.new_zeros(3)
        (image, alpha, depth), blending.saved = self.driver.blend(self.bins, self.camera, black, self.options, False)
        found = {"image": image, "alpha": alpha}
        if self.options.depth:
            found["depth"] = torch.where(alpha > 0, depth / alpha.clamp_min(1e-10), 0.0)
        if self.options.strongest:  # that takes numbers and weights from the lists, nothing from the splats
            found["strongest"], found["strongest_weights"], _ = find_strongest(self.splats, blending)
        shape = len(self.counts), self.bins.height
        shown = {name: table.view(*shape, *table.shape[1:]) for name, table in found.items()}
        if self.options.strongest:  # numbered by world
            first = len(self.backdrop.splats.radii) if self.backdrop else 0
            begins = send(torch.tensor([0, *self.counts[:-1]]).cumsum(0), image.device)
            shown["strongest"] -= torch.where(shown["strongest"] < first, 0, begins[:, None, None, None])
        if self.backdrop:
            own = self.bins.by_pixel(self.touched, self.camera.width).view_as(shown["alpha"])
            for name, behind in self.backdrop.pictures.items():
                shown[name] = torch.where(own if behind.dim() == 3 else own[..., None], shown[name], behind)
        return shown

    def _merge(self, backdrop: "Worlds") -> None:
        """Add the backdrop's lists to those of the tiles that are touched."""
        back, own, device = backdrop.bins, self.bins, self.touched.device
        behind, lengths = ((bins.ranges[:, 1] - bins.ranges[:, 0]).long() for bins in (back, own))
        lengths += torch.where(self.touched, behind.repeat(own.pictures), 0)
        ends = lengths.cumsum(0)
        check_count(count := int(ends[-1]), self.camera, len(own.splats), device)
        ranges, instances = torch.stack([ends - lengths, ends], 1).int(), own.instances.new_empty(count)
        slices = balanced_slices(ends.numpy()) if own.slices else []
        launch(merge_lists, len(ranges), [back.view(), own.view(), ranges], [instances], bounds=slices, device=device)
        splats = empty(len(back.splats) + len(own.splats), Splat2D, device)
        wp.copy(splats, back.splats)
        wp.copy(splats, own.splats, len(back.splats))
        numbers = torch.cat([wp.to_torch(back.gaussians), wp.to_torch(own.gaussians) + back.gaussian_count])
        listed = {"gaussians": wp.from_torch(numbers), "splats": splats, "instances": instances}
        self.bins: Bins = replace(own, ranges=ranges, slices=slices, **listed)

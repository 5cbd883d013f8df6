"""What travels between the stages of the renderer, and how kernels read it.

N Gaussians, V splats, M tile instances (a splat in the list of a tile), T tiles, H x W pixels.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
import warp as wp

from warp_splat.config import T_LEAST, TILE, RasterOptions
from warp_splat.kernels.bound import BoundView
from warp_splat.kernels.falloff import FalloffFunctions, make_falloff
from warp_splat.kernels.splat import BlendVariant
from warp_splat.kernels.structs import BinsView, PixelsView, Splats2DView
from warp_splat.runtime.launch import pack_struct

MAX_INSTANCES = 2**31 - 1  # kernels index instances with 32 bits
LESS = "render a smaller image or fewer, smaller Gaussians"  # where there is no room for the instances
LONG = 1000  # views: a training sees all of its photographs meanwhile, mostly several times
WIDTHS = (2, 3, 1, 3, 1)  # columns of a slot: mean, conic, opacity, color, and depth where it is asked for


class Gaussians(NamedTuple):
    """3D Gaussians, activated."""

    means: torch.Tensor  # [N, 3] world units
    quats: torch.Tensor  # [N, 4] (w, x, y, z), any norm
    scales: torch.Tensor  # [N, 3] standard deviations, world units
    opacities: torch.Tensor  # [N] 0..1
    sh_dc: torch.Tensor  # [N, 1, 3]
    sh_rest: torch.Tensor  # [N, K - 1, 3]

    @property
    def sh(self) -> torch.Tensor:
        """All coefficients, [N, K, 3]; a copy."""
        return torch.cat([self.sh_dc, self.sh_rest], 1)


class Splats2D(NamedTuple):
    """Gaussians projected; all 0 where culled."""

    means2d: torch.Tensor  # [N, 2] px
    conics: torch.Tensor  # [N, 3] 1/px^2, (xx, xy, yy) of the inverse 2D covariance
    opacities: torch.Tensor  # [N] after antialiasing
    colors: torch.Tensor  # [N, 3]
    depths: torch.Tensor  # [N] world units, z in the camera
    extents: torch.Tensor  # [N, 2] px, half sides of the box where alpha >= alpha_min; no gradient
    radii: torch.Tensor  # [N] int32, px; 0 if culled, -1 if invalid; no gradient

    def view(self) -> Splats2DView:
        """As kernels take them."""
        return pack_struct(Splats2DView, **self._asdict())


@dataclass
class Bins:
    """Tile lists. Splats are the Gaussians drawn, packed for the blend; on a GPU all: those not drawn have no tile."""

    gaussian_count: int  # N
    gaussians: wp.array  # [V] Gaussian of each splat: ascending; on a GPU, nearest first
    splats: wp.array  # [V] Splat2D
    instances: torch.Tensor  # [M] int32, splats, by tile, nearest first
    places: torch.Tensor  # [M] int32, where in ``instances`` a splat stands, splat by splat
    place_begins: torch.Tensor  # [V] int32, where in ``places`` those of each splat begin; on a GPU also the end
    ranges: torch.Tensor  # [T, 2] int32, first and last instance
    slices: list[int]  # bounds of slices of tiles with about equal work, for the threads of the CPU; on a GPU empty
    tiles_x: int
    height: int  # px of a picture
    invalid: int | torch.Tensor  # Gaussians left out because an input was not finite or a quaternion was zero
    pictures: int = 1  # below each other, with their tiles one after another
    bound: BoundView = field(default_factory=BoundView)  # filled in where the blend finds the bound

    def view(self, **saved: torch.Tensor) -> BinsView:
        """What every blend kernel reads first; ``saved``: ``blocks``, once they are known."""
        size = {"tiles_x": self.tiles_x, "tiles": len(self.ranges) // self.pictures, "height": self.height}
        lists = {"ranges": self.ranges, "instances": self.instances, "splats": self.splats}
        return pack_struct(BinsView, **size, **lists, **saved)

    def by_pixel(self, values: torch.Tensor, width: int) -> torch.Tensor:
        """Of each tile [T] to its pixels, [H, W]."""
        tiles = values.view(self.pictures, -1, self.tiles_x)
        pixels = tiles.repeat_interleave(TILE, 1).repeat_interleave(TILE, 2)[:, : self.height, :width]
        return pixels.reshape(-1, width)

    def new_gradients(self, slots: torch.Tensor) -> list[torch.Tensor]:
        """Room for what slots sum up to, [N, width] each; zeros for depths, if slots have none."""
        grads = [slots.new_empty(self.gaussian_count, width) for width in WIDTHS]
        if slots.shape[1] < sum(WIDTHS):
            grads[-1].zero_()
        return grads


@dataclass
class Room:
    """For how many tile instances a GPU makes room before it knows their number; kept from one view to the next.

    It is a quarter more than there were in any view so far. As long as none is known, the host waits for the number.
    The number of a view is on its way to the host while the view is rendered; see :meth:`overflowed`. Where views have
    needed less than half of it for LONG, it shrinks to what the largest of these takes.
    """

    instances: int = 0  # 0: not known
    counted: Callable[[], list] | None = None  # tile instances of the last view
    recent: int = 0  # the most that any view needed since `views` was 0
    views: int = 0

    def learn(self, count: int) -> None:
        """Make room for ``count`` and some more, in steps of an eighth at most: memory of the same size is at hand."""
        self.instances = max(self.instances, _with_spare(count))
        self.recent, self.views = max(self.recent, count), self.views + 1
        if self.views == LONG:
            enough = _with_spare(self.recent)
            self.instances = enough if 2 * enough < self.instances else self.instances
            self.recent = self.views = 0

    def overflowed(self) -> bool:
        """Whether the last view had more than there was room for: what it shows is wrong. The next one is waited for.

        To be asked once the view has been launched: only its instances need have been counted by then.
        """
        if self.counted is None:
            return False
        (count,), room, self.counted = self.counted(), self.instances, None
        self.learn(count)
        if count > room:
            self.instances = 0
        return count > room


def _with_spare(count: int) -> int:
    """Room for ``count`` instances; see :meth:`Room.learn`."""
    wanted = count + count // 4
    step = 1 << max(wanted.bit_length() - 4, 10)
    return -(-wanted // step) * step


class Pixels(NamedTuple):
    """An image, or the upstream gradient of one."""

    image: torch.Tensor  # [H, W, 3]
    alpha: torch.Tensor  # [H, W]
    depth: torch.Tensor  # [H, W] world units, sum of weight times z; [0, 0] if not asked for

    def view(self) -> PixelsView:
        """As kernels take them."""
        return pack_struct(PixelsView, **self._asdict())


class Saved(NamedTuple):
    """What a blend leaves for its adjoint, in the layout of its device."""

    final: torch.Tensor  # [T, a tile's pixels] transmittance behind the last Gaussian
    count: torch.Tensor  # [T, a tile's pixels] instances walked before the pixel stopped
    blocks: torch.Tensor  # [M] int32, blocks of its tile in which an instance is blended, a bit each; on a GPU [0]
    kept: torch.Tensor  # [M, a tile's pixels] every transmittance; [0, ...] if not asked for


def plus(counted: int | torch.Tensor, more: torch.Tensor) -> torch.Tensor:
    """Their sum; no operation, where nothing was counted so far."""
    return more if isinstance(counted, int) and not counted else counted + more


@dataclass
class Dropped:
    """What the adjoint refused to spread: counted during ``backward``, where that ran, and read when asked for."""

    pixel_count: int | torch.Tensor = 0
    gaussian_count: int | torch.Tensor = 0

    @property
    def pixels(self) -> int:
        """Pixels whose upstream gradient was not finite; counted for each output that has one."""
        return int(self.pixel_count)

    @property
    def gaussians(self) -> int:
        """Gaussians whose own gradient was not finite."""
        return int(self.gaussian_count)


def falloff_of(options: RasterOptions) -> FalloffFunctions:
    """What kernels call for the falloff of ``options``."""
    return make_falloff(variant_of(options).falloff)


def variant_of(options: RasterOptions, keep: bool = False, bound: bool = False, hides: bool = False) -> BlendVariant:
    """What the kernels are compiled for; see :class:`BlendVariant`."""
    falloff = options.exp_degree if options.falloff is None else options.falloff
    ideal, floor = bound and options.tolerance is None, bound and options.of == "trained"
    return BlendVariant(3 + options.depth, falloff, keep, bound, ideal, floor, hides)


def alphas_of(options: RasterOptions) -> wp.vec2:
    """Below which opacity a Gaussian is skipped at a pixel, and to which it is clamped, as kernels take it."""
    return wp.vec2(options.alpha_min, options.alpha_max)


def limits_of(options: RasterOptions) -> list:
    """Where a pixel stops, as kernels take it: its least transmittance, and the entries of the list that it sees."""
    steps = MAX_INSTANCES if options.max_steps is None else min(options.max_steps, MAX_INSTANCES)
    return [max(options.t_min, T_LEAST), steps]

"""How far each pixel can be from the ideal: what kernels are told, and where they write it (docs/tolerance.md)."""

from dataclasses import dataclass, replace

import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.config import ALPHA_MIN, TILE, RasterOptions
from warp_splat.errors import InputError
from warp_splat.kernels.bound import FAINT, SEEN, BoundView, Rules, make_spread
from warp_splat.raster.data import Bins, Gaussians, Splats2D, falloff_of
from warp_splat.raster.drivers import driver_of
from warp_splat.raster.seam import Crossing, with_copies
from warp_splat.runtime.launch import launch, pack_struct
from warp_splat.runtime.pool import even_slices

#: Where maps of depth begin, as shares of the Gaussians: most is hidden by what is near.
STARTS = (0.06, 0.15, 0.3, 0.55)
BAND = 1e-4  # around 1/255, where rounding decides what the reference leaves out
SURE = (1.0 + BAND) * ALPHA_MIN
SAMPLE = 2048  # Gaussians that tell depths and colors
#: Relative error of alpha by the degree of its exponential (kernels/falloff.py).
EXP_ERRORS = {3: 7.6e-5, 4: 3.1e-6, 5: 1.8e-7, 6: 1.8e-7, None: 1.8e-7}
ROUNDED_COLORS = 64 * 2.0**-24  # of the brightest


@dataclass
class Certificate:
    """What the blend reads for the bound of a view, and the bound."""

    bound: torch.Tensor  # [H, W]
    rounding: torch.Tensor  # [H, W], the part of it that no other cut takes away
    errors: torch.Tensor  # [N, 3]
    fields: dict  # of a BoundView

    def view(self, bins: Bins) -> BoundView:
        """As the blend takes it: by splat."""
        if len(bins.gaussians):  # else one row stands there: Warp takes no array of nothing
            self.errors = self.errors[wp.to_torch(bins.gaussians).long()]
        out = {"bound_out": self.bound, "rounding_out": self.rounding}
        return pack_struct(BoundView, errors=self.errors, **out, **self.fields)


def far_reaching(options: RasterOptions) -> RasterOptions:
    """Options for the projection: for the bound, what is too faint to be drawn counts, too."""
    if options.tolerance is not None:  # which finds a cut of its own
        return replace(options, alpha_min=FAINT)
    return replace(options, alpha_min=min(options.alpha_min, FAINT)) if options.bound else options


def looking(options: RasterOptions) -> RasterOptions:
    """Options for the lists: the blend looks farther than to its cut, and so knows what it skips."""
    if not options.bound:
        return options
    least = min(0.9 * ALPHA_MIN, options.alpha_min) if options.of == "trained" else SEEN * options.alpha_min
    return replace(options, alpha_min=least)


def drawing(options: RasterOptions) -> RasterOptions:
    """Options for the blend: within a tolerance, all that it looks at is drawn."""
    return replace(options, alpha_min=FAINT) if options.tolerance is not None and options.of == "ideal" else options


def certify(
    splats: Splats2D,
    gaussians: Gaussians,
    crossing: Crossing,
    camera: Camera,
    background: torch.Tensor,
    options: RasterOptions,
) -> tuple[Splats2D, Certificate]:
    """The splats as they are drawn, of those that :func:`far_reaching` options give; and what the blend is told.

    Raises:
        InputError: if the background is negative, or no color.
    """
    if background.dim() != 1 or float(background.detach().min()) < 0.0:
        raise InputError("options.bound: expected a background of one color without negative numbers; give one.")
    with torch.no_grad():
        count, device, faint = len(splats.radii), background.device, min(options.alpha_min, FAINT)
        colors, behind = splats.colors.detach(), float(background.detach().max())
        drawn = max(float(colors.max()) if count else 0.0, behind)  # the brightest color
        errors = _color_errors(gaussians, options, drawn)
        scales, errors = (with_copies(tensor, crossing) for tensor in (gaussians.scales.detach(), errors))
        brightest = max(float((colors + errors[:, 2:]).max()) if count else 0.0, behind)  # with harmonics left out
        sample = torch.nonzero(splats.radii[:: max(count // SAMPLE, 1)] > 0)[:, 0] * max(count // SAMPLE, 1)
        usual, begins = 1e-3, [-torch.inf]
        if len(sample):
            depths = splats.depths.detach()[sample].sort().values
            begins += depths[[int(len(sample) * share) for share in STARTS]].tolist()
            usual = max(float(colors[sample].amax(1).median()), 1e-3 * brightest, 1e-30)
        rules = Rules()
        rules.focal, rules.principal = wp.vec2(camera.fx, camera.fy), wp.vec2(camera.cx, camera.cy)
        rules.seen = looking(options).alpha_min
        rules.faint, rules.square = faint, int(options.extent == "square")
        rules.floor = ALPHA_MIN if options.of == "trained" else 0.0
        rules.exp_error = 1e-6 if options.falloff else EXP_ERRORS[options.exp_degree]
        worst = 4.0 * max(options.alpha_min, faint, 0.012 * rules.square)  # alpha outside of where the blend looks
        rules.usual, rules.unit = usual, 1.1 * max(count, 1) * worst * max(brightest / usual, 1.0) / 2**31
        lost = torch.zeros(1, dtype=torch.int32, device=device)
        threads = driver_of(device).peeks  # each has maps of its own
        bounds = even_slices(count) if threads else list(range(count + 1))
        rows, columns = 4 * -(-camera.height // TILE), 4 * -(-camera.width // TILE)
        new = {"dtype": torch.int32, "device": device}
        maps = torch.zeros(len(bounds) - 1 if threads else 1, len(begins), rows + 1, columns + 1, **new)
        starts, bands = colors.new_tensor(begins), torch.tensor(bounds, **new)
        extents, radii = torch.empty_like(splats.extents), torch.empty_like(splats.radii)
        if count:
            inputs, outputs = [bands, splats.view(), scales, rules, starts], [maps, lost, extents, radii, errors]
            kernel, one_each = make_spread(falloff_of(options)), list(range(len(bounds))) if threads else None
            launch(kernel, len(bounds) - 1, inputs, outputs, bounds=one_each, device=device)
        outside = maps.sum(0, dtype=torch.int32).cumsum(1, dtype=torch.int32).cumsum(2, dtype=torch.int32)
    fields = {
        "outside": outside[:, :-1, :-1].contiguous(),
        "unit": rules.unit,
        "usual": usual,
        "begins": starts,
        "brightest": brightest,
        "shade": float(errors[:, 2].max()),
        "darkest": float(background.detach().min()),
        "behind": behind,
        "everywhere": 0.0 if rules.floor else 2.0 * count * faint * max(brightest, 1.0),
        "unknown": float(lost),
        "floor": wp.vec2((1.0 - BAND) * ALPHA_MIN, SURE) if rules.floor else wp.vec2(faint),
    }
    bound, rounding = (colors.new_empty(camera.height, camera.width) for _ in range(2))
    return splats._replace(extents=extents, radii=radii), Certificate(bound, rounding, errors, fields)


def _color_errors(gaussians: Gaussians, options: RasterOptions, brightest: float) -> torch.Tensor:
    """[N, 3], of which the last column is filled: rounding, and the bands of harmonics that are left out.

    A band of degree l is at most sqrt((2 l + 1) / 4 pi) times the norm of its coefficients.
    """
    errors = gaussians.means.new_empty(max(len(gaussians.means), 1), 3)
    errors[:, 2] = ROUNDED_COLORS * brightest
    rest = gaussians.sh_rest.detach()
    for degree, (low, high) in enumerate(((0, 3), (3, 8), (8, 15)), 1):
        if options.sh_degree is not None and options.sh_degree < degree and rest.shape[1] >= high:
            norms = rest[:, low:high].norm(dim=1).amax(1)
            errors[: len(rest), 2] += ((2 * degree + 1) / (4 * torch.pi)) ** 0.5 * norms
    return errors

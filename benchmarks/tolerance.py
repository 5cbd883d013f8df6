"""Error against run time: a tolerance, and each knob of the forward pass alone.

Truth is float64 without any cut, at random pixels of one view. A training view is shrunk to --width. Errors are those
of the worst of these pixels and of half of them; the bound is found with a tolerance alone.

    python benchmarks/tolerance.py -s SCENE -m MODEL [-s SCENE -m MODEL ...] [--crowd 1000000] [--out docs/benchmarks]
"""

from dataclasses import replace
from pathlib import Path

import torch
from common import interleaved, option, parse, write_table
from knobs import KNOBS
from made_up import cameras, make_crowd
from numerics import PAIRS, some_pixels, views_of
from panels import Panel, draw_panels

from warp_splat.camera import Camera
from warp_splat.compare import oracle
from warp_splat.compare.stability import cases, verdict
from warp_splat.compare.truth import for_oracle
from warp_splat.config import ALPHA_MIN, RasterOptions
from warp_splat.raster.api import render
from warp_splat.raster.data import Gaussians
from warp_splat.runtime import launch, pool

TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
HEADERS = ("scene", "options", "error, worst", "error, median", "bound, worst", "bound, median", "bound : error")
HEADERS += ("times default", "adjoint")
PLOTTED = ("extent", "exp_degree", "max_steps")  # and not in the table
BETWEEN = ("1e-05", "1e-08")  # likewise
ROUNDS = 2
MOST = 500_000  # Gaussians that are listed in all tiles, as without a cut; more do not fit


def variants(count: int) -> dict[str, tuple[str, RasterOptions]]:
    """By name: the curve that it belongs to, and the options; for so many Gaussians."""
    found = {"default": ("default", RasterOptions(bound=True))}
    for of in ("ideal", "trained"):
        for tolerance in TOLERANCES:
            found[f"tolerance {tolerance:g}, {of}"] = (f"tolerance, {of}", RasterOptions(tolerance=tolerance, of=of))
    for knob, values in KNOBS.items():
        for value in values:
            if value != getattr(RasterOptions(), knob) and (knob != "alpha_min" or value > 0.0 or count <= MOST):
                shown = f"{value:.3g}" if isinstance(value, float) else value
                found[f"{knob} {shown}"] = (knob, RasterOptions(**{knob: value}))
    return found


@torch.no_grad()
def exact(gaussians: Gaussians, camera: Camera, pixels: torch.Tensor, alpha_min: float, at_once: int) -> torch.Tensor:
    """The ideal at ``pixels`` [P, 2], [P, 3] float64; with ``alpha_min``, what is trained."""
    means, quats, scales, opacities, sh_dc, sh_rest = (tensor.double() for tensor in gaussians)
    splats = (means, quats, scales, opacities, torch.cat([sh_dc, sh_rest], 1))
    cuts = {"alpha_min": alpha_min, "t_min": 0.0}
    parts = [oracle.exact_render(*splats, camera, pixels=part, **cuts).image for part in pixels.split(at_once)]
    return torch.cat(parts)


def measure(name: str, gaussians: Gaussians, camera: Camera, count: int) -> list[dict]:
    """A row for each variant."""
    pixels, black = some_pixels(camera, count, torch.Generator().manual_seed(0)), torch.zeros(3)
    at_once = max(2_000_000 // len(gaussians.means), 1)
    truths = {
        of: exact(gaussians, camera, pixels, alpha_min, at_once)
        for of, alpha_min in (("ideal", 0.0), ("trained", ALPHA_MIN))
    }
    leaves = Gaussians(*(tensor.clone().requires_grad_() for tensor in gaussians))

    def adjoint(options: RasterOptions) -> None:
        render(leaves, camera, black, options).image.sum().backward()

    rows, forward, both = [], {}, {}
    for variant, (curve, options) in variants(len(gaussians.means)).items():
        with torch.no_grad():
            out = render(gaussians, camera, black, options)
        rows_of, columns_of = pixels.T
        error = (out.image[rows_of, columns_of].double() - truths[options.of]).abs().amax(1)
        row = {"scene": name, "options": variant, "curve": curve, "of": options.of}
        row |= {"worst": error.max().item(), "median": error.median().item()}
        if out.bound is not None:
            bound = out.bound[rows_of, columns_of]
            ratio = bound / error.clamp_min(1e-9)
            row |= {"bound": bound.max().item(), "bound_median": bound.median().item()}
            row |= {"ratio": ratio.median().item(), "ratio_99": ratio.quantile(0.99).item()}
            row |= {"exceeded": int((error > bound).sum())}
        rows.append(row)
        timed = replace(options, bound=False)
        forward[variant] = lambda options=timed: render(gaussians, camera, black, options)
        both[variant] = lambda options=timed: adjoint(options)
    with torch.no_grad():
        seconds = interleaved(forward, ROUNDS)
        bounded = {
            "bound": lambda: render(gaussians, camera, black, RasterOptions(bound=True)),
            "none": lambda: render(gaussians, camera, black, RasterOptions()),
        }
        cost = interleaved(bounded, 4 * ROUNDS)
    with_adjoint = interleaved(both, ROUNDS)
    for row in rows:
        variant = row["options"]
        row |= {"seconds": seconds[variant], "times": seconds[variant] / seconds["default"]}
        row["adjoint"] = with_adjoint[variant] / with_adjoint["default"]
    rows[0]["cost of bound"] = cost["bound"] / cost["none"]
    return rows


def stiff() -> list[dict]:
    """A row for each stiff or extreme case that is rendered: error and bound of the pixels whose order is known."""
    rows = []
    for case in cases.CASES:
        if not case.build:
            continue
        problem = case.build()
        kept = torch.tensor(sorted(set(range(len(problem.gaussians["means"]))) - set(problem.left_out)))
        drawn = replace(problem, gaussians={name: found[kept] for name, found in problem.gaussians.items()})
        with torch.no_grad():
            leaves = verdict.leaves_of(drawn, torch.float32)
            gaussians, background = verdict.activated(drawn, leaves), leaves["background"].detach()
            out = render(gaussians, problem.camera, background, replace(problem.options, bound=True))
            means, quats, scales, opacities, sh_dc, sh_rest = (tensor.double() for tensor in gaussians)
            view = for_oracle(problem.options) | {"alpha_min": 0.0, "t_min": 0.0, "sh_degree": None}
            sh = torch.cat([sh_dc, sh_rest], 1)
            exact = oracle.exact_render(
                means, quats, scales, opacities, sh, problem.camera, background.double(), **view
            )
        sure = ~exact.fragile
        if sure.any() and out.bound is not None:
            error, bound = (out.image - exact.image).abs().amax(2)[sure], out.bound[sure]
            ratio = (bound / error.clamp_min(1e-9)).median().item()
            rows.append({"case": case.name, "worst": error.max().item(), "bound": bound.max().item(), "ratio": ratio})
            rows[-1]["exceeded"] = int((error > bound).sum())
    return rows


def plot(path: Path, rows: list[dict]) -> None:
    """Worst error over time, one panel for each scene."""
    panels = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        panels.append(
            panel := Panel(
                f"{scene}: error of the worst pixel", "time of the forward pass, times the default's", ticks=True
            )
        )
        ideal = [row for row in rows if (row["scene"], row["of"]) == (scene, "ideal")]
        for curve in dict.fromkeys(row["curve"] for row in ideal):
            points = sorted((row["times"], row["worst"]) for row in ideal if row["curve"] == curve)
            style = {"lw": 2.5, "color": "black"} if curve.startswith("tolerance") else {"alpha": 0.8}
            panel.line(curve, *zip(*points, strict=True), marker="o", markersize=4, **style)
    draw_panels(path, panels, 2, 2.8)


def write(rows: list[dict], extreme: list[dict], count: int, out: Path | None) -> None:
    """The table, and the plot."""
    keys = ("worst", "median", "bound", "bound_median", "ratio", "times", "adjoint")
    shown = [row for row in rows if row["curve"] not in PLOTTED and not any(map(row["options"].count, BETWEEN))]
    cells = [
        (row["scene"], row["options"], *(f"{row[key]:.2g}" if key in row else "" for key in keys)) for row in shown
    ]
    ratios = sorted(row["ratio"] for row in extreme)
    exceeded = sum(row.get("exceeded", 0) for row in rows + extreme)
    costs = [f"{row['scene']} {row['cost of bound']:.2f}" for row in rows if "cost of bound" in row]
    note = (
        f"{count} pixels of a view; {pool.get_threads()} threads. With the bound, the default takes so many times as "
        f"long: {', '.join(costs)}. In {len(extreme)} stiff and extreme cases, bound over error is "
        f"{ratios[len(ratios) // 2]:.0f} in the median case. {exceeded} pixels were off by more than their bound."
    )
    write_table("tolerance", out, HEADERS, cells, note, {"rows": rows, "stiff": extreme})
    if out:
        plot(out / "tolerance.png", rows)


def main() -> None:
    arguments = parse(
        __doc__,
        *PAIRS,
        option("--width", type=int, default=480, help="of the view [px]"),
        option("--crowd", type=int, nargs="*", default=[], help="Gaussians of crowds made up"),
        option("--pixels", type=int, default=200),
    )
    launch.prepare("cpu", 0)
    rows, extreme = [], stiff()
    for name, gaussians, camera in views_of(arguments):
        rows += measure(name, gaussians, camera, arguments.pixels)
        write(rows, extreme, arguments.pixels, arguments.out)
    for count in arguments.crowd:
        with torch.no_grad():
            gaussians = make_crowd(count, "cpu").activated()
        camera = cameras(arguments.width, arguments.width * 9 // 16, 1)[0]
        rows += measure(f"crowd of {count}", gaussians, camera, arguments.pixels // 4)
        write(rows, extreme, arguments.pixels, arguments.out)


if __name__ == "__main__":
    main()

"""Splats against physics, measured: how three integrators fare on stiff media, and what each splatting shortcut costs.

The physics is :mod:`warp_splat.compare.volume`; here are the media and scenes, the measurements, tables and pictures.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from warp_splat.camera import Camera
from warp_splat.compare import volume as physics
from warp_splat.compare.volume import Volume
from warp_splat.formats.atomic import atomic_write, write_json
from warp_splat.report import BLUE, DPI, FAINT, GREEN, INK, ORANGE, WIDTH, format_table

#: name: (integrator, evaluations of the medium per step, largest stable tau ds in theory, color, marker)
METHODS = {
    "exponential": (physics.integrate_exponential, 1, np.inf, BLUE, "o"),
    "Euler": (physics.integrate_euler, 1, 2.0, ORANGE, "s"),
    "RK4": (physics.integrate_rk4, 2, 2.785293563405282, GREEN, "^"),
}
OPTICAL_DEPTHS = (1e-2, 1.0, 1e2, 1e4, 1e6)
SAMPLES = [2**k for k in range(3, 13)]
RAYS = 64
FAR = 20.0  # world units; the media of the integrators lie between 0 and here
REPEATS = 5
UNSTABLE = 1.0  # an error as large as the whole range of color, or one that is no number
LIMIT_DEPTHS = (1e2, 1e3, 1e4)  # media in which the largest stable step is sought

#: Rung of the ladder: the image that it changes in one thing, so that the difference is that thing's own cost.
PARENT = {
    "no overlap": "truth",
    "linear depth": "no overlap",
    "linear peak": "no overlap",
    "affine": "no overlap",
    "ellipsoid": "no overlap",
    "affine + blur": "affine",
    "3DGS": "truth",
}
PICTURED = ("overlapping", "needle at the edge", "cluster")
LEAST_ERROR = 1e-4  # black in the error maps, a fortieth of a step of 8-bit color


def run(out: Path, say: Callable[[str], None] = print) -> dict[str, list[dict[str, Any]]]:
    """Measure everything; takes about half a minute on one core.

    Args:
        out: folder for volume.json, volume.csv, volume_stiff.png and volume_maps.png; created if it is missing.
        say: receives the tables and headings.

    Returns:
        ``integrators``, ``limits`` and ``ladder``: records as written to volume.json.

    Raises:
        InputError: if a file cannot be written.
    """
    out = Path(out)
    integrators, limits = measure_integrators(), measure_limits()
    say(f"Error of C(0), the largest of {RAYS} rays, by samples per ray (and run time for all rays)\n")
    say(_integrator_table(integrators))
    say("\nLargest stable tau ds, tau at its peak\n")
    say(_limit_table(limits))
    images, ladder = measure_ladder()
    say("\nSplatting against the truth (colors 0 to 1; 300 dB is exact); own: against the rung that it changes\n")
    say(_ladder_table(ladder))
    doubt = max(record["truth_error"] for record in integrators + ladder)
    say(f"\nThe truths change by at most {doubt:.1e} when their panels are doubled.")
    results = {"integrators": integrators, "limits": limits, "ladder": ladder}
    write_json(out / "volume.json", results)
    _write_csv(out / "volume.csv", results)
    plot_integrators(out / "volume_stiff.png", integrators, limits)
    plot_maps(out / "volume_maps.png", {name: images[name] for name in PICTURED})
    return results


# media and scenes -------------------------------------------------------------------------------------------------


def stiff_medium(optical_depth: float, rays: int = RAYS) -> tuple[physics.Profile, Volume]:
    """A fan of rays through two overlapping Gaussians of different color, ``optical_depth`` along the first ray."""
    volume = Volume(
        means=[[0, 0, 10], [0.4, 0.1, 10.5]],
        quats=[[1, 0, 0, 0], [0.9, 0.2, 0.3, 0.1]],
        scales=[[1, 1, 1], [1.2, 0.6, 1.1]],
        densities=[1, 1],
        colors=[[0.9, 0.3, 0.1], [0.1, 0.4, 0.9]],
        background=[0.2, 0.8, 0.4],
    )
    directions = np.stack([np.linspace(0, 0.1, rays), np.zeros(rays), np.ones(rays)], 1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    profile = physics.ray_profile(volume, np.zeros(3), directions)
    return replace(profile, peak=profile.peak * optical_depth / profile.depths()[0].sum()), volume


def _scene(camera: Camera, means, scales, optical_depths, colors, quats=None) -> tuple[Volume, Camera]:
    """Gaussians with an optical depth through the center as the camera sees it; unrotated unless ``quats``."""
    count = len(means)
    quats = np.tile([1.0, 0, 0, 0], (count, 1)) if quats is None else quats
    volume = Volume(means, quats, scales, np.ones(count), colors, [0.05, 0.05, 0.08])
    return replace(volume, densities=optical_depths / physics.peak_depths(volume, camera)), camera


def _camera(size: int = 48, focal: float = 48.0) -> Camera:
    return Camera(size, size, focal, focal, size / 2, size / 2, np.eye(3), np.zeros(3))


def _cluster() -> tuple[Volume, Camera]:
    rng, count = np.random.default_rng(7), 32
    means = rng.normal(size=(count, 3)) * [0.55, 0.55, 0.4] + [0, 0, 4]
    scales = np.exp(rng.uniform(np.log(0.08), np.log(0.45), (count, 3)))
    optical_depths = np.exp(rng.uniform(np.log(0.3), np.log(6), count))
    return _scene(_camera(), means, scales, optical_depths, rng.uniform(0, 1, (count, 3)), rng.normal(size=(count, 4)))


ORANGE_BLUE = np.array([[0.95, 0.55, 0.1], [0.1, 0.4, 0.9]])
SCENES: dict[str, Callable[[], tuple[Volume, Camera]]] = {
    "one": lambda: _scene(_camera(), [[0, 0, 4]], [[0.5, 0.35, 0.4]], np.array([2.0]), ORANGE_BLUE[:1]),
    "separated": lambda: _scene(
        _camera(), [[-0.2, 0, 3], [0.4, 0, 9]], [[0.3] * 3, [1.0] * 3], np.array([1.5, 3.0]), ORANGE_BLUE
    ),
    "overlapping": lambda: _scene(
        _camera(), [[-0.25, 0, 4], [0.25, 0, 4.2]], [[0.5, 0.5, 0.6]] * 2, np.array([3.0, 3.0]), ORANGE_BLUE
    ),
    "needle along its axis": lambda: _scene(
        _camera(), [[0, 0, 5]], [[0.08, 0.08, 0.8]], np.array([4.0]), ORANGE_BLUE[:1]
    ),
    "needle at the edge": lambda: _scene(
        _camera(focal=17.0), [[2.6, 0.6, 3.0]], [[0.35, 0.35, 0.8]], np.array([3.0]), ORANGE_BLUE[:1]
    ),
    "cluster": _cluster,
}


# measuring --------------------------------------------------------------------------------------------------------


def measure_integrators() -> list[dict[str, Any]]:
    """Error and run time of each integrator at each optical depth and number of samples."""
    records = []
    for optical_depth in OPTICAL_DEPTHS:
        profile, volume = stiff_medium(optical_depth)
        medium = profile.medium(volume.colors)
        truth = physics.integrate_exact(profile, volume.colors, volume.background, 128)
        doubled = physics.integrate_exact(profile, volume.colors, volume.background, 256)
        seconds: dict[tuple[str, int], list[float]] = {(name, count): [] for name in METHODS for count in SAMPLES}
        radiance = {}
        for _ in range(REPEATS):  # interleaved, so that a disturbance meets all alike
            for (name, count), times in seconds.items():
                radiance[name, count] = _integrate(name, medium, count, volume.background)  # memory and caches ready
                start = time.perf_counter()
                _integrate(name, medium, count, volume.background)
                times.append(time.perf_counter() - start)
        records += [
            {
                "optical_depth": optical_depth,
                "method": name,
                "samples": count,
                "peak_tau_ds": _peak(profile) * FAR * METHODS[name][1] / count,
                "error": _error(radiance[name, count], truth),
                "stable": _error(radiance[name, count], truth) < UNSTABLE,
                "seconds": float(np.median(times)),
                "truth_error": _error(truth, doubled),
            }
            for (name, count), times in seconds.items()
        ]
    return records


def measure_limits() -> list[dict[str, Any]]:
    """The largest stable tau ds, tau at its peak: in a slab of constant tau, and on a ray through Gaussians.

    There a larger step may pass, since the near flank damps what the dense core has amplified; the denser the medium,
    the more steps amplify, until nothing can damp them, and the limit falls to that of the slab.
    """
    records = []
    for name, (integrate, _, theory, *_) in METHODS.items():
        records.append({"medium": "slab", "method": name, "theory": theory, "measured": _slab_limit(integrate)})
    for optical_depth in LIMIT_DEPTHS:
        profile, volume = stiff_medium(optical_depth, rays=1)
        medium = profile.medium(volume.colors)
        truth = physics.integrate_exact(profile, volume.colors, volume.background, 128)
        for name, (integrate, _, theory, *_) in METHODS.items():
            steps = np.unique((_peak(profile) * FAR / np.geomspace(1, 20, 60)).astype(int))
            errors = [_error(integrate(medium, 0.0, FAR, int(n), volume.background), truth) for n in steps]
            tau_ds = _peak(profile) * FAR / steps
            bad = np.flatnonzero(~(np.array(errors) < UNSTABLE))
            measured = np.inf if not len(bad) else float(tau_ds[bad[-1] + 1])
            records.append(
                {
                    "medium": f"Gaussians, optical depth {_plain(optical_depth)}",
                    "method": name,
                    "theory": theory,
                    "measured": measured,
                    "tau_ds": tau_ds.tolist(),
                    "errors": errors,
                }
            )
    return records


def _integrate(name: str, medium: physics.Medium, samples: int, background: np.ndarray) -> np.ndarray:
    integrate, evaluations, *_ = METHODS[name]
    return integrate(medium, 0.0, FAR, samples // evaluations, background)


def _error(radiance: np.ndarray, truth: np.ndarray) -> float:
    """The largest difference; inf where a result is no number."""
    return float(np.nan_to_num(np.abs(radiance - truth), nan=np.inf).max())


def _peak(profile: physics.Profile) -> float:
    """The largest extinction on the first ray, 1 / world unit."""
    return float(profile.extinction(np.linspace(0, FAR, 4001)[:, None]).sum(-1)[:, 0].max())


def _slab_limit(integrate: Callable) -> float:
    """The largest tau ds at which 2000 steps through a dark slab do not amplify the light behind it; by bisection."""

    def grows(tau_ds: float) -> bool:
        return not integrate(slab, 0.0, 2000 * tau_ds, 2000, np.ones(3)).max() <= 1

    def slab(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.ones((len(s), 1)), np.zeros((len(s), 1, 3))

    stable, unstable = 0.1, 1e6
    if not grows(unstable):
        return np.inf
    while unstable - stable > 1e-6 * stable:
        middle = np.sqrt(stable * unstable)
        stable, unstable = (stable, middle) if grows(middle) else (middle, unstable)
    return float(stable)


def measure_ladder() -> tuple[dict[str, dict[str, np.ndarray]], list[dict[str, Any]]]:
    """The images of each scene, "truth" and the rungs, and the errors of the rungs."""
    images, records = {}, []
    for scene, make in SCENES.items():
        volume, camera = make()
        truth = physics.render_volume(volume, camera)
        truth_error = _error(physics.render_volume(volume, camera, panels=32), truth)
        images[scene] = {"truth": truth, **physics.splat_ladder(volume, camera)}
        for rung, parent in PARENT.items():
            error = np.abs(images[scene][rung] - truth)
            own = np.abs(images[scene][rung] - images[scene][parent])
            records.append(
                {
                    "scene": scene,
                    "rung": rung,
                    "mean": float(error.mean()),
                    "max": float(error.max()),
                    "psnr": float(-10 * np.log10(max((error**2).mean(), 1e-30))),
                    "parent": parent,
                    "own_mean": float(own.mean()),
                    "own_max": float(own.max()),
                    "truth_error": truth_error,
                }
            )
    return images, records


# tables -----------------------------------------------------------------------------------------------------------


def _plain(number: float) -> str:
    """0.01 and 1,000,000, not 1e+06."""
    return f"{number:,.0f}" if number >= 1 else f"{number:g}"


def _integrator_table(records: Sequence[Mapping[str, Any]]) -> str:
    shown = (8, 64, 512, 4096)
    cells = {(r["optical_depth"], r["method"], r["samples"]): r for r in records}

    def cell(record: Mapping[str, Any]) -> str:
        error = f"{record['error']:.1e}" if record["stable"] else "unstable"
        return f"{error} ({1e3 * record['seconds']:.2g} ms)"

    rows = [
        [_plain(depth), name, *(cell(cells[depth, name, count]) for count in shown)]
        for depth in OPTICAL_DEPTHS
        for name in METHODS
    ]
    return format_table(["optical depth", "integrator", *(f"{count} samples" for count in shown)], rows)


def _limit_table(records: Sequence[Mapping[str, Any]]) -> str:
    def cell(value: float) -> str:
        return "none found" if np.isinf(value) else f"{value:.3f}"

    rows = [
        [r["medium"], r["method"], "none" if np.isinf(r["theory"]) else cell(r["theory"]), cell(r["measured"])]
        for r in records
    ]
    return format_table(["medium", "integrator", "theory (constant tau)", "measured"], rows)


def _ladder_table(records: Sequence[Mapping[str, Any]]) -> str:
    def cells(r: Mapping[str, Any], *keys: str) -> list[str]:
        return [f"{r[key]:.1e}" for key in keys]

    rows = [
        [
            r["scene"],
            r["rung"],
            *cells(r, "mean", "max"),
            f"{r['psnr']:.1f}",
            r["parent"],
            *cells(r, "own_mean", "own_max"),
        ]
        for r in records
    ]
    headers = ["scene", "rung", "mean error", "max error", "PSNR [dB]", "changes", "own mean", "own max"]
    return format_table(headers, rows)


def _write_csv(path: Path, results: Mapping[str, Sequence[Mapping[str, Any]]]) -> None:
    """All records in one table, a column for each number that any of them has; the curves are in the JSON only."""
    rows = [
        {"table": table, **{key: value for key, value in record.items() if not isinstance(value, list)}}
        for table, records in results.items()
        for record in records
    ]
    with atomic_write(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(key for row in rows for key in row)))
        writer.writeheader()
        writer.writerows(rows)


# pictures ---------------------------------------------------------------------------------------------------------


def plot_integrators(path: Path, integrators: Sequence[Mapping[str, Any]], limits: Sequence[Mapping[str, Any]]) -> None:
    """Draw error against run time, a panel for each optical depth, and error against tau ds around the limits."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - half a second, only for pictures

    figure = Figure(figsize=(WIDTH, 5.4), dpi=DPI, layout="constrained", facecolor="white")
    figure.supylabel("largest error of the radiance (colors 0 to 1)", fontsize=9, color=INK)
    panels = figure.subplots(2, 3).ravel()
    for axes, optical_depth in zip(panels, OPTICAL_DEPTHS, strict=False):
        chosen = [r for r in integrators if r["optical_depth"] == optical_depth]
        _style(axes, f"optical depth {_plain(optical_depth)}", f"run time for {RAYS} rays [ms]", "")
        for name, (*_, color, marker) in METHODS.items():
            stable = [(1e3 * r["seconds"], r["error"]) for r in chosen if r["method"] == name and r["stable"]]
            unstable = [1e3 * r["seconds"] for r in chosen if r["method"] == name and not r["stable"]]
            if stable:
                axes.plot(*zip(*stable, strict=True), color=color, marker=marker, markersize=4, linewidth=1.4)
            # crosses in a row of their own, above every error
            axes.plot(unstable, [6.0 if name == "Euler" else 60.0] * len(unstable), "x", color=color, markersize=5)
        axes.set_ylim(1e-16, 1e3)
        axes.axhline(UNSTABLE, color=INK, linewidth=0.6, linestyle=":")
    axes = panels[-1]
    _style(axes, f"step limit at {_plain(LIMIT_DEPTHS[-1])}", "tau ds at the peak of tau", "")
    for record in limits[-len(METHODS) :]:  # those of the densest medium
        theory, color = METHODS[record["method"]][2:4]
        axes.plot(record["tau_ds"], np.minimum(record["errors"], 1e6), color=color, linewidth=1.4)  # some are inf
        if np.isfinite(theory):
            axes.axvline(theory, color=color, linewidth=1, linestyle="--")
    axes.set_ylim(1e-16, 1e3)
    axes.set_xticks([1, 2, 5, 10, 20], labels=["1", "2", "5", "10", "20"])
    axes.minorticks_off()
    lines = [axes.plot([], [], color=color, marker=marker, markersize=4)[0] for *_, color, marker in METHODS.values()]
    cross = axes.plot([], [], "x", color=INK)[0]
    dashed = axes.plot([], [], "--", color=INK, linewidth=1)[0]
    labels = [*METHODS, "unstable: error above 1", "stability limit for constant tau"]
    figure.legend([*lines, cross, dashed], labels, loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    with atomic_write(path) as temporary:
        figure.savefig(temporary)


def _style(axes: Any, title: str, x: str, y: str) -> None:
    axes.set_title(title, loc="left", fontsize=10, fontweight="bold", color=INK)
    axes.set_xlabel(x, fontsize=9, color=INK)
    axes.set_ylabel(y, fontsize=9, color=INK)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["bottom", "left"]].set_color(FAINT)
    axes.tick_params(labelsize=8, labelcolor=INK, color=FAINT)
    axes.grid(color=FAINT, linewidth=0.5)
    axes.set_axisbelow(True)


def plot_maps(path: Path, scenes: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Draw for each scene the truth, the renderer's image, and where each rung of the ladder is wrong."""
    from matplotlib.colors import LogNorm  # noqa: PLC0415 - half a second, only for pictures
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(WIDTH, 4.2), dpi=DPI, layout="compressed", facecolor="white")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.02, hspace=0.02)
    grid = figure.subplots(len(scenes), 1 + len(PARENT))
    shown = None
    for row, (scene, images) in zip(grid, scenes.items(), strict=True):
        row[0].imshow(images["truth"].clip(0, 1))
        row[0].set_ylabel(scene.replace(" at", "\nat"), fontsize=8, color=INK)
        for axes, rung in zip(row[1:], PARENT, strict=True):
            error = np.abs(images[rung] - images["truth"]).mean(-1)
            shown = axes.imshow(error.clip(LEAST_ERROR), cmap="inferno", norm=LogNorm(LEAST_ERROR, 0.3))
            mean = f"{error.mean():.1e}" if error.mean() > 1e-12 else "exact"
            axes.set_xlabel(mean, fontsize=8, color=INK, labelpad=2)
        for axes in row:
            axes.set_xticks([])
            axes.set_yticks([])
            axes.spines[:].set_visible(False)
    for axes, title in zip(grid[0], ("truth", *PARENT), strict=True):
        axes.set_title(title, fontsize=8, fontweight="bold", color=INK)
    bar = figure.colorbar(shown, ax=grid, orientation="horizontal", fraction=0.05, aspect=70, extend="both")
    bar.set_label("|error|, mean of the channels (colors 0 to 1); under each map its mean", fontsize=8)
    bar.ax.tick_params(labelsize=8, labelcolor=INK)
    with atomic_write(path) as temporary:
        figure.savefig(temporary)

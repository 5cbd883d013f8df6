"""Splats against the emission-absorption equation: integrators on stiff media, and what splatting's shortcuts cost.

The physics, in float64, is benchmarks/light.py; here are the media and scenes, the measurements and tables.

    python benchmarks/volume.py [--out docs/compare]
"""

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import light as physics
import maps
import numpy as np
from common import parse, transcribe
from light import Volume
from panels import Panel, draw_panels

from warp_splat.camera import Camera
from warp_splat.compare.scenes import make_camera
from warp_splat.evaluation.report import BLUE, GREEN, INK, ORANGE
from warp_splat.formats.files import write_csv, write_json
from warp_splat.text import format_table, table_of

#: name: (integrator, evaluations of the medium per step, largest stable tau ds in theory, color, marker)
METHODS = {
    "exponential": (physics.integrate_exponential, 1, np.inf, BLUE, "o"),
    "Euler": (physics.integrate_euler, 1, 2.0, ORANGE, "s"),
    "RK4": (physics.integrate_rk4, 2, 2.785293563405282, GREEN, "^"),
}
RAYS = 64
FAR = 20.0  # world units; the media of the integrators lie between 0 and here
OPTICAL_DEPTHS = (1e-2, 1.0, 1e2, 1e4, 1e6)
SAMPLES = [2**k for k in range(3, 13)]
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
SHOWN = (8, 64, 512, 4096)  # samples, in the table of the integrators
LIMITS = {
    **{"medium": "{medium}", "integrator": "{method}"},
    "theory (constant tau)": lambda record: "none" if np.isinf(record["theory"]) else f"{record['theory']:.3f}",
    "measured": lambda record: "none found" if np.isinf(record["measured"]) else f"{record['measured']:.3f}",
}
LADDER = {
    **{"scene": "{scene}", "rung": "{rung}", "mean error": "{mean:.1e}", "max error": "{max:.1e}"},
    **{"PSNR [dB]": "{psnr:.1f}", "changes": "{parent}", "own mean": "{own_mean:.1e}", "own max": "{own_max:.1e}"},
}


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


def _camera(focal: float = 48.0) -> Camera:
    return make_camera(48, 48, focal, seed=None)


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


def plain(number: float) -> str:
    """0.01 and 1,000,000, not 1e+06."""
    return f"{number:,.0f}" if number >= 1 else f"{number:g}"


def compare_with_physics(out: Path, say: Callable[[str], None] = print) -> dict[str, list[dict[str, Any]]]:
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
    say(table_of(limits, LIMITS))
    images, ladder = measure_ladder()
    say("\nSplatting against the truth (colors 0 to 1; 300 dB is exact); own: against the rung that it changes\n")
    say(table_of(ladder, LADDER))
    doubt = max(record["truth_error"] for record in integrators + ladder)
    say(f"\nThe truths change by at most {doubt:.1e} when their panels are doubled.")
    results = {"integrators": integrators, "limits": limits, "ladder": ladder}
    write_json(out / "volume.json", results)
    flat = [{"table": table, **record} for table, records in results.items() for record in records]
    curves = ("tau_ds", "errors")  # in the JSON only
    write_csv(out / "volume.csv", [{key: row[key] for key in row if key not in curves} for row in flat])
    plot_integrators(out / "volume_stiff.png", integrators, limits)
    rows = {
        name.replace(" at", "\nat"): [
            ("truth", images[name]["truth"], None),
            *((rung, images[name]["truth"], images[name][rung]) for rung in PARENT),
        ]
        for name in PICTURED
    }
    maps.plot_maps(out / "volume_maps.png", rows, 4.2, LEAST_ERROR)
    return results


def measure_integrators() -> list[dict[str, Any]]:
    """Error and run time of each integrator at each optical depth and number of samples."""
    records = []
    for optical_depth in OPTICAL_DEPTHS:
        profile, volume = stiff_medium(optical_depth)
        medium, peak = profile.medium(volume.colors), _peak(profile)
        truth, doubled = (physics.integrate_exact(profile, volume.colors, volume.background, n) for n in (128, 256))
        ways = list(itertools.product(METHODS, SAMPLES))
        seconds, radiance = {way: [] for way in ways}, {}
        for _, (name, count), warm in itertools.product(range(REPEATS), ways, (False, True)):
            # interleaved, so that a disturbance meets all alike; the first time makes memory and caches ready
            integrate, evaluations, *_ = METHODS[name]
            start = time.perf_counter()
            radiance[name, count] = integrate(medium, 0.0, FAR, count // evaluations, volume.background)
            seconds[name, count] += [time.perf_counter() - start] * warm
        for name, count in ways:
            error = _error(radiance[name, count], truth)
            found = {"optical_depth": optical_depth, "method": name, "samples": count}
            found |= {"peak_tau_ds": peak * FAR * METHODS[name][1] / count, "error": error}
            found |= {"stable": error < UNSTABLE, "seconds": float(np.median(seconds[name, count]))}
            records.append({**found, "truth_error": _error(truth, doubled)})
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
            found = {"measured": measured, "tau_ds": tau_ds.tolist(), "errors": errors}
            medium_name = f"Gaussians, optical depth {plain(optical_depth)}"
            records.append({"medium": medium_name, "method": name, "theory": theory, **found})
    return records


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
            found = {"mean": float(error.mean()), "max": float(error.max())}
            found["psnr"] = float(-10 * np.log10(max((error**2).mean(), 1e-30)))
            found |= {"parent": parent, "own_mean": float(own.mean()), "own_max": float(own.max())}
            records.append({"scene": scene, "rung": rung, **found, "truth_error": truth_error})
    return images, records


def _integrator_table(records: Sequence[Mapping[str, Any]]) -> str:
    rows: dict[tuple[str, str], list[str]] = {}
    for r in records:
        if r["samples"] in SHOWN:
            error = f"{r['error']:.1e}" if r["stable"] else "unstable"
            row = rows.setdefault((plain(r["optical_depth"]), r["method"]), [])
            row.append(f"{error} ({1e3 * r['seconds']:.2g} ms)")
    headers = ["optical depth", "integrator", *(f"{count} samples" for count in SHOWN)]
    return format_table(headers, [[*key, *cells] for key, cells in rows.items()])


def plot_integrators(path: Path, integrators: Sequence[Mapping[str, Any]], limits: Sequence[Mapping[str, Any]]) -> None:
    """Draw error against run time, a panel for each optical depth, and error against tau ds around the limits."""
    drawn = []
    for optical_depth in OPTICAL_DEPTHS:
        title, x = f"optical depth {plain(optical_depth)}", f"run time for {RAYS} rays [ms]"
        drawn.append(panel := Panel(title, x))
        for place, (name, (*_, color, marker)) in enumerate(METHODS.items()):
            for stable in (True, False):
                chosen = [r for r in integrators if (r["optical_depth"], r["method"]) == (optical_depth, name)]
                chosen = [r for r in chosen if r["stable"] == stable]
                # crosses in rows of their own, above every error
                errors = [r["error"] if stable else 6.0 * 10**place for r in chosen]
                label, marks = (name, marker) if stable else ("unstable: error above 1", "x")
                seconds, line = [1e3 * r["seconds"] for r in chosen], {"ls": "-", "lw": 1.4} if stable else {}
                panel.marks(label, seconds, errors, (color, marks), **line)
    title = f"step limit at {plain(LIMIT_DEPTHS[-1])}"
    drawn.append(panel := Panel(title, "tau ds at the peak of tau", ticks=True))
    for record in limits[-len(METHODS) :]:  # those of the densest medium
        theory, color = record["theory"], METHODS[record["method"]][3]
        panel.line("", record["tau_ds"], np.minimum(record["errors"], 1e6), color=color, lw=1.4)
        panel.line("stability limit for constant tau", [theory] * 2, [1e-16, 1e3], color=INK, lw=1, ls="--")
    draw_panels(path, drawn, 3, 2.3, "largest error of the radiance (colors 0 to 1)", ylim=(1e-16, 1e3))


def main() -> None:
    transcribe("volume", parse(__doc__).out, compare_with_physics)


if __name__ == "__main__":
    main()

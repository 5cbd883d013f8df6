"""Splats against physics, measured: how three integrators fare on stiff media, and what each splatting shortcut costs.

The physics is :mod:`warp_splat.compare.volume.light`; here are the media and scenes, the measurements and tables.
"""

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warp_splat.compare import plots
from warp_splat.compare.volume import light as physics
from warp_splat.compare.volume import media
from warp_splat.evaluation.report import INK
from warp_splat.formats.atomic import write_csv, write_json
from warp_splat.text import format_table, table_of

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
    say(f"Error of C(0), the largest of {media.RAYS} rays, by samples per ray (and run time for all rays)\n")
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
    maps = {
        name.replace(" at", "\nat"): [
            ("truth", images[name]["truth"], None),
            *((rung, images[name]["truth"], images[name][rung]) for rung in media.PARENT),
        ]
        for name in media.PICTURED
    }
    plots.plot_maps(out / "volume_maps.png", maps, 4.2, media.LEAST_ERROR)
    return results


def measure_integrators() -> list[dict[str, Any]]:
    """Error and run time of each integrator at each optical depth and number of samples."""
    records = []
    for optical_depth in media.OPTICAL_DEPTHS:
        profile, volume = media.stiff_medium(optical_depth)
        medium, peak = profile.medium(volume.colors), _peak(profile)
        truth, doubled = (physics.integrate_exact(profile, volume.colors, volume.background, n) for n in (128, 256))
        ways = list(itertools.product(media.METHODS, media.SAMPLES))
        seconds, radiance = {way: [] for way in ways}, {}
        for _, (name, count), warm in itertools.product(range(media.REPEATS), ways, (False, True)):
            # interleaved, so that a disturbance meets all alike; the first time makes memory and caches ready
            integrate, evaluations, *_ = media.METHODS[name]
            start = time.perf_counter()
            radiance[name, count] = integrate(medium, 0.0, media.FAR, count // evaluations, volume.background)
            seconds[name, count] += [time.perf_counter() - start] * warm
        for name, count in ways:
            error = _error(radiance[name, count], truth)
            found = {"optical_depth": optical_depth, "method": name, "samples": count}
            found |= {"peak_tau_ds": peak * media.FAR * media.METHODS[name][1] / count, "error": error}
            found |= {"stable": error < media.UNSTABLE, "seconds": float(np.median(seconds[name, count]))}
            records.append({**found, "truth_error": _error(truth, doubled)})
    return records


def measure_limits() -> list[dict[str, Any]]:
    """The largest stable tau ds, tau at its peak: in a slab of constant tau, and on a ray through Gaussians.

    There a larger step may pass, since the near flank damps what the dense core has amplified; the denser the medium,
    the more steps amplify, until nothing can damp them, and the limit falls to that of the slab.
    """
    records = []
    for name, (integrate, _, theory, *_) in media.METHODS.items():
        records.append({"medium": "slab", "method": name, "theory": theory, "measured": _slab_limit(integrate)})
    for optical_depth in media.LIMIT_DEPTHS:
        profile, volume = media.stiff_medium(optical_depth, rays=1)
        medium = profile.medium(volume.colors)
        truth = physics.integrate_exact(profile, volume.colors, volume.background, 128)
        for name, (integrate, _, theory, *_) in media.METHODS.items():
            steps = np.unique((_peak(profile) * media.FAR / np.geomspace(1, 20, 60)).astype(int))
            errors = [_error(integrate(medium, 0.0, media.FAR, int(n), volume.background), truth) for n in steps]
            tau_ds = _peak(profile) * media.FAR / steps
            bad = np.flatnonzero(~(np.array(errors) < media.UNSTABLE))
            measured = np.inf if not len(bad) else float(tau_ds[bad[-1] + 1])
            found = {"measured": measured, "tau_ds": tau_ds.tolist(), "errors": errors}
            medium_name = f"Gaussians, optical depth {media.plain(optical_depth)}"
            records.append({"medium": medium_name, "method": name, "theory": theory, **found})
    return records


def _error(radiance: np.ndarray, truth: np.ndarray) -> float:
    """The largest difference; inf where a result is no number."""
    return float(np.nan_to_num(np.abs(radiance - truth), nan=np.inf).max())


def _peak(profile: physics.Profile) -> float:
    """The largest extinction on the first ray, 1 / world unit."""
    return float(profile.extinction(np.linspace(0, media.FAR, 4001)[:, None]).sum(-1)[:, 0].max())


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
    for scene, make in media.SCENES.items():
        volume, camera = make()
        truth = physics.render_volume(volume, camera)
        truth_error = _error(physics.render_volume(volume, camera, panels=32), truth)
        images[scene] = {"truth": truth, **physics.splat_ladder(volume, camera)}
        for rung, parent in media.PARENT.items():
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
            row = rows.setdefault((media.plain(r["optical_depth"]), r["method"]), [])
            row.append(f"{error} ({1e3 * r['seconds']:.2g} ms)")
    headers = ["optical depth", "integrator", *(f"{count} samples" for count in SHOWN)]
    return format_table(headers, [[*key, *cells] for key, cells in rows.items()])


def plot_integrators(path: Path, integrators: Sequence[Mapping[str, Any]], limits: Sequence[Mapping[str, Any]]) -> None:
    """Draw error against run time, a panel for each optical depth, and error against tau ds around the limits."""
    panels = []
    for optical_depth in media.OPTICAL_DEPTHS:
        title, x = f"optical depth {media.plain(optical_depth)}", f"run time for {media.RAYS} rays [ms]"
        panels.append(panel := plots.Panel(title, x))
        for place, (name, (*_, color, marker)) in enumerate(media.METHODS.items()):
            for stable in (True, False):
                chosen = [r for r in integrators if (r["optical_depth"], r["method"]) == (optical_depth, name)]
                chosen = [r for r in chosen if r["stable"] == stable]
                # crosses in rows of their own, above every error
                errors = [r["error"] if stable else 6.0 * 10**place for r in chosen]
                label, marks = (name, marker) if stable else ("unstable: error above 1", "x")
                seconds, line = [1e3 * r["seconds"] for r in chosen], {"ls": "-", "lw": 1.4} if stable else {}
                panel.marks(label, seconds, errors, (color, marks), **line)
    title = f"step limit at {media.plain(media.LIMIT_DEPTHS[-1])}"
    panels.append(panel := plots.Panel(title, "tau ds at the peak of tau", ticks=True))
    for record in limits[-len(media.METHODS) :]:  # those of the densest medium
        theory, color = record["theory"], media.METHODS[record["method"]][3]
        panel.line("", record["tau_ds"], np.minimum(record["errors"], 1e6), color=color, lw=1.4)
        panel.line("stability limit for constant tau", [theory] * 2, [1e-16, 1e3], color=INK, lw=1, ls="--")
    plots.draw_panels(path, panels, 3, 2.3, "largest error of the radiance (colors 0 to 1)", ylim=(1e-16, 1e3))

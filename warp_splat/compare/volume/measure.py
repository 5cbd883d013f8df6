"""Splats against physics, measured: how three integrators fare on stiff media, and what each splatting shortcut costs.

The physics is :mod:`warp_splat.compare.volume.light`; here are the media and scenes, the measurements and tables.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warp_splat.compare.volume import light as physics
from warp_splat.compare.volume import media
from warp_splat.compare.volume.maps import plot_integrators, plot_maps
from warp_splat.formats.atomic import write_csv, write_json
from warp_splat.text import format_table


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
    plot_maps(out / "volume_maps.png", {name: images[name] for name in media.PICTURED})
    return results


def measure_integrators() -> list[dict[str, Any]]:
    """Error and run time of each integrator at each optical depth and number of samples."""
    records = []
    for optical_depth in media.OPTICAL_DEPTHS:
        profile, volume = media.stiff_medium(optical_depth)
        medium = profile.medium(volume.colors)
        truth = physics.integrate_exact(profile, volume.colors, volume.background, 128)
        doubled = physics.integrate_exact(profile, volume.colors, volume.background, 256)
        seconds: dict[tuple[str, int], list[float]] = {
            (name, count): [] for name in media.METHODS for count in media.SAMPLES
        }
        radiance = {}
        for _ in range(media.REPEATS):  # interleaved, so that a disturbance meets all alike
            for (name, count), times in seconds.items():
                radiance[name, count] = _integrate(name, medium, count, volume.background)  # memory and caches ready
                start = time.perf_counter()
                _integrate(name, medium, count, volume.background)
                times.append(time.perf_counter() - start)
        records += [
            {
                **{"optical_depth": optical_depth, "method": name, "samples": count},
                "peak_tau_ds": _peak(profile) * media.FAR * media.METHODS[name][1] / count,
                "error": _error(radiance[name, count], truth),
                "stable": _error(radiance[name, count], truth) < media.UNSTABLE,
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


def _integrate(name: str, medium: physics.Medium, samples: int, background: np.ndarray) -> np.ndarray:
    integrate, evaluations, *_ = media.METHODS[name]
    return integrate(medium, 0.0, media.FAR, samples // evaluations, background)


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
    shown = (8, 64, 512, 4096)
    cells = {(r["optical_depth"], r["method"], r["samples"]): r for r in records}

    def cell(record: Mapping[str, Any]) -> str:
        error = f"{record['error']:.1e}" if record["stable"] else "unstable"
        return f"{error} ({1e3 * record['seconds']:.2g} ms)"

    rows = [
        [media.plain(depth), name, *(cell(cells[depth, name, count]) for count in shown)]
        for depth in media.OPTICAL_DEPTHS
        for name in media.METHODS
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

    quality = [[f"{r['psnr']:.1f}", r["parent"]] for r in records]
    rows = [
        [r["scene"], r["rung"], *cells(r, "mean", "max"), *middle, *cells(r, "own_mean", "own_max")]
        for r, middle in zip(records, quality, strict=True)
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
    write_csv(path, rows)

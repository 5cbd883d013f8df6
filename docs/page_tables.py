"""Tables in pages that no script of benchmarks/ writes as they stand: put together from its files.

A page has ``<!-- NAME -->`` where one goes; docs/make_pages.py writes it there.
"""

import figures as f
import numpy as np

from warp_splat.kernels.falloff import EXP2


def modes() -> str:
    """The README's table."""
    derived = {
        "manual": "hand",
        "stepwise": "hand (loop), Warp (its body)",
        "reversible": "Warp, T recovered by an inverse step",
        "stored": "Warp, every T kept in memory",
    }
    lines = ["| mode | derived by | time of the adjoint | peak memory | error |", "| --- | --- | ---: | ---: | ---: |"]
    for mode, by in derived.items():
        shown = f.two if mode in ("manual", "stepwise") else f.one
        time = "1" if mode == "manual" else " to ".join(f.span(f.times_manual(mode), shown))
        error = " to ".join(f.span(f.errors(mode), f.small))
        lines.append(f"| `{mode}` | {by} | {time} | {f.mebibytes(mode)} MiB | {error} |")
    return "\n".join(lines)


def adjoint_times() -> str:
    """The table of 100,000 Gaussians."""
    header = (
        "mode | adjoint, 1 thread | times manual | 2 threads | times manual | peak memory | lines: rules + plumbing"
    )
    lines = [f"| {header} |", "| --- |" + " ---: |" * 6]
    for mode in f.WITH_GENERATED:
        cells = []
        for threads in (1, 2):
            time = f.seconds(mode, "adjoint", threads)
            cells += [f"{1e3 * time:.0f} ms", f.two(time / f.seconds("manual", "adjoint", threads))]
        lines.append(
            f"| {mode} | {' | '.join(cells)} | {f.mebibytes(mode)} MiB | {f.rules(mode)} + {f.plumbing(mode)} |"
        )
    return "\n".join(lines)


#: By row of benchmarks/recipes.py: the paper, what it claims, and what became of it here.
INGREDIENTS = {
    "--growth budget": (
        "Mallick et al. 2024 (a budget), Deng et al. 2025 (long axis)",
        "the quality of four to five times the time and size; more, with fewer Gaussians",
        "yes, in `--preset fast`",
    ),
    "--coarse_by detail": ("Chen et al. 2025", "45.7 % less time", "yes, in `--preset fast`: 15 and 8 % less time"),
    "--preset fast": ("both", "", "yes"),
    "three quarters of all steps": ("", "", "no: for those who have less time, `--minutes`"),
    "harmonics of higher degree in every 4th step": (
        "Mallick et al. 2024 (every 16th)",
        "",
        "no: 4 % of the time, and 0.35 dB less than with the growth alone",
    ),
    "--growth mcmc": (
        "Kheradmand et al. 2024",
        "better, and robust to where it starts",
        "as `--growth mcmc`: a twentieth at a time is too slow for short schedules",
    ),
}


def camera_gradients() -> str:
    """What those of a pinhole's pose and intrinsics are off by."""
    parts = ("rotation", "translation", "focal", "principal")
    lines = [f"| projection | adjoint | {' | '.join(parts)} |", "| --- | --- |" + " ---: |" * len(parts)]
    found = [row for row in f.rows("cameras_gradients") if row["camera"] == "pinhole, 90 degrees"]
    for way in dict.fromkeys((row["projection"], row["mode"]) for row in found):
        errors = {row["parameter"]: float(row["error"]) for row in found if (row["projection"], row["mode"]) == way}
        lines.append(f"| {' | '.join((*way, *(f'{errors[part]:.1e}' for part in parts)))} |")
    return "\n".join(lines)


def ingredients() -> str:
    """What recipes are made of: the paper, its claim, the gain here, kept or not."""
    lines = ["| ingredient | paper | gain claimed there | measured here | kept |", "| --- | --- | --- | --- | --- |"]
    data = f.data("recipes")
    rows = [dict(zip(data["headers"], row, strict=True)) for row in data["rows"]]
    for name, (paper, claimed, kept) in INGREDIENTS.items():
        gains = [f"{row['scene']} at {row['budget']}: {row['gain']} dB" for row in rows if row["recipe"] == name]
        if gains:
            lines.append(f"| {name} | {paper} | {claimed} | {'; '.join(gains)} | {kept} |")
    return "\n".join(lines)


def exponentials() -> str:
    """The largest relative error of each exponential on [0, 1), computed here; the instruction's is NVIDIA's figure."""
    lines = ["| exponential | error | with its rounding |", "| --- | ---: | ---: |"]
    z = np.linspace(0, 1, 1_000_000, endpoint=False, dtype=np.float32)
    truth = np.exp2(-z.astype(float))
    for degree, coefficients in EXP2.items():
        exact, rounded = np.zeros(z.shape), np.zeros_like(z)
        for coefficient in np.float32(coefficients)[::-1].astype(float):
            exact = exact * z + coefficient
            rounded = (rounded.astype(float) * z + coefficient).astype(np.float32)
        errors = (f"{np.abs(found / truth - 1).max():.1e}" for found in (exact, rounded))
        lines.append(f"| degree {degree} | {' | '.join(errors)} |")
    return "\n".join([*lines, "| a GPU's instruction, for degrees up to 5 | | 2.4e-07 |"])


TABLES = {
    "modes": modes,
    "camera_gradients": camera_gradients,
    "adjoint_times": adjoint_times,
    "ingredients": ingredients,
    "exponentials": exponentials,
}

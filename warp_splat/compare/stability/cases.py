"""Stiff and extreme cases: what float64 says, what every adjoint gives, and whether that is what was stated.

A catalog of named inputs at the ends of what float32 holds. Each has a stated outcome: as in float64 within a limit,
or left out and counted; never NaN or infinity where float64 is finite. ``warp-splat compare --stability`` writes the
table, and the tests run the same catalog. The bounds are those of Higham, Accuracy and Stability of Numerical
Algorithms, 2002: n eps for a product of n rounded factors, and the condition of a problem where that is larger.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from warp_splat.compare.stability import arithmetic, pixel_loop, shapes
from warp_splat.compare.stability.verdict import EPS, Case, Outcome
from warp_splat.formats.files import write_csv, write_json
from warp_splat.text import Report, format_table

CASES = (*pixel_loop.CASES, *shapes.CASES, *arithmetic.CASES)
NO_MODE = ""  # of a case that involves no adjoint


class Row(NamedTuple):
    """A case and its outcome in every mode; in ``NO_MODE`` alone where none is involved."""

    case: Case
    outcomes: dict[str, Outcome]

    @property
    def verdict(self) -> str:
        """Whether every statement held; if not in every mode, in which."""
        if not (failed := [mode for mode, outcome in self.outcomes.items() if outcome.failures]):
            return "pass"
        return "FAIL" if len(failed) == len(self.outcomes) else f"FAIL {', '.join(failed)}"


def run_cases(out: Path, modes: Sequence[str], say: Report = print) -> int:
    """Measure every case in every mode; print the table and write it.

    Args:
        out: folder for ``stability.json`` and ``stability.csv``.
        modes: of the adjoint, some of ``warp_splat.config.ADJOINTS``.
        say: prints a line.

    Returns:
        The number of verdicts (case by mode) that failed.
    """
    rows = [Row(case, {mode: case.run(mode) for mode in modes_of(case, modes)}) for case in CASES]
    say(format_table(["case", "float64 says", "value", *modes, "limit", "counted", "verdict"], table(rows, modes)))
    flat = [
        {"case": row.case.name, "group": row.case.group, "claim": row.case.claim, "mode": mode, **outcome._asdict()}
        for row in rows
        for mode, outcome in row.outcomes.items()
    ]
    write_json(out / "stability.json", {"verdicts": flat, "eps": EPS})  # nested; a line for each case and mode as CSV
    lines = [{**line, "failures": "; ".join(line["failures"])} for line in flat]
    write_csv(out / "stability.csv", lines)
    failed = [line for line in lines if line["failures"]]
    for line in failed:
        say(f"{line['case']} {line['mode']}: {line['failures']}")
    say(f"{len(failed)} of {len(lines)} verdicts failed.")
    return len(failed)


def modes_of(case: Case, modes: Sequence[str]) -> Sequence[str]:
    """The modes in which a case is run."""
    return modes if case.modal else (NO_MODE,)


def table(rows: Sequence[Row], modes: Sequence[str]) -> list[list[str]]:
    """Cells: error of the value, of the gradients in each mode and their limit, what was counted, the verdict."""
    cells = []
    for row in rows:
        first = next(iter(row.outcomes.values()))
        errors = [_error(row.outcomes.get(mode, first).gradient_error) for mode in modes]
        value = max(outcome.value_error for outcome in row.outcomes.values())
        limit = "-" if first.gradient_error is None else _error(first.gradient_limit)
        cells.append([row.case.name, first.says, _error(value), *errors, limit, first.counted, row.verdict])
    return cells


def _error(value: float | None) -> str:
    return "-" if value is None else "0" if value == 0 else f"{value:.0e}"

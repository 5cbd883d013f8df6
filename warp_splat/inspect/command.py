"""``warp-splat inspect``: all checks, a line for each finding, a page with pictures."""

import os
import sys
import time
from collections import Counter
from pathlib import Path

from warp_splat.config import InspectConfig
from warp_splat.formats.model_folder import check_output
from warp_splat.inspect import geometry, verdicts
from warp_splat.inspect.cost import check_cost
from warp_splat.inspect.page import draw_pictures, write_page
from warp_splat.inspect.subject import Finding, read_subject
from warp_splat.scene import has_cameras, read_photos
from warp_splat.sfm.forecast import time_of_cameras

COLORS = {"error": 31, "warning": 33, "note": 34, "ok": 32}  # of a terminal, the worst first


def inspect(config: InspectConfig) -> int:
    """Examine a scene as ``config`` says; returns the process's exit code: 1 if there is an error.

    Raises:
        InputError: if the folder is no scene at all, or the page cannot be written.
    """
    started = time.perf_counter()
    source = Path(config.scene)
    page = Path(config.out or Path("output") / "inspect" / f"{os.path.basename(os.path.realpath(source))}.html")
    check_output(page, endings=(".html", ".htm"))
    if not has_cameras(source):
        if source.is_dir() and not (source / "point_cloud").is_dir():
            time_of_cameras(source, print)
        read_photos(source, config.images, print)  # says what is missing
    subject, findings = read_subject(source, config.images)
    for check in (verdicts.check_cameras, *geometry.CHECKS, *verdicts.CHECKS):
        findings += check(subject)
    findings += check_cost(subject, print)
    findings.sort(key=lambda finding: list(COLORS).index(finding.level))
    verdict = _verdict(findings)
    shown = "\033[{1}m{0:7s}\033[0m" if sys.stdout.isatty() else "{0:7s}"
    for finding in findings:
        print(f"{shown.format(finding.level, COLORS[finding.level])}  {finding.check:13s} {finding.text}")
    write_page(page, f"Scene {source}", verdict, findings, draw_pictures(subject))
    print(f"{source}: {verdict} ({time.perf_counter() - started:.1f} s)\n  page {page}")
    return int(any(finding.level == "error" for finding in findings))


def _verdict(findings: list[Finding]) -> str:
    counts = Counter(finding.level for finding in findings)
    parts = [f"{counts[level]} {level}{'s' * (counts[level] > 1)}" for level in ("error", "warning") if counts[level]]
    if not parts:
        return "nothing wrong was found."
    return f"{' and '.join(parts)}; {'training would fail or be useless' if counts['error'] else 'training will work'}."

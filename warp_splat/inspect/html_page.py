"""The page of ``inspect``: one HTML file that holds its pictures and needs nothing else."""

from collections.abc import Iterable
from html import escape
from pathlib import Path

from warp_splat.formats.atomic import write_text
from warp_splat.inspect.subject import Finding

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
table { border-collapse: collapse; width: 100%; }
td { border-bottom: 1px solid #d9d9d9; padding: .35rem .6rem; vertical-align: top; white-space: nowrap; }
td:first-child { font-weight: 600; }
td:last-child { white-space: normal; overflow-wrap: anywhere; }
.ok { color: #009e73; } .note { color: #0072b2; } .warning { color: #b35900; } .error { color: #c00000; }
img { max-width: 100%; } figure { margin: 2rem 0; } figcaption { font-weight: 600; margin-bottom: .4rem; }
"""


def write_page(
    path: Path, title: str, verdict: str, findings: list[Finding], pictures: Iterable[tuple[str, str]]
) -> None:
    """Write the verdict, a row for each finding, and the pictures (captions, addresses of data).

    Raises:
        InputError: if the file cannot be written.
    """
    rows = "\n".join(
        f'<tr><td class="{finding.level}">{finding.level}</td><td>{escape(finding.check)}</td>'
        f"<td>{escape(finding.text)}</td></tr>"
        for finding in findings
    )
    figures = "\n".join(
        f'<figure><figcaption>{escape(caption)}</figcaption><img src="{address}" alt="{escape(caption)}"></figure>'
        for caption, address in pictures
    )
    write_text(
        path,
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{STYLE}</style></head>\n<body><h1>{escape(title)}</h1><p>{escape(verdict)}</p>\n"
        f"<table>\n{rows}\n</table>\n{figures}\n</body></html>\n",
    )

"""What pages repeat, from where it stands: ``python docs/make_pages.py``.

- docs/flags.md, docs/flags_train.md and docs/presets.md, from the configurations.
- Between ``<!-- NAME -->`` and ``<!-- end -->``: what benchmarks/NAME.py wrote, a table of docs/page_tables.py, or, for
  ``imports``, the package's imports.
- Figures in running text: see docs/sentences.py.
- docs/images/architecture.svg, from the imports.
"""

import argparse
import re
import textwrap
from collections.abc import Iterable
from pathlib import Path

import make_architecture
import page_tables
import sentences

from warp_splat.cli import COMMANDS
from warp_splat.flags import default_of, flags_of, purpose_of
from warp_splat.presets import EMBEDDED_DEFAULTS, PRESETS

DOCS = Path(__file__).parent
PAGES = [DOCS.parent / "README.md", *sorted(DOCS.glob("*.md"))]
PICTURE = DOCS / "images" / "architecture.svg"
TABLE = re.compile(r"<!-- (\w+) -->\n.*?<!-- end -->", re.DOTALL)
INTRODUCTION = """# Every flag

What each command can be told, as `--help` says it. `python docs/make_pages.py` wrote this page. Flags that are on or
off have a `--no-` form. Those of `warp-splat train` have [a page of their own](flags_train.md). `render.py` is
`warp-splat render`, and `python -m warp_splat.compare` is `warp-splat compare`.

Exit codes: 0; 1 for bad input, of which one sentence says what is wrong, and where `inspect` found an error, `audit` or
`compare --stability` something that is off; 2 for words that make no command, such as a value that is no number; 130
for what Ctrl-C ended, such as a training, whose model is saved.
"""
TRAINING = """# Every flag of a training

What `uv run train.py` (which is `warp-splat train`) can be told, as its `--help` says it. `python docs/make_pages.py`
wrote this page. Flags that are on or off have a `--no-` form. The other commands have theirs [here](flags.md).
A few flags of the reference are refused, with the reason: `--debug`, `--ip`, `--train_test_exp` and others.
"""
PRESET_TEXT = """# What presets change

`uv run train.py -s path/to/scene --preset fast` trains in less time: these are the flags that it stands for, and those
that training the embedded scene (without `-s`) starts from. A flag that is given takes precedence.
"""


def filled(page: Path) -> str:
    """The text of a page, with tables and figures as they were measured."""

    def table(found: re.Match) -> str:
        name, written = found[1], DOCS / "benchmarks" / f"{found[1]}.md"
        make = {**page_tables.TABLES, "imports": make_architecture.table}.get(name, written.read_text)
        lines = [line if line.startswith("|") else textwrap.fill(line, 120) for line in make().strip().split("\n")]
        return "\n".join([f"<!-- {name} -->", *lines, "<!-- end -->"])

    if page.name in GENERATED:
        return GENERATED[page.name]()
    return sentences.filled(page.name, TABLE.sub(table, page.read_text()))


def flags(introduction: str, names: Iterable[str]) -> str:
    """The page of the flags of some commands."""
    parts = [introduction]
    for name in names:
        config_type, _ = COMMANDS[name]
        parts.append(f"\n## warp-splat {name}\n{purpose_of(config_type)}\n")
        heading = None
        for item in flags_of(config_type):
            what = item.metadata["help"].replace("|", "\\|")
            if item.metadata["group"] is None:
                parts.append(f"\n`{item.name.upper()}`: {what}.\n")
                continue
            if item.metadata["group"] != heading:
                heading = item.metadata["group"]
                title = f"{heading[0].upper()}{heading[1:]}" if heading else "Flag"
                parts.append(f"\n| {title} | default | |\n| --- | --- | --- |\n")
            names = ", ".join(f"`{flag}`" for flag in (f"--{item.name}", *item.metadata["names"]))
            choices = [str(choice) for choice in item.metadata["choices"] or () if choice != ""]
            note = f" ({', '.join(choices)})" if choices else ""
            parts.append(f"| {names} | {_shown(default_of(item))} | {what}{note} |\n")
    return "".join(parts)


def presets() -> str:
    """The page of presets."""
    parts = [PRESET_TEXT]
    columns = {"fast": PRESETS["fast"], "embedded": EMBEDDED_DEFAULTS[""]}
    columns["embedded, fast"] = {**EMBEDDED_DEFAULTS[""], **PRESETS["fast"], **EMBEDDED_DEFAULTS["fast"]}
    changed = list(dict.fromkeys(name for values in columns.values() for name in values))
    parts.append("\n| flag | default | " + " | ".join(columns) + " |\n" + "| --- " * (2 + len(columns)) + "|\n")
    train = COMMANDS["train"][0]().flat()
    for name in changed:
        cells = [_shown(values.get(name, "")) for values in columns.values()]
        parts.append(f"| `--{name}` | {_shown(train[name])} | {' | '.join(cells)} |\n")
    return "".join(parts)


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, list):
        return " ".join(map(str, value))
    return str(value)


GENERATED = {
    "flags.md": lambda: flags(INTRODUCTION, [name for name in COMMANDS if name != "train"]),
    "flags_train.md": lambda: flags(TRAINING, ["train"]),
    "presets.md": presets,
}

if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    PICTURE.write_text(make_architecture.picture())
    for page in PAGES:
        page.write_text(filled(page))

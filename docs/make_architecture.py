"""The picture and the table of docs/architecture.md, drawn from the imports; docs/make_pages.py calls it.

A room is a folder of the package or a module beside them. The layers are those of tests/test_layers.py.
"""

import ast
import sys
import textwrap
from html import escape
from itertools import permutations
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from test_layers import LAYERS, PACKAGE, imported  # noqa: E402

COLUMNS = 5
WIDTH, HEIGHT, BESIDE, BELOW, LINE = 176, 90, 24, 36, 14  # px: a box, the space beside and below it, a line of text
LETTER = 5.9  # px of a letter of 11 px, at most
HIDDEN = 1000  # px of length that an arrow behind a box costs
STYLE = """
text { font: 11px sans-serif; fill: #222 } .name { font: bold 14px sans-serif }
rect { fill: #eef3fa; stroke: #7d95b5 } .wing { fill: #d9e5f4 } path { fill: none; stroke: #93a3b8 }
"""
TIP = """<marker id="tip" orient="auto" markerWidth="8" markerHeight="8" refX="7" refY="4">
<path d="M1,1 L7,4 L1,7"/></marker>"""


def rooms() -> list[list[str]]:
    """Names by layer, the lowest first."""
    return [sorted(name for name in layer if not name.startswith("__")) for layer in LAYERS]


def imports() -> dict[str, set[str]]:
    """By room: those that it imports from."""
    found = {name: set() for row in rooms() for name in row}
    for path in PACKAGE.rglob("*.py"):
        room = path.relative_to(PACKAGE).with_suffix("").parts[0]
        targets = {name.split(".")[1] for name in imported(path) if name.startswith("warp_splat.")}
        if room in found and path.stem != "__main__":
            found[room] |= targets & (found.keys() - {room})
    return found


def purpose(room: str) -> str:
    """The first sentence of a room's docstring."""
    path = PACKAGE / room / "__init__.py"
    text = (path if path.exists() else PACKAGE / f"{room}.py").read_text()
    return ast.get_docstring(ast.parse(text)).splitlines()[0].split(". ")[0].rstrip(".").replace("``", "")


def table() -> str:
    """Every room, from the top of the house down."""
    lines = ["| room | what for | imports from |", "| --- | --- | --- |"]
    found = imports()
    for row in reversed(rooms()):
        for room in row:
            name = f"`{room}/`" if (PACKAGE / room).is_dir() else f"`{room}.py`"
            lines.append(f"| {name} | {purpose(room)} | {', '.join(sorted(found[room]))} |")
    return "\n".join(lines)


def picture() -> str:
    """An SVG of the rooms. Left out: arrows that follow from two others, and those to the lowest layer."""
    arrows = [arrow for arrow in _direct(imports()) if arrow[1] not in LAYERS[0]]
    places = _places(arrows)
    width, height = COLUMNS * (WIDTH + BESIDE) + BESIDE, len(LAYERS) * (HEIGHT + BELOW) + BELOW
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}">',
        f"<style>{STYLE}</style>",
        TIP,
        f'<rect width="{width}" height="{height}" style="fill: white; stroke: none"/>',
    ]
    for arrow in arrows:
        (x, y), (to_x, to_y) = _ends(places, arrow)
        bend = f"C{x},{y - BELOW} {to_x},{y - BELOW}" if y == to_y else "L"  # within a row: over the roofs
        parts.append(f'<path marker-end="url(#tip)" d="M{x},{y} {bend} {to_x},{to_y}"/>')
    for room, (column, level) in places.items():
        x, y = _corner(column, level)
        kind = ' class="wing"' if (PACKAGE / room).is_dir() else ""
        parts.append(f'<rect{kind} x="{x}" y="{y}" width="{WIDTH}" height="{HEIGHT}" rx="6"/>')
        parts.append(f'<text class="name" x="{x + 8}" y="{y + 19}">{room}</text>')
        for number, line in enumerate(textwrap.wrap(purpose(room), int((WIDTH - 12) / LETTER))):
            parts.append(f'<text x="{x + 8}" y="{y + 36 + LINE * number}">{escape(line)}</text>')
    return "\n".join([*parts, "</svg>\n"])


def _direct(found: dict[str, set[str]]) -> list[tuple[str, str]]:
    """Arrows without those that follow from others."""

    def reached(room: str) -> set[str]:
        return found[room].union(*(reached(other) for other in found[room]))

    indirect = {room: set().union(*(reached(other) for other in found[room])) for room in found}
    return sorted((room, other) for room in found for other in found[room] - indirect[room])


def _places(arrows: list[tuple[str, str]]) -> dict[str, tuple[int, int]]:
    """Column and layer of each room: arrows short, and seldom behind a box. Layer by layer, until nothing improves."""
    places = {room: (column, level) for level, row in enumerate(rooms()) for column, room in enumerate(row)}
    cost = None
    while cost != (cost := _cost(places, arrows)):
        for level, row in enumerate(rooms()):
            orders = permutations(range(COLUMNS), len(row))
            choices = [places | {room: (at, level) for room, at in zip(row, order, strict=True)} for order in orders]
            places = min([places, *choices], key=lambda choice: _cost(choice, arrows))
    return places


def _cost(places: dict[str, tuple[int, int]], arrows: list[tuple[str, str]]) -> float:
    taken, cost = set(places.values()), 0.0
    for a, b in arrows:
        (x, y), (to_x, to_y) = places[a], places[b]
        cost += abs(to_x - x) * (WIDTH + BESIDE)
        for level in range(to_y + 1, y):
            share = (y - level) / (y - to_y)
            at = x + share * (to_x - x)  # the column where it crosses this layer
            cost += sum(HIDDEN for column in range(COLUMNS) if abs(column - at) < 0.5 and (column, level) in taken)
    return cost


def _corner(column: int, level: int) -> tuple[int, int]:
    return BESIDE + column * (WIDTH + BESIDE), BELOW + (len(LAYERS) - 1 - level) * (HEIGHT + BELOW)


def _ends(places: dict[str, tuple[int, int]], arrow: tuple[str, str]) -> list[tuple[int, int]]:
    """Where an arrow begins and ends, on the edges of two boxes, each a little towards the other."""
    (column, level), (to_column, to_level) = (places[room] for room in arrow)
    (x, y), (to_x, to_y) = _corner(column, level), _corner(to_column, to_level)
    lean = max(-1, min(1, to_column - column)) * WIDTH // 3
    return [(x + WIDTH // 2 + lean, y + HEIGHT * (level != to_level)), (to_x + WIDTH // 2 - lean, to_y)]

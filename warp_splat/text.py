"""Tables and lists as text."""

import math
import re
import string
from collections.abc import Callable, Iterable, Mapping, Sequence
from decimal import ROUND_CEILING, Context

from warp_splat.errors import InputError

Report = Callable[[str], object]  # is called with a line for each thing that the user should know
NUMBER = re.compile(r"[-+]?[\d.,]+(e[-+]?\d+)?\s?\S{0,4}|-?|inf|nan")
NAMED = 3  # things that a message names


def few(names: Iterable[str]) -> str:
    """The first names, and how many more there are."""
    names = list(names)
    return ", ".join(names[:NAMED]) + f" and {len(names) - NAMED} more" * (len(names) > NAMED)


def upward(number: float) -> str:
    """Two digits of a number that is not negative, which it does not exceed."""
    return f"{float(Context(prec=2, rounding=ROUND_CEILING).create_decimal(repr(float(number)))):.2g}"


def format_table(headers: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table that reads well in a terminal and is Markdown: columns padded, columns of numbers to the right.

    Args:
        headers: one for each column.
        rows: cells, written by ``str``; the first column is always text.

    Raises:
        InputError: if a row has another length than the headers.
    """
    table = [[str(cell).replace("|", "\\|") for cell in row] for row in (headers, *rows)]
    if any(len(row) != len(headers) for row in table):
        raise InputError(f"rows: expected {len(headers)} cells each, got {sorted({len(row) for row in table})}.")
    columns = []
    for place, (head, *cells) in enumerate(zip(*table, strict=True)):
        to_right = place > 0 and all(NUMBER.fullmatch(cell) for cell in cells)
        width = max(3, *(len(cell) for cell in (head, *cells)))
        rule = "-" * (width - 1) + (":" if to_right else "-")
        columns.append([f"{cell:{'>' if to_right else '<'}{width}}" for cell in (head, rule, *cells)])
    return "\n".join(f"| {' | '.join(line)} |" for line in zip(*columns, strict=True))


def table_of(records: Iterable[Mapping], columns: Mapping[str, str | Callable[[Mapping], object]]) -> str:
    """A table of records, by header: what :meth:`str.format` makes of one, or a function of it.

    A cell whose number is missing, None or NaN, is "-".
    """
    return format_table(list(columns), cells_of(records, columns))


def cells_of(records: Iterable[Mapping], columns: Mapping[str, str | Callable[[Mapping], object]]) -> list[list]:
    """The rows of :func:`table_of`."""
    return [[_cell(record, column) for column in columns.values()] for record in records]


def _cell(record: Mapping, column: str | Callable[[Mapping], object]) -> object:
    if callable(column):
        return column(record)
    values = [record.get(name) for _, name, _, _ in string.Formatter().parse(column) if name]
    missing = any(value is None or (isinstance(value, float) and math.isnan(value)) for value in values)
    return "-" if missing else column.format(**record)
